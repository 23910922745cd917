"""Recordings for tests: a real one, if there is one, and small ones that are made here."""

import math
from pathlib import Path

import numpy as np
import pytest
from policies import smooth_frame

from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.recording.episode import About, EpisodeWriter

REPO = Path(__file__).resolve().parents[1]
BESIDE = (REPO, *REPO.parents[:2])  # where shared/ may be


def real_episode() -> Path:
    """Return the folder of a real recording in shared/, in or beside the checkout. Skips the test if there is none."""
    for base in BESIDE:
        found = sorted((base / "shared" / "sample_episode").glob("episode_*/episode_data.json"))
        if found:
            return found[0].parent
    pytest.skip("no real recording here: put one at shared/sample_episode/episode_*/ to run this test on it")


def real_recordings() -> Path:
    """Return the folder of several whole real recordings in shared/. Skips the test if there is none."""
    for base in BESIDE:
        if any((base / "shared" / "recordings").glob("episode_*/frames")):
            return base / "shared" / "recordings"
    pytest.skip("no real recordings here: put some at shared/recordings/episode_*/ to run this test on them")


def record_drives(root: Path, drives: int = 4, frames: int = 24) -> Path:
    """Record drives in which steering, throttle and pictures change. Returns `root`."""
    rng, pwm = np.random.default_rng(0), PwmCalibration()
    for drive in range(drives):
        with EpisodeWriter(root / f"episode_{drive}", About(""), resolution=(96, 54)) as writer:
            for i in range(frames + 6):
                t_s = i / 30
                pulses = pwm.pulses(0.5 * math.sin(4 * t_s + drive), 0.05 + 0.04 * math.cos(3 * t_s + drive))
                writer.control(t_s, 500 + 33 * i, pulses.steering_us, pulses.throttle_us, 21316, 1016)
            for i in range(frames):
                writer.frame(0.1 + i / 30, smooth_frame(rng, 54, 96))
    return root
