"""Count every artifact of a run in the emulated Pi, and judge what it predicts there.

count_run("runs/demo")      # writes runs/demo/arm.json
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lab.a76.core import A76, prepare
from lab.a76.count import COUNTED, STEADY, Counted, count_artifact, packages_of, side_by_side
from lab.a76.report import LABEL, gates
from lab.params import lab_params
from rover_lib.onboard.artifact.manifest import ONNX_SUFFIX, read_manifest
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.onboard.stage import sha256_of, write_stage
from rover_lib.workshop.judge.recorded_range import pct_of_range
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.session import Opened, open_run
from rover_lib.workshop.run_program import run

REFERENCE = "policy_fp32"
FRAMES = 50
FEW = {"fp32": STEADY, "dynamic": COUNTED}  # frames of what is slow: FP32 takes minutes for an emulated inference


def count_run(run_dir: Path | str, *, frames: int = FRAMES, progress: Progress = silent) -> dict[str, Any]:
    """Count every artifact of a run; write and return its arm.json.

    What an artifact predicts on `frames` held-out frames, in the emulated Pi and on this machine, is compared with what
    the FP32 artifact predicts here. FP32 takes up to minutes for an emulated frame, so it predicts only a few there,
    which must equal this machine's within the parity vectors' tolerance. Raises RoverError.
    """
    run_dir = Path(run_dir)
    artifacts = {p.stem: p for p in sorted(run_dir.glob("policy_*")) if p.name.endswith((".pt", ONNX_SUFFIX))}
    if REFERENCE not in artifacts:
        raise RoverError(f"{run_dir}: no {REFERENCE}.pt in it", found=[*artifacts], remedy="'rover run' makes a run")
    manifests = {stem: read_manifest(path) for stem, path in artifacts.items()}
    if len(cameras := manifests[REFERENCE]["cameras"]) != 1:
        raise RoverError(f"{run_dir}: only policies of one camera are counted", found=f"{len(cameras)} cameras")
    again = open_run(run_dir)
    samples = pick_evenly(again.parts.held_out, frames)
    if not samples:
        raise RoverError(f"{run_dir}: its recordings have no held-out frames", remedy="record more episodes")
    core, jobs = prepare(), {}
    chosen = {stem: pick_evenly(range(len(samples)), FEW.get(m["mode"], len(samples))) for stem, m in manifests.items()}
    for stem in sorted(artifacts, key=lambda stem: len(chosen[stem])):  # FP32, which takes longest, first
        path, manifest, seen = artifacts[stem], manifests[stem], [samples[i] for i in chosen[stem]]
        most = min(COUNTED, FEW.get(manifest["mode"], COUNTED))
        jobs[stem] = partial(count_artifact, core, path, manifest, seen, packages=packages_of(path), counted=most)
    counts = side_by_side(jobs, progress)
    judged = _judge(artifacts, chosen, counts, samples, again, progress)
    rows = {stem: counts[stem].row | judged[stem] for stem in artifacts}
    metrics: dict[str, Any] = {"label": LABEL, "artifacts": rows}
    metrics["gates"] = gates(metrics, lab_params()["arm"]["gates"])
    given = {"frames": len(samples), "steady": STEADY, "cpu": A76, "threads": 1}
    given["qemu"] = run("qemu-aarch64", "--version", error=RoverError).splitlines()[0]
    inputs = {p.name: sha256_of(p) for p in artifacts.values()}
    return write_stage(run_dir / "arm.json", "arm", params=given, metrics=metrics, inputs=inputs)


def _judge(
    artifacts: Mapping[str, Path],
    chosen: Mapping[str, Sequence[int]],
    counts: Mapping[str, Counted],
    samples: Sequence[Any],
    again: Opened,
    progress: Progress,
) -> dict[str, dict[str, Any]]:
    """Judge each artifact's predictions; return rows for arm.json. Raises RoverError if FP32 differs in the Pi."""
    rows: dict[str, dict[str, Any]] = {}
    ranges, names = again.recordings.action_range(), again.checkpoint.config.action_names
    here = chunks_here(artifacts[REFERENCE], samples, progress)
    differences = np.abs(counts[REFERENCE].chunks - here[list(chosen[REFERENCE])]).max((0, 1))
    difference = float(differences.max())
    tolerance = read_manifest(artifacts[REFERENCE])["parity"]["tolerance"]
    if not all(d <= tolerance[name] for name, d in zip(names, differences, strict=True)):
        raise RoverError(f"{artifacts[REFERENCE]}: differs by {difference:.2g} on the core", remedy="quantize again")
    for stem, frames in chosen.items():
        expected, seen = here[list(frames)], [samples[i] for i in frames]
        at_home = expected if stem == REFERENCE else chunks_here(artifacts[stem], seen, progress)
        rows[stem] = errors_pct(expected, counts[stem].chunks, names, ranges)
        rows[stem] |= {f"workstation_{k}": v for k, v in errors_pct(expected, at_home, names, ranges).items()}
        rows[stem] |= {"reference": REFERENCE, "frames_on_the_core": len(frames)}
        rows[stem]["reference_max_difference"] = difference
    return rows


def chunks_here(path: Path, samples: Sequence[Any], progress: Progress) -> np.ndarray:
    """Return what an artifact predicts on this machine in one thread: (n, C, A) float32."""
    policy = load_policy(path, threads=1)
    watched = progress(samples, desc=f"{path.stem} on this machine", total=len(samples))
    return np.stack([policy.predict_chunk(s.frame_bgr(), s.state) for s in watched])


def errors_pct(
    reference: np.ndarray, chunks: np.ndarray, actions: Sequence[str], ranges: dict[str, tuple[float, float]]
) -> dict[str, float | None]:
    """Return <action>_mae_pct: the mean difference of two sets of chunks (n, C, A), in percent of the recorded range.

    None for an action that never changes in the recordings.
    """
    mean = np.abs(chunks.astype(np.float64) - reference).mean((0, 1))
    return {f"{action}_mae_pct": pct_of_range(float(mean[i]), ranges[action]) for i, action in enumerate(actions)}
