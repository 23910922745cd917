"""Frames: equal to LeRobot's path (RGB, resize, ImageNet normalisation)."""

import cv2
import numpy as np
import pytest
import torch

from rover_lib.onboard.errors import PolicyError
from rover_lib.onboard.policy.preprocess import IMAGENET_MEAN, IMAGENET_STD, prepare_frame
from tests.helpers.policies import normalise, smooth_frame


def lerobots(frame_bgr, height, width):
    """RGB, to float, torchvision's resize, torchvision's normalisation."""
    from torchvision.transforms.v2 import functional as tv  # takes seconds, and not in every process that collects

    x = torch.from_numpy(cv2.cvtColor(frame_bgr, cv2.COLOR_BGR2RGB)).permute(2, 0, 1).float() / 255
    x = tv.resize(x, [height, width], antialias=True)
    return tv.normalize(x, IMAGENET_MEAN, IMAGENET_STD).numpy()


def test_same_size_is_exact():
    frame = np.random.default_rng(0).integers(0, 256, (360, 640, 3), dtype=np.uint8)
    rgb = prepare_frame(frame, 360, 640)
    assert np.array_equal(rgb, frame[:, :, ::-1]) and rgb.flags.c_contiguous
    assert np.abs(normalise(rgb) - lerobots(frame, 360, 640)).max() < 1e-5
    for bad in (None, np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)):
        with pytest.raises(PolicyError):
            prepare_frame(bad, 360, 640)


@pytest.mark.parametrize(("h", "w"), [(720, 1280), (180, 320)])
def test_resized_is_lerobots_to_a_step_of_the_picture(h, w):
    """OpenCV averages bytes, torchvision floats: on a camera-like picture they differ by rounding of a byte or two."""
    frame = smooth_frame(np.random.default_rng(1), h, w)
    difference = np.abs(normalise(prepare_frame(frame, 360, 640)) - lerobots(frame, 360, 640))
    step = 1 / 255 / min(IMAGENET_STD)
    assert difference.mean() < 0.75 * step and difference.max() < 4 * step
