"""The benchmark: exact with fake clocks and hosts, and once with real ones."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard.care.benchmark import BenchmarkOptions, Clocks, benchmark, latency_metrics, peak_memory_alone_mb
from rover_lib.onboard.care.limits import check_gates
from rover_lib.onboard.care.lower_bound import floor_ms
from rover_lib.onboard.errors import ParamsError, PolicyError

FRAMES = [np.full((4, 4, 3), k, np.uint8) for k in range(3)]
STATE = np.zeros(2, np.float32)
GATES = {
    "latency_mean_ms": [20, 40], "latency_p95_ms": [30, 50], "throughput_fps": [25, 50], "control_rate_hz": [22, 35],
    "model_size_mb": 100, "memory_mb": 500, "cpu_pct": 80, "accuracy_loss_pct": 5, "temperature_c": 80,
    "throttled": "0x0",
}  # fmt: skip


class Machine:
    """Clocks that advance only when a policy computes or the benchmark sleeps."""

    def __init__(self):
        self.now_s = self.cpu_s = 0.0
        self.log = []
        self.slept_s = []

    def clock(self):
        return self.now_s

    def cpu_clock(self):
        return self.cpu_s

    def sleep(self, seconds):
        assert seconds > 0
        self.slept_s.append(seconds)
        self.now_s += seconds

    def policy(self, name, times_ms, **attributes):
        calls = iter(range(10**9))

        def predict_chunk(frame, state):
            assert state is STATE
            k = next(calls)
            self.log.append((name, int(frame[0, 0, 0])))
            self.now_s += times_ms[k % len(times_ms)] / 1000
            self.cpu_s += 2 * times_ms[k % len(times_ms)] / 1000  # two threads at work

        return SimpleNamespace(predict_chunk=predict_chunk, **attributes)

    @property
    def clocks(self):
        return Clocks(self.clock, self.cpu_clock, self.sleep)

    def benchmark(self, policies, host, **options):
        return benchmark(policies, FRAMES, STATE, BenchmarkOptions(**options), host=host, clocks=self.clocks)


@pytest.fixture
def machine():
    return Machine()


# ---- arithmetic


@pytest.mark.parametrize(
    ("mode", "expected_ms"), [("int8", 49), ("static", 49), ("mixed", 49), ("fp16", 98), ("fp32", 196)]
)
def test_floor_of_a_pi_5(mode, expected_ms):
    assert round(floor_ms(15.02, mode)) == expected_ms


def test_floor_of_a_mixture():
    assert floor_ms({"int8": 12.0, "fp32": 3.02}, "mixed") == pytest.approx(12000 / 307 + 3020 / 76.75)
    assert floor_ms(None, "static") is None
    assert floor_ms(0, "static") == 0


@pytest.mark.parametrize(
    ("gmac", "mode"), [(1, "int4"), (-1, "fp32"), (math.nan, "fp32"), ("15", "fp32"), (True, "fp32")]
)
def test_floor_of_nonsense(gmac, mode):
    with pytest.raises(ParamsError):
        floor_ms(gmac, mode)


def test_latency_metrics():
    found = latency_metrics([float(k) for k in range(1, 101)])
    assert found == {
        "latency_p50_ms": pytest.approx(50.5),
        "latency_p95_ms": pytest.approx(95.05),
        "latency_p99_ms": pytest.approx(99.01),
        "latency_min_ms": 1,
        "latency_mean_ms": pytest.approx(50.5),
        "latency_max_ms": 100,
        "n": 100,
        "throughput_fps": pytest.approx(1000 / 50.5),
        "control_rate_hz": pytest.approx(1000 / 95.05),
    }


# ---- timing


def test_interleaved_warmed_up_and_each_first_in_turn(machine, bare_host):
    policies = {n: machine.policy(n, [10]) for n in "abc"}
    machine.benchmark(policies, bare_host, warmup=2, iterations=4)
    names = "".join(name for name, _ in machine.log)
    assert names == "aabbcc" + "abc" + "bca" + "cab" + "abc"
    assert [frame for _, frame in machine.log[6:]] == [0] * 3 + [1] * 3 + [2] * 3 + [0] * 3


def test_metrics(machine, bare_host, tmp_path):
    artifact = tmp_path / "policy_static.pt"
    artifact.write_bytes(bytes(2_500_000))
    static = machine.policy("static", [10, 20], manifest={"mode": "static", "gmac": 15.02}, path=artifact)
    fp32 = machine.policy("fp32", [40], manifest={"mode": "fp32", "gmac": 15.02})
    lerobot = machine.policy("lerobot", [60])
    policies = {"static": static, "fp32": fp32, "lerobot": lerobot}
    metrics = machine.benchmark(policies, bare_host, warmup=2, iterations=10, reference="lerobot")
    assert metrics["main"] == "static"
    for key, value in {
        "latency_p50_ms": 15,
        "latency_p95_ms": 20,
        "latency_p99_ms": 20,
        "latency_mean_ms": 15,
        "latency_max_ms": 20,
        "n": 10,
        "throughput_fps": 1000 / 15,
        "control_rate_hz": 50,
        "size_mb": 2.5,
        "floor_ms": 48.925,
    }.items():
        assert metrics[key] == pytest.approx(value, rel=1e-3), key
        assert metrics["artifacts"]["static"][key] == metrics[key]
    assert metrics["artifacts"]["fp32"]["floor_ms"] == pytest.approx(195.7, abs=0.1)
    assert metrics["artifacts"]["lerobot"]["floor_ms"] is None
    assert metrics["artifacts"]["lerobot"]["size_mb"] is None
    assert metrics["artifacts"]["static"]["speedup"] == pytest.approx(4)
    assert metrics["artifacts"]["static"]["speedup_p5"] == pytest.approx(3)
    assert metrics["artifacts"]["static"]["speedup_p95"] == pytest.approx(6)
    assert metrics["artifacts"]["lerobot"]["speedup"] == pytest.approx(1)
    assert metrics["cpu_pct"] == pytest.approx(200 / metrics["cores"])
    assert metrics["artifacts"]["fp32"]["cpu_pct"] == pytest.approx(200 / metrics["cores"])
    assert metrics["wall_s"] == pytest.approx(1.15)
    assert (metrics["rounds"], metrics["series"], metrics["missed_deadlines"]) == (10, None, None)
    json.dumps(metrics, allow_nan=False)


def test_another_main(machine, bare_host):
    policies = {"a": machine.policy("a", [10]), "b": machine.policy("b", [30])}
    metrics = machine.benchmark(policies, bare_host, main="b", iterations=3)
    assert metrics["latency_p50_ms"] == pytest.approx(30)
    assert "speedup" not in metrics["artifacts"]["a"]


def test_what_a_host_cannot_tell_is_none(machine, bare_host):
    metrics = machine.benchmark({"a": machine.policy("a", [10])}, bare_host, iterations=2)
    for key in ("temperature_c", "clock_mhz", "throttled", "throttled_means", "cpu_per_core_pct", "floor_ms"):
        assert metrics[key] is None, key
    assert metrics["peak_memory_mb"] > 10  # this process's, as the operating system counts it
    assert metrics["artifacts"]["a"]["peak_memory_mb"] is None


def test_what_a_pi_tells(machine, pi_host):
    metrics = machine.benchmark({"a": machine.policy("a", [10])}, pi_host, iterations=2)
    assert metrics["temperature_c"] == 61.35
    assert metrics["clock_mhz"] == 1500  # the slowest core
    assert metrics["throttled"] == "0x50000"
    assert metrics["throttled_means"] == ["under-voltage since the start", "throttled since the start"]
    assert metrics["peak_memory_mb"] == pytest.approx(409.6)
    assert metrics["cpu_per_core_pct"] == [0, 0]  # its tick counts stand still


def test_soak_has_a_time_series(machine, pi_host):
    policies = {"a": machine.policy("a", [100]), "b": machine.policy("b", [300])}
    metrics = machine.benchmark(policies, pi_host, warmup=1, iterations=1, duration_s=9.9)
    assert metrics["rounds"] == 25
    assert metrics["wall_s"] == pytest.approx(10)
    series = metrics["series"]
    assert len(series) == 9  # one about every second, after whole rounds of 0.4 s, and one for the rest
    times_s = [p["t_s"] for p in series]
    assert times_s == sorted(times_s)
    assert times_s[-1] == pytest.approx(10)
    assert sum(p["artifacts"]["a"]["n"] for p in series) == 25
    assert series[0]["artifacts"]["b"]["latency_p50_ms"] == pytest.approx(300)
    assert series[0]["temperature_c"] == 61.35
    assert series[0]["memory_mb"] == pytest.approx(409.6)
    json.dumps(metrics, allow_nan=False)


@pytest.mark.slow
def test_a_long_soak_keeps_its_series_short(machine, bare_host):
    policy = {"a": machine.policy("a", [500])}
    metrics = machine.benchmark(policy, bare_host, duration_s=3600)
    assert 280 <= len(metrics["series"]) <= 301
    assert metrics["rounds"] == 7200


def test_a_rate_is_held_by_absolute_deadlines(machine, bare_host):
    policy = {"a": machine.policy("a", [10])}
    metrics = machine.benchmark(policy, bare_host, warmup=0, iterations=30, rate_hz=10)
    assert metrics["wall_s"] == pytest.approx(29 * 0.1 + 0.01)
    assert machine.slept_s == pytest.approx([0.09] * 29)
    assert metrics["missed_deadlines"] == 0
    assert metrics["cpu_pct"] == pytest.approx(100 * 0.6 / 2.91 / metrics["cores"])


@pytest.mark.parametrize(("took_ms", "rounds"), [(10, 100), (90, 56), (1000, 20)])
def test_slow_policies_are_timed_less_often_but_often_enough(machine, bare_host, took_ms, rounds):
    policy = {"a": machine.policy("a", [took_ms])}
    assert machine.benchmark(policy, bare_host, warmup=0, iterations=100, at_most_s=5)["rounds"] == rounds


def test_missed_deadlines_are_counted_and_not_made_up_for(machine, bare_host):
    policy = {"a": machine.policy("a", [10, 10, 350, 10, 10])}
    metrics = machine.benchmark(policy, bare_host, warmup=0, iterations=5, rate_hz=10)
    assert metrics["missed_deadlines"] == 2
    assert machine.log == [("a", k % 3) for k in range(5)]
    assert metrics["wall_s"] == pytest.approx(0.61)  # calls start at 0, 0.1, 0.2 (until 0.55), 0.55 at once, and 0.6 s


def test_progress_is_called_like_tqdm(machine, bare_host):
    seen = []

    def progress(iterable, desc=None, total=None):
        seen.append((desc, total))
        yield from iterable

    policy = {"a": machine.policy("a", [100])}
    given = {"host": bare_host, "clocks": machine.clocks, "progress": progress}
    benchmark(policy, FRAMES, STATE, BenchmarkOptions(iterations=3), **given)
    benchmark(policy, FRAMES, STATE, BenchmarkOptions(duration_s=2), **given)
    assert seen == [("timing", 3), ("soaking for 2 s", None)]


def test_threads_are_set_and_restored(bare_host):
    class Threaded(SimpleNamespace):
        threads = 7

        def set_threads(self, threads):
            self.threads = threads

    seen = []
    policy = Threaded(predict_chunk=lambda frame, state: seen.append(policy.threads))
    options = BenchmarkOptions(warmup=0, iterations=1, threads=1)
    metrics = benchmark({"a": policy}, FRAMES, STATE, options, host=bare_host)
    assert seen == [1]
    assert metrics["threads"] == 1
    metrics = benchmark({"a": policy}, FRAMES, STATE, replace(options, threads=0), host=bare_host)
    assert metrics["threads"] == metrics["cores"]

    def fail(frame, state):
        raise PolicyError("no")

    failing = Threaded(predict_chunk=fail)
    with pytest.raises(PolicyError):
        benchmark({"a": failing}, FRAMES, STATE, options, host=bare_host)
    assert policy.threads == failing.threads == 7


@pytest.mark.parametrize(
    "bad",
    [
        {"policies": {}}, {"frames": []}, {"iterations": 0}, {"warmup": -1}, {"threads": -1}, {"duration_s": 0},
        {"duration_s": math.inf}, {"rate_hz": math.nan}, {"main": "z"}, {"reference": "z"},
    ],
)  # fmt: skip
def test_parameters_that_make_no_sense(machine, bare_host, bad):
    given = {"policies": {"a": machine.policy("a", [1])}, "frames": FRAMES, **bad}
    policies, frames = given.pop("policies"), given.pop("frames")
    with pytest.raises(ParamsError):
        benchmark(policies, frames, STATE, BenchmarkOptions(**given), host=bare_host, clocks=machine.clocks)
    assert machine.log == []


@pytest.mark.slow
def test_memory_of_an_artifact_that_does_not_load(tmp_path):
    bad = tmp_path / "policy_static.pt"
    bad.write_bytes(b"no artifact")
    with pytest.raises(PolicyError, match="process of its own") as e:
        peak_memory_alone_mb(bad, threads=1)
    assert "\n" not in str(e.value)


# ---- gates


def test_gates_of_the_original():
    metrics = {
        "latency_mean_ms": 41.0,
        "latency_p95_ms": 12.0,  # better than promised
        "throughput_fps": 25.0,
        "control_rate_hz": 21.9,
        "size_mb": 66.4,
        "peak_memory_mb": 500.0,
        "cpu_pct": None,
        "temperature_c": None,
        "throttled": "0x50000",
    }
    rows = check_gates(metrics, GATES)
    assert [r["gate"] for r in rows] == list(GATES)
    assert {r["gate"]: r["passed"] for r in rows} == {
        "latency_mean_ms": False, "latency_p95_ms": True, "throughput_fps": True, "control_rate_hz": False,
        "model_size_mb": True, "memory_mb": False, "cpu_pct": None, "accuracy_loss_pct": None, "temperature_c": None,
        "throttled": False,
    }  # fmt: skip
    assert rows[4] == {"gate": "model_size_mb", "limit": 100, "found": 66.4, "passed": True}


def test_nan_is_not_measured():
    assert check_gates({"cpu_pct": math.nan}, {"cpu_pct": 80}) == [
        {"gate": "cpu_pct", "limit": 80, "found": None, "passed": None}
    ]


@pytest.mark.parametrize("limit", [None, True, [1], [3, 2], [1, 2, 3], {"max": 3}, math.nan, [0, "x"]])
def test_gates_that_make_no_sense(limit):
    with pytest.raises(ParamsError, match=r"params\.yml"):
        check_gates({"cpu_pct": 1.0}, {"cpu_pct": limit})
