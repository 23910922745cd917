"""Notebook 07: how late may a plan be? Drive a run's static policy with inferences as slow as they are told to be."""

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from balloon_world.drives import SEED, Driven, count_hits, drive_in, everywhere, load_for_cores
from balloon_world.world import World
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import find_stage, write_stage
from rover_lib.workshop.judge.compare import GATED, gate
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.progress import Progress, silent

ENSEMBLE = 0.01  # LeRobot's coefficient
JUDGED_MS = 150.0
How = tuple[float, int, Settings]  # latency in ms, pushes, settings of the loop


def measure_latencies(
    run_dir: Path | str,
    *,
    worlds: int,
    latencies_ms: Sequence[float],
    pushes: int = 0,
    pushed_latencies_ms: Sequence[float] = (),
    shown_ms: float | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure how a run's static policy drives when its plans are late; write and return drive.json, stage 'drive'.

    It drives at each of latencies_ms with and without compensation, other settings being those of params.yml's section
    `drive`; at each of pushed_latencies_ms the same way, with `pushes` pushes in each world; and at the first latency
    with LeRobot's temporal ensembling. shown_ms: for this latency, keep the world in which the drives with and without
    compensation differ most, with their plans.
    A drive.json that was made of the same policy and parameters is read, not made again.
    Raises TrainingError if there is no policy, no world or no latency.
    """
    run_dir, p = Path(run_dir), params()
    artifact, path = run_dir / f"policy_{GATED}.pt", run_dir / "drive.json"
    if not artifact.is_file():
        raise TrainingError(f"{artifact}: not there", remedy="run notebooks 01 to 03, or `make demo`, first")
    if not latencies_ms or worlds < 1:
        raise TrainingError("drives need at least one latency and one world", found=f"{latencies_ms} and {worlds}")
    limit = p["gates"]["hits_lost_at_150_ms"]
    given = {
        "worlds": worlds,
        "seed": SEED,
        "latencies_ms": latencies_ms,
        "pushes": pushes,
        "pushed_latencies_ms": pushed_latencies_ms,
        "shown_ms": shown_ms,
        "drive": p["drive"],
        "hits_lost_at_150_ms": limit,
    }
    inputs = {artifact.name: content_hash(artifact)}  # unchanged if the same policy is exported again
    if there := find_stage(path, "drive", params=given, inputs=inputs):
        return there
    settings = Settings.of(p["drive"])
    hows: list[How] = []
    for ms, count in [(ms, 0) for ms in latencies_ms] + [(ms, pushes) for ms in pushed_latencies_ms]:
        # A plan that takes no time leaves nothing to compensate.
        hows += [
            (ms, count, replace(settings, compensate=compensate)) for compensate in ((True, False) if ms else (True,))
        ]
    hows.append((latencies_ms[0], 0, replace(settings, ensemble=ENSEMBLE)))
    policies = load_for_cores(artifact, worlds * len(hows))
    drives = drive_all(policies, hows, worlds, progress)
    first: dict[int, list[Driven]] = {}  # for each number of pushes, the drives at its first latency, compensated
    rows = []
    for how, driven in zip(hows, drives, strict=True):
        base = first.setdefault(how[1], driven)
        aside_cm = [1e2 * beside_path(d, b) for d, b in zip(driven, base, strict=True)]
        rows.append(_row(how, driven) | {f"aside_p{q}_cm": float(np.percentile(aside_cm, q)) for q in (50, 90)})
    metrics = {
        "policy": {"chunk": policies[0].chunk, "rate_hz": policies[0].rate_hz},
        "rows": rows,
        "gates": gates(rows, limit),
        "from_above": _choose_shown(hows, drives, shown_ms),
    }
    return write_stage(path, "drive", params=given, metrics=metrics, inputs=inputs)


def drive_all(
    policies: Sequence[Any], hows: Sequence[How], worlds: int, progress: Progress = silent
) -> list[list[Driven]]:
    """Drive through the same worlds in each way; return the drives of each. policies: the same one for each thread."""

    def one(policy: Any, asked: tuple[int, int]) -> Driven:
        latency_ms, pushes, settings = hows[asked[0]]
        return drive_in(policy, World(asked[1], pushes), latency_ms / 1e3, settings)

    asked = [(i, seed) for i in range(len(hows)) for seed in range(SEED, SEED + worlds)]
    drives = dict(progress(everywhere(policies, asked, one), desc="driving", total=len(asked)))
    return [[drives[i, seed] for seed in range(SEED, SEED + worlds)] for i in range(len(hows))]


def _row(how: How, driven: Sequence[Driven]) -> dict[str, Any]:
    """Return a row of drive.json, less how far the car was beside its path."""
    latency_ms, pushes, settings = how
    ages_ms = 1e3 * np.array([o.age_s for d in driven for o in d.orders])
    outcomes = [d.outcome for d in driven]
    times_s = [d.duration_s for d in driven if d.outcome == "hit"]
    counted = count_hits(dict(enumerate(outcomes)), "hits_wilson")
    del counted["missed"]
    ages = {
        f"plan_age_{name}_ms": round(float(np.percentile(ages_ms, q)), 3) if len(ages_ms) else None
        for name, q in (("min", 0), ("p50", 50), ("p95", 95), ("max", 100))
    }
    return {
        "latency_ms": round(float(latency_ms), 3),
        "pushes": pushes,
        "compensate": settings.compensate,
        "ensemble": settings.ensemble,
        **counted,
        **{outcome: outcomes.count(outcome) for outcome in ("left", "timeout", "stopped")},
        **ages,
        "time_to_hit_p50_s": float(np.median(times_s)) if times_s else None,
    }


def beside_path(drive: Driven, other: Driven) -> float:
    """Return how far a drive's path is from another one's at most, in metres. Times do not matter, only places."""
    a, b = drive.trajectory, other.trajectory
    return float(np.hypot(a.x_m[:, None] - b.x_m, a.y_m[:, None] - b.y_m).min(1).max())


def from_above(drive: Driven, seed: int, how: How) -> dict[str, Any]:
    """Return a drive and its plans for a figure, in JSON's types and metres.

    A plan's path is that of the world's own car, which follows the plan, unpushed, from where its frame was taken.
    """

    def path(x_m: Iterable[float], y_m: Iterable[float]) -> dict[str, list[float]]:
        return {"x_m": [round(float(x), 3) for x in x_m], "y_m": [round(float(y), 3) for y in y_m]}

    world, plans = World(seed), []
    for plan, looked_from in drive.plans:
        ghost = copy.copy(world)
        ghost.state, ghost.trajectory = looked_from, [looked_from]
        for steering, throttle in plan.actions:
            if not ghost.done:
                ghost.step(float(steering), float(throttle))
        plans.append(path((s.x_m for s in ghost.trajectory), (s.y_m for s in ghost.trajectory)))
    return {
        "latency_ms": round(float(how[0]), 3),
        "compensate": how[2].compensate,
        "seed": seed,
        "outcome": drive.outcome,
        "balloon_xy_m": list(drive.trajectory.balloon_xy_m),
        **path(drive.trajectory.x_m, drive.trajectory.y_m),
        "plans": plans,
    }


def _choose_shown(hows: Sequence[How], drives: Sequence[list[Driven]], shown_ms: float | None) -> list[dict[str, Any]]:
    """Return, for one latency, the world in which the drives with and without compensation differ most."""
    pair = [
        (how, driven)
        for how, driven in zip(hows, drives, strict=True)
        if how[0] == shown_ms and not (how[1] or how[2].ensemble)
    ]
    if not pair:
        return []
    apart = [beside_path(a, b) for a, b in zip(pair[0][1], pair[-1][1], strict=True)]
    i = int(np.argmax(apart))
    return [from_above(driven[i], SEED + i, how) for how, driven in pair]


def gates(rows: Sequence[Mapping[str, Any]], limit: int) -> list[dict[str, Any]]:
    """Judge what params.yml promises for late plans: how many hits are lost at 150 ms, compensated, compared with 0 ms.

    rows: of drive.json.
    """
    hits = {r["latency_ms"]: r["hits"] for r in rows if r["compensate"] and not r["pushes"] and r["ensemble"] is None}
    lost = hits[0.0] - hits[JUDGED_MS] if {0.0, JUDGED_MS} <= set(hits) else None
    return [gate(f"{GATED} hits lost at {JUDGED_MS:g} ms", lost, "<=", limit)]


def table(content: Mapping[str, Any]) -> Table:
    """Show the content of drive.json as a table."""
    rows = []
    for r in content["metrics"]["rows"]:
        how = [f"{r['pushes']} pushes"] if r["pushes"] else ["left alone"]
        how += [] if r["compensate"] else ["not compensated"]
        how += ["ensembling"] if r["ensemble"] is not None else []
        age = "-" if r["plan_age_p95_ms"] is None else f"{r['plan_age_p95_ms']:.0f} ms"
        hits = f"{r['hits']} of {r['trials']}"
        rows.append((", ".join(how), f"{r['latency_ms']:g} ms", age, hits, str(r["stopped"])))
    verdict = {True: "pass", False: "FAIL", None: "not measured"}
    notes = [
        f"{g['gate']}: {g['found']}, at most {g['limit']}: {verdict[g['passed']]}" for g in content["metrics"]["gates"]
    ]
    return Table(("", "latency", "plan age, p95", "hits", "stopped"), rows, notes=notes)
