"""Write a kit as a folder: networks, calibration set, model scripts, and kit.json, by which compile.py works."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.lib.format import open_memmap

from rover_exchange.hailo.networks import Network, networks
from rover_lib.onboard.artifact.manifest import Artifact, largest_tolerance
from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.params import params
from rover_lib.workshop.act import ACT, ActConfig, inputs_of, parameters_by_block, zero_colour
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import Sample
from rover_lib.workshop.run.pipeline import Recipe
from rover_lib.workshop.run.session import Opened

NAME = "backbone"  # of the network on the chip
LEAST_SAMPLES = 1024  # as many as the zoo's scripts use to calibrate transformers (vit_small.alls, deit_base.alls)
# times what is allowed to torch's INT8: a HEF that computes something else is hundreds of times as far off
STATIC_TIMES = 2.5


def write_kit(
    loaded: Opened, run_dir: Path | str, out: Path | str, *, samples: int = LEAST_SAMPLES, progress: Progress = silent
) -> None:
    """Write the kit of a run to the new folder `out`.

    loaded: what the run was made of. run_dir: the run's folder, with its artifacts. samples: how many frames the
    calibration set has. Raises ArtifactError if `out` exists, too few frames were recorded or an artifact is missing.
    """
    out = Path(out)
    if out.exists() or out.is_symlink():
        raise ArtifactError(f"{out}: exists already", remedy="give a folder that does not")
    chosen, _ = Recipe.of(params(), samples).choose(loaded.parts.calibration)
    if len(chosen) < samples:
        what = f"a calibration set of {samples} frames is wanted, {len(chosen)} are usable for it"
        raise ArtifactError(what, remedy="record more; or say --samples, and expect more of an error")
    policy = ACT(loaded.checkpoint.config, loaded.checkpoint.weights)
    front, rest = networks(policy)
    with build_folder(out) as folder:
        manifest = _manifest(Path(run_dir), samples, folder) | _describe(policy, front)
        onnx.save(rest, folder / "transformer.onnx")
        onnx.save(front.model, folder / f"{NAME}.onnx")
        (folder / f"{NAME}.alls").write_text(model_script(policy.config, samples))
        for name in ("KIT.md", "compile.py"):
            shutil.copyfile(Path(__file__).with_name(name), folder / name)
        write_calibration(policy.config, chosen, folder / f"calibration_{front.picture}.npy", progress)
        content = {"schema": 1, "input": front.picture, "shape": front.shape, "end": front.end, "manifest": manifest}
        (folder / "kit.json").write_text(json.dumps(content, indent=1))


def write_calibration(config: ActConfig, samples: Sequence[Sample], path: Path, progress: Progress) -> None:
    """Write the calibration set, (n, height, width, 3) uint8 RGB."""
    frames = open_memmap(path, "w+", np.uint8, (len(samples), *config.image_sizes[0], 3))
    for i, sample in enumerate(progress(samples, desc="calibration set")):
        frames[i] = inputs_of(sample, config)[1].numpy()
    frames.flush()


def model_script(config: ActConfig, samples: int) -> str:
    """Return the network's .alls file. Comments in it give its sources; zoo means hailo_model_zoo."""
    (norm,) = config.image_norm
    mean = [round(v, 6) for v in zero_colour(norm)]
    std = [round(255 / s, 6) for s in norm.scale]
    lines = [
        f"# {NAME}; compiled by nobody yet",
        f"normalization1 = normalization({mean}, {std})",
        f"model_optimization_config(calibration, batch_size=8, calibset_size={samples})",
        "# zoo, detr_resnet_v1_18_bn and vit_small; 0 needs no GPU, with one try optimization_level=2",
        "model_optimization_flavor(optimization_level=0, compression_level=0)",
        "pre_quantization_optimization(equalization, policy=enabled)",
        "quantization_param({output_layer*}, precision_mode=a16_w16)",
    ]
    return "\n".join(lines) + "\n"


def _describe(policy: ACT, network: Network) -> dict[str, Any]:
    """Return the manifest's part for the rover's engine, with shapes as HailoRT gives them."""
    parameters = parameters_by_block(policy)
    on_chip = {block for block in parameters if block.startswith("backbone") or block == "image_project"}
    features = [*policy.config.grid(*policy.config.image_sizes[0]), policy.config.dim]
    return {
        # Weights that are not on the chip stay in float.
        "weights_mb": sum(n if block in on_chip else 4 * n for block, n in parameters.items()) / 1e6,
        "hailo": {"network": NAME, "outputs": {network.features: features}},
    }


def _manifest(run_dir: Path, samples: int, folder: Path) -> dict[str, Any]:
    """Return the manifest of what compile.py packs, without what depends on the networks, and write parity.npz."""
    with Artifact(run_dir / "policy_fp32.pt") as fp32, Artifact(run_dir / "policy_static.pt") as static:
        np.savez_compressed(folder / "parity.npz", allow_pickle=False, **fp32.parity)
        manifest, allowed = fp32.manifest, static.manifest["parity"]["tolerance"]
    parity = {
        "tolerance": {a: min(STATIC_TIMES * most, largest_tolerance("static", a)) for a, most in allowed.items()},
        "reason": f"the chip is INT8: {STATIC_TIMES:g} times what torch's INT8 may be off",
    }
    calibration = {"samples": samples, "observer": "Hailo's compiler"}
    engine = {"mode": "static", "scheme": "affine", "engine": "hailo"}
    return manifest | engine | {"calibration": calibration, "parity": parity}
