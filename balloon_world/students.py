"""Can a smaller policy drive the same? Judge a teacher and its students on recordings, and drive them side by side.

    content = measured("runs/full", ["runs/fast", "runs/faster"])

All results concern the artifact that would drive the car, a run's policy_static.pt. Every drive and plan stays in the
cache, keyed by the artifact's content. So a process that was ended goes on where it was, and a further student costs
only its own drives and plans.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from balloon_world import latency, trial, world
from balloon_world.frontier import DRIVES, NOBODY_DROVE, recommendation
from balloon_world.latency import SEED, Condition, drive_late
from balloon_world.side_by_side import append_row, everywhere, load_for_cores, read_rows
from balloon_world.trial import run_trials, wilson_interval
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
from rover_lib.workshop.judge.compare import GATED
from rover_lib.workshop.judge.recorded_range import not_judged
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import Recordings, Sample, Source, pick_evenly

WORLDS, PUSHES = 200, 4
HELD_OUT_FRAMES = 300
TEACHER = "teacher"
ARTIFACT = f"policy_{GATED}.pt"
COUNTED = "Pushed at the high end of the time that was computed for a Raspberry Pi 5 from counted work."
ESTIMATED = (
    "Pushed at an estimate for a Raspberry Pi 5 by multiply-accumulates, as the teacher's instructions are not counted."
)


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
    Sets torch to one thread. Raises DistillError for runs that do not belong together or lack a file, and
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
        every = everywhere(policies, range(len(samples)), lambda policy, i: _plan(policy, samples[i]))
        planned = dict(progress(every, desc=f"judging {name}", total=len(samples)))
        with atomic_path(path) as temporary:
            np.save(temporary, np.stack([planned[i] for i in range(len(samples))]))
    return np.load(path)


def _plan(policy: Policy, sample: Sample) -> np.ndarray:
    return policy.predict_chunk(sample.frame_bgr(), sample.state)


# --- in worlds --------------------------------------------------------------------------------------------------------

Drive = Callable[[Policy, int], str]  # drives a policy through the world of a seed and returns the outcome


def _left_alone(policy: Policy, seed: int) -> str:
    return run_trials(policy, worlds=1, seed=seed, keep_frames=0).per_world[0].outcome


def _pushed(policy: Policy, seed: int, *, condition: Condition) -> str:
    return drive_late(policy, seed, condition).outcome


def _drives(run: _Run, worlds: int, pushed_ms: float | None, progress: Progress) -> dict[str, Any]:
    """Return a row's hits, left alone and pushed; all None if nobody drove. pushed_ms: None if it is not known."""
    how = params()["drive"]
    asked: dict[str, Drive] = {}
    if worlds:
        asked[""] = _left_alone
        if pushed_ms is not None:
            condition = Condition(pushed_ms / 1e3, Settings.of(how), PUSHES)
            asked["pushed_"] = partial(_pushed, condition=condition)
    sources = [world, trial, latency, loop, pilot, plan, preprocess]
    driven_by = {"artifact": content_hash(run.artifact), "torch": torch.__version__, **car_in_key()}
    alike = driven_by | {"drive": how, "pushes": PUSHES}
    files = {}
    for name in asked:
        key = key_of(alike | {"how": name, "latency_ms": pushed_ms if name else None}, *sources)
        files[name] = cache_root() / f"drives-{key}.jsonl"
    found = _drive(run, asked, files, range(SEED, SEED + worlds), progress)
    row: dict[str, Any] = {"pushed_latency_ms": pushed_ms if worlds else None}
    for name in DRIVES:
        missed = [seed for seed, outcome in found[name].items() if outcome != "hit"] if name in found else None
        hits = None if missed is None else worlds - len(missed)
        low, high = (None, None) if hits is None else wilson_interval(hits, worlds)
        row |= {
            f"{name}hits": hits,
            f"{name}trials": None if hits is None else worlds,
            f"{name}hits_wilson_low": low,
            f"{name}hits_wilson_high": high,
            f"{name}missed": missed,
        }
    return row


def _drive(
    run: _Run, asked: Mapping[str, Drive], files: Mapping[str, Path], seeds: range, progress: Progress
) -> dict[str, dict[int, str]]:
    """Return the outcomes by seed of each kind of drive.

    Drives that are in the files are not repeated, and each new one is written to its file as soon as it has ended.
    """
    kept = {name: {row["seed"]: row["outcome"] for row in read_rows(path)} for name, path in files.items()}
    missing = [(name, seed) for name in asked for seed in seeds if seed not in kept[name]]
    policies = load_for_cores(run.artifact, len(missing))
    driven = everywhere(policies, missing, lambda policy, drive: asked[drive[0]](policy, drive[1]))
    for (name, seed), outcome in progress(driven, desc=f"driving {run.name}", total=len(missing)) if missing else ():
        kept[name][seed] = outcome
        append_row(files[name], {"seed": seed, "outcome": outcome})
    return {name: {seed: kept[name][seed] for seed in seeds} for name in asked}
