"""From a checkpoint and recordings to artifacts, as params.yml says: calibrate -> quantize -> export.

    loaded = session.load("best_model.pth", "episodes")
    chosen, note = choose_calibration(loaded.parts.calibration)
    calibration = calibrate(loaded.checkpoint, chosen, smooth=0.5)
    policy = quantize(loaded.checkpoint, Scheme(), calibration)
    export_policies("runs/mine", loaded.checkpoint, {"static": policy}, calibration, samples)

The steps are in `observe`, `quantize`, `choose` and `export`; here, which frames, which options, which files.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rover_lib.onboard.artifact.manifest import ONNX_SUFFIX, content_hash
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import atomic_path, read_stage, sha256_of
from rover_lib.workshop.act import ACT
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.checkpoint.facts import GUESS
from rover_lib.workshop.int8.choose import Chooser
from rover_lib.workshop.int8.export import Exporter, Onnx
from rover_lib.workshop.int8.familiar import Drives
from rover_lib.workshop.int8.frames import odd_samples, odd_share
from rover_lib.workshop.int8.observe import Calibration, calibrate
from rover_lib.workshop.int8.quantize import QuantizedPolicy, forget_graphs, quantize
from rover_lib.workshop.int8.scheme import Scheme
from rover_lib.workshop.judge.compare import ARTIFACTS
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import choose_calibration
from rover_lib.workshop.recordings.samples import Sample, pick_evenly
from rover_lib.workshop.run.session import Opened, open_run

DRIVEN = ("fp32", "static", "mixed")  # the others are made to be compared
# Ranges and blocks chosen on 16 frames were up to twice as bad on others. The 64 also tell what share is odd.
CHOOSING_FRAMES = 64
CHECKED_OBSERVATIONS = 3  # of an ONNX graph without recordings
EXPORT_FRAMES = 16  # of these check an export


def prepare_chooser(
    checkpoint: Checkpoint, loaded: Opened, calibration: Calibration, frames: int = CHOOSING_FRAMES
) -> Chooser:
    """A chooser on this many frames that calibration has not seen, and on odd ones, if calibration met any."""
    parts = loaded.parts
    odd = odd_samples(calibration.frames, calibration.seen, parts.calibration)
    tried = pick_evenly(parts.choosing or parts.calibration, frames)
    return Chooser(checkpoint, calibration, tried, loaded.recordings.action_range(), odd)


def schemes_of(static: Scheme, mixed: Scheme, modes: Sequence[str] | None = None) -> dict[str, Scheme]:
    """The schemes of a run's artifacts beside FP32, by name: static, and `modes` or all.

    Mixed is among them only if it leaves a block in float.
    """
    schemes = {"dynamic": replace(static, mode="dynamic"), "static": static, "mixed": mixed}
    if not mixed.float_blocks:
        del schemes["mixed"]  # it is static
    return {name: scheme for name, scheme in schemes.items() if modes is None or name in ("static", *modes)}


def make_artifact(
    loaded: Opened, path: Path | str, p: Mapping[str, Any], *, progress: Progress = silent
) -> tuple[str, list[str]]:
    """One artifact at `path`: calibrated on the recordings, quantized as `p`, params.yml's content, says, exported.

    Where there are odd frames, which one scale may not serve, the ranges are chosen first. Returns its content hash,
    and warnings. Raises ArtifactError.
    """
    checkpoint = loaded.checkpoint
    parts = loaded.parts
    samples = pick_evenly(parts.choosing or parts.calibration, EXPORT_FRAMES)
    settings = p["quantization"]
    scheme = Scheme(smooth=settings["smooth"])
    frames, note = choose_calibration(parts.calibration, p["calibration"]["samples"], p["calibration"]["seed"])
    calibration = calibrate(checkpoint, frames, smooth=scheme.smooth, progress=progress)
    if odd_share(calibration.frames):
        scheme, _ = prepare_chooser(checkpoint, loaded, calibration).observer(scheme, settings["observers"], progress)
    policy = quantize(checkpoint, scheme, calibration)
    drives = Drives.of(parts)
    digest, _ = Exporter(checkpoint, samples).export(policy, path, calibration, drives)
    return digest, ([note] if note else []) + drives.warnings + policy.report["warnings"]


def export_policies(
    folder: Path | str,
    checkpoint: Checkpoint,
    policies: Mapping[str, ACT | QuantizedPolicy],
    calibration: Calibration,
    samples: Sequence[Sample],
    drives: Drives | None = None,
) -> dict[str, dict[str, Any]]:
    """Write policy_<name>.pt of each policy into `folder`, without other modes' of before; what quantize.json says.

    drives: by which those that a rover may drive by (DRIVEN) tell how unfamiliar a picture is.
    """
    described = {}
    for mode in set(ARTIFACTS) - policies.keys():
        (Path(folder) / f"policy_{mode}.pt").unlink(missing_ok=True)
    exporter = Exporter(checkpoint, samples)
    for name, policy in policies.items():
        forget_graphs()
        path = Path(folder) / f"policy_{name}.pt"
        own = calibration if isinstance(policy, QuantizedPolicy) else None
        digest, familiar = exporter.export(policy, path, own, drives if name in DRIVEN else None)
        described[name] = {"content_hash": digest} | ({"familiar": familiar} if familiar else {})
        if isinstance(policy, QuantizedPolicy):
            described[name] |= policy.report | {"scheme": asdict(policy.scheme)}
    return described


def export_onnx(run_dir: Path | str, progress: Progress = silent) -> dict[str, str]:
    """policy_fp32 and policy_static of a run once more, for ONNX Runtime: {file's name: content hash}.

    Static INT8 is made again from the run's calibration. Raises ArtifactError, before anything is written, if
    policy_static.pt and calibration.pt are not those of quantize.json, and as `export` does; RoverError if the run's
    checkpoint or recordings have changed.
    """
    run_dir = Path(run_dir)
    again = open_run(run_dir, progress)
    checkpoint = again.checkpoint
    parts = again.parts
    exporter = Exporter(checkpoint, pick_evenly(parts.choosing or parts.calibration, EXPORT_FRAMES))
    stage = read_stage(run_dir / "quantize.json", "quantize")
    static = stage["metrics"]["modes"]["static"]
    calibrated = run_dir / "calibration.pt"
    hashes = content_hash(run_dir / "policy_static.pt"), sha256_of(calibrated)
    if hashes != (static["content_hash"], stage["inputs"]["calibration.pt"]):
        problem = f"{run_dir}: policy_static.pt and calibration.pt are not those of quantize.json"
        raise ArtifactError(problem, remedy="quantize again")
    calibration = Calibration.load(calibrated)
    drives = Drives.of(parts)
    policies: dict[str, ACT | QuantizedPolicy] = {
        "fp32": ACT(checkpoint.config, checkpoint.weights),
        "static": quantize(checkpoint, Scheme.of(static["scheme"]), calibration),
    }
    artifacts = {}
    for name, policy in progress(policies.items(), desc="for ONNX Runtime", total=len(policies)):
        path = run_dir / f"policy_{name}{ONNX_SUFFIX}"
        artifacts[path.name], _ = exporter.export(policy, path, calibration if name == "static" else None, drives)
        forget_graphs()
    return artifacts


@torch.inference_mode()
def export_graph(checkpoint: Checkpoint, path: Path | str) -> Path:
    """Write FP32 as a plain ONNX graph, for which neither a run nor recordings are needed; return its path.

    `rover export best_model.pth --onnx` does it. `rover export runs/mine --onnx` writes artifacts, FP32 and INT8, whose
    zip holds the same graph as `archive/model.onnx`. Opset 17, static shapes, one file:

    | name | type and shape | content |
    |---|---|---|
    | in: `state` | float32 (1, S) | as recorded, such as steering and throttle of the frame before |
    | in: `frame_<camera>`, one each | uint8 (height, width, 3) | **RGB**, resized to the policy's size by the caller |
    | out: `chunk` | float32 (1, steps, A) | actions as recorded, not clipped |
    | out: `embedding`, of artifacts that know their way | float32 (1, D) | what tells how familiar a picture is |

    Inside are the picture's scaling to [0, 1] and its normalisation, those of state and actions, and the VAE's latent
    of zeros. Metadata: `states`, `actions` (their order), `rate_hz`, `checkpoint` (SHA-256), and `guessed`, which of
    these nothing says.

    Raises ArtifactError, and writes nothing, if ONNX Runtime computes something else than the policy does for random
    observations.
    """
    config = checkpoint.config
    rng = np.random.default_rng(0)
    policy = ACT(config, checkpoint.weights)
    form = Onnx(policy, config)
    for _ in range(CHECKED_OBSERVATIONS):
        state = torch.from_numpy(rng.uniform(-1, 1, (1, len(config.state_names))).astype(np.float32))
        frames = [torch.from_numpy(rng.integers(0, 256, (*size, 3), np.uint8)) for size in config.image_sizes]
        expected = policy(state, *frames)
        actual = form.run((state, *frames))[0]
        gap = (actual - expected).abs().max()
        tolerance = params()["parity"]["fp32"] * expected.abs().max().clamp(min=1)
        if not gap <= tolerance:  # written so that NaN fails
            raise ArtifactError(f"{path}: the written graph differs by {gap:.3g}; nothing was written")
    facts = {"rate_hz": config.rate_hz, "states": ",".join(config.state_names), "checkpoint": checkpoint.sha256}
    guessed = [fact for fact in ("actions", "rate") if checkpoint.facts.source(fact) == GUESS]
    facts |= {"actions": ",".join(config.action_names), "guessed": ",".join(guessed)}
    form.note({name: str(fact) for name, fact in facts.items()})
    with atomic_path(Path(path)) as temporary:
        temporary.write_bytes(form.model)
    return Path(path)
