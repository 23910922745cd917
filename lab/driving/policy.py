"""A policy that does what the picture's corner tells it to, so that what happens inside an inference can be chosen."""

from pathlib import Path

import cv2
import numpy as np

from rover_lib.onboard.artifact import SCHEMA, save_artifact

SIZE = (160, 320)  # height and width of the camera's pictures
CHUNK, RATE_HZ = 32, 30.0
PLAN, OTHER_PLAN = (0.2, 0.15), (-0.3, 0.08)  # steering, throttle

# Instructions: red, green and blue of the picture's corner are on or off.
PLAIN, RAISE, HANG, NAN, OUT_OF_RANGE, SLOW, OTHER = range(7)


def make_artifact(
    path: Path, *, camera: str = "front", size: tuple[int, int] = (48, 96), engine: str | None = None
) -> None:
    """An artifact with constant plans that obeys the corner of the picture: PLAIN to OTHER.

    camera, size: its name, and height and width of what the policy looks at. engine: in the manifest; this machine's.
    """
    import torch

    class Obedient(torch.nn.Module):
        plan: torch.Tensor
        other: torch.Tensor

        def __init__(self):
            super().__init__()
            self.register_buffer("plan", torch.tensor([PLAN] * CHUNK)[None])
            self.register_buffer("other", torch.tensor([OTHER_PLAN] * CHUNK)[None])

        def forward(self, state, frame):
            corner = frame[4:12, 4:12].float().mean(dim=(0, 1)) > 127.0
            instruction = int(corner[0]) * 4 + int(corner[1]) * 2 + int(corner[2])
            plan = self.plan.clone()
            if instruction == 1:
                raise RuntimeError("told to fail by the picture")
            if instruction == 2 or instruction == 5:
                work_ns = 300000000 if instruction == 5 else 1 << 62
                start, rounds = torch.ops.prim.TimePoint(), 0
                while torch.ops.prim.TimePoint() - start < work_ns:
                    rounds += 1
                plan = plan + 0 * rounds
            if instruction == 3:
                plan = plan * float("nan")
            if instruction == 4:
                plan = plan * 0 + 5.0
            if instruction == 6:
                plan = self.other.clone()
            return plan

    height, width = size
    module = torch.jit.script(Obedient().eval())
    names = ["steering", "throttle"]
    manifest = {
        "schema": SCHEMA,
        "mode": "fp32",
        "scheme": "float",
        "engine": engine or torch.backends.quantized.engine,
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
    save_artifact(path, module, manifest, parity)


def pictures(instruction: int, size: tuple[int, int] = SIZE, level: int = 100, count: int = 16) -> list[bytes]:
    """JPEGs with a sensor's noise, no two the same, whose corner has an instruction. level: their grey, 0 is black."""
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
