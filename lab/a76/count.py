"""Count the instructions that artifacts execute in the emulated Pi, in one thread, and judge what they predict there.

count_run("runs/demo")      # writes runs/demo/arm.json
"""

import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lab import PARAMS
from lab.a76.core import A76, FOR_GUEST, Core, Emulation, emulate_artifact, fetch_wheels, prepare
from lab.a76.pi5 import DRIVING, predict_ms
from lab.a76.report import LABEL, alone_of, gates
from lab.a76.symbols import GuestFunctions, by_kernel
from rover_lib.onboard.artifact.manifest import ONNX_SUFFIX, ONNXRUNTIME, read_manifest
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.onboard.stage import sha256_of, write_stage
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.judge.recorded_range import pct_of_range
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.session import Opened, open_run
from rover_lib.workshop.run_program import run
from rover_lib.workshop.wheelhouse import REQUIREMENTS

COUNTED = 10  # how many inferences after loading are counted, each by itself
STEADY = 3  # the number of the first inference whose count is that of all later ones too
SDOT_MACS = 16  # multiply-accumulates of one SDOT; the floor is the count if nothing but SDOT ran
REFERENCE = "policy_fp32"
FRAMES = 50
FEW = {"fp32": STEADY, "dynamic": COUNTED}  # frames of what is slow: FP32 takes minutes for an emulated inference


def packages_of(artifact: Path) -> Path | None:
    """Return what comes before the Pi's own packages: for an ONNX Runtime artifact, those of a Pi without torch."""
    if read_manifest(artifact)["engine"] != ONNXRUNTIME:
        return None
    wheels = REQUIREMENTS["onnxruntime"]
    return cache_folder("arm-onnxruntime", key_of({"for": FOR_GUEST}, wheels), lambda to: fetch_wheels(to, wheels))


class Counted(NamedTuple):
    """What an artifact did in the emulated Pi. row: its part of arm.json. chunks: (n, C, A) float32."""

    row: dict[str, Any]
    chunks: np.ndarray


def count_artifact(
    core: Core,
    artifact: Path,
    manifest: dict[str, Any],
    samples: Sequence[Any],
    *,
    packages: Path | None = None,
    counted: int = COUNTED,
) -> Counted:
    """Load an artifact in the emulated Pi, predict each sample, and count the first `counted` inferences one by one.

    samples: have frame_bgr() and state; if there are fewer than `counted`, at least STEADY, they are repeated.
    packages: of packages_of(). Raises RoverError if it fails.
    """
    with tempfile.TemporaryDirectory(prefix="rover-arm-") as scratch:
        folder, observations = Path(scratch), Path(scratch) / "observations.npz"  # which guest/predict.py explains
        frames: dict[str, Any] = {f"frame_{i:04d}": sample.frame_bgr() for i, sample in enumerate(samples)}
        np.savez(observations, state=np.stack([s.state for s in samples]).astype(np.float32), **frames)
        arguments = [artifact.resolve(), observations, folder, counted]
        done = emulate_artifact(core, arguments, folder, packages, f"memory={STEADY}")
        return Counted(_row(done, folder, counted, manifest), np.load(folder / "chunks.npy"))


def _row(done: Emulation, folder: Path, counted: int, manifest: dict[str, Any]) -> dict[str, Any]:
    """Return an artifact's part of arm.json; _g are 10**9 instructions. The floor is SDOT alone, for every mode."""
    kernels = by_kernel(done.sections[STEADY], GuestFunctions((folder / "maps").read_text()))
    kernels_g = {name: instructions / 1e9 for name, instructions in kernels.items()}
    inferences_g = [done.total(i) / 1e9 for i in range(1, counted + 1)]
    counts: dict[str, float] = {"instructions": done.total(STEADY), "sdot": done.total(STEADY, "sdot")}
    counts |= {"simd": done.total(STEADY, "simd"), "cycles": done.cycles(STEADY)}
    counts["near_lines"], counts["far_lines"] = done.lines(STEADY)
    work = {f"{name}_g": count / 1e9 for name, count in counts.items()} | {"alone": alone_of(kernels_g)}
    floor_g = manifest["gmac"] / SDOT_MACS
    versions = json.loads((folder / "versions.json").read_text())
    return work | {
        "floor_g": floor_g,
        "x_floor": work["instructions_g"] / floor_g,
        "first_g": inferences_g[0],
        "second_g": inferences_g[1],
        "tenth_g": inferences_g[9] if counted >= COUNTED else None,
        "familiar_g": done.total(counted + 1) / 1e9 if "familiar" in manifest else None,
        "load_instructions_g": done.total(0) / 1e9,
        "gmac": manifest["gmac"],
        "image_height": manifest["cameras"][0]["height"],
        "image_width": manifest["cameras"][0]["width"],
        "instructions_by_kernel": kernels_g,
        "peak_memory_mb": done.peak_mb["predict"],
        "peak_memory_loading_mb": done.peak_mb["load"],
        "threads": versions["threads"],
        "versions": versions,
        "computed_pi5_ms": predict_ms(work) | {"threads": DRIVING},
    }


def side_by_side(counts: Mapping[str, Callable[[], Counted]], progress: Progress) -> dict[str, Counted]:
    """Count in several emulated machines, one for each of this machine's cores at a time."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        done = pool.map(lambda count: count(), counts.values())  # if one fails, no more begin
        return dict(zip(counts, progress(done, desc="artifacts, emulated", total=len(counts)), strict=True))


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
    picks = {stem: pick_evenly(range(len(samples)), FEW.get(m["mode"], len(samples))) for stem, m in manifests.items()}
    for stem in sorted(artifacts, key=lambda stem: len(picks[stem])):  # FP32, which takes longest, first
        path, manifest, subset = artifacts[stem], manifests[stem], [samples[i] for i in picks[stem]]
        limit = min(COUNTED, FEW.get(manifest["mode"], COUNTED))
        jobs[stem] = partial(count_artifact, core, path, manifest, subset, packages=packages_of(path), counted=limit)
    counts = side_by_side(jobs, progress)
    errors = _judge(artifacts, picks, counts, samples, again, progress)
    rows = {stem: counts[stem].row | errors[stem] for stem in artifacts}
    metrics: dict[str, Any] = {"label": LABEL, "artifacts": rows}
    metrics["gates"] = gates(metrics, PARAMS["arm"]["gates"])
    settings = {"frames": len(samples), "steady": STEADY, "cpu": A76, "threads": 1}
    settings["qemu"] = run("qemu-aarch64", "--version", error=RoverError).splitlines()[0]
    inputs = {p.name: sha256_of(p) for p in artifacts.values()}
    return write_stage(run_dir / "arm.json", "arm", params=settings, metrics=metrics, inputs=inputs)


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
        expected = at_home = here[list(frames)]
        if stem != REFERENCE:
            at_home = chunks_here(artifacts[stem], [samples[i] for i in frames], progress)
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
