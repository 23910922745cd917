"""Tables of text: aligned columns, a dash where nothing was measured, ratios to the first row."""

from rover_lib.onboard.columns import align, benchmark_rows, number, ratio


def test_columns_stand_under_each_other_and_what_was_not_measured_is_a_dash():
    assert align([["", "MB"], ["static", "11.9"], ["fp32", "-"]]) == ["          MB", "static  11.9", "fp32       -"]
    assert number(None) == number(float("nan")) == "-" and number(1.25) == "1.2"
    assert ratio(None, 2) is None and ratio(1, 0) is None and ratio(6, 2) == 3


def timed(p50_ms, size_mb):
    latency = {f"latency_{p}_ms": p50_ms for p in ("p50", "p95", "p99")}
    return {**latency, "size_mb": size_mb, "peak_memory_mb": None, "n": 3}


def test_ratios_are_to_the_first_artifact():
    header, fp32, static = benchmark_rows({"artifacts": {"fp32": timed(20.0, 40.0), "static": timed(5.0, 10.0)}})
    faster, smaller = (header.index(f"times {what}") for what in ("faster", "smaller"))
    assert (fp32[faster], static[faster], static[smaller], static[-2]) == ("1.0", "4.0", "4.0", "-")
