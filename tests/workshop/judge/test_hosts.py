"""Benchmarks beside each other, as rover_lib's own benchmark writes them; time and heat of the machines are made up."""

import json
import math
import socket
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard.care.benchmark import BenchmarkOptions, Clocks, benchmark
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop import plots
from rover_lib.workshop.judge import hosts

OURS = {"policy_static.pt": "5a", "policy_fp32.pt": "f3"}


class Machine:
    """A Host of its own clock, which gets warm while it computes and is held back from 80 degrees on."""

    def __init__(self, latency_ms: float, hottest_c: float | None):
        self.latency_ms, self.hottest_c, self.now_s = latency_ms, hottest_c, 0.0

    def clock(self) -> float:
        return self.now_s

    def predict_chunk(self, frame, state) -> None:
        self.now_s += self.latency_ms / 1e3 * (1.5 if self.is_hot else 1)

    @property
    def celsius(self) -> float | None:
        return self.hottest_c and 45 + (self.hottest_c - 45) * (1 - math.exp(-self.now_s / 300))

    @property
    def is_hot(self) -> bool:
        return (self.celsius or 0) > 80

    def reading(self):
        throttled = None if self.hottest_c is None else "0x80008" if self.is_hot else "0x80000"
        clock_mhz = None if self.hottest_c is None else 1500.0 if self.is_hot else 2400.0
        return {"temperature_c": self.celsius, "clock_mhz": clock_mhz, "throttled": throttled}

    def process_peak_memory_mb(self) -> float:
        return 400.0

    def core_ticks(self) -> None:
        return None


def written(folder, name, latency_ms, *, hottest_c=None, soak_s=None, inputs=None, artifact="policy", host="rover"):
    """benchmark-<name>.json, as `rover benchmark` leaves it."""
    machine = Machine(latency_ms, hottest_c)
    policy = SimpleNamespace(predict_chunk=machine.predict_chunk, manifest={"mode": "static", "gmac": 0.375})
    options, clocks = BenchmarkOptions(iterations=20, duration_s=soak_s), Clocks(machine.clock, machine.clock)
    frames = [np.zeros((2, 2, 3), np.uint8)]
    metrics = benchmark({artifact: policy}, frames, np.zeros(2), options, host=machine, clocks=clocks)
    path = folder / f"benchmark-{name}.json"
    write_stage(path, "benchmark", params={}, metrics=metrics, inputs=inputs or {"policy.pt": "5a"})
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "env": {**content["env"], "host": host}}))
    return path


@pytest.fixture
def folders(tmp_path):
    """A run's folder with this machine's benchmark, and one for those of rovers."""
    run_dir, rovers = tmp_path / "demo", tmp_path / "rovers"
    run_dir.mkdir()
    rovers.mkdir()
    written(run_dir, socket.gethostname(), 8.0, artifact="static", inputs=OURS, host=socket.gethostname())
    return run_dir, rovers


def test_this_machine_alone_is_a_sentence(folders):
    benchmarks = hosts.read_benchmarks(*folders)
    assert list(benchmarks.by_host) == [hosts.THIS] and not benchmarks.soaks() and not benchmarks.unusable
    head, row, note = str(benchmarks.table()).splitlines()
    assert head.split()[:3] == ["host", "artifact", "p50"] and note == hosts.NO_ROVER
    assert row.split() == ["this", "machine", "static", "8.0", "8.0", "8.0", "20", "-", "-", "-"]
    assert socket.gethostname() not in str(benchmarks.table()).split()


def test_rovers_go_by_the_inventory_and_artifacts_by_their_mode(folders):
    """Two whose system is called the same, as every new card's is; one has another artifact than the run's."""
    written(folders[1], "rover2", 60.0, soak_s=20, inputs={"policy.pt": "0f"}, host="raspberrypi")
    written(folders[1], "rover1", 60.0, host="raspberrypi")
    benchmarks = hosts.read_benchmarks(*folders)
    assert list(benchmarks.by_host) == [hosts.THIS, "rover1", "rover2"]
    ours, another = (benchmarks.by_host[name]["metrics"] for name in ("rover1", "rover2"))
    assert list(ours["artifacts"]) == ["static"] and list(benchmarks.soaks()) == ["rover2"]
    assert list(another["artifacts"]) == ["static, another"] == list(another["series"][3]["artifacts"])
    assert another["main"] == "static, another"


def test_the_table_says_how_hot_and_how_fast(folders):
    written(folders[1], "rover1", 60.0, hottest_c=88, soak_s=1800)
    benchmarks = hosts.read_benchmarks(*folders)
    row = str(benchmarks.table()).splitlines()[2].split()
    assert row[:3] == ["rover1", "static", "90.0"] and row[-3:] == ["87.9", "1500", "0x80008"]
    assert hosts.NO_SOAK not in str(benchmarks.table()) and hosts.NO_ROVER not in str(benchmarks.table())


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


def test_a_soak_over_time(folders):
    written(folders[1], "rover1", 60.0, hottest_c=88, soak_s=1800)
    written(folders[1], "rover2", 55.0, hottest_c=70, soak_s=900)
    soaks = hosts.read_benchmarks(*folders).soaks()
    assert list(soaks) == ["rover1", "rover2"]
    figure = plots.soak(soaks)
    figure.canvas.draw()
    hot, cool = (collection.get_paths() for collection in figure.axes[3].collections)
    assert hot and not cool
    first_hot_min = min(path.vertices[:, 0].min() for path in hot)
    assert 7 < first_hot_min < 10  # 80 degrees after 300 s * ln(43 / 8) = 8.4 min
    times_ms = figure.axes[0].lines[0].get_ydata()
    assert times_ms[0] == pytest.approx(60) and times_ms[-1] == pytest.approx(90)
