"""Give the engines' own tools what they start from: our float policy, and the frames that calibrated our artifact."""

from collections.abc import Iterator

import numpy as np
import torch
from planes import planes
from torch import Tensor, nn

from rover_lib.onboard.stage import sha256_of
from rover_lib.workshop.act import ACT
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint


def float_policy(checkpoint: str) -> tuple[ACT, tuple[Tensor, Tensor]]:
    """Load the policy, (state (1, S), planes (1, 3, height, width)) -> (1, C, A), all float32, with example inputs."""
    # checked when it was run; there is no LeRobot for the engines' torch
    found = load_checkpoint(checkpoint, checked=sha256_of(checkpoint))
    model = ACT(found.config, found.weights)
    # Only the normalisation of the images stays in the model: the planes are made outside of it.
    model.image_input = nn.ModuleList(pixels.norm for pixels in model.image_input)
    height, width = found.config.image_sizes[0]
    return model, (torch.zeros(1, len(found.config.state_names)), torch.full((1, 3, height, width), 128.0))


def observations(calibration: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield (state, planes) from an npz of `state` (n, S) float32 and `frames` (n, height, width, 3) uint8 RGB."""
    with np.load(calibration) as seen:
        states, frames = seen["state"], seen["frames"]
    for state, frame in zip(states, frames, strict=True):
        yield state[None], planes(frame)
