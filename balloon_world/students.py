"""Notebook 08: can a smaller policy drive the same? Judge a teacher and its students on recordings and in worlds.

    content = judge_students("runs/full", ["runs/fast", "runs/faster"])

All results concern the artifact that would drive the car, a run's policy_static.pt. Every drive and plan stays in the
cache, keyed by the artifact's content. So a process that was ended goes on where it was, and a further student costs
only its own drives and plans. A rule holds the rows to limits from params.yml, and recommends a student or the teacher.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from balloon_world import drives, trial, world
from balloon_world.drives import SEED, count_hits, drive_in, drive_missing, everywhere, load_for_cores, pair_worlds
from balloon_world.trial import run_trials
from balloon_world.world import World
from rover_learn.distill import errors_of
from rover_lib.onboard.artifact.manifest import content_hash, read_manifest
from rover_lib.onboard.care.pi5 import Work, estimate_ms, predict_ms
from rover_lib.onboard.drive import loop, pilot, plan
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.errors import DistillError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.onboard.policy.load import Policy
from rover_lib.onboard.stage import atomic_path, read_stage, sha256_of, write_stage
from rover_lib.workshop.cache import cache_root, car_in_key, key_of
from rover_lib.workshop.judge.compare import GATED, gate
from rover_lib.workshop.judge.recorded_range import format_pct, not_judged, worst
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import Recordings, Sample, Source, pick_evenly

WORLDS, PUSHES = 200, 4
HELD_OUT_FRAMES = 300
TEACHER = "teacher"
ARTIFACT = f"policy_{GATED}.pt"
HOW = {"": "left alone", "pushed_": "pushed"}  # how a row's keys begin, and the words for that kind of drive
COUNTED = "Pushed at the high end of the time that was computed for a Raspberry Pi 5 from counted work."
ESTIMATED = (
    "Pushed at an estimate for a Raspberry Pi 5 by multiply-accumulates, as the teacher's instructions are not counted."
)
NOBODY_DROVE = "Nobody drove: judged by errors on recordings alone."


@dataclass(frozen=True)
class _Run:
    """A run's static artifact.

    shape: its row of students.json. counts: its instructions from arm.json, None if they were not counted.
    """

    name: str
    artifact: Path
    manifest: dict[str, Any]
    shape: dict[str, Any]
    counts: dict[str, Any] | None

    @property
    def computed_ms(self) -> list[float] | None:
        """The low and the high end of the computed latency on a Pi 5; None if instructions were not counted."""
        if not self.counts:
            return None
        span = predict_ms(Work.of(self.counts))
        return [span.low, span.high]

    @property
    def estimated_ms(self) -> float:
        return estimate_ms(self.manifest["gmac"])


def judge_students(
    run_dir: Path | str,
    students: Sequence[Path | str],
    *,
    episodes: Path | str | None = None,
    worlds: int = WORLDS,
    held_out_frames: int = HELD_OUT_FRAMES,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Compare a teacher's run with its students' runs; write and return students.json in the teacher's folder.

    students: folders that `rover distill` left, each with a policy_static.pt. episodes: the recordings to judge with,
    those of the teacher's run if None. worlds: how many each policy drives through twice, left alone as in
    `run_trials`, and pushed at the latency computed for it. With 0 nobody drives, as there is no world for a real
    car's policy. held_out_frames: how many to judge with at most.
    Raises DistillError for runs that do not belong together or lack a file, and
    whatever reading them raises.
    """
    folder, p = Path(run_dir).resolve(), params()
    runs = _runs(folder, [Path(student).resolve() for student in students])
    source = _source_of(folder, episodes)
    recordings = load_recordings(source, runs[0].manifest["chunk"], p["calibration"]["sync_s"], progress)
    parts = split(recordings, p["calibration"]["held_out_share"], p["calibration"]["seed"])
    samples = pick_evenly(parts.held_out, held_out_frames)
    counted = runs[0].counts is not None
    rows = []
    for run, errors in zip(runs, _errors(folder, runs, samples, recordings, progress), strict=True):
        pushed_ms = (run.computed_ms[1] if run.computed_ms else None) if counted else run.estimated_ms
        rows.append(_row(run) | errors | _drives(run, worlds, pushed_ms, progress))
    notes = [COUNTED if counted else ESTIMATED] if worlds else [NOBODY_DROVE]
    if missing := [run.name for run in runs if run.counts is None]:
        notes.append(f"Not counted, or another artifact was: {', '.join(missing)}. `make count` counts.")
    metrics = {
        "students": rows,
        "recommendation": recommendation(rows, p["students"]),
        "limits": p["students"],
        "latency": "counted" if counted else "estimated",
        "judged_frames": len(samples),
        "held_out_episodes": parts.episodes["held_out"],
        "warnings": not_judged(recordings.action_range()),
        "notes": notes,
    }
    how = {
        "worlds": worlds,
        "seed": SEED,
        "pushes": PUSHES,
        "drive": p["drive"],
        "students": [r.name for r in runs[1:]],
    }
    inputs = {f"{run.name}/{ARTIFACT}": sha256_of(run.artifact) for run in runs}
    return write_stage(folder / "students.json", "students", params=how, metrics=metrics, inputs=inputs)


# --- which runs -------------------------------------------------------------------------------------------------------


def _runs(folder: Path, students: Sequence[Path]) -> list[_Run]:
    """Read the teacher's run and its students', the teacher first, and check that they belong together."""
    names = [student.name for student in students]
    if not names or len({*names, TEACHER}) <= len(names):
        raise DistillError(f"students must have names of their own, and none is '{TEACHER}'", found=names)
    taught = [_read_distilled(student) for student in students]
    manifest = read_manifest(_artifact_of(folder))
    runs = [_Run(TEACHER, folder / ARTIFACT, manifest, taught[0]["metrics"]["students"][0], _counts(folder))]
    for student, content in zip(students, taught, strict=True):
        if manifest["checkpoint"]["sha256"] not in content["inputs"].values():
            raise DistillError(f"{student}: is a student of another checkpoint than {folder / ARTIFACT} is made of")
        own_manifest = read_manifest(_artifact_of(student))
        if own_manifest["checkpoint"]["sha256"] not in content["metrics"]["files_sha256"].values():
            raise DistillError(
                f"{student / ARTIFACT}: is not made of the student that was distilled there",
                remedy="'rover run' makes it anew",
            )
        runs.append(
            _Run(student.name, student / ARTIFACT, own_manifest, content["metrics"]["students"][1], _counts(student))
        )
    return runs


def _read_distilled(student: Path) -> dict[str, Any]:
    """Read the distill.json that `rover distill` left in a student's run."""
    path = student / "distill.json"
    if not path.is_file():
        raise DistillError(f"{student}: no distill.json in it", remedy="'rover distill' makes a student")
    return read_stage(path, "distill")


def _artifact_of(run_dir: Path) -> Path:
    if not (path := run_dir / ARTIFACT).is_file():
        raise DistillError(f"{path}: not there", remedy="'rover run' makes it")
    return path


def _counts(run_dir: Path) -> dict[str, Any] | None:
    """Return what arm.json says about policy_static.pt; None if nothing, or of another file, or without cycles."""
    if not (path := run_dir / "arm.json").is_file():
        return None
    arm = read_stage(path, "arm")
    same = arm["inputs"].get(ARTIFACT) == sha256_of(run_dir / ARTIFACT)
    row = arm["metrics"]["artifacts"].get(Path(ARTIFACT).stem, {})
    return row if same and "cycles_g" in row else None


def _source_of(run_dir: Path, episodes: Path | str | None) -> Source:
    """Return the recordings that the teacher's run loaded; or, if `episodes` is given, those, read the same way."""
    if (run_dir / "load.json").is_file():
        return Source.loaded(read_stage(run_dir / "load.json", "load")["params"], episodes)
    if not episodes:
        raise DistillError(f"{run_dir}: says nothing of its recordings", remedy="give --episodes")
    return Source.of(episodes)


def _row(run: _Run) -> dict[str, Any]:
    (camera,) = run.manifest["cameras"]
    return {
        "name": run.name,
        "height": camera["height"],
        "width": camera["width"],
        **{key: run.shape[key] for key in ("decoder_layers", "feedforward", "qat")},
        "backbone_channels": run.shape.get("backbone_channels"),  # older students have all channels
        "gmac": run.manifest["gmac"],
        "instructions_g": run.counts and run.counts["instructions_g"],
        "simd_g": run.counts and run.counts["simd_g"],
        "size_mb": run.artifact.stat().st_size / 1e6,
        "computed_ms": run.computed_ms,
    }


# --- on recordings ----------------------------------------------------------------------------------------------------


def _errors(
    folder: Path, runs: Sequence[_Run], samples: Sequence[Sample], recordings: Recordings, progress: Progress
) -> list[dict[str, float | None]]:
    """Return each artifact's errors against the plans of the teacher's policy_fp32.pt and against the recordings."""
    reference = folder / "policy_fp32.pt"
    if not reference.is_file():
        remedy = "'rover run CHECKPOINT EPISODES' makes it"
        raise DistillError(f"{reference}: the teacher as it was trained is not there", remedy=remedy)
    taught = _plans(reference, f"{TEACHER} in float", samples, progress)
    planned = [_plans(run.artifact, run.name, samples, progress) for run in runs]
    return [errors_of(plans, taught, samples, recordings.action_range()) for plans in planned]


def _plans(artifact: Path, name: str, samples: Sequence[Sample], progress: Progress) -> np.ndarray:
    """Return what an artifact plans for the samples, (n, C, A) float32, from the cache if it is there."""
    frames = [(str(s.frame_path), s.frame_path.stat().st_size, s.frame_name, s.state.tolist()) for s in samples]
    planned_by = {"artifact": content_hash(artifact), "torch": torch.__version__, **car_in_key()}
    key = key_of(planned_by | {"frames": frames}, preprocess)
    path = cache_root() / f"plans-{key}.npy"
    if not path.exists():
        policies = load_for_cores(artifact, len(samples))
        every = everywhere(
            policies, range(len(samples)), lambda p, i: p.predict_chunk(samples[i].frame_bgr(), samples[i].state)
        )
        planned = dict(progress(every, desc=f"judging {name}", total=len(samples)))
        with atomic_path(path) as temporary:
            np.save(temporary, np.stack([planned[i] for i in range(len(samples))]))
    return np.load(path)


# --- in worlds --------------------------------------------------------------------------------------------------------


def _drives(run: _Run, worlds: int, pushed_ms: float | None, progress: Progress) -> dict[str, Any]:
    """Return a row's hits, left alone and pushed; all None if nobody drove. pushed_ms: None if it is not known."""
    how = params()["drive"]
    late_ms = {"": None, "pushed_": pushed_ms}

    def one(policy: Policy, asked: tuple[str, int]) -> dict[str, Any]:
        return {"outcome": drive_once(policy, asked[1], late_ms[asked[0]], Settings.of(how))}

    driven_by = {"artifact": content_hash(run.artifact), "torch": torch.__version__, **car_in_key()}
    key = key_of(
        driven_by | {"drive": how, "pushes": PUSHES, "late": pushed_ms}, world, trial, drives, loop, pilot, plan
    )
    row: dict[str, Any] = {"pushed_latency_ms": pushed_ms if worlds else None}
    kinds = [kind for kind in HOW if worlds and not (kind and pushed_ms is None)]
    asked = [(kind, seed) for kind in kinds for seed in range(SEED, SEED + worlds)]
    found = drive_missing(
        run.artifact, asked, one, cache_root() / f"drives-{key}.jsonl", progress, f"driving {run.name}"
    )
    for kind in HOW:
        outcomes = {seed: each["outcome"] for (of, seed), each in found.items() if of == kind}
        keys = "hits", "trials", "hits_wilson_low", "hits_wilson_high", "missed"
        counted = count_hits(outcomes, "hits_wilson") if outcomes else dict.fromkeys(keys)
        row |= {f"{kind}{name}": value for name, value in counted.items()}
    return row


def drive_once(policy: Policy, seed: int, late_ms: float | None, settings: Settings) -> str:
    """Drive through the world of a seed and return the outcome: left alone, or pushed if plans are late_ms late."""
    if late_ms is None:
        return run_trials(policy, worlds=1, seed=seed, keep_frames=0).per_world[0].outcome
    return drive_in(policy, World(seed, PUSHES), late_ms / 1e3, settings).outcome


# --- the rule ---------------------------------------------------------------------------------------------------------


def gates_of(row: Mapping[str, Any], teacher: Mapping[str, Any], limits: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Hold a student to the rule; return rows of `compare.gate`. limits: params.yml's section `students`.

    Drives are judged only if the teacher drove. Then a kind of drive that is missing neither passes nor fails.
    """
    rows = []
    for kind, how in HOW.items() if teacher["trials"] else ():
        lost = None
        if row[f"{kind}trials"] and teacher[f"{kind}trials"]:
            lost = 100 * (teacher[f"{kind}hits"] - row[f"{kind}hits"]) / teacher[f"{kind}trials"]
        rows.append(gate(f"{row['name']} worlds lost, {how}, %", lost, "<=", limits[f"{kind}worlds_lost_pct"]))
    keys = [key for key in row if key.startswith("recorded_") and None not in (row[key], teacher[key])]
    above = worst(row[key] - teacher[key] for key in keys)
    return [*rows, gate(f"{row['name']} error to the recordings, points above", above, "<=", limits["recorded_points"])]


def recommendation(rows: Sequence[Mapping[str, Any]], limits: Mapping[str, Any]) -> dict[str, Any]:
    """Choose the fastest student that passes every gate, or the teacher if none does.

    rows: of students.json, the teacher first. Fastest is what has fewest instructions if all are counted, else fewest
    multiply-accumulates. Returns {"name", "fastest_by", "gates": of all students}.
    """
    teacher, *students = rows
    gates = {row["name"]: gates_of(row, teacher, limits) for row in students}
    key = "gmac" if any(row["instructions_g"] is None for row in rows) else "instructions_g"
    passed = [row for row in students if all(g["passed"] for g in gates[row["name"]])]
    fastest = min(passed, key=lambda row: row[key], default=teacher)
    return {"name": fastest["name"], "fastest_by": key, "gates": [g for its_gates in gates.values() for g in its_gates]}


def table(metrics: Mapping[str, Any]) -> Table:
    """Show a teacher and its students as a table, a row each. metrics: of students.json."""
    teacher = metrics["students"][0]
    actions = [key.removeprefix("teacher_").removesuffix("_pct") for key in teacher if key.startswith("teacher_")]
    rows = []
    for row in metrics["students"]:
        counted = "-" if row["instructions_g"] is None else f"{row['instructions_g']:.3g}"
        span = "not counted" if row["computed_ms"] is None else "{:.3g} to {:.3g}".format(*row["computed_ms"])
        pushed = _hits(row, "pushed_") + (f" at {row['pushed_latency_ms']:.0f} ms" if row["pushed_trials"] else "")
        errors = (
            " / ".join(format_pct(row[f"{to}_{action}_pct"]).strip().removesuffix(" %") for action in actions)
            for to in ("teacher", "recorded")
        )
        work = (f"{row['size_mb']:.1f}", f"{row['gmac']:.3g}", counted, span)
        rows.append((f"{row['name']}: {shape_of(row)}", *work, _hits(row, ""), pushed, *errors))
    what = f"errors in {' / '.join(actions)}, of the static INT8 artifact, % of the recorded range"
    header = ("", "MB", "GMAC", "10^9 instructions", "ms, computed", "left alone", "pushed")
    notes = (what, *metrics["notes"], *metrics["warnings"])
    return Table((*header, "to the teacher, %", "to the recordings, %"), rows, notes=notes)


def shape_of(row: Mapping[str, Any]) -> str:
    layers = f"{row['decoder_layers']} decoder layer{'s' if row['decoder_layers'] != 1 else ''}"
    share = f", {row['backbone_channels']:.0%} of the channels" if row.get("backbone_channels") else ""
    return f"{row['width']}x{row['height']}, {layers} of {row['feedforward']}{share}{', QAT' if row['qat'] else ''}"


def _hits(row: Mapping[str, Any], kind: str) -> str:
    return f"{row[f'{kind}hits']} of {row[f'{kind}trials']}" if row[f"{kind}trials"] else "-"


def sentences(metrics: Mapping[str, Any]) -> list[str]:
    """Say the recommendation in plain English, a sentence to a line. metrics: of students.json."""
    teacher, *students = metrics["students"]
    verdict = metrics["recommendation"]
    chosen = next((row for row in students if row["name"] == verdict["name"]), None)
    if chosen is None:
        lines = ["No student keeps to the limits of params.yml: stay with the teacher."]
    else:
        by = {"instructions_g": "fewest instructions", "gmac": "fewest multiply-accumulates"}[verdict["fastest_by"]]
        lines = [f"Recommended: {chosen['name']} ({shape_of(chosen)}), which has the {by} of those within the limits."]
    for row in students:
        for kind, how in HOW.items():
            if row[f"{kind}trials"] and teacher[f"{kind}trials"]:
                only, only_teacher, p = pair_worlds(row[f"{kind}missed"], teacher[f"{kind}missed"])
                lines.append(
                    f"{row['name']}, {how}: {_hits(row, kind)} worlds, its teacher {_hits(teacher, kind)}; {only} only "
                    f"the student hit, {only_teacher} only the teacher (sign test, p = {p:.2g})."
                )
    return lines if teacher["trials"] else [*lines, NOBODY_DROVE]
