"""The benchmark: exact with fake clocks and hosts, and once with real ones."""

import json
import time
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard.care import benchmark as module
from rover_lib.onboard.care.benchmark import Timing, benchmark, clock_fall, describe_clock
from rover_lib.onboard.columns import benchmark_rows
from rover_lib.onboard.errors import ParamsError

FRAMES = [np.full((4, 4, 3), k, np.uint8) for k in range(3)]
STATE = np.zeros(2, np.float32)


class Machine:
    """Clocks that advance only when a policy computes."""

    def __init__(self):
        self.now_s = self.cpu_s = 0.0
        self.log = []
        self.clocks = {"wall": lambda: self.now_s, "cpu": lambda: self.cpu_s}

    def policy(self, name, times_ms, **attributes):
        calls = iter(range(10**9))

        def predict_chunk(frame, state):
            assert state is STATE
            k = next(calls)
            self.log.append((name, int(frame[0, 0, 0])))
            self.now_s += times_ms[k % len(times_ms)] / 1000
            self.cpu_s += 2 * times_ms[k % len(times_ms)] / 1000  # two threads at work

        return SimpleNamespace(predict_chunk=predict_chunk, **attributes)

    def benchmark(self, policies, host, **options):
        return benchmark(Timing(policies, FRAMES, STATE, **options), host=host, **self.clocks)


@pytest.fixture
def machine():
    return Machine()


def test_interleaved_warmed_up_and_each_first_in_turn(machine, bare_host):
    policies = {n: machine.policy(n, [10]) for n in "abc"}
    machine.benchmark(policies, bare_host, warmup=2, iterations=4)
    names = "".join(name for name, _ in machine.log)
    assert names == "aabbcc" + "abc" + "bca" + "cab" + "abc"
    assert [frame for _, frame in machine.log[6:]] == [0] * 3 + [1] * 3 + [2] * 3 + [0] * 3


def test_metrics(machine, pi_host, tmp_path):
    artifact = tmp_path / "policy_static.pt"
    artifact.write_bytes(bytes(2_500_000))
    static = machine.policy("static", [10, 20], manifest={"mode": "static", "gmac": 15.02}, path=artifact)
    fp32 = machine.policy("fp32", [40], manifest={"mode": "fp32", "gmac": 15.02})
    policies = {"static": static, "fp32": fp32, "lerobot": machine.policy("lerobot", [60])}
    metrics = machine.benchmark(policies, pi_host, warmup=2, iterations=10, reference="lerobot")
    timed = metrics["artifacts"]
    expected = {"latency_p50_ms": 15, "latency_p95_ms": 20, "latency_max_ms": 20, "n": 10, "throughput_fps": 1000 / 15}
    for key, value in {**expected, "control_rate_hz": 50, "size_mb": 2.5, "floor_ms": 48.925}.items():
        assert metrics[key] == timed["static"][key] == pytest.approx(value, rel=1e-3), key
    assert timed["fp32"]["floor_ms"] == pytest.approx(195.7, abs=0.1)
    assert timed["lerobot"]["floor_ms"] is timed["lerobot"]["size_mb"] is None
    assert (timed["static"]["speedup"], timed["static"]["speedup_p5"]) == pytest.approx((4, 3))
    assert metrics["cpu_pct"] == pytest.approx(200 / metrics["cores"]) and metrics["wall_s"] == pytest.approx(1.15)
    assert (metrics["main"], metrics["rounds"]) == ("static", 10)
    told = [metrics[name] for name in ("temperature_c", "clock_mhz", "throttled", "cpu_per_core_pct")]
    assert told == [61.35, 1500, "0x50000", [0, 0]]  # its tick counts stand still
    json.dumps(metrics, allow_nan=False)


def test_slow_policies_are_timed_less_often_but_often_enough(machine, bare_host):
    for took_ms, rounds in ((90, 56), (1000, 20)):
        policy = {"a": machine.policy("a", [took_ms])}
        assert machine.benchmark(policy, bare_host, warmup=0, iterations=100, at_most_s=5)["rounds"] == rounds


class Hot:
    """A host that gets 1 C warmer in 4 s, and from 80 C on lowers its clock, by which its plans take longer."""

    def __init__(self, machine):
        self.machine = machine

    def __getattr__(self, name):
        return lambda: None  # of memory and cores

    def temperature_c(self):
        return 50 + self.machine.now_s / 4

    def clock_mhz(self):
        return 1500.0 if self.temperature_c() >= 80 else 2400.0

    def throttled(self):
        return "0xe0008" if self.temperature_c() >= 80 else "0x0"

    def supply_v(self):
        return 5.1 - self.machine.now_s / 1000

    def reading(self):
        return {name: getattr(self, name)() for name in ("temperature_c", "clock_mhz", "throttled")}

    def policy(self):
        policy = self.machine.policy("a", [0])

        def predict_chunk(frame, state):
            self.machine.now_s += 60 / self.clock_mhz()

        policy.predict_chunk = predict_chunk
        return policy


def test_minutes_show_from_when_a_hot_host_was_slow(machine):
    host = Hot(machine)
    found = machine.benchmark({"a": host.policy()}, host, warmup=0, iterations=1, minutes=3)
    rows = found["over_time"]
    assert [row["from_s"] for row in rows] == list(range(0, 180, 10))
    assert sum(row["artifacts"]["a"]["n"] for row in rows) == found["rounds"] > 1000
    expected = [(25, 2400, "0x0")] * 12 + [(40, 1500, "0xe0008")] * 6
    for row, (ms, mhz, throttled) in zip(rows, expected, strict=True):
        timed = row["artifacts"]["a"]
        assert (timed["p50_ms"], timed["p95_ms"]) == pytest.approx((ms, ms)), row
        assert (row["clock_mhz"], row["throttled"]) == (mhz, throttled)
        assert row["temperature_c"] == pytest.approx(50 + (row["from_s"] + 10) / 4, abs=0.5)
        assert row["supply_v"] == pytest.approx(5.1 - (row["from_s"] + 10) / 1000, abs=0.002)
    assert clock_fall(rows) is rows[12]
    assert describe_clock(rows) == "clock fell after 2:00 min at 82 C, from 2400 to 1500 MHz"
    assert describe_clock(rows[:12]) == "clock did not fall: 2400 MHz at least"
    assert machine.benchmark({"a": host.policy()}, host, iterations=30)["over_time"] == []


def test_a_host_without_sensors_runs_for_minutes_too(machine, bare_host):
    rows = machine.benchmark({"a": machine.policy("a", [1000])}, bare_host, warmup=0, minutes=0.5)["over_time"]
    assert [row["artifacts"]["a"]["n"] for row in rows] == [10, 10, 10]
    assert {row[key] for row in rows for key in ("clock_mhz", "throttled", "supply_v")} == {None}
    assert describe_clock(rows) == "clock not reported"


def test_the_firmware_is_asked_outside_the_confined_process(monkeypatch, pi_host):
    """That process starts no program: each row gets what this one read in its ten seconds."""

    def confined(function, **_):
        began_s = time.perf_counter()
        time.sleep(0.15)
        row = {"throttled": None, "supply_v": None}
        return {"began_s": began_s, "over_time": [row | {"from_s": 0.0}, row | {"from_s": 10.0}]}

    monkeypatch.setattr(module, "run_confined", confined)
    monkeypatch.setattr(module, "Host", lambda: pi_host)
    monkeypatch.setattr(module, "FIRMWARE_S", 0.02)
    monkeypatch.setattr(module, "_add_memory", lambda *_: None)
    first, second = module.benchmark_artifacts({}, 1, {"minutes": 1})["over_time"]
    assert (first["throttled"], first["supply_v"]) == ("0x50000", 5.02)
    assert (second["throttled"], second["supply_v"]) == (None, None)


def test_parameters_that_make_no_sense():
    for bad in ({"policies": {}}, {"frames": []}, {"iterations": 0}, {"main": "b"}, {"reference": "b"}):
        with pytest.raises(ParamsError):
            Timing(**{"policies": {"a": None}, "frames": FRAMES, "state": STATE} | bad)


def test_ratios_are_to_the_first_artifact():
    times = [dict.fromkeys(("latency_p50_ms", "latency_p95_ms", "latency_p99_ms"), ms) for ms in (20.0, 5.0)]
    sizes = [{"size_mb": mb, "peak_memory_mb": None, "n": 3} for mb in (40.0, 10.0)]
    timed = {"fp32": times[0] | sizes[0], "static": times[1] | sizes[1]}
    header, fp32, static = benchmark_rows({"artifacts": timed})
    faster, smaller = (header.index(f"times {what}") for what in ("faster", "smaller"))
    assert (fp32[faster], static[faster], static[smaller], static[-2]) == ("1.0", "4.0", "4.0", "-")
