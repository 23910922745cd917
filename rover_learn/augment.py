"""Vary pictures while a policy learns, as another day, camera and road would: light, blur, noise and small shifts.

augmentation = Augmentation(light=0.3, noise=8)
variation = augmentation.draw(len(pictures), rng)     # arrays, which a thread may draw ahead
varied = vary(pictures, variation)                    # tensors, on the training's device
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

GAIN, NOISE, BLUR = "gain", "noise", "blur"  # of a variation


@dataclass(frozen=True)
class Augmentation:
    """How far pictures are varied; with 0, not at all.

    light: a picture is multiplied by up to 1 + light, or divided. shift: share of a side by which a picture is moved.
    blur: share of the pictures that are blurred. noise: largest standard deviation of what is added to each value, in
    grey levels.
    """

    light: float = 0.0
    shift: float = 0.0
    blur: float = 0.0
    noise: float = 0.0

    def draw(self, count: int, rng: np.random.Generator, of: np.ndarray | bool = True) -> dict[str, np.ndarray]:
        """Draw a variation for each of `count` pictures: (count, 1, 1, 1) float32 each. of: (count,), which vary."""
        brightest = np.log1p(self.light)
        variation = {
            GAIN: np.exp(rng.uniform(-brightest, brightest, count) * of),
            NOISE: rng.uniform(0, self.noise, count) * of,
            BLUR: (rng.random(count) < self.blur) & of,
        }
        return {name: values.astype(np.float32).reshape(count, 1, 1, 1) for name, values in variation.items()}

    def shifted(self, pictures: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return pictures, (n, height, width, 3) uint8, each moved by some pixels, with its edge repeated."""
        if not self.shift:
            return pictures
        height, width = pictures.shape[1:3]
        output = np.empty_like(pictures)
        for i, picture in enumerate(pictures):
            right, down = rng.uniform(-self.shift, self.shift, 2) * (width, height)
            matrix = np.array([[1, 0, round(right)], [0, 1, round(down)]], np.float32)
            output[i] = cv2.warpAffine(picture, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)
        return output


def vary(pictures: Tensor, variation: Mapping[str, Tensor]) -> Tensor:
    """Return pictures, (B, height, width, 3) uint8, as (B, 3, height, width) float32 from 0 to 255, varied.

    variation: as `Augmentation.draw` gives it, on the device of the pictures; what is not in it does not vary.
    """
    x = pictures.permute(0, 3, 1, 2).float()
    if BLUR in variation and variation[BLUR].any():
        blurred = F.avg_pool2d(F.pad(x, (1, 1, 1, 1), mode="replicate"), 3, 1)
        x = torch.where(variation[BLUR] > 0, blurred, x)
    if GAIN in variation:
        x = x * variation[GAIN]
    if NOISE in variation and variation[NOISE].any():
        x = x + torch.randn_like(x) * variation[NOISE]
    return x.clamp_(0, 255) if variation else x
