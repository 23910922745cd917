"""A policy with a constant plan, and pictures for its camera."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from rover_lib.onboard.artifact.manifest import SCHEMA, TORCH, save_artifact

SIZE = (160, 320)  # height and width of the camera's pictures
CHUNK, RATE_HZ = 32, 30.0
PLAN = 0.2, 0.15  # steering, throttle


def make_artifact(
    path: Path,
    *,
    camera: str = "front",
    size: tuple[int, int] = (48, 96),
    plan: Sequence[Sequence[float]] | np.ndarray = (PLAN,) * CHUNK,
    follows: float = 0.0,
) -> None:
    """Write an artifact with a plan, (CHUNK, 2), that a white picture moves by `follows` from a black one's.

    camera: its name. size: height and width of its pictures.
    """
    import torch

    planned = np.asarray(plan, np.float32)

    class Constant(torch.nn.Module):
        plan: torch.Tensor

        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("plan", torch.tensor(planned)[None])

        def forward(self, state: torch.Tensor, frame: torch.Tensor) -> torch.Tensor:
            return self.plan + 0 * state[:, None] + follows * frame.float().mean() / 255

    names, frame = ["steering", "throttle"], f"frame_{camera}"
    manifest = {
        "schema": SCHEMA,
        "mode": "fp32",
        "scheme": "float",
        "engine": TORCH,
        "cameras": [{"name": camera, "height": size[0], "width": size[1]}],
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
    arrays: dict[str, np.ndarray] = {"state": np.zeros((1, 2), np.float32), frame: np.zeros((1, *size, 3), np.uint8)}
    graph = torch.jit.trace(Constant().eval(), (torch.zeros(1, 2), torch.zeros((*size, 3), dtype=torch.uint8)))
    save_artifact(path, torch.jit.freeze(graph), manifest, arrays | {"chunk": planned[None]})


def pictures(size: tuple[int, int] = SIZE, count: int = 40) -> list[bytes]:
    """Make JPEGs with a sensor's noise, no two the same, of that (height, width).

    If they are shown over and over again, they pass for a live camera only if there are more of them than Camera
    remembers.
    """
    rng = np.random.default_rng(0)
    jpegs = []
    for i in range(count):
        picture = rng.integers(100, 112, (*size, 3), np.uint8)
        picture[: size[0] // 3, : size[1] // 3] -= 75  # so that there is something to see
        picture = np.roll(picture, i * size[1] // count, 1)  # or the car would be stuck
        jpegs.append(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    return jpegs
