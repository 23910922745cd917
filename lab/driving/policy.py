"""A policy with a constant plan, and pictures for its camera."""

from pathlib import Path

import cv2
import numpy as np

from rover_lib.onboard.artifact.engines import ONNXRUNTIME, TORCH
from rover_lib.onboard.artifact.manifest import SCHEMA, save_artifact, save_onnx

SIZE = (160, 320)  # height and width of the camera's pictures
CHUNK, RATE_HZ = 32, 30.0
PLAN = 0.2, 0.15  # steering, throttle
PLAIN = 0  # the pictures' usual seed


def make_artifact(
    path: Path, *, camera: str = "front", size: tuple[int, int] = (48, 96), engine: str | None = None
) -> None:
    """Write an artifact with the constant plan PLAN.

    camera: the camera's name. size: height and width of the policy's pictures. engine: torch if None; with ONNX
    Runtime's the artifact is made for that, any other is only named in the manifest.
    """
    import torch

    class Constant(torch.nn.Module):
        plan: torch.Tensor
        nothing: torch.Tensor

        def __init__(self):
            super().__init__()
            self.register_buffer("plan", torch.tensor([PLAN] * CHUNK)[None])
            self.register_buffer("nothing", torch.zeros(1))

        def forward(self, state, frame):
            return self.plan + self.nothing * state[:, None]

    height, width = size
    module = Constant().eval()
    inputs = {"state": torch.zeros(1, 2), f"frame_{camera}": torch.zeros((height, width, 3), dtype=torch.uint8)}
    names = ["steering", "throttle"]
    manifest = {
        "schema": SCHEMA,
        "mode": "fp32",
        "scheme": "float",
        "engine": engine or TORCH,
        "cameras": [{"name": camera, "height": height, "width": width}],
        "state_names": names,
        "action_names": names,
        "chunk": CHUNK,
        "rate_hz": RATE_HZ,
        "normalisation": "none",
        "checkpoint": {"sha256": "", "format": "made by the laboratory"},
        "calibration": None,
        "weights_mb": 0.0,
        "gmac": 0.0,
        "parity": {"tolerance": dict.fromkeys(names, 1e-6), "reason": "constant"},
        "versions": {"torch": torch.__version__, "rover_lib": ""},
    }
    frames = np.zeros((1, height, width, 3), np.uint8)
    parity: dict[str, np.ndarray] = {
        "state": np.zeros((1, 2), np.float32),
        f"frame_{camera}": frames,
        "chunk": np.full((1, CHUNK, 2), PLAN, np.float32),
    }
    if engine == ONNXRUNTIME:
        from rover_lib.workshop.int8.onnx_graph import graph_of, onnx_model

        save_onnx(path, onnx_model(graph_of(module), inputs, ("chunk",)).SerializeToString(), manifest, parity)
    else:
        save_artifact(path, torch.jit.freeze(torch.jit.trace(module, tuple(inputs.values()))), manifest, parity)


def pictures(seed: int = PLAIN, size: tuple[int, int] = SIZE, count: int = 40) -> list[bytes]:
    """Make JPEGs with a sensor's noise, no two the same, of that (height, width).

    If they are shown over and over again, they pass for a live camera only if there are more of them than Camera
    remembers.
    """
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        picture = rng.integers(100, 112, (*size, 3), np.uint8)
        picture[: size[0] // 3, : size[1] // 3] -= 75  # so that there is something to see
        made.append(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    return made
