"""Predict what a Raspberry Pi 5 takes from what is counted, and hold the prediction against published times.

    tell_time("results/clock/clock.json")      # what `python -m lab clock` does

`rover_lib.onboard.care.pi5` has the model. Here it is fitted, and each network is predicted by a fit that knew none of
its architecture, our policies by a fit of all. The model's form was chosen, and `judge_choice` judges that too.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from lab.a76.core import A76, GUEST, PLUGIN, prepare
from lab.a76.network_counts import (
    EXECUTORCH,
    NCNN,
    POLICIES,
    SOURCES,
    THREADS,
    TOO_SLOW,
    TORCHVISION,
    Published,
    Shape,
    count_network,
    count_policy,
    read_published,
)
from rover_lib.onboard.care.pi5 import CORES, FITTED, OVERLAP, Span, Work, predict_ms, spread, time_ms
from rover_lib.onboard.columns import align
from rover_lib.onboard.stage import atomic_path, read_stage, write_stage
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.judge.compare import gate
from rover_lib.workshop.progress import Progress, silent

OUTPUT = Path(__file__).parents[2] / "results" / "clock" / "clock.json"
HELD = 0.9  # the share of times that an interval is to hold
GENTLE = 0.05  # a relative error below it weighs by its square, above it more and more by its size
STEPS, START = 60, (300.0, 1000.0, 6000.0)  # of the fit, and where it begins, in ps
FORMS = tuple(product(("cycles_g", "instructions_g"), (OVERLAP, 1)))  # that the model was chosen from; the first is it
ODD = {"executorch/googlenet/int8": "as long as one thread takes"}  # what is off by more than a gate, and how
JOBS = 2  # how many networks are counted at a time


@dataclass(frozen=True)
class Row:
    """A published time with the work behind it."""

    network: Published
    threads: int
    work: Work
    instructions_g: float = 0.0
    power: int = OVERLAP

    @property
    def architecture(self) -> str:
        return self.network.name.removesuffix("_int8").removesuffix("1_0")

    @property
    def ms(self) -> float:
        return self.network.ms[self.threads]

    @property
    def terms(self) -> tuple[float, float, float]:
        return self.work.terms(self.threads)

    def in_form(self, own: str, power: int) -> "Row":
        """Return it as another form of the model sees it. own: what a core's own time is counted in."""
        cycles_g = self.instructions_g if own == "instructions_g" else self.work.cycles_g
        return replace(self, work=replace(self.work, cycles_g=cycles_g), power=power)


def fit(rows: Sequence[Row]) -> tuple[float, ...]:
    """Return what a cycle, a near line and a far line take, in ns, so that relative errors are small.

    Gauss-Newton steps on errors whose weights fall with their size, so that a few odd networks do not decide.
    """
    terms, ms = np.array([row.terms for row in rows]), np.array([row.ms for row in rows])
    ns, p = np.array(START) / 1e3, rows[0].power
    for _ in range(STEPS):
        own, shared = 1e3 * terms[:, :2] @ ns[:2], 1e3 * terms[:, 2] * ns[2]
        found = (own**p + shared**p) ** (1 / p)
        slopes = 1e3 * terms * (np.stack([own, own, shared], 1) / found[:, None]) ** (p - 1) / ms[:, None]
        off = found / ms - 1
        weight = 1 / np.sqrt(np.abs(off) + GENTLE)
        step = np.linalg.lstsq(slopes * weight[:, None], -off * weight, rcond=None)[0]
        ns = np.maximum(ns + 0.7 * step, 0)
    return tuple(float(n) for n in ns)


def off_of(row: Row, ns: Sequence[float]) -> float:
    """Return the natural logarithm of published by predicted time."""
    return math.log(row.ms / time_ms(row.terms, ns, row.power))


def reach(off: Iterable[float]) -> float:
    """Return how far HELD of such logarithms reach at most, and the next one, for the one that is to be predicted."""
    sizes = sorted(map(abs, off))
    return sizes[min(len(sizes) - 1, math.ceil(HELD * (len(sizes) + 1)) - 1)]


def leave_out(rows: Sequence[Row]) -> tuple[list[dict[str, float]], list[float]]:
    """Predict each row by fits that knew nothing of its architecture; return its interval, and its `off_of`.

    The interval is as wide as such fits were off on the other architectures, for as many threads.
    """
    off = off_left_out(rows)
    predicted = []
    for row, own in zip(rows, off, strict=True):
        others = [(r, o) for r, o in zip(rows, off, strict=True) if r.architecture != row.architecture]
        predicted.append(told(spread(row.ms * math.exp(-own), reach_of(others, row.threads))))
    return predicted, off


def reach_of(rows: Iterable[tuple[Row, float]], threads: int) -> float:
    """Return the `reach` of architectures, each by its row that is furthest off: what is new is an architecture."""
    worst: dict[str, float] = {}
    for row, off in rows:
        if row.threads == threads:
            worst[row.architecture] = max(worst.get(row.architecture, 0.0), abs(off))
    return reach(worst.values())


def off_left_out(rows: Sequence[Row]) -> list[float]:
    """Return `off_of` each row for a fit that knew nothing of its architecture."""
    architectures = {row.architecture for row in rows}
    fits = {a: fit([row for row in rows if row.architecture != a]) for a in architectures}
    return [off_of(row, fits[row.architecture]) for row in rows]


def judge_choice(rows: Sequence[Row]) -> dict[str, Any]:
    """Judge the choice of a form: each architecture is predicted by the form that was best on all of the others.

    Best is the least mean `off_left_out`, of either number of threads alike. Returns the median and the worst error in
    percent by threads, and how often each of FORMS was chosen.
    """
    in_forms = {form: [row.in_form(*form) for row in rows] for form in FORMS}
    chosen: dict[str, tuple[str, int]] = {}
    off: dict[int, list[float]] = {}
    for left_out in sorted({row.architecture for row in rows}):

        def mean_off(form: tuple[str, int], left_out: str = left_out) -> float:
            others = [row for row in in_forms[form] if row.architecture != left_out]
            sizes = list(zip(map(abs, off_left_out(others)), others, strict=True))
            return sum(float(np.mean([s for s, row in sizes if row.threads == n])) for n in (1, THREADS))

        form = chosen[left_out] = min(FORMS, key=mean_off)
        ns = fit([row for row in in_forms[form] if row.architecture != left_out])
        for row in in_forms[form]:
            if row.architecture == left_out:
                off.setdefault(row.threads, []).append(off_of(row, ns))
    forms = list(chosen.values())
    return {str(n): _errors(found) for n, found in sorted(off.items())} | {
        "chosen": {f"{own}, {power}": forms.count((own, power)) for own, power in FORMS}
    }


def _errors(off: Iterable[float]) -> dict[str, float]:
    errors = [100 * abs(math.exp(-o) - 1) for o in off]
    return {"n": len(errors), "median_pct": float(np.median(errors)), "worst_pct": max(errors)}


def told(span: Span) -> dict[str, float]:
    """Return a computed time as a row of clock.json says it, with four digits."""
    keys = ("predicted_low_ms", "predicted_ms", "predicted_high_ms")
    return {key: float(f"{ms:.4g}") for key, ms in zip(keys, span, strict=True)}


def judge(rows: Sequence[tuple[Row, Mapping[str, float], float]]) -> dict[str, float]:
    """Return how many there are, the median and the worst error in percent, and the share that the interval holds.

    rows: each with its prediction and its `off_of`.
    """
    held = [span["predicted_low_ms"] <= row.ms <= span["predicted_high_ms"] for row, span, _ in rows]
    return _errors(off for _, _, off in rows) | {"held_pct": 100 * sum(held) / len(held)}


def tell_time(
    output: Path | str = OUTPUT, *, graphs: Path | None = None, limits: Mapping[str, Any], progress: Progress = silent
) -> dict[str, Any]:
    """Count what is not counted yet, fit, predict, and write `output` and what the rover knows of the fit.

    graphs: benchmark in a copy of ncnn's repository at its tag 20240102, which only counting ncnn's networks needs.
    limits: `clock` of lab/params.yml. metrics: see lab/README.md.
    """
    output, counting = Path(output), counted_by()
    content = read_stage(output, "clock") if output.is_file() else {}
    same = content and content["params"].get("counting") == counting
    counts = _count(content["metrics"]["counts"] if same else {}, counting, graphs, progress)
    networks = [n for n in read_published() if n.key in counts]
    judged = [
        Row(n, threads, Work.of(counts[n.key]), counts[n.key]["instructions_g"]) for n in networks for threads in n.ms
    ]
    predicted, off = leave_out(judged)
    wide = {n: reach_of(zip(judged, off, strict=True), n) for n in (1, THREADS)}
    fitted: dict[str, Any] = {"ns": fit(judged), "off": {str(n): reached for n, reached in wide.items()}}
    fitted["gmac_per_s"] = _gmac_per_s(counts, fitted)
    rows = []
    for row, span in zip(judged, predicted, strict=True):
        n = row.network
        says = {"name": n.name, "runtime": n.runtime, "precision": n.precision, "threads": row.threads}
        says |= {"published_ms": row.ms, "source": SOURCES[n.runtime]} | counts[n.key] | span
        rows.append(says | {"odd": ODD.get(n.key)})
    with atomic_path(FITTED) as temporary:
        temporary.write_text(json.dumps(fitted, indent=1) + "\n")
    found = {}
    for threads in (1, THREADS):
        chosen = [told for told in zip(judged, predicted, off, strict=True) if told[0].threads == threads]
        found[str(threads)] = judge(chosen)
    ordinary = [(row.threads, o) for row, o in zip(judged, off, strict=True) if row.network.key not in ODD]
    without_odd = {str(n): _errors(o for threads, o in ordinary if threads == n) for n in (1, THREADS)}
    metrics = {
        "networks": rows,
        "policies": _policies(counts, fitted),
        "fit": fitted,
        "judged": found,
        "judged_without_odd": without_odd,
        "choice": judge_choice(judged),
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
    return write_stage(
        output,
        "clock",
        params={"cpu": A76, "ncnn": NCNN, "held": HELD, "counting": counting},
        metrics=metrics,
        inputs={},
    )


def counted_by() -> str:
    """Return a key of what counts: with another one, everything is counted anew."""
    packages = [NCNN, *EXECUTORCH.packages, *EXECUTORCH.guest_packages, TORCHVISION]
    return key_of({"packages": packages}, PLUGIN, GUEST / "network.py")


def _count(known: Mapping[str, Any], counting: str, graphs: Path | None, progress: Progress) -> dict[str, Any]:
    """Return the counts by key: those that are known, and the others from the cache or counted now."""
    networks = {n.key: n for n in read_published() if n.key not in TOO_SLOW}
    policies = {key_of_policy(shape): shape for shape in POLICIES}
    new = [key for key in (*networks, *policies) if key not in known]
    counts = {key: known[key] for key in (*networks, *policies) if key in known}
    if not new:
        return counts
    core = prepare(progress)

    def count(key: str) -> dict[str, Any]:
        def make(folder: Path) -> None:
            network = networks.get(key)
            work = count_network(core, network, graphs) if network else count_policy(core, policies[key])
            (folder / "work.json").write_text(json.dumps(work))

        return json.loads(
            (cache_folder("clock-count", key_of({"by": counting, "key": key}), make) / "work.json").read_text()
        )

    with ThreadPoolExecutor(JOBS) as pool:
        started = {pool.submit(count, key): key for key in new}
        try:
            for future in progress(as_completed(started), desc="networks, emulated", total=len(new)):
                counts[started[future]] = future.result()
        finally:
            pool.shutdown(cancel_futures=True)
    return {key: counts[key] for key in (*networks, *policies)}


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
    return _errors(off_of(row, ns) for row in rows if row.network.runtime == runtime and row.threads == THREADS)


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
