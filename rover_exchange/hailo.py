"""What Hailo's compiler needs of a run, and what it gave back: the backbone for the chip, the rest for the processor.

    write_kit("runs/mine")                  # rover export runs/mine --hailo: runs/mine/hailo
    report = judge("runs/mine", fp32, loaded)  # notebook 04, once features.npy was brought back into that folder

Nobody has compiled it; docs/hailo.md says what to do.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.lib.format import open_memmap
from torch import Tensor, nn

from rover_exchange.onnx_graph import onnx_model
from rover_lib.onboard.care.benchmark import floor_ms
from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import ArtifactError, PolicyError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import action_limits
from rover_lib.onboard.policy.onnx_engine import session_of
from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.workshop.act import ACT, ActConfig, inputs_of, multiply_accumulates, transform, zero_colour
from rover_lib.workshop.int8.quantize import graph_of
from rover_lib.workshop.judge.compare import Fidelity, fidelity
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import choose_calibration
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.session import Opened, open_run

SAMPLES = 1024  # as many as the model zoo's scripts take to calibrate transformers
JUDGED = 120  # held-out frames whose features are wanted back
# 10**9 multiply-accumulates per second: the model zoo's DETR-ResNet18 has 31 * 10**9, and these pictures a second.
CHIP_GMAC_PER_S = {"hailo8": 31 * 30, "hailo8l": 31 * 19, "hailo10h": 31 * 41}


class Front(nn.Module):
    """A normalised picture, (1, 3, H, W) float32 -> projected features, (1, D, h, w)."""

    def __init__(self, policy: ACT):
        super().__init__()
        self.backbone = policy.backbone
        self.image_project = policy.image_project

    def forward(self, picture: Tensor) -> Tensor:
        return self.image_project(self.backbone(picture))


class Rest(nn.Module):
    """What follows on the processor: (raw state (1, S), features (h, w, D)) -> raw actions (1, C, A), float32."""

    def __init__(self, policy: ACT):
        super().__init__()
        self.encoder = policy.encoder
        self.decoder = policy.decoder
        self.memory = policy.memory
        self.encoder_norm = policy.encoder_norm
        self.norm = policy.norm
        self.head = policy.head
        self.state_norm = policy.state_norm
        self.state_project = policy.state_project
        self.action_unnorm = policy.action_unnorm
        self.latent, self.pos, self.q_pos = (nn.Buffer(x) for x in (policy.latent, policy.pos, policy.q_pos))

    def forward(self, state: Tensor, features: Tensor) -> Tensor:
        token = self.state_project(self.state_norm(state)).unsqueeze(1)
        image = features.flatten(0, 1).unsqueeze(0)
        return self.action_unnorm(transform(self, torch.cat([self.latent, token, image], 1)))


def halves(policy: ACT) -> tuple[bytes, bytes]:
    """Return the two ONNX graphs of an FP32 policy; ArtifactError for one without a state or of several cameras."""
    config = policy.config
    if not config.sees_state or len(config.cameras) != 1:
        raise ArtifactError("a kit for Hailo needs a state and one camera", found=config.cameras, remedy="use the CPU")
    (size,) = config.image_sizes
    inputs = {
        "state": torch.zeros(1, len(config.state_names)),
        "features": torch.zeros(*config.grid(*size), config.dim),
    }
    front = onnx_model(graph_of(Front(policy)), {"picture": torch.zeros(1, 3, *size)}, ["features"])
    last = front.graph.node.pop()  # an Identity, which the compiler need not learn to parse
    (end,) = (node for node in front.graph.node if node.output[0] == last.input[0])
    end.name = end.output[0] = "features"
    onnx.checker.check_model(front, full_check=True)
    rest = onnx_model(graph_of(Rest(policy)), inputs, ["chunk"])
    return front.SerializeToString(deterministic=True), rest.SerializeToString(deterministic=True)


def write_kit(run_dir: Path | str, progress: Progress = silent) -> dict[str, Any]:
    """Write the folder `hailo` of a run, and return its facts, which are in its kit.json too.

    Raises ArtifactError, and writes nothing, if in ONNX Runtime both halves together differ from the policy by more
    than 1e-4 of the largest action planned, or of 1.
    """
    loaded = open_run(run_dir, progress)
    policy = ACT(loaded.checkpoint.config, loaded.checkpoint.weights)
    config = policy.config
    front, rest = halves(policy)
    calibration_frames, _ = choose_calibration(loaded.parts.calibration, SAMPLES, params()["calibration"]["seed"])
    held_out_frames = pick_evenly(loaded.parts.held_out, JUDGED)
    gap = _gap(
        policy,
        front,
        rest,
        [inputs_of(sample, config) for sample in held_out_frames[:: max(len(held_out_frames) // 4, 1)]],
    )
    if not gap <= 1e-4:  # written so that NaN fails
        raise ArtifactError(f"backbone and rest together differ from the policy by {gap:.3g}; nothing was written")
    blocks = multiply_accumulates(policy)
    on_chip = sum(n for block, n in blocks.items() if block.startswith(("backbone", "image_project"))) / 1e9
    on_cpu = sum(blocks.values()) / 1e9 - on_chip
    computed_ms: dict[str, float | None] = {chip: on_chip / rate * 1000 for chip, rate in CHIP_GMAC_PER_S.items()}
    computed_ms["cpu, FP32, at least"] = floor_ms(on_cpu, "fp32")
    facts = {
        "gmac": {"chip": on_chip, "cpu": on_cpu},
        "computed_ms": computed_ms,
        "gap": gap,
        "frames": len(calibration_frames),
    }
    with build_folder(Path(run_dir) / "hailo", lambda old: old.glob("features.npy")) as folder:
        (folder / "backbone.onnx").write_bytes(front)
        (folder / "rest.onnx").write_bytes(rest)
        (folder / "backbone.alls").write_text(model_script(config, len(calibration_frames)))
        (folder / "kit.json").write_text(json.dumps(facts, indent=1))
        for name, frames in (("calibration", calibration_frames), ("judged", held_out_frames)):
            array = open_memmap(folder / f"{name}.npy", "w+", np.uint8, (len(frames), *config.image_sizes[0], 3))
            for i, sample in enumerate(progress(frames, desc=f"{name} frames", total=len(frames))):
                array[i] = inputs_of(sample, config)[1].numpy()
            array.flush()
    return facts


@torch.inference_mode()
def _gap(policy: ACT, front: bytes, rest: bytes, inputs: list[tuple[Tensor, ...]]) -> float:
    first = session_of(front, 1)
    second = session_of(rest, 1)
    gaps = []
    for state, frame in inputs:
        (features,) = first.run(None, {"picture": policy.image_input[0](frame).contiguous().numpy()})
        (chunk,) = second.run(None, {"state": state.numpy(), "features": features[0].transpose(1, 2, 0)})
        expected = policy(state, frame).numpy()
        gaps.append(np.abs(chunk - expected).max() / max(np.abs(expected).max(), 1))
    return float(np.max(gaps))


def model_script(config: ActConfig, samples: int) -> str:
    """Return the .alls file: the chip normalises pixels itself, and features leave it in 16 bits."""
    mean = zero_colour(config.image_norm[0])
    std = [255 / scale for scale in config.image_norm[0].scale]
    lines = [
        f"normalization1 = normalization({[round(v, 6) for v in mean]}, {[round(v, 6) for v in std]})",
        f"model_optimization_config(calibration, batch_size=8, calibset_size={samples})",
        "model_optimization_flavor(optimization_level=0, compression_level=0)",  # 0 needs no GPU
        "quantization_param({output_layer*}, precision_mode=a16_w16)",
    ]
    return "\n".join(lines) + "\n"


class Returned:
    """Plans from features, (n, h, w, D), that a Hailo or its emulator computed of the kit's n judged frames, in order.

    Raises PolicyError for features of another shape.
    """

    def __init__(self, folder: Path, like: Any):
        self.action_names = like.action_names
        self.chunk = like.chunk
        self._low, self._high = action_limits(like.action_names, like.car)
        frames = np.load(folder / "judged.npy", mmap_mode="r")
        self._features = np.load(folder / "features.npy", allow_pickle=False)
        self._rest = session_of((folder / "rest.onnx").read_bytes(), 1)
        shape = (len(frames), *self._rest.get_inputs()[1].shape)
        if self._features.shape != shape or not np.isfinite(self._features).all():
            problem = f"{folder / 'features.npy'}: not the features of judged.npy, {shape} and finite"
            raise PolicyError(problem, found=self._features.shape, remedy="one for each frame, channels last")
        self._size = frames.shape[1:3]
        self._places = {frame.tobytes(): i for i, frame in enumerate(frames)}

    def predict_chunk(self, frame_bgr: Any, state: np.ndarray) -> np.ndarray:
        """As an artifact does, (C, A) float32. Raises PolicyError for a frame that is not in judged.npy."""
        (frame,) = frame_bgr.values() if isinstance(frame_bgr, Mapping) else (frame_bgr,)
        place = self._places.get(prepare_frame(frame, *self._size).tobytes())
        if place is None:
            raise PolicyError("a held-out frame is not in judged.npy", remedy="make the kit of this run again")
        inputs = {"state": np.asarray(state, np.float32)[None], "features": self._features[place].astype(np.float32)}
        return np.clip(self._rest.run(None, inputs)[0][0], self._low, self._high)


def judge(run_dir: Path | str, fp32: Any, loaded: Opened) -> Fidelity | None:
    """Compare with the run's FP32 policy what was brought back into its folder `hailo`; None if nothing was."""
    folder = Path(run_dir) / "hailo"
    if not (folder / "features.npy").is_file():
        return None
    frames = pick_evenly(loaded.parts.held_out, JUDGED)
    return fidelity(fp32, {"hailo": Returned(folder, fp32)}, frames, loaded.recordings.action_range())
