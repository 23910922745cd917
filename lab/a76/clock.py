"""Predict what a Raspberry Pi 5 takes from what is counted, and hold the prediction against published times.

    tell_time("results/clock/clock.json")      # what `python -m lab clock` does

`rover_lib.onboard.care.pi5` has the model. Here it is fitted, and each network is predicted by a fit that knew none of
its architecture, our policies by a fit of all.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.a76.core import A76, CountError, prepare
from lab.a76.network_counts import (
    NCNN,
    POLICIES,
    SOURCES,
    THREADS,
    Published,
    Shape,
    count_executorch,
    count_ncnn,
    count_policy,
    read_published,
)
from rover_lib.onboard.care.pi5 import CORES, FITTED, Span, Work, predict_ms, spread, time_ms
from rover_lib.onboard.columns import align
from rover_lib.onboard.stage import atomic_path, read_stage, write_stage
from rover_lib.workshop.judge.compare import gate
from rover_lib.workshop.progress import Progress, silent

OUTPUT = Path(__file__).parents[2] / "results" / "clock" / "clock.json"
HELD = 0.9  # the share of times that an interval is to hold
GENTLE = 0.05  # a relative error below it weighs by its square, above it more and more by its size
STEPS, START = 60, (150.0, 2000.0, 6000.0)  # of the fit, and where it begins
NOT_JUDGED = {  # rows that are predicted but neither fitted nor judged, and why
    "executorch/googlenet/int8": "its time is that of one thread, in INT8 and in FP32",
}


@dataclass(frozen=True)
class Row:
    """A published time with the work behind it."""

    network: Published
    threads: int
    work: Work

    @property
    def architecture(self) -> str:
        return self.network.name.removesuffix("_int8").removesuffix("1_0")

    @property
    def ms(self) -> float:
        return self.network.ms[self.threads]

    @property
    def terms(self) -> tuple[float, float, float]:
        return self.work.terms(self.threads)


def fit(rows: Sequence[Row]) -> tuple[float, ...]:
    """Return what an instruction, a near line and a far line take, in ns, so that relative errors are small.

    Gauss-Newton steps on errors whose weights fall with their size, so that a few odd networks do not decide.
    """
    terms, ms = np.array([row.terms for row in rows]), np.array([row.ms for row in rows])
    ns = np.array(START) / 1e3
    for _ in range(STEPS):
        own, shared = 1e3 * terms[:, :2] @ ns[:2], 1e3 * terms[:, 2] * ns[2]
        found = np.hypot(own, shared)
        slopes = 1e3 * terms * np.stack([own, own, shared], 1) / (found * ms)[:, None]
        off = found / ms - 1
        weight = 1 / np.sqrt(np.abs(off) + GENTLE)
        step = np.linalg.lstsq(slopes * weight[:, None], -off * weight, rcond=None)[0]
        ns = np.maximum(ns + 0.7 * step, 0)
    return tuple(float(n) for n in ns)


def off_of(row: Row, ns: Sequence[float]) -> float:
    """Return the natural logarithm of published by predicted time."""
    return math.log(row.ms / time_ms(row.terms, ns))


def reach(off: Iterable[float]) -> float:
    """Return how far HELD of such logarithms reach at most, and the next one, for the one that is to be predicted."""
    sizes = sorted(map(abs, off))
    return sizes[min(len(sizes) - 1, math.ceil(HELD * (len(sizes) + 1)) - 1)]


def leave_out(rows: Sequence[Row]) -> tuple[list[dict[str, float]], list[float]]:
    """Predict each row by fits that knew nothing of its architecture; return its interval, and its `off_of`.

    The interval is as wide as such fits were off on the other architectures, for as many threads.
    """
    parts = {a: [row for row in rows if row.architecture != a] for a in {row.architecture for row in rows}}
    fits = {a: fit(others) for a, others in parts.items()}
    off = [off_of(row, fits[row.architecture]) for row in rows]
    predicted = []
    for row in rows:
        others = [
            o for o, r in zip(off, rows, strict=True) if r.threads == row.threads and r.architecture != row.architecture
        ]
        span = spread(time_ms(row.terms, fits[row.architecture]), reach(others))
        predicted.append(told(span))
    return predicted, off


def told(span: Span) -> dict[str, float]:
    """Return a computed time as a row of clock.json says it, with four digits."""
    keys = ("predicted_low_ms", "predicted_ms", "predicted_high_ms")
    return {key: float(f"{ms:.4g}") for key, ms in zip(keys, span, strict=True)}


def judge(rows: Sequence[tuple[Row, Mapping[str, float], float]]) -> dict[str, float]:
    """Return how many there are, the median and the worst error in percent, and the share that the interval holds.

    rows: each with its prediction and its `off_of`.
    """
    errors = [100 * abs(math.exp(-off) - 1) for _, _, off in rows]
    held = [span["predicted_low_ms"] <= row.ms <= span["predicted_high_ms"] for row, span, _ in rows]
    return {
        "n": len(rows),
        "median_pct": float(np.median(errors)),
        "worst_pct": max(errors),
        "held_pct": 100 * sum(held) / len(held),
    }


def tell_time(
    output: Path | str = OUTPUT, *, graphs: Path | None = None, limits: Mapping[str, Any], progress: Progress = silent
) -> dict[str, Any]:
    """Count what is not counted yet, fit, predict, and write `output` and what the rover knows of the fit.

    graphs: benchmark/models of a copy of ncnn's repository, which only counting ncnn's networks needs. limits: `clock`
    of lab/params.yml. metrics: see lab/README.md.
    """
    output = Path(output)
    known = read_stage(output, "clock")["metrics"]["counts"] if output.is_file() else {}
    counts = _count(known, output, graphs, progress)
    networks = [n for n in read_published() if n.key in counts]
    every = [Row(n, threads, Work.of(counts[n.key])) for n in networks for threads in n.ms]
    judged = [row for row in every if row.network.key not in NOT_JUDGED]
    predicted, off = leave_out(judged)
    wide = {n: reach(o for o, row in zip(off, judged, strict=True) if row.threads == n) for n in (1, THREADS)}
    fitted: dict[str, Any] = {"ns": fit(judged), "off": {str(n): reached for n, reached in wide.items()}}
    fitted["gmac_per_s"] = _gmac_per_s(counts, fitted)
    left_out = dict(zip(((r.network.key, r.threads) for r in judged), predicted, strict=True))
    rows = []
    for row in every:
        n = row.network
        says = {"name": n.name, "runtime": n.runtime, "precision": n.precision, "threads": row.threads}
        says |= {"published_ms": row.ms, "source": SOURCES[n.runtime]} | counts[n.key]
        says |= left_out.get((n.key, row.threads)) or told(predict_ms(row.work, row.threads, fitted))
        rows.append(says | {"not_judged": NOT_JUDGED.get(n.key)})
    with atomic_path(FITTED) as temporary:
        temporary.write_text(json.dumps(fitted, indent=1) + "\n")
    found = {}
    for threads in (1, THREADS):
        chosen = [told for told in zip(judged, predicted, off, strict=True) if told[0].threads == threads]
        found[str(threads)] = judge(chosen)
    metrics = {
        "networks": rows,
        "policies": _policies(counts, fitted),
        "fit": fitted,
        "judged": found,
        "other_runtime": {runtime: _other_runtime(judged, runtime) for runtime in SOURCES},
        "not_counted": [n.key for n in read_published() if n.key not in counts],
        "counts": counts,
    }
    metrics["gates"] = [
        gate(
            f"{n} thread{'s' * (n != '1')}, {key.replace('_pct', ' %')}",
            found[n][key],
            ">=" if key in ("n", "held_pct") else "<=",
            limit,
        )
        for n, own in limits["gates"].items()
        for key, limit in own.items()
    ]
    return write_stage(output, "clock", params={"cpu": A76, "ncnn": NCNN, "held": HELD}, metrics=metrics, inputs={})


def _count(known: Mapping[str, Any], output: Path, graphs: Path | None, progress: Progress) -> dict[str, Any]:
    """Return the counts by key: those that are known, and new ones of what is not known and can be counted here."""
    counts, published = dict(known), read_published()
    new = [n for n in published if n.key not in known]
    ncnn = [n for n in new if n.runtime == "ncnn" and graphs]
    others = [n for n in new if n.runtime == "executorch"]
    policies = [shape for shape in POLICIES if key_of_policy(shape) not in known]
    if not known and not graphs:
        raise CountError(
            f"{output}: has no counts yet, and ncnn's graphs are not given",
            remedy="--ncnn benchmark/models of a copy of ncnn's repository",
        )
    steps = iter(progress(range(len(ncnn) + len(others) + len(policies)), desc="networks, emulated"))

    def done(network: Published, work: dict[str, Any]) -> None:
        counts[network.key] = work
        next(steps, None)

    if ncnn or others or policies:
        core = prepare(progress)
        count_ncnn(core, ncnn, graphs or Path(), done)
        count_executorch(core, others, done)
        for shape in policies:
            counts[key_of_policy(shape)] = count_policy(core, shape)
            next(steps, None)
    return counts


def key_of_policy(shape: Shape) -> str:
    return f"ours/{shape.name}/{shape.mode}"


def _policies(counts: Mapping[str, Any], fitted: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what each of our policies takes on 1 to 4 threads."""
    rows = []
    for shape in POLICIES:
        if work := counts.get(key_of_policy(shape)):
            for threads in range(1, CORES + 1):
                span = told(predict_ms(Work.of(work), threads, fitted))
                rows.append({**shape.row(), "runtime": "torch", "precision": "int8", "threads": threads} | work | span)
    return rows


def _gmac_per_s(counts: Mapping[str, Any], fitted: Mapping[str, Any]) -> float:
    """Return the multiply-accumulates a second, in 10**9, of our largest policy at the high end while it drives."""
    work = counts[key_of_policy(POLICIES[0])]
    return 1e3 * work["gmac"] / predict_ms(Work.of(work), fit=fitted).high


def _other_runtime(rows: Sequence[Row], runtime: str) -> dict[str, float]:
    """Return how far off a runtime's times on four threads are for a fit that knows only the other runtime's."""
    ns = fit([row for row in rows if row.network.runtime != runtime])
    errors = [
        100 * abs(math.exp(-off_of(row, ns)) - 1)
        for row in rows
        if row.network.runtime == runtime and row.threads == THREADS
    ]
    return {"n": len(errors), "median_pct": float(np.median(errors)), "worst_pct": max(errors)}


def table(content: Mapping[str, Any]) -> str:
    """Show clock.json as text: published against computed times, then our policies, and which gates hold."""
    metrics = content["metrics"]
    lines = [["", "threads", "published", "computed", "from", "to", "ms"]]
    for row in [*metrics["networks"], *metrics["policies"]]:
        name = f"{row['runtime']} {row['name']} {row['precision']}"
        times = [row.get("published_ms"), *(row[f"predicted{end}_ms"] for end in ("", "_low", "_high"))]
        lines.append([name, str(row["threads"]), *("-" if ms is None else f"{ms:.4g}" for ms in times), ""])
    verdicts = [
        f"{row['gate']}: {row['found']:.1f}, wanted {row['relation']} {row['limit']:g}"
        f"{'' if row['passed'] else ', FAIL'}"
        for row in metrics["gates"]
    ]
    return "\n".join([*align(lines), "", *verdicts])
