"""Measure the latency of policies on this machine: its distribution, the host's state, and a Pi 5's lower bound.

    metrics = benchmark(Timing({"static": static, "fp32": fp32}, frames, state, iterations=1000))

All policies are timed in one run. Each round has one inference of every policy, and starts with a different one. So a
machine that heats up or is shared slows all of them alike. A value that the host does not report (no thermal zone, no
vcgencmd) is None, not 0. MB are 10**6 bytes.
"""

import functools
import itertools
import math
import operator
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.host import Host, usable_cores
from rover_lib.onboard.errors import ParamsError
from rover_lib.onboard.policy.confined import load_confined, run_confined

Progress = Callable[..., Iterable]  # called like tqdm.tqdm(iterable, desc=, total=)
PERCENTILES = {"p50": 50, "p95": 95, "p99": 99}
LEAST_ROUNDS = 20  # with fewer, the 95th percentile is just the slowest round
READ_S = 1.0  # between two readings of the host
FIRMWARE_S = 2.5  # between two questions to the firmware, each of which starts a process
SPAN_S = 10.0  # a row of over_time
FALLEN = 0.97  # of the highest clock: below it, a clock has fallen
# Measured peaks of a Raspberry Pi 5, four cores at 2.4 GHz (public cpufp results), in 10**9 multiply-accumulates
# per second: INT8 SDOT 614 GOPS, FP16 307 GFLOPS, FP32 153.5 GFLOPS, two operations to a multiply-accumulate.
PI5_GMAC_PER_S = {"int8": 307.0, "fp16": 153.5, "fp32": 76.75}


def peak_memory_alone_mb(path: Path | str, *, threads: int | None = None, timeout_s: float = 300) -> float | None:
    """Return the peak resident memory, in MB, of a fresh process that loads one artifact and predicts three times.

    Returns None if the machine does not report it. Raises PolicyError if the artifact does not load or predict there.
    """
    return run_confined(_predict_alone, timeout_s=timeout_s, path=str(path), threads=threads or usable_cores())


def _predict_alone(path: str, threads: int) -> float | None:
    policies, _ = load_confined({"policy": path}, threads=threads)
    policy = policies["policy"]
    frame = {c["name"]: np.zeros((c["height"], c["width"], 3), np.uint8) for c in policy.manifest["cameras"]}
    for _ in range(3):
        policy.predict_chunk(frame, np.zeros(len(policy.state_names), np.float32))
    return Host().process_peak_memory_mb()


def benchmark_artifacts(paths: Mapping[str, Path], threads: int, options: Mapping[str, Any]) -> dict[str, Any]:
    """Time artifacts from anywhere, by name, in a confined process, on the frames of the first one's parity vectors.

    options: of Timing. Each artifact's memory is measured too. Raises PolicyError for one that does not load.
    """
    host, ended, readings = Host(), threading.Event(), []  # a confined process starts no vcgencmd

    def read_firmware() -> None:
        while not ended.wait(FIRMWARE_S):
            now_s = time.perf_counter()
            readings.append({"s": now_s, "throttled": host.throttled(), "supply_v": host.supply_v()})

    reader = threading.Thread(target=read_firmware, name="firmware", daemon=True)
    if options.get("minutes"):
        reader.start()
    try:
        metrics = run_confined(_time_artifacts, paths=dict(paths), threads=threads, options=options)
    finally:
        ended.set()
    for row in metrics["over_time"]:  # perf_counter is one clock for all processes
        row |= _of_firmware(_within(readings, metrics["began_s"] + row["from_s"]))
    metrics["throttled"] = host.throttled()
    _add_memory(metrics, paths, threads)
    return metrics


def _within(readings: Sequence[dict[str, Any]], from_s: float) -> list[dict[str, Any]]:
    return [reading for reading in readings if from_s <= reading["s"] < from_s + SPAN_S]


def _of_firmware(readings: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return every bit of `throttled` that was set in one of the readings, and the lowest supply."""
    bits = [int(r["throttled"], 16) for r in readings if r["throttled"] is not None]
    supplies_v = [r["supply_v"] for r in readings if r["supply_v"] is not None]
    throttled = hex(functools.reduce(operator.or_, bits)) if bits else None
    return {"throttled": throttled, "supply_v": min(supplies_v, default=None)}


def clock_fall(over_time: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """Return the first row whose clock is clearly below the highest; None if it never fell or was not reported."""
    rows = [row for row in over_time if row["clock_mhz"] is not None]
    highest_mhz = max((row["clock_mhz"] for row in rows), default=0.0)
    return next((row for row in rows if row["clock_mhz"] < FALLEN * highest_mhz), None)


def describe_clock(over_time: Sequence[Mapping[str, Any]]) -> str:
    """Say from when the clock fell in a benchmark of minutes."""
    clocks_mhz = [row["clock_mhz"] for row in over_time if row["clock_mhz"] is not None]
    if not clocks_mhz:
        return "clock not reported"
    if (fall := clock_fall(over_time)) is None:
        return f"clock did not fall: {min(clocks_mhz):.0f} MHz at least"
    minutes, seconds = divmod(round(fall["from_s"]), 60)
    heat = "" if fall["temperature_c"] is None else f" at {fall['temperature_c']:.0f} C"
    return f"clock fell after {minutes}:{seconds:02} min{heat}, from {max(clocks_mhz):.0f} to {min(clocks_mhz):.0f} MHz"


def _time_artifacts(paths: dict[str, str], threads: int, options: dict[str, Any]) -> dict[str, Any]:
    policies, artifacts = load_confined(paths, threads=threads)
    cameras = next(iter(policies.values())).cameras
    vectors = next(iter(artifacts.values())).parity
    frames = []
    for i in range(len(vectors["state"])):  # stored as RGB; a camera gives BGR
        frames.append({camera: vectors[f"frame_{camera}"][i][:, :, ::-1] for camera in cameras})
    return benchmark(Timing(policies, frames, vectors["state"][0], **options))


def _add_memory(metrics: dict[str, Any], paths: Mapping[str, Path], threads: int | None) -> None:
    with ThreadPoolExecutor(2) as pool:  # each process mostly imports, on one core
        peaks = pool.map(lambda path: peak_memory_alone_mb(path, threads=threads), paths.values())
        for name, peak_mb in zip(paths, peaks, strict=True):
            metrics["artifacts"][name]["peak_memory_mb"] = peak_mb
    if (peak_mb := metrics["artifacts"][metrics["main"]]["peak_memory_mb"]) is not None:
        metrics["peak_memory_mb"] = peak_mb


@dataclass(frozen=True)
class Timing:
    """What is timed, and how. Raises ParamsError without policies, frames or iterations, and for unknown names.

    policies: name -> an object with predict_chunk(frame, state); its `.manifest` ("mode", "gmac"), `.path` and
    `.threads` are used if it has them. frames: used in turn. warmup: inferences of each policy that are not counted.
    iterations: number of rounds. at_most_s: limits the time, but not to less than LEAST_ROUNDS. minutes: if given,
    rounds begin for that long, whatever `iterations` and `at_most_s`, and over_time has a row for each ten seconds.
    main: whose figures are at the top level ("": the first's). reference: what the others' speed is compared with
    ("": nothing).
    """

    policies: Mapping[str, Any]
    frames: Sequence[Any]
    state: np.ndarray
    warmup: int = 10
    iterations: int = 100
    at_most_s: float = math.inf
    minutes: float | None = None
    main: str = ""
    reference: str = ""

    def __post_init__(self) -> None:
        names = list(self.policies)
        unknown = {self.main, self.reference} - {"", *self.policies}
        if not names or not len(self.frames) or not self.iterations > 0 or unknown:
            what = f"a benchmark needs frames, iterations and policies, {self.main} and {self.reference} among them"
            raise ParamsError(what, found=f"{len(self.frames)}, {self.iterations} and {names}")


def benchmark(
    timing: Timing,
    *,
    memory_alone: bool = False,
    host: Host | None = None,
    wall: Callable[[], float] = time.perf_counter,
    cpu: Callable[[], float] = time.process_time,
    progress: Progress = lambda items, **_: items,
) -> dict[str, Any]:
    """Time every policy's predict_chunk, interleaved, and return the metrics of benchmark-<host>.json.

    memory_alone: measure each artifact's memory in a process of its own. wall, cpu: clocks of elapsed and of processor
    time, in seconds.

    cpu_pct is processor time as a share of all cores that this process may use. temperature_c is the highest and
    clock_mhz the lowest reading. peak_memory_mb is the artifact's alone if it was measured, else None, and this
    process's at the top level. over_time, of `minutes`: {"from_s", "clock_mhz", "temperature_c", "throttled",
    "supply_v", "artifacts": {name: {"p50_ms", "p95_ms", "n"}}} for each ten seconds, throttled with each bit that was
    set in them. began_s: by `wall`.
    """
    policies = timing.policies
    main = timing.main or next(iter(timing.policies))
    for policy in policies.values():
        for i in range(timing.warmup):
            policy.predict_chunk(timing.frames[i % len(timing.frames)], timing.state)
    run = _Run(timing, host or Host(), wall, cpu)
    cores = usable_cores()
    if timing.minutes:
        run.measure(itertools.count())
    else:
        run.measure(progress(range(timing.iterations), desc="timing", total=timing.iterations))
    metrics = {
        **run.metrics_of(main),
        "peak_memory_mb": run.host.process_peak_memory_mb(),
        "cpu_pct": 100 * run.process_s / run.wall_s / cores,
        "cpu_per_core_pct": run.per_core_pct,
        **_heat_and_clock(run.readings),
        "throttled": run.readings[-1]["throttled"],
        "main": main,
        "reference": timing.reference or None,
        "threads": getattr(policies[main], "threads", None),
        "cores": cores,
        "warmup": timing.warmup,
        "rounds": len(run.latencies_ms[main]),
        "wall_s": run.wall_s,
        "began_s": run.start_s,
        "over_time": run.over_time() if timing.minutes else [],
        "artifacts": {name: run.metrics_of(name) | run.speedup(name) for name in policies},
    }
    if memory_alone:
        paths = {name: path for name in policies if (path := getattr(policies[name], "path", None))}
        _add_memory(metrics, paths, metrics["threads"])
    return metrics


def floor_ms(gmac: float | None, mode: str) -> float | None:
    """Return the least time that a Pi 5 needs for one inference, by arithmetic alone; None where `gmac` is not known.

    gmac: 10**9 multiply-accumulates of one inference. mode: an artifact's: `mixed` and `dynamic` count as INT8, a floor
    that they cannot reach.
    """
    return None if gmac is None else gmac / PI5_GMAC_PER_S["fp32" if mode == "fp32" else "int8"] * 1000


class _Run:
    """The timed part of one benchmark."""

    def __init__(self, timing: Timing, host: Host, wall: Callable[[], float], cpu: Callable[[], float]):
        self.timing = timing
        self.host = host
        self.wall = wall
        self.cpu = cpu
        self.latencies_ms: dict[str, list[float]] = {name: [] for name in timing.policies}
        self.readings: list[dict[str, Any]] = []
        self.begun_s: list[float] = []  # each round's start, since start_s
        self.start_s = self.wall_s = self.process_s = 0.0
        self.per_core_pct: list[float] | None = None

    def measure(self, rounds: Iterable[int]) -> None:
        """Time the rounds, or as many as begin within at_most_s, and fill the lists."""
        timing = self.timing
        names = list(self.timing.policies)
        at_most_s = 60 * timing.minutes if timing.minutes else timing.at_most_s
        before = self.host.core_ticks()
        cpu_start_s = self.cpu()
        self.start_s = self.wall()
        read_s = -math.inf
        for i in rounds:
            passed_s = self.wall() - self.start_s
            if i >= LEAST_ROUNDS and passed_s >= at_most_s:
                break
            if passed_s >= read_s + READ_S:
                self._read_host(passed_s)
                read_s = passed_s
            self.begun_s.append(passed_s)
            frame = timing.frames[i % len(timing.frames)]
            for k in range(len(names)):
                name = names[(i + k) % len(names)]
                begin_s = self.wall()
                timing.policies[name].predict_chunk(frame, timing.state)
                self.latencies_ms[name].append((self.wall() - begin_s) * 1000)
        self.wall_s = self.wall() - self.start_s
        self.process_s = self.cpu() - cpu_start_s
        self._read_host(self.wall_s)
        after = self.host.core_ticks()
        if before and after and len(before) == len(after):
            spans = [(b1 - b0, a1 - a0) for (b0, a0), (b1, a1) in zip(before, after, strict=True)]
            self.per_core_pct = [100 * busy / total if total > 0 else 0.0 for busy, total in spans]

    def metrics_of(self, name: str) -> dict[str, Any]:
        """Return the figures of one policy: those measured, and those known from its manifest and file.

        control_rate_hz: the highest rate at which 95 % of the inferences end within their period (1000 / p95).
        """
        policy = self.timing.policies[name]
        times_ms = np.asarray(self.latencies_ms[name], float)
        mean_ms = float(times_ms.mean())
        p95_ms = float(np.percentile(times_ms, 95))
        manifest = getattr(policy, "manifest", None) or {}
        path = getattr(policy, "path", None)
        mode = manifest.get("mode")
        gmac = manifest.get("gmac")
        return {
            **{f"latency_{name}_ms": float(np.percentile(times_ms, q)) for name, q in PERCENTILES.items()},
            "latency_min_ms": float(times_ms.min()),
            "latency_mean_ms": mean_ms,
            "latency_max_ms": float(times_ms.max()),
            "n": len(times_ms),
            "throughput_fps": 1000 / mean_ms,
            "control_rate_hz": 1000 / p95_ms,
            "peak_memory_mb": None,
            "floor_ms": floor_ms(gmac, mode) if mode else None,
            "gmac": gmac,
            "mode": mode,
            "size_mb": Path(path).stat().st_size / 1e6 if path and Path(path).is_file() else None,
        }

    def speedup(self, name: str) -> dict[str, float | None]:
        """Return how many times as fast as the reference a policy is: by p50, and from 5 to 95 % of the rounds."""
        if not self.timing.reference:
            return {}
        times_ms, reference_ms = (np.asarray(self.latencies_ms[n]) for n in (name, self.timing.reference))
        p50_ms = float(np.median(times_ms))
        reference_p50_ms = float(np.median(reference_ms))
        low, high = np.percentile(reference_ms / times_ms, (5, 95)).tolist()
        return {"speedup": reference_p50_ms / p50_ms, "speedup_p5": low, "speedup_p95": high}

    def _read_host(self, passed_s: float) -> None:
        """Keep the host's state. Only a benchmark of minutes asks for the supply, by a process beside what is timed."""
        supply_v = self.host.supply_v() if self.timing.minutes else None
        self.readings.append(self.host.reading() | {"s": passed_s, "supply_v": supply_v})

    def over_time(self) -> list[dict[str, Any]]:
        """Return a row for each ten seconds in which a round began."""
        spans = np.floor_divide(self.begun_s, SPAN_S).astype(int)
        rows = []
        for span in np.unique(spans).tolist():
            artifacts = {}
            for name, times_ms in self.latencies_ms.items():
                p50_ms, p95_ms = np.percentile(np.asarray(times_ms)[spans == span], (50, 95)).tolist()
                artifacts[name] = {"p50_ms": p50_ms, "p95_ms": p95_ms, "n": int(np.sum(spans == span))}
            readings = _within(self.readings, span * SPAN_S)
            state = _heat_and_clock(readings) | _of_firmware(readings)
            rows.append({"from_s": span * SPAN_S, **state, "artifacts": artifacts})
        return rows


def _heat_and_clock(readings: Sequence[dict[str, Any]]) -> dict[str, Any]:
    temperatures_c = [r["temperature_c"] for r in readings if r["temperature_c"] is not None]
    clocks_mhz = [r["clock_mhz"] for r in readings if r["clock_mhz"] is not None]
    return {"temperature_c": max(temperatures_c, default=None), "clock_mhz": min(clocks_mhz, default=None)}
