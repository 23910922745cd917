"""Benchmarks beside each other: this machine's, and those that were fetched from rovers."""

import json
import socket

import pytest

from rover_lib.onboard.stage import write_stage
from rover_lib.workshop import plots
from rover_lib.workshop.judge import hosts
from rover_lib.workshop.plots.minutes import NONE_YET

OURS = {"policy_static.pt": "5a", "policy_fp32.pt": "f3"}


def written(folder, name, latency_ms, *, inputs=None, artifact="policy", **sensed):
    """benchmark-<name>.json, as `rover benchmark` leaves it."""
    timed = {"mode": "static", "gmac": 0.375, "n": 20} | {f"latency_{p}_ms": latency_ms for p in ("p50", "p95", "p99")}
    metrics = {"artifacts": {artifact: timed}, "main": artifact, "threads": 3, **sensed}
    path = folder / f"benchmark-{name}.json"
    write_stage(path, "benchmark", params={}, metrics=metrics, inputs=inputs or {"policy.pt": "5a"})
    return path


@pytest.fixture
def folders(tmp_path):
    """A run's folder with this machine's benchmark, and one for those of rovers."""
    run_dir, rovers = tmp_path / "demo", tmp_path / "rovers"
    run_dir.mkdir()
    rovers.mkdir()
    written(run_dir, socket.gethostname(), 8.0, artifact="static", inputs=OURS)
    return run_dir, rovers


def test_rovers_go_by_the_inventory_and_artifacts_by_their_mode(folders):
    """Two whose system is called as this machine, as cards may be; one has another artifact than the run's."""
    alone = hosts.read_benchmarks(*folders).table()
    assert alone.rows == [(hosts.THIS, "static", *["8.0"] * 3, "20", *"---")] and alone.notes == [hosts.NO_ROVER]
    written(folders[1], "rover2", 60.0, inputs={"policy.pt": "0f"})
    written(folders[1], "rover1", 90.0, temperature_c=87.9, clock_mhz=1500.0, throttled="0x80008")
    benchmarks = hosts.read_benchmarks(*folders)
    assert list(benchmarks.by_host) == [hosts.THIS, "rover1", "rover2"]
    _, ours, another = benchmarks.table().rows
    assert ours[:3] == ("rover1", "static", "90.0") and ours[-3:] == ("87.9", "1500", "0x80008")
    assert another[:3] == ("rover2", "static, another", "60.0") and hosts.NO_ROVER not in str(benchmarks.table())


def test_minutes_are_drawn_for_each_host_that_has_them(folders):
    assert str(plots.minutes(hosts.read_benchmarks(*folders).by_host, {})) == NONE_YET
    rows = []
    for i, mhz in enumerate((2400.0, 2400.0, 1500.0)):
        timed = {"policy": {"p50_ms": 60000 / mhz, "p95_ms": 70000 / mhz, "n": 300}}
        state = {"clock_mhz": mhz, "temperature_c": None, "throttled": "0x4" if i == 2 else "0x0", "supply_v": 5.1}
        rows.append({"from_s": 10.0 * i, **state, "artifacts": timed})
    written(folders[1], "rover1", 25.0, over_time=rows)
    benchmarks = hosts.read_benchmarks(*folders)
    latency, clock, heat = plots.minutes(benchmarks.by_host, benchmarks.modes).axes
    assert latency.get_title("left") == "rover1: clock fell after 0:20 min, from 2400 to 1500 MHz"
    p50, p95, fall = latency.get_lines()
    assert (p50.get_label(), p95.get_label()) == ("static, p50", "static, p95")
    assert p50.get_ydata().tolist() == pytest.approx([25, 25, 40]) and fall.get_xdata() == pytest.approx([1 / 3] * 2)
    assert len(clock.patches) == 1 and [text.get_text() for text in heat.texts] == ["not reported"]


@pytest.mark.parametrize(
    "spoil", [lambda c: "{", lambda c: json.dumps({**c, "schema": 9}), lambda c: json.dumps({**c, "metrics": {}})]
)
def test_a_damaged_or_foreign_file_is_named(folders, spoil):
    written(folders[1], "rover1", 60.0)
    bad = written(folders[1], "rover2", 60.0)
    bad.write_text(spoil(json.loads(bad.read_text())))
    benchmarks = hosts.read_benchmarks(*folders)
    assert list(benchmarks.by_host) == [hosts.THIS, "rover1"]
    assert str(benchmarks.table()).splitlines()[-1].startswith("left out: benchmark-rover2.json: ")
    assert str(folders[1]) not in str(benchmarks.table())  # a published notebook holds no path
