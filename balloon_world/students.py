"""Notebook 08: can a smaller policy drive the same? Judge a teacher and its students on recordings and in worlds.

    content = judge_students("runs/full", ["runs/fast", "runs/faster"])

All results concern the artifact that would drive the car, a run's policy_static.pt. Every drive stays in the cache,
keyed by the artifact's content, so a run that was ended can resume. A rule holds the rows to limits from
params.yml, and recommends a student or the teacher.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch

from balloon_world import drives, world
from balloon_world.drives import SEED, car_in_key, count_hits, drive_in, everywhere, judge, run_trials
from balloon_world.level import EASY, Level, level_in_key, level_named
from balloon_world.world import World
from rover_learn.distill import errors_of, shape_of
from rover_lib.onboard.artifact.manifest import content_hash, read_manifest
from rover_lib.onboard.drive import loop, pilot, plan
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import Policy
from rover_lib.onboard.stage import read_stage, sha256_of, write_stage
from rover_lib.workshop.cache import cache_root, key_of
from rover_lib.workshop.judge.compare import GATED, gate
from rover_lib.workshop.judge.recorded_range import format_pct, not_judged, worst
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import Sample, pick_evenly
from rover_lib.workshop.recordings.source import Source

PUSHES = 4
TEACHER = "teacher"
ARTIFACT = f"policy_{GATED}.pt"
HOW = {"": "left alone", "pushed_": "pushed"}  # how a row's keys begin, and the words for that kind of drive
COUNTS = ("hits", "trials", "hits_wilson_low", "hits_wilson_high", "missed")
COUNTED = "Pushed at the high end of the time that was computed for a Raspberry Pi 5 from counted work."
GMAC_PER_S = 78.02  # in 10**9, of a Pi 5 with INT8 that was not counted: the high end for published policies
ESTIMATED = "Pushed at an estimate for a Raspberry Pi 5 by multiply-accumulates: the teacher is not counted."
NOBODY_DROVE = "Nobody drove: judged by errors on recordings alone."


@dataclass(frozen=True)
class _Run:
    """A run's static artifact. row: how its row of students.json begins; computed_ms: low and high end on a Pi 5."""

    name: str
    artifact: Path
    manifest: dict[str, Any]
    row: dict[str, Any]

    @classmethod
    def read(cls, folder: Path, name: str, shape: Mapping[str, Any]) -> "_Run":
        """Read a run's folder. shape: its row of distill.json."""
        artifact = folder / ARTIFACT
        counts = dict[str, Any]()
        manifest = read_manifest(artifact)
        if (folder / "arm.json").is_file():
            arm = read_stage(folder / "arm.json", "arm")
            if arm["inputs"].get(ARTIFACT) == sha256_of(artifact):
                counts = arm["metrics"]["artifacts"].get(artifact.stem, {})
        (camera,) = manifest["cameras"]
        row = {"name": name, "height": camera["height"], "width": camera["width"]}
        row |= {key: shape.get(key) for key in ("decoder_layers", "feedforward", "backbone_channels")}
        row |= {"gmac": manifest["gmac"], "size_mb": artifact.stat().st_size / 1e6}
        row |= {key: counts.get(key) for key in ("instructions_g", "simd_g")}
        span = counts.get("computed_pi5_ms")
        return cls(name, artifact, manifest, row | {"computed_ms": span and [span["low"], span["high"]]})


def judge_students(
    run_dir: Path | str,
    students: Sequence[Path | str],
    *,
    episodes: Path | str | None = None,
    worlds: int = 200,
    level: str = EASY.name,
    held_out_frames: int = 300,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Compare a teacher's run with its students' runs; write and return students.json in the teacher's folder.

    students: folders that `rover distill` left, each with a policy_static.pt. episodes: the recordings to judge with,
    those of the teacher's run if None. worlds: how many each policy drives through twice, left alone as in
    `run_trials`, and pushed at the latency computed for it; 0 for a real car's policy, which has no world.
    level: of the worlds.
    Raises TrainingError for runs that do not belong together, RoverError and ArtifactError for a missing file.
    """
    of_level = level_named(level)
    folder = Path(run_dir).resolve()
    p = params()
    runs = _runs(folder, [Path(student).resolve() for student in students])
    source = Source.loaded(read_stage(folder / "load.json", "load")["params"], episodes)
    recordings = load_recordings(source, runs[0].manifest["chunk"], p["calibration"]["sync_s"], progress)
    parts = split(recordings, p["calibration"]["held_out_share"], p["calibration"]["seed"])
    samples = pick_evenly(parts.held_out, held_out_frames)
    teacher_plans = _plans(folder / "policy_fp32.pt", f"{TEACHER} in float", samples, progress)
    is_counted = runs[0].row["computed_ms"] is not None
    rows = []
    for run in runs:
        plans = _plans(run.artifact, run.name, samples, progress)
        pushed_ms = 1e3 * run.manifest["gmac"] / GMAC_PER_S
        if is_counted:
            pushed_ms = (run.row["computed_ms"] or (None, None))[1]
        row = run.row | errors_of(plans, teacher_plans, samples, recordings.action_range())
        rows.append(row | _drives(run, worlds, pushed_ms, of_level, progress))
    metrics = {
        "students": rows,
        "recommendation": recommendation(rows, p["students"]),
        "limits": p["students"],
        "judged_frames": len(samples),
        "held_out_episodes": parts.episodes["held_out"],
        "warnings": not_judged(recordings.action_range()),
        "notes": [COUNTED if is_counted else ESTIMATED] if worlds else [NOBODY_DROVE],
    }
    parameters = {"worlds": worlds, "level": level, "seed": SEED, "pushes": PUSHES, "drive": p["drive"]}
    parameters["students"] = [run.name for run in runs[1:]]
    inputs = {f"{run.name}/{ARTIFACT}": sha256_of(run.artifact) for run in runs}
    return write_stage(folder / "students.json", "students", params=parameters, metrics=metrics, inputs=inputs)


def _runs(folder: Path, students: Sequence[Path]) -> list[_Run]:
    """Read the teacher's run and its students', the teacher first, and check that they belong together."""
    names = [student.name for student in students]
    if not names or len({*names, TEACHER}) <= len(names):
        raise TrainingError(f"students must have names of their own, and none is '{TEACHER}'", found=names)
    runs: list[_Run] = []
    for student in students:
        distillation = read_stage(student / "distill.json", "distill")
        of_teacher, own = distillation["metrics"]["students"]
        runs = runs or [_Run.read(folder, TEACHER, of_teacher)]
        runs.append(_Run.read(student, student.name, own))
        teacher_sha256, student_sha256 = (run.manifest["checkpoint"]["sha256"] for run in (runs[0], runs[-1]))
        files_sha256 = distillation["metrics"]["files_sha256"].values()
        if teacher_sha256 not in distillation["inputs"].values() or student_sha256 not in files_sha256:
            problem = (
                f"{student / ARTIFACT}: its checkpoint is not the student, or {folder / ARTIFACT} not its teacher's"
            )
            raise TrainingError(problem, remedy="'rover run' makes artifacts anew")
    return runs


def _plans(artifact: Path, name: str, samples: Sequence[Sample], progress: Progress) -> np.ndarray:
    """Return what an artifact plans for the samples, (n, C, A) float32."""

    def one(policy: Policy, i: int) -> np.ndarray:
        return policy.predict_chunk(samples[i].frame_bgr(), samples[i].state)

    answers = everywhere(artifact, range(len(samples)), one)
    plans = dict(progress(answers, desc=f"judging {name}", total=len(samples)))
    return np.stack([plans[i] for i in range(len(samples))])


def _drives(run: _Run, worlds: int, pushed_ms: float | None, level: Level, progress: Progress) -> dict[str, Any]:
    """Return a row's hits, left alone and pushed; all None if nobody drove. pushed_ms: None if it is not known."""
    section = params()["drive"]

    def one(policy: Policy, kind: str, seed: int) -> str:
        return drive_once(policy, seed, pushed_ms if kind else None, Settings.of(section), level)

    key_parameters = {"artifact": content_hash(run.artifact), "torch": torch.__version__, **car_in_key()}
    key_parameters |= {"drive": section, "pushes": PUSHES, "late": pushed_ms, **level_in_key(level)}
    path = cache_root() / f"drives-{key_of(key_parameters, world, drives, loop, pilot, plan)}.jsonl"
    counts = {kind: worlds for kind in HOW if worlds and not (kind and pushed_ms is None)}
    outcomes = judge(run.artifact, counts, one, path, progress, run.name)
    row: dict[str, Any] = {"pushed_latency_ms": pushed_ms if worlds else None}
    for kind in HOW:
        hits = count_hits(outcomes[kind]) if kind in outcomes else dict.fromkeys(COUNTS)
        row |= {f"{kind}{name}": value for name, value in hits.items()}
    return row


def drive_once(policy: Policy, seed: int, late_ms: float | None, settings: Settings, level: Level = EASY) -> str:
    """Drive through the world of a seed and return the outcome: left alone, or pushed if plans are late_ms late."""
    if late_ms is None:
        return "hit" if run_trials(policy, worlds=1, seed=seed, level=level).hits else "missed"
    return drive_in(policy, World(seed, PUSHES, level=level), late_ms / 1e3, settings).outcome


def gates_of(row: Mapping[str, Any], teacher: Mapping[str, Any], limits: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Hold a student to the rule; return rows of `compare.gate`. limits: params.yml's section `students`.

    Drives are judged only if the teacher drove. Then a kind of drive that is missing neither passes nor fails.
    """
    rows = []
    for kind, words in HOW.items() if teacher["trials"] else ():
        hits, trials = (teacher[f"{kind}{count}"] for count in ("hits", "trials"))
        lost = 100 * (hits - row[f"{kind}hits"]) / trials if trials and row[f"{kind}trials"] else None
        rows.append(gate(f"{row['name']} worlds lost, {words}, %", lost, "<=", limits[f"{kind}worlds_lost_pct"]))
    keys = [key for key in row if key.startswith("recorded_") and None not in (row[key], teacher[key])]
    above = worst(row[key] - teacher[key] for key in keys)
    return [*rows, gate(f"{row['name']} error to the recordings, points above", above, "<=", limits["recorded_points"])]


def recommendation(rows: Sequence[Mapping[str, Any]], limits: Mapping[str, Any]) -> dict[str, Any]:
    """Choose the student with fewest instructions (multiply-accumulates, if any is not counted) of those that pass.

    rows: of students.json, the teacher first; it is chosen if none passes. Returns {"name", "fastest_by", "gates"}.
    """
    teacher, *students = rows
    gates = {row["name"]: gates_of(row, teacher, limits) for row in students}
    key = "gmac" if any(row["instructions_g"] is None for row in rows) else "instructions_g"
    passing = [row for row in students if all(g["passed"] for g in gates[row["name"]])]
    fastest = min(passing, key=lambda row: row[key], default=teacher)
    return {"name": fastest["name"], "fastest_by": key, "gates": list(chain.from_iterable(gates.values()))}


def table(metrics: Mapping[str, Any]) -> Table:
    """Show a teacher and its students as a table, a row each. metrics: of students.json."""
    teacher = metrics["students"][0]
    actions = [key.removeprefix("teacher_").removesuffix("_pct") for key in teacher if key.startswith("teacher_")]
    rows = []
    for row in metrics["students"]:
        instructions = "-" if row["instructions_g"] is None else f"{row['instructions_g']:.3g}"
        span = "not counted" if row["computed_ms"] is None else "{:.3g} to {:.3g}".format(*row["computed_ms"])
        pushed = _hits(row, "pushed_") + (f" at {row['pushed_latency_ms']:.0f} ms" if row["pushed_trials"] else "")
        errors = []
        for to in ("teacher", "recorded"):
            errors_pct = [format_pct(row[f"{to}_{action}_pct"]).strip().removesuffix(" %") for action in actions]
            errors.append(" / ".join(errors_pct))
        work = (f"{row['size_mb']:.1f}", f"{row['gmac']:.3g}", instructions, span)
        rows.append((f"{row['name']}: {shape_of(row)}", *work, _hits(row, ""), pushed, *errors))
    error_note = f"errors in {' / '.join(actions)}, of the static INT8 artifact, % of the recorded range"
    header = ("", "MB", "GMAC", "10^9 instructions", "ms, computed", "left alone", "pushed")
    recommended = f"recommended by the limits of params.yml: {metrics['recommendation']['name']}"
    notes = (recommended, error_note, *metrics["notes"], *metrics["warnings"])
    return Table((*header, "to the teacher, %", "to the recordings, %"), rows, notes=notes)


def _hits(row: Mapping[str, Any], kind: str) -> str:
    return f"{row[f'{kind}hits']} of {row[f'{kind}trials']}" if row[f"{kind}trials"] else "-"
