"""Write a kit as a folder: all its files, and kit.json, which has in numbers what KIT.md says in words."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import onnx

from rover_hailo.calibration import save_arrays, write_calibration, write_expected
from rover_hailo.chips import CHIPS, estimate
from rover_hailo.description import description
from rover_hailo.int8_estimate import Error, stand_in_errors
from rover_hailo.networks import Network, Splits
from rover_hailo.scripts import compile_script, model_script, script_names
from rover_lib.onboard.artifact.manifest import LARGEST_TOLERANCE, Artifact
from rover_lib.onboard.errors import QuantizeError
from rover_lib.onboard.params import params
from rover_lib.workshop.act import ACT, Affine
from rover_lib.workshop.int8.export import Exporter
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.pipeline import CHOOSING_FRAMES, Recipe
from rover_lib.workshop.run.session import Opened

LEAST_SAMPLES = 1024  # as many as the zoo's scripts use to calibrate transformers (vit_small.alls, deit_base.alls)
# The chip's answers may be this many times as far from FP32 as those of ONNX Runtime's INT8. The chip rounds in other
# places, and nobody knows by how much, but a HEF that computes something else is hundreds of times as far off.
STAND_IN_TIMES = 5.0


def write_kit(
    loaded: Opened, out: Path | str, *, samples: int = LEAST_SAMPLES, progress: Progress = silent
) -> dict[str, Any]:
    """Write the kit of a checkpoint to the new folder `out`, and return the content of its kit.json.

    samples: how many frames the calibration set has. Raises QuantizeError if `out` exists or too few frames were
    recorded. After an error nothing of the kit is left.
    """
    out = Path(out)
    if out.exists() or out.is_symlink():
        raise QuantizeError(f"{out}: exists already", remedy="give a folder that does not")
    recipe = Recipe.of(params(), samples)
    chosen, _ = recipe.choose(loaded.parts.calibration)
    if len(chosen) < samples:
        raise QuantizeError(
            f"a calibration set of {samples} frames is wanted, {len(chosen)} are usable for it",
            remedy="record more; or say --samples, and expect more of an error",
        )
    splits = Splits(ACT(loaded.checkpoint.config, loaded.checkpoint.weights))
    judged = Exporter(loaded.checkpoint, pick_evenly(loaded.parts.choosing or chosen, CHOOSING_FRAMES), recipe.parity)
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as temporary:
        folder = Path(temporary) / out.name
        folder.mkdir()
        _write_networks(splits, samples, folder)
        write_calibration(splits, chosen, folder, progress)
        errors = stand_in_errors(splits, folder, judged, progress)
        write_expected(splits, judged, folder)
        report = {
            "schema": 1,
            "samples": samples,
            "networks": {
                network.name: _describe_network(splits, network, errors[network.name], recipe)
                for network in (splits.front, splits.whole)
            },
            "manifest": _manifest(judged, samples, folder),
        }
        (folder / "kit.json").write_text(json.dumps(report, indent=1))
        (folder / "KIT.md").write_text(description(splits.config, report))
        folder.rename(out)
    return report


def _write_networks(splits: Splits, samples: int, folder: Path) -> None:
    """Write the ONNX files and the scripts that compile them."""
    for name, model in (
        ("backbone", splits.front.model),
        ("whole", splits.whole.model),
        ("transformer", splits.rest),
    ):
        onnx.save(model, folder / f"{name}.onnx")
    for chip in CHIPS.values():
        for network in (splits.front, splits.whole):
            text = model_script(network, chip, splits.config, samples)
            (folder / f"{network.name}_{chip.name}.alls").write_text(text)
        (folder / f"compile_{chip.name}.sh").write_text(compile_script(chip))
    shutil.copyfile(Path(__file__).with_name("compile.py"), folder / "compile.py")


def _describe_network(splits: Splits, network: Network, error: Error, recipe: Recipe) -> dict[str, Any]:
    """Return what kit.json says of a network."""
    whole, of_front = splits.whole, network is splits.front
    # An action may be off by STAND_IN_TIMES the stand-in's error, but not by more than an artifact may allow.
    tolerance = {
        name: max(recipe.parity.tolerance, min(STAND_IN_TIMES * largest, LARGEST_TOLERANCE["int8"]))
        for name, largest in error.actions.items()
    }
    return {
        "onnx": f"{network.name}.onnx",
        "cpu": "transformer.onnx" if of_front else None,
        "inputs": {
            name: {"shape": shape, "calibration": f"calibration_{name}.npy"} for name, shape in network.inputs.items()
        },
        "end_nodes": list(network.outputs.values()),
        "script_names": script_names(network),
        "compilers": {chip.name: chip.compiler for chip in CHIPS.values()},
        "operators": dict(sorted(network.operators.items())),
        "estimate": {chip.name: asdict(estimate(network, chip)) for chip in CHIPS.values()},
        "gmac": network.macs / 1e9,
        "parameters_m": network.parameters / 1e6,
        "stand_in_error": error.network,
        "stand_in_actions": error.actions,
        "tolerance": tolerance,
        # Weights that are not on the chip stay in float.
        "weights_mb": (whole.parameters + 3 * (whole.parameters - network.parameters)) / 1e6,
        "runs": {
            "outputs": {name: splits.output_shape(network, name) for name in network.outputs},
            "original_names": network.outputs,
            "state": None if of_front else _affine(splits.config.state_norm),
            "actions": None if of_front else _affine(splits.config.action_unnorm),
        },
    }


def _affine(affine: Affine | None) -> Mapping[str, Any] | None:
    return asdict(affine) if affine else None


def _manifest(judged: Exporter, samples: int, folder: Path) -> dict[str, Any]:
    """Return the manifest of what compile.py packs, without what depends on the network, and write parity.npz.

    Both come from the FP32 artifact, whose export checks that it computes what the policy computes.
    """
    with TemporaryDirectory() as temporary:
        path = Path(temporary) / "policy_fp32.pt"
        judged.export(judged.float_policy, path)
        with Artifact(path) as artifact:
            save_arrays(folder / "parity.npz", artifact.parity)
            manifest = artifact.manifest
    return manifest | {
        "mode": "static",
        "scheme": "affine",
        "engine": "hailo",
        "calibration": {"samples": samples, "observer": "Hailo's compiler"},
        "gmac": judged.gmac,
        "parity": {
            "reason": f"the chip is INT8: {STAND_IN_TIMES:g} times as far from FP32 as ONNX Runtime's INT8",
        },
    }
