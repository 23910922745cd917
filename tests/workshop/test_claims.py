"""The sentence above a figure is computed from what it draws, and says the contrary when the data does."""

from pathlib import Path

import pytest

from rover_lib.workshop import plots
from rover_lib.workshop.plots import claims
from rover_lib.workshop.recordings.samples import Fault, Recordings, Source


def compared(fp32, static):
    return {"fp32": {"hits": fp32, "trials": 40}, "modes": {"static": {"hits": static, "trials": 40}}}


@pytest.mark.parametrize(
    ("fp32", "static", "says"),
    [
        (38, 38, "Static INT8 hits what FP32 hits: 38 of 40"),
        (40, 37, "Static INT8 hits 3 fewer of 40 than FP32"),
        (36, 38, "Static INT8 hits 2 more of 40 than FP32"),
    ],
)
def test_hits(fp32, static, says):
    assert claims.hits(compared(fp32, static)) == says


def test_nobody_drove_or_was_not_made():
    assert claims.hits({"fp32": {"hits": None, "trials": None}, "modes": {}}) == ""
    assert claims.size({"fp32": 46.5}) == ""
    assert claims.speed({"here": {"metrics": {"artifacts": {"fp32": {"latency_p50_ms": 20.0}}}}}) == ""


@pytest.mark.parametrize(
    ("static_ms", "says"), [(5.0, "4.0 times as fast"), (20.0, "as fast"), (40.0, "2.0 times as slow")]
)
def test_speed_may_be_slowness(static_ms, says):
    timed = {name: {"latency_p50_ms": ms} for name, ms in (("fp32", 20.0), ("static", static_ms))}
    assert claims.speed({"rover1": {"metrics": {"artifacts": timed}}}) == f"Static INT8 is {says} as FP32 on rover1"


def test_compensation_is_praised_where_it_helps_alone():
    found = claims.beside({0: 0.0, 30: 1.5, 75: 1.2, 300: 7.3}, {0: 0.0, 30: 1.1, 75: 2.0, 300: 7.0})
    assert found == "Compensation keeps the car closer to its path at 75 ms, and not at 30 and 300 ms"
    assert claims.beside({30: 2.0}, {30: 1.0}) == "Compensation keeps the car no closer to its path"


def test_a_balloon_lost_ends_how_late_a_plan_may_be():
    rows = [{"latency_ms": ms, "hits": hits} for ms, hits in ((0, 40), (75, 40), (150, 39), (300, 40))]
    assert claims.late_hits(rows) == "Left alone, plans may be 75 ms late and no balloon is lost"
    assert claims.late_hits([{"latency_ms": 0, "hits": 40}, {"latency_ms": 30, "hits": 1}]) == ""


def test_what_is_not_judged_is_not_claimed():
    table = {"minmax": {"steering_mae_pct": 0.5, "throttle_mae_pct": None}, "histogram": {"steering_mae_pct": 0.2}}
    assert claims.least_wrong(table) == "Histogram is least wrong: 0.20 %, the others up to 0.50 %"
    assert claims.most_sensitive({"layer4": {"throttle_mae_pct": None}}) == ""


def test_shares_of_the_work():
    found = claims.work({"backbone.stem": 10, "encoder.0": 30}, {"backbone.stem": 75, "encoder.0": 25})
    assert found == "The backbone has 75 % of the work, and 25 % of the weights"


def test_how_much_of_the_recorded_range_calibrates():
    pool = [(0.0, 0.0), (0.5, 0.1), (1.0, 0.2)]
    found = claims.coverage(pool[:2], pool, ("steering", "throttle"))
    assert found == "2 of 3 frames reach 50 % of steering and 50 % of throttle's recorded range"


def test_each_way_of_handling_a_fault_has_its_own_count():
    """4,353 faults were once said to be left out or repaired, and were neither."""
    kinds = {"serial_burst": 7, "steering_recomputed": 30, "throttle_disagrees_with_pulse": 2, "broken_jpeg": 1}
    found = tuple(Fault("episode_1/control_data.csv", kind, count, "") for kind, count in kinds.items())
    figure = plots.faults(Recordings(Path("episodes"), (), found, Source(Path("episodes"))))
    said = "7 repaired, 30 recomputed from the pulses, 2 taken as recorded, 1 left out"
    assert figure._suptitle.get_text() == f"0 episodes give 0 samples; faults: {said}"
