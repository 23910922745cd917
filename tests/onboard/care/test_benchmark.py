"""The benchmark: exact with fake clocks and hosts, and once with real ones."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard.care.benchmark import Timing, benchmark
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
