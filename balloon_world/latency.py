"""Notebook 07: how late may a plan be? Drive a run's static policy with inferences as slow as they are told to be."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np

from balloon_world.drives import SEED, WorldDrive, count_hits, drive_in, everywhere, path_of
from balloon_world.level import EASY, level_named
from balloon_world.world import World
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import load_policy
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop.judge.compare import GATED, WORLDS_LOST, worlds_lost
from rover_lib.workshop.judge.pairs import compare_pairs
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.progress import Progress, silent

JUDGED_MS = 150.0
ON_A_MAP = 8  # worlds


def measure_latencies(
    run_dir: Path | str,
    *,
    worlds: int,
    latencies_ms: Sequence[float],
    pushes: int = 0,
    pushed_latencies_ms: Sequence[float] = (),
    level: str = EASY.name,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure how a run's static policy drives when its plans are late; write and return drive.json, stage 'drive'.

    It drives at each of latencies_ms with and without compensation, and at each of pushed_latencies_ms the same way,
    with `pushes` pushes in each world. level: of the worlds.
    Raises TrainingError if there is no policy, no world, no latency or no such level.
    """
    of_level = level_named(level)
    p = params()
    artifact = Path(run_dir) / f"policy_{GATED}.pt"
    if not artifact.is_file():
        raise TrainingError(f"{artifact}: not there", remedy="rover run makes it")
    if not latencies_ms or worlds < 1:
        raise TrainingError("drives need at least one latency and one world", found=f"{latencies_ms} and {worlds}")
    parameters = {"worlds": worlds, "seed": SEED, "latencies_ms": latencies_ms, "pushes": pushes, "drive": p["drive"]}
    limit_pct = p["gates"]["worlds_lost_pct"]
    parameters |= {"pushed_latencies_ms": pushed_latencies_ms, "limit_pct": limit_pct, "level": level}
    inputs = {artifact.name: content_hash(artifact)}  # unchanged if the same policy is exported again
    settings = Settings.of(p["drive"])
    rows = list[dict[str, Any]]()
    for ms, count in [(ms, 0) for ms in latencies_ms] + [(ms, pushes) for ms in pushed_latencies_ms]:
        conditions = {"latency_ms": round(float(ms), 3), "pushes": count}
        rows.append(conditions | {"compensate": True})
        if ms:  # a plan that takes no time leaves nothing to compensate
            rows.append(conditions | {"compensate": False})

    def one(policy: Any, question: tuple[int, int]) -> WorldDrive:
        row = rows[question[0]]
        seed = question[1]
        own_settings = replace(settings, compensate=row["compensate"])
        return drive_in(policy, World(seed, row["pushes"], level=of_level), row["latency_ms"] / 1e3, own_settings)

    questions = list(product(range(len(rows)), range(SEED, SEED + worlds)))
    drives = dict(progress(everywhere(artifact, questions, one), desc="driving", total=len(questions)))
    for i, row in enumerate(rows):
        row |= _count_outcomes([drives[i, seed] for seed in range(SEED, SEED + worlds)])
    metrics = {"rows": rows, "gates": gates(rows, limit_pct)}
    return write_stage(artifact.with_name("drive.json"), "drive", params=parameters, metrics=metrics, inputs=inputs)


@dataclass(frozen=True)
class OnMap:
    """A drive as a map shows it. path: (ticks, 2) metres ahead and to the left of the start; balloon: (2,) m."""

    outcome: str
    path: np.ndarray
    balloon: tuple[float, float]


def pushed_on_map(
    run_dir: Path | str, *, latencies_ms: Sequence[float], pushes: int, worlds: int, level: str = EASY.name
) -> dict[str, list[OnMap]]:
    """Drive some of the pushed drives of `measure_latencies` once more, compensated, for a map of each latency."""
    of_level = level_named(level)
    policy = load_policy(Path(run_dir) / f"policy_{GATED}.pt")
    settings = Settings.of(params()["drive"])
    maps: dict[str, list[OnMap]] = {}
    for ms in latencies_ms:
        for seed in range(SEED, SEED + min(worlds, ON_A_MAP)):
            world = World(seed, pushes, level=of_level)
            drive = drive_in(policy, world, ms / 1e3, settings)
            on_map = OnMap(drive.outcome, path_of(world), (world.balloon.x_m, world.balloon.y_m))
            maps.setdefault(f"{ms:g} ms late", []).append(on_map)
    return maps


def _count_outcomes(drives: Sequence[WorldDrive]) -> dict[str, Any]:
    """Return what a row of drive.json says of its drives."""
    outcomes = [d.outcome for d in drives]
    counts = count_hits(outcomes) | {
        outcome: outcomes.count(outcome) for outcome in ("left", "bumped", "timeout", "stopped")
    }
    orders = chain.from_iterable(d.orders for d in drives)
    ages_ms = 1e3 * np.array([order.age_s for order in orders])
    for name, q in (("min", 0), ("p50", 50), ("p95", 95), ("max", 100)):
        counts[f"plan_age_{name}_ms"] = round(float(np.percentile(ages_ms, q)), 3) if len(ages_ms) else None
    return counts


def gates(rows: Sequence[Mapping[str, Any]], limit_pct: float) -> list[dict[str, Any]]:
    """Judge the worlds lost at 150 ms, compensated, against the same at 0 ms. rows: of drive.json."""
    missed = {r["latency_ms"]: r["missed"] for r in rows if r["compensate"] and not r["pushes"]}
    pairs = None
    worlds = rows[0]["trials"]
    if {0.0, JUDGED_MS} <= set(missed):
        seeds = range(SEED, SEED + worlds)
        pairs = compare_pairs(*([seed not in missed[ms] for seed in seeds] for ms in (0.0, JUDGED_MS)))
    return [worlds_lost(f"{GATED} at {JUDGED_MS:g} ms: {WORLDS_LOST}", pairs, worlds, limit_pct)]


def table(content: Mapping[str, Any]) -> Table:
    """Show the content of drive.json as a table."""
    rows = []
    for r in content["metrics"]["rows"]:
        kind = f"{r['pushes']} pushes" if r["pushes"] else "left alone"
        kind += "" if r["compensate"] else ", not compensated"
        age = "-" if r["plan_age_p95_ms"] is None else f"{r['plan_age_p95_ms']:.0f} ms"
        rows.append((kind, f"{r['latency_ms']:g} ms", age, f"{r['hits']} of {r['trials']}", str(r["stopped"])))
    return Table(("", "latency", "plan age, p95", "hits", "stopped"), rows)
