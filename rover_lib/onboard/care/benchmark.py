"""Measure the latency of policies on this machine: its distribution, the host's state, and a Pi 5's lower bound.

    metrics = benchmark({"static": static, "fp32": fp32}, frames, state, BenchmarkOptions(iterations=1000))

All policies are timed in one run. Each round has one inference of every policy, and starts with a different one. So a
machine that heats up or is shared slows all of them alike. A value that the host does not report (no thermal zone, no
vcgencmd) is None, not 0. MB are 10**6 bytes.
"""

import itertools
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.host import Host, throttled_means, usable_cores
from rover_lib.onboard.care.lower_bound import floor_ms
from rover_lib.onboard.checked import broken_rule, number, optional, whole
from rover_lib.onboard.errors import ParamsError
from rover_lib.onboard.policy.confined import load_confined, run_confined

Progress = Callable[..., Iterable]  # called like tqdm.tqdm(iterable, desc=, total=)
PERCENTILES = {"p50": 50, "p95": 95, "p99": 99}
MOST = 10**9  # rounds or seconds: a limit that nobody meets
NOTED = ("latency_p50_ms", "latency_p95_ms", "latency_max_ms", "n")  # of a point in the time series
LEAST_ROUNDS = 20  # with fewer, the 95th percentile is just the slowest round


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

    options: of BenchmarkOptions. Each artifact's memory is measured too. Raises PolicyError for one that does not load.
    """
    metrics = run_confined(_time_artifacts, paths=dict(paths), threads=threads, options=options)
    metrics["throttled"] = Host().throttled()  # a confined process starts no vcgencmd
    metrics["throttled_means"] = throttled_means(metrics["throttled"])
    _add_memory(metrics, paths, threads)
    return metrics


def _time_artifacts(paths: dict[str, str], threads: int, options: dict[str, Any]) -> dict[str, Any]:
    policies, artifacts = load_confined(paths, threads=threads)
    cameras, vectors = next(iter(policies.values())).cameras, next(iter(artifacts.values())).parity
    frames = []
    for i in range(len(vectors["state"])):  # stored as RGB; a camera gives BGR
        frames.append({camera: vectors[f"frame_{camera}"][i][:, :, ::-1] for camera in cameras})
    return benchmark(policies, frames, vectors["state"][0], BenchmarkOptions(**options))


def _add_memory(metrics: dict[str, Any], paths: Mapping[str, Path], threads: int | None) -> None:
    """Measure the memory of each artifact alone, and add it to the metrics."""
    with ThreadPoolExecutor(2) as pool:  # each process mostly imports, on one core
        peaks = pool.map(lambda path: peak_memory_alone_mb(path, threads=threads), paths.values())
        for name, peak_mb in zip(paths, peaks, strict=True):
            metrics["artifacts"][name]["peak_memory_mb"] = peak_mb
    if (peak_mb := metrics["artifacts"][metrics["main"]]["peak_memory_mb"]) is not None:
        metrics["peak_memory_mb"] = peak_mb


def latency_metrics(latencies_ms: Sequence[float]) -> dict[str, float | int]:
    """Return the distribution of one policy's latencies, and the rates that follow from it.

    control_rate_hz: the highest rate at which 95 % of the inferences end within their period (1000 / p95).
    """
    x = np.asarray(latencies_ms, float)
    mean_ms, p95_ms = float(x.mean()), float(np.percentile(x, 95))
    return {
        **{f"latency_{name}_ms": float(np.percentile(x, q)) for name, q in PERCENTILES.items()},
        "latency_min_ms": float(x.min()),
        "latency_mean_ms": mean_ms,
        "latency_max_ms": float(x.max()),
        "n": len(x),
        "throughput_fps": 1000 / mean_ms if mean_ms > 0 else math.inf,
        "control_rate_hz": 1000 / p95_ms if p95_ms > 0 else math.inf,
    }


def _silent(items: Iterable, **_: object) -> Iterable:
    return items


@dataclass(frozen=True)
class BenchmarkOptions:
    """How to time policies. Raises ParamsError for impossible values.

    warmup: inferences of each policy that are not counted. iterations: number of rounds. duration_s: instead, a soak
    test with a time series. at_most_s: limits the time, but not to less than LEAST_ROUNDS. main: whose figures are at
    the top level (None: the first's). reference: what the others' speed is compared with. memory_alone: measure each
    artifact's memory in a process of its own.
    """

    warmup: int = 10
    iterations: int = 100
    duration_s: float | None = None
    at_most_s: float | None = None
    main: str | None = None
    reference: str | None = None
    memory_alone: bool = False

    def __post_init__(self) -> None:
        rules = {"warmup": whole(0, MOST), "iterations": whole(1, MOST)}
        rules |= dict.fromkeys(("duration_s", "at_most_s"), optional(number(0.001, MOST)))
        if broken := broken_rule(vars(self), rules):
            raise ParamsError(f"{broken[0]} of a benchmark must be {broken[1]}", found=broken[2])


@dataclass(frozen=True)
class Clocks:
    """The clocks of a benchmark, both in seconds: elapsed time, and processor time."""

    wall: Callable[[], float] = time.perf_counter
    cpu: Callable[[], float] = time.process_time


DEFAULTS = BenchmarkOptions()
REAL_TIME = Clocks()


def benchmark(
    policies: Mapping[str, Any],
    frames: Sequence[Any],
    state: np.ndarray,
    options: BenchmarkOptions = DEFAULTS,
    *,
    host: Host | None = None,
    clocks: Clocks = REAL_TIME,
    progress: Progress = _silent,
) -> dict[str, Any]:
    """Time every policy's predict_chunk(frame, state), interleaved, and return the metrics of benchmark-<host>.json.

    policies: name -> an object with predict_chunk; its `.manifest` ("mode", "gmac"), `.path` and `.threads` are used if
    it has them. frames: used in turn.

    cpu_pct is processor time as a share of all cores that this process may use. temperature_c is the highest and
    clock_mhz the lowest reading. peak_memory_mb is the artifact's alone if it was measured, else None, and this
    process's at the top level. Raises ParamsError without policies or frames, or if main or reference is not among the
    policies.
    """
    names = list(policies)
    main, reference = options.main or next(iter(names), None), options.reference
    if not len(frames) or main not in names or reference not in (None, *names):
        what = f"a benchmark needs frames and policies, {main} and {reference} among them"
        raise ParamsError(what, found=f"{len(frames)} frames and {names}")
    host = host or Host()
    cores = usable_cores()
    for name in names:
        for i in range(options.warmup):
            policies[name].predict_chunk(frames[i % len(frames)], state)
    run = _Run(policies, frames, state, host, clocks)
    run.measure(options, progress)
    threads = getattr(policies[main], "threads", None)

    artifacts = {name: run.metrics_of(name, cores) for name in names}
    top = dict(artifacts[main])
    if reference is not None:
        for name, metrics in artifacts.items():
            metrics |= run.speedup(name, reference)
    process_mb = host.process_peak_memory_mb()
    metrics = {
        **top,
        "peak_memory_mb": process_mb,
        "process_peak_memory_mb": process_mb,
        "cpu_pct": _share_pct(run.process_s, run.wall_s, cores),
        **run.host_metrics(),
        "main": main,
        "reference": reference,
        "threads": threads,
        "cores": cores,
        "warmup": options.warmup,
        "rounds": len(run.latencies_ms[main]),
        "wall_s": run.wall_s,
        "artifacts": artifacts,
        "series": run.series if options.duration_s is not None else None,
    }
    if options.memory_alone:
        paths = {name: path for name in names if (path := getattr(policies[name], "path", None))}
        _add_memory(metrics, paths, threads)
    return metrics


def _share_pct(cpu_s: float, wall_s: float, cores: int) -> float | None:
    return 100 * cpu_s / wall_s / cores if wall_s > 0 else None


class _Run:
    """The timed part of one benchmark."""

    def __init__(
        self, policies: Mapping[str, Any], frames: Sequence[Any], state: np.ndarray, host: Host, clocks: Clocks
    ):
        self.policies, self.frames, self.state = policies, frames, state
        self.host, self.clocks = host, clocks
        self.latencies_ms: dict[str, list[float]] = {name: [] for name in policies}
        self.cpu_s = dict.fromkeys(policies, 0.0)
        self.readings: list[dict[str, Any]] = []
        self.series: list[dict[str, Any]] = []
        self.wall_s = self.process_s = 0.0
        self.per_core_pct: list[float] | None = None

    def measure(self, options: BenchmarkOptions, progress: Progress) -> None:
        """Time `iterations` rounds, or as many as begin within duration_s, and fill the lists."""
        duration_s, names = options.duration_s, list(self.policies)
        if duration_s is None:
            rounds = progress(range(options.iterations), desc="timing", total=options.iterations)
        else:
            rounds = progress(itertools.count(), desc=f"soaking for {duration_s:g} s", total=None)
        # at most 300 points: enough to see a machine throttle, few enough to plot and to keep
        every_s = max(1.0, (duration_s or 0) / 300)
        self.readings.append(self.host.reading())
        before = self.host.core_ticks()
        cpu_start_s, start_s = self.clocks.cpu(), self.clocks.wall()
        ends = (duration_s or math.inf, 1), (options.at_most_s or math.inf, LEAST_ROUNDS)
        tick_s, seen = every_s, dict.fromkeys(names, 0)
        for i in rounds:
            passed_s = self.clocks.wall() - start_s
            if any(i >= least and passed_s >= end_s for end_s, least in ends):
                break
            if duration_s and passed_s >= tick_s:
                self._note(passed_s, seen)
                tick_s = passed_s + every_s
            for k in range(len(names)):
                self._time(names[(i + k) % len(names)], self.frames[i % len(self.frames)])
        self.wall_s, self.process_s = self.clocks.wall() - start_s, self.clocks.cpu() - cpu_start_s
        after = self.host.core_ticks()
        self._note(self.wall_s, seen)
        if before and after and len(before) == len(after):
            spans = [(b1 - b0, a1 - a0) for (b0, a0), (b1, a1) in zip(before, after, strict=True)]
            self.per_core_pct = [100 * busy / total if total > 0 else 0.0 for busy, total in spans]

    def metrics_of(self, name: str, cores: int) -> dict[str, Any]:
        """Return the figures of one policy: those measured, and those known from its manifest and file."""
        policy, times_ms = self.policies[name], self.latencies_ms[name]
        manifest = getattr(policy, "manifest", None) or {}
        path = getattr(policy, "path", None)
        mode, gmac = manifest.get("mode"), manifest.get("gmac")
        return {
            **latency_metrics(times_ms),
            "peak_memory_mb": None,
            "cpu_pct": _share_pct(self.cpu_s[name], sum(times_ms) / 1000, cores),
            "floor_ms": floor_ms(gmac, mode) if mode else None,
            "gmac": gmac,
            "mode": mode,
            "size_mb": Path(path).stat().st_size / 1e6 if path and Path(path).is_file() else None,
        }

    def speedup(self, name: str, reference: str) -> dict[str, float | None]:
        """Return how many times as fast as the reference a policy is: by p50, and from 5 to 95 % of the rounds."""
        times_ms, reference_ms = self.latencies_ms[name], self.latencies_ms[reference]
        p50_ms, reference_p50_ms = (float(np.percentile(x, 50)) for x in (times_ms, reference_ms))
        paired = np.asarray(reference_ms) / np.maximum(times_ms, 1e-9)
        low, high = np.percentile(paired, (5, 95)).tolist()
        return {"speedup": reference_p50_ms / p50_ms if p50_ms > 0 else None, "speedup_p5": low, "speedup_p95": high}

    def host_metrics(self) -> dict[str, Any]:
        """Return the machine's state in the run: load of its cores, highest temperature, lowest clock, throttling."""
        temperatures_c = [r["temperature_c"] for r in self.readings if r["temperature_c"] is not None]
        clocks_mhz = [r["clock_mhz"] for r in self.readings if r["clock_mhz"] is not None]
        throttled = self.readings[-1]["throttled"]
        return {
            "cpu_per_core_pct": self.per_core_pct,
            "temperature_c": max(temperatures_c, default=None),
            "clock_mhz": min(clocks_mhz, default=None),
            "throttled": throttled,
            "throttled_means": throttled_means(throttled),
        }

    def _time(self, name: str, frame: Any) -> None:
        predict = self.policies[name].predict_chunk
        cpu_start_s, start_s = self.clocks.cpu(), self.clocks.wall()
        predict(frame, self.state)
        end_s, cpu_end_s = self.clocks.wall(), self.clocks.cpu()
        self.latencies_ms[name].append((end_s - start_s) * 1000)
        self.cpu_s[name] += cpu_end_s - cpu_start_s

    def _note(self, t_s: float, seen: dict[str, int]) -> None:
        """Add one point to the time series: the latencies since the last point, and the host's state."""
        reading = self.host.reading()
        self.readings.append(reading)
        artifacts = {}
        for name, times_ms in self.latencies_ms.items():
            recent, seen[name] = times_ms[seen[name] :], len(times_ms)
            if recent:
                all_of = latency_metrics(recent)
                artifacts[name] = {key: all_of[key] for key in NOTED}
        memory_mb = self.host.process_peak_memory_mb()
        self.series.append({"t_s": t_s, **reading, "memory_mb": memory_mb, "artifacts": artifacts})
