"""Make a full-size policy to count if no checkpoint is at hand: format, size and ranges are real, but it cannot drive.

full_run("runs/full")                  # takes some ten minutes; then `python -m lab arm runs/full` counts it
full_run("runs/full", steps=None)      # makes one that has learned to drive; takes an hour or more, only once
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from balloon_world.record import record_episodes
from rover_learn.train import train
from rover_lib.onboard.artifact.manifest import ONNX_SUFFIX
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.act import ACT
from rover_lib.workshop.int8.observe import calibrate
from rover_lib.workshop.int8.quantize import quantize
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.pipeline import (
    Recipe,
    export_onnx,
    export_policies,
    write_calibrate,
    write_load,
    write_quantize,
)
from rover_lib.workshop.run.session import Opened, load

LAST = f"policy_static{ONNX_SUFFIX}"  # the last file that is made, which the Makefile looks for
NOTE = "trained for a few steps only, so that activations have real ranges: this policy does not drive"
LEARNED_NOTE = "trained whole on the balloon world's drives: this policy has learned to drive there"
STEPS = 24
DRIVES = 16  # two of them choose and two judge, with far more frames than the 50 that judge a count
LEARNED_DRIVES = 80  # as many as the demo's, so that their recordings are in the cache already
SAMPLES = 64  # how many frames calibrate
CHECKED_FRAMES = 8  # how many frames check an export against its policy
SIZES = ((180, 320),)  # image sizes that are judged, in addition to that of training


def full_run(
    run_dir: Path | str,
    *,
    size: str = "full",
    steps: int | None = STEPS,
    drives: int | None = None,
    samples: int = SAMPLES,
    sizes: tuple[tuple[int, int], ...] = SIZES,
    progress: Progress = silent,
) -> Path:
    """Record drives, train a policy for a few steps, and quantize it at several image sizes. Returns run_dir.

    size: 'full' (the user's policy, 360x640), or 'small' to try this out. steps: None for the whole recipe, as in
    `rover train`. drives: if None, 16, or the demo's 80 for the whole recipe. samples: how many frames calibrate
    at most. sizes: further image sizes (height, width) in pixels, with the same weights.

    Leaves what the notebooks leave, as far as counting needs it: episodes, best_model.pth, load.json, calibrate.json,
    calibration.pt, policy_fp32.pt, policy_static.pt, quantize.json and, last, these two policies for ONNX Runtime as
    policy_fp32.onnx.zip and policy_static.onnx.zip. For each of `sizes` it leaves calibration_<height>x<width>.pt,
    policy_fp32_<height>x<width>.pt and policy_static_<height>x<width>.pt.
    load.json says whether the policy can drive. Recordings and checkpoint come from the cache if they were made before.
    Raises TrainingError if run_dir holds another kind of run, and whatever the steps raise.
    """
    run_dir = Path(run_dir).resolve()
    note = NOTE if steps else LEARNED_NOTE
    if (run_dir / "load.json").exists() and read_stage(run_dir / "load.json", "load")["metrics"].get("note") != note:
        raise TrainingError(
            f"{run_dir}: holds a run on another checkpoint", remedy="name another folder, or move it away first"
        )
    for name in ("quantize.json", LAST):
        (run_dir / name).unlink(missing_ok=True)
    drives = drives or (DRIVES if steps else LEARNED_DRIVES)
    episodes = record_episodes(run_dir / "episodes", drives, progress=progress)
    checkpoint = train(episodes, run_dir / "best_model.pth", size, steps=steps, progress=progress)
    loaded = load(checkpoint, episodes)
    write_load(run_dir, loaded, note)
    recipe = replace(Recipe.of(params()), samples=samples)
    modes: dict[str, dict[str, Any]] = {}
    for at in sizes:
        modes |= _quantize(run_dir, loaded, at, recipe, progress)
    modes |= _quantize(run_dir, loaded, None, recipe, progress)
    write_quantize(run_dir, loaded.checkpoint, {"modes": modes})
    export_onnx(run_dir, progress)
    return run_dir


def _quantize(
    run_dir: Path,
    loaded: Opened,
    size: tuple[int, int] | None,
    recipe: Recipe,
    progress: Progress,
) -> dict[str, dict[str, Any]]:
    """Calibrate at one image size (None: training's), write its artifacts, and return their part of quantize.json."""
    suffix = f"_{size[0]}x{size[1]}" if size else ""
    checkpoint = loaded.checkpoint.at_size(*size) if size else loaded.checkpoint
    chosen, note = recipe.choose(loaded.parts.calibration)
    calibration = calibrate(checkpoint, chosen, smooth=recipe.scheme.smooth, progress=progress)
    policies: dict[str, Any] = {f"static{suffix}": quantize(checkpoint, recipe.scheme, calibration)}
    policies[f"fp32{suffix}"] = ACT(checkpoint.config, checkpoint.weights)
    calibration.save(run_dir / f"calibration{suffix}.pt")
    if not suffix:
        write_calibrate(run_dir, checkpoint, calibration, chosen, recipe, note)
    samples = pick_evenly(loaded.parts.choosing, CHECKED_FRAMES)
    return export_policies(run_dir, checkpoint, policies, calibration, samples, recipe.parity)
