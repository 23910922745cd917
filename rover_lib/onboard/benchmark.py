"""Time policies on the machine that runs them: a distribution, the host's state, and the floor of a Pi 5
beside it.

    metrics = benchmark({"static": static, "fp32": fp32}, frames, state, warmup=10, iterations=100)
    gates = check_gates(metrics, params["gates"]["original"])

All policies are timed interleaved in one run, one inference of each per round and another one first in every
round: a machine that heats up or is shared slows all of them alike. What a host cannot tell (no thermal
zone, no vcgencmd) is None, not 0. MB are 10**6 bytes.
"""

import itertools
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rover_lib.onboard.errors import ParamsError, PolicyError
from rover_lib.onboard.host import Host, throttled_means

# Measured peaks of a Raspberry Pi 5, four cores at 2.4 GHz (public cpufp results), in 10**9 multiply-accumulates
# per second: INT8 SDOT 614 GOPS, FP16 307 GFLOPS, FP32 153.5 GFLOPS, two operations to a multiply-accumulate.
PI5_GMAC_PER_S = {"int8": 307.0, "fp16": 153.5, "fp32": 76.75}
PRECISION = {"dynamic": "int8", "static": "int8", "mixed": "int8"}  # of an artifact's mode, at its best

PERCENTILES = {"p50": 50, "p95": 95, "p99": 99}
HIGHER_IS_BETTER = ("throughput_fps", "control_rate_hz")
GATE_KEYS = {"memory_mb": "peak_memory_mb", "model_size_mb": "size_mb"}  # gates that go by another name here


def floor_ms(gmac: float | Mapping[str, float] | None, mode: str) -> float | None:
    """The least time that a Pi 5 needs for one inference, by arithmetic alone; None where `gmac` is not
    known.

    gmac: 10**9 multiply-accumulates of one inference, or a mapping from precision (int8, fp16, fp32) to its
    share. mode: a precision, or an artifact's mode, for which a plain number counts as if all of it were in
    INT8 (fp32: in FP32). That is a true floor for `mixed` and `dynamic` too, though one that they cannot
    reach. Raises ParamsError for an unknown mode or a count that is no amount.
    """
    if gmac is None:
        return None
    shares = gmac if isinstance(gmac, Mapping) else {PRECISION.get(mode, mode): gmac}
    total_s = 0.0
    for precision, amount in shares.items():
        if precision not in PI5_GMAC_PER_S:
            known = sorted({*PI5_GMAC_PER_S, *PRECISION})
            raise ParamsError(f"no Pi 5 peak is known for {precision!r}: choose one of {', '.join(known)}")
        if isinstance(amount, bool) or not isinstance(amount, (int, float)) or not 0 <= amount < math.inf:
            raise ParamsError(f"gmac must be a number from 0, found {amount!r}: count the model again")
        total_s += amount / PI5_GMAC_PER_S[precision]
    return total_s * 1000


def peak_memory_alone_mb(path: Path | str, *, threads: int | None = None, timeout_s: float = 300) -> float | None:
    """Peak resident memory of a fresh process that loads one artifact and predicts three times; None if it
    has no reading.

    The calling process holds every policy that is compared, so that its own peak says nothing about one of
    them. Raises PolicyError if the artifact does not load or predict there.
    """
    code = (
        "import sys, numpy as np\n"
        "from rover_lib.onboard import load_policy\n"
        "from rover_lib.onboard.host import Host\n"
        "policy = load_policy(sys.argv[1], threads=int(sys.argv[2]) or None)\n"
        "cameras = policy.manifest['cameras']\n"
        "frame = {c['name']: np.zeros((c['height'], c['width'], 3), np.uint8) for c in cameras}\n"
        "for _ in range(3):\n"
        "    policy.predict_chunk(frame, np.zeros(len(policy.state_names), np.float32))\n"
        "print('peak', Host().process_peak_memory_mb())\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    try:
        found = subprocess.run(
            [sys.executable, "-c", code, str(path), str(threads or 0)],
            capture_output=True,
            text=True,
            timeout=timeout_s,
            env=environment,
        )
    except subprocess.TimeoutExpired:
        raise PolicyError(f"{path}: no prediction within {timeout_s:g} s in a process of its own") from None
    if found.returncode:
        last = (found.stderr.strip().splitlines() or ["no message"])[-1]
        raise PolicyError(f"{path}: does not run in a process of its own ({last}): load it here to see why")
    word = found.stdout.split()[-1]
    return None if word == "None" else float(word)


def latency_metrics(latencies_ms: Sequence[float]) -> dict[str, float | int]:
    """The distribution of one policy's latencies, and the rates that follow.

    throughput_fps: inferences per second, one after the other (1000 / mean). control_rate_hz: the highest
    rate at which 95 % of the inferences end within their period (1000 / p95).
    """
    x = np.asarray(latencies_ms, float)
    found: dict[str, float | int] = {
        f"latency_{name}_ms": float(np.percentile(x, q)) for name, q in PERCENTILES.items()
    }
    found["latency_mean_ms"] = float(x.mean())
    found["latency_max_ms"] = float(x.max())
    found["n"] = len(x)
    found["throughput_fps"] = float(1000 / x.mean()) if x.mean() > 0 else math.inf
    p95_ms = found["latency_p95_ms"]
    found["control_rate_hz"] = 1000 / p95_ms if p95_ms > 0 else math.inf
    return found


def benchmark(
    policies: Mapping[str, Any],
    frames: Sequence[Any],
    state: np.ndarray,
    *,
    warmup: int = 10,
    iterations: int = 100,
    threads: int | None = None,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    main: str | None = None,
    reference: str | None = None,
    memory_alone: bool = False,
    host: Host | None = None,
    clock: Callable[[], float] = time.perf_counter,
    cpu_clock: Callable[[], float] = time.process_time,
    sleep: Callable[[float], None] = time.sleep,
    progress: Callable[..., Iterable] | None = None,
) -> dict[str, Any]:
    """Time every policy's predict_chunk(frame, state), interleaved, and return the metrics of
    benchmark-<host>.json.

    policies: name -> anything with predict_chunk; `.manifest` ("mode", "gmac") and `.path` are used where
    there are any. frames: taken in turn. iterations: rounds; with duration_s, a soak, rounds until that time
    is over, with a time series. threads: torch's threads, 0 for all cores, None as they are; restored
    afterwards. rate_hz: at most this many inferences per second, on absolute deadlines, as a drive makes
    them; None: as fast as it can. main: whose figures stand at the top level (the first if None). reference:
    whose p50 the others are compared with. memory_alone: measure each artifact's memory in a process of its
    own (seconds each). progress: called like tqdm.tqdm(iterable, desc=, total=), or None.

    At the top level cpu_pct is this process's time over the whole run, as a share of all cores it may use;
    per artifact, of its own inferences. temperature_c is the highest and clock_mhz the lowest reading.
    peak_memory_mb is the artifact's alone where measured, else None there and this process's at the top
    level. Raises ParamsError for parameters that make no sense; what a policy raises goes through.
    """
    names = list(policies)
    main = names[0] if main is None and names else main
    for name in (main, reference):
        if name is not None and name not in policies:
            raise ParamsError(f"no policy {name!r} to benchmark, found {names}: name one of them")
    if not names or not len(frames):
        raise ParamsError(f"nothing to benchmark: {len(names)} policies, {len(frames)} frames")
    if warmup < 0 or iterations < 1:
        raise ParamsError(f"warmup must be from 0 and iterations from 1, found {warmup} and {iterations}")
    for what, value in (("duration_s", duration_s), ("rate_hz", rate_hz)):
        if value is not None and not 0 < value < math.inf:
            raise ParamsError(f"{what} must be above 0, found {value}")
    if threads is not None and threads < 0:
        raise ParamsError(f"threads must be from 0 (all cores), found {threads}")
    host = host or Host()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads_before = torch.get_num_threads()
    if threads is not None:
        torch.set_num_threads(threads or cores)
    try:
        for name in names:
            for i in range(warmup):
                policies[name].predict_chunk(frames[i % len(frames)], state)
        run = _Run(policies, frames, state, host, clock, cpu_clock, sleep, rate_hz)
        run.measure(iterations, duration_s, progress)
        threads_used = torch.get_num_threads()
    finally:
        torch.set_num_threads(threads_before)

    artifacts: dict[str, dict[str, Any]] = {}
    for name, policy in policies.items():
        manifest = getattr(policy, "manifest", None) or {}
        path = getattr(policy, "path", None)
        mode, gmac = manifest.get("mode"), manifest.get("gmac")
        times_ms = run.latencies_ms[name]
        artifacts[name] = {
            **latency_metrics(times_ms),
            "peak_memory_mb": peak_memory_alone_mb(path, threads=threads_used) if memory_alone and path else None,
            "cpu_pct": _share_pct(run.cpu_s[name], sum(times_ms) / 1000, cores),
            "floor_ms": floor_ms(gmac, mode) if mode else None,
            "gmac": gmac,
            "mode": mode,
            "size_mb": Path(path).stat().st_size / 1e6 if path and Path(path).is_file() else None,
        }
        if reference is not None:
            paired = np.asarray(run.latencies_ms[reference]) / np.maximum(times_ms, 1e-9)
            p50_ms = artifacts[name]["latency_p50_ms"]
            reference_ms = float(np.percentile(run.latencies_ms[reference], 50))
            artifacts[name]["speedup"] = reference_ms / p50_ms if p50_ms > 0 else None
            artifacts[name]["speedup_p5"], artifacts[name]["speedup_p95"] = np.percentile(paired, (5, 95)).tolist()
    process_mb = host.process_peak_memory_mb()
    throttled = run.readings[-1]["throttled"]
    top = {k: v for k, v in artifacts[main].items() if not k.startswith("speedup")}
    return {
        **top,
        "peak_memory_mb": process_mb if top["peak_memory_mb"] is None else top["peak_memory_mb"],
        "process_peak_memory_mb": process_mb,
        "cpu_pct": _share_pct(run.process_s, run.wall_s, cores),
        "cpu_per_core_pct": run.per_core_pct,
        "temperature_c": max(
            (r["temperature_c"] for r in run.readings if r["temperature_c"] is not None), default=None
        ),
        "clock_mhz": min((r["clock_mhz"] for r in run.readings if r["clock_mhz"] is not None), default=None),
        "throttled": throttled,
        "throttled_means": throttled_means(throttled),
        "main": main,
        "reference": reference,
        "threads": threads_used,
        "cores": cores,
        "warmup": warmup,
        "rounds": len(run.latencies_ms[main]),
        "wall_s": run.wall_s,
        "rate_hz": rate_hz,
        "missed_deadlines": run.missed if rate_hz else None,
        "artifacts": artifacts,
        "series": run.series if duration_s is not None else None,
    }


def _share_pct(cpu_s: float, wall_s: float, cores: int) -> float | None:
    return 100 * cpu_s / wall_s / cores if wall_s > 0 else None


class _Run:
    """The timed part of one benchmark."""

    def __init__(self, policies, frames, state, host, clock, cpu_clock, sleep, rate_hz):
        self.policies, self.frames, self.state, self.host = policies, frames, state, host
        self.clock, self.cpu_clock, self.sleep, self.rate_hz = clock, cpu_clock, sleep, rate_hz
        self.latencies_ms: dict[str, list[float]] = {name: [] for name in policies}
        self.cpu_s = dict.fromkeys(policies, 0.0)
        self.readings: list[dict[str, Any]] = []
        self.series: list[dict[str, Any]] = []
        self.missed = 0
        self.wall_s = self.process_s = 0.0
        self.per_core_pct: list[float] | None = None

    def measure(self, iterations: int, duration_s: float | None, progress: Callable[..., Iterable] | None) -> None:
        """Fill the lists: `iterations` rounds, or as many as begin within duration_s."""
        rounds: Iterable[int] = range(iterations) if duration_s is None else itertools.count()
        if progress:
            text = "timing" if duration_s is None else f"soaking for {duration_s:g} s"
            rounds = progress(rounds, desc=text, total=iterations if duration_s is None else None)
        # at most 300 points: enough to see a machine throttle, few enough to plot and to keep
        every_s = max(1.0, (duration_s or 0) / 300)
        names = list(self.policies)
        self.readings.append(self.host.reading())
        before = self.host.core_ticks()
        cpu_start_s, start_s = self.cpu_clock(), self.clock()
        due_s, tick_s, seen = start_s, start_s + every_s, dict.fromkeys(names, 0)
        for i in rounds:
            if duration_s is not None and self.clock() - start_s >= duration_s and i > 0:
                break
            for k in range(len(names)):
                if self.rate_hz:
                    due_s = self._wait(due_s)
                self._time(names[(i + k) % len(names)], self.frames[i % len(self.frames)])
            if duration_s is not None and (now_s := self.clock()) >= tick_s:
                self._note(now_s - start_s, seen)
                tick_s = now_s + every_s
        self.wall_s, self.process_s = self.clock() - start_s, self.cpu_clock() - cpu_start_s
        after = self.host.core_ticks()
        if duration_s is not None and any(len(self.latencies_ms[n]) > seen[n] for n in names):
            self._note(self.wall_s, seen)
        else:
            self.readings.append(self.host.reading())
        if before and after and len(before) == len(after):
            spans = [(b1 - b0, a1 - a0) for (b0, a0), (b1, a1) in zip(before, after, strict=True)]
            self.per_core_pct = [100 * busy / total if total > 0 else 0.0 for busy, total in spans]

    def _time(self, name: str, frame: Any) -> None:
        predict = self.policies[name].predict_chunk
        cpu_start_s, start_s = self.cpu_clock(), self.clock()
        predict(frame, self.state)
        end_s, cpu_end_s = self.clock(), self.cpu_clock()
        self.latencies_ms[name].append((end_s - start_s) * 1000)
        self.cpu_s[name] += cpu_end_s - cpu_start_s

    def _wait(self, due_s: float) -> float:
        """Wait for a deadline and return the next one; one that is over is counted and not made up for."""
        now_s = self.clock()
        if now_s < due_s:
            self.sleep(due_s - now_s)
        period_s = 1 / self.rate_hz
        behind = math.floor((now_s - due_s) / period_s) if now_s > due_s else 0
        self.missed += behind
        return due_s + (behind + 1) * period_s

    def _note(self, t_s: float, seen: dict[str, int]) -> None:
        """One point of the soak's series: the latencies since the last one, and the host's state."""
        reading = self.host.reading()
        self.readings.append(reading)
        point: dict[str, Any] = {
            "t_s": t_s,
            **reading,
            "memory_mb": self.host.process_peak_memory_mb(),
            "artifacts": {},
        }
        for name, times_ms in self.latencies_ms.items():
            recent = times_ms[seen[name] :]
            seen[name] = len(times_ms)
            if recent:
                point["artifacts"][name] = {
                    "latency_p50_ms": float(np.percentile(recent, 50)),
                    "latency_p95_ms": float(np.percentile(recent, 95)),
                    "latency_max_ms": float(max(recent)),
                    "n": len(recent),
                }
        self.series.append(point)


def check_gates(metrics: Mapping[str, Any], gates: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Hold measured figures against gates: one {gate, limit, found, passed} each; passed is None if not
    measured.

    A gate is a number or a [low, high] range that was promised. Doing better than promised passes: a latency
    need only not be above its range, a rate not below it. A single number must be stayed under (rates:
    reached). A text, such as throttled "0x0", must be equal. Raises ParamsError for a gate that is none of
    these.
    """
    rows = []
    for gate, limit in gates.items():
        found = metrics.get(gate)
        if found is None:
            found = metrics.get(GATE_KEYS.get(gate, gate))
        if isinstance(limit, str):
            passed = None if found is None else found == limit
            rows.append({"gate": gate, "limit": limit, "found": found, "passed": passed})
            continue
        is_range = isinstance(limit, (list, tuple)) and len(limit) == 2
        ends = list(limit) if is_range else [limit]
        numbers = [e for e in ends if isinstance(e, (int, float)) and not isinstance(e, bool) and math.isfinite(e)]
        if len(numbers) != len(ends) or ends != sorted(ends):
            raise ParamsError(f"gate {gate} must be a number, [low, high] or a text, found {limit!r}: see params.yml")
        if found is None or isinstance(found, str) or math.isnan(found):
            found, passed = None, None
        elif gate in HIGHER_IS_BETTER:
            passed = bool(found >= ends[0])
        else:
            passed = bool(found <= ends[1] if is_range else found < ends[0])
        rows.append({"gate": gate, "limit": limit, "found": found, "passed": passed})
    return rows
