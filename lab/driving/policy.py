"""A policy that does what the picture's corner tells it to, so that a test can choose what happens in an inference."""

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rover_lib.onboard.artifact.engines import ONNXRUNTIME, TORCH
from rover_lib.onboard.artifact.manifest import SCHEMA, save_artifact, save_onnx

SIZE = (160, 320)  # height and width of the camera's pictures
CHUNK, RATE_HZ = 32, 30.0
PLAN, OTHER_PLAN = (0.2, 0.15), (-0.3, 0.08)  # steering, throttle

# The instructions. Red, green and blue in the picture's corner, on or off, are the bits 4, 2 and 1 of one.
PLAIN, RAISE, HANG, NAN, OUT_OF_RANGE, SLOW, OTHER = range(7)
SLOW_S = 0.3


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


def obey_pictures() -> None:
    """Let this process's policy process do from now on what the picture's corner tells it to: PLAIN to OTHER.

    An artifact cannot do that, as its operators are a closed list. Otherwise the policy process is the real one.
    """
    from rover_lib.onboard.drive.inference import PolicyProcess

    PolicyProcess.loaded = staticmethod(obey)


def obey(policy: Any) -> None:
    """Change a loaded policy with the plan PLAN, so that it does what the picture's corner tells it to."""
    plain = policy.run

    def run(state: np.ndarray, frames_rgb: list[np.ndarray]) -> np.ndarray:
        red, green, blue = frames_rgb[0][4:12, 4:12].mean((0, 1)) > 127
        instruction = 4 * red + 2 * green + blue
        if instruction == RAISE:
            raise RuntimeError("told to fail by the picture")
        if instruction in (HANG, SLOW):
            end_s = time.monotonic() + (SLOW_S if instruction == SLOW else float("inf"))
            while time.monotonic() < end_s:
                pass
        plan = plain(state, frames_rgb)
        if instruction == NAN:
            return plan * np.nan
        if instruction == OUT_OF_RANGE:
            return plan * 0 + 5
        return plan * 0 + np.array(OTHER_PLAN, np.float32) if instruction == OTHER else plan

    policy.run = run


def pictures(instruction: int, size: tuple[int, int] = SIZE, level: int = 100, count: int = 40) -> list[bytes]:
    """Make JPEGs with a sensor's noise, no two the same, whose corner shows an instruction.

    level: their grey; with 0 they are black and show no instruction. count: how many. If they are shown over and over
    again, they pass for a live camera only if there are more of them than Camera remembers.
    """
    rng = np.random.default_rng(instruction)
    height, width = size
    made = []
    for _ in range(count):
        picture = rng.integers(level, level + 12, (height, width, 3), np.uint8)
        on = [bool(instruction & bit) for bit in (1, 2, 4)]  # blue, green, red
        if level:
            picture[: height // 3, : width // 3] = np.where(on, 225, 25)
            picture[: height // 3, : width // 3] += rng.integers(0, 12, (height // 3, width // 3, 3), np.uint8)
        made.append(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    return made
