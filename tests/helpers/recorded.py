"""Recordings for tests: a real one, if there is one, and small ones that are made here."""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.recording.episode import About, EpisodeWriter
from rover_lib.workshop.recordings.samples import Sample
from tests.helpers.policies import smooth_frame

REPO = Path(__file__).resolve().parents[2]
BESIDE = (REPO, *REPO.parents[:2])  # where shared/ may be


@dataclass(frozen=True, eq=False)
class PictureSample(Sample):
    """A sample whose picture is in memory."""

    picture: np.ndarray | None = None

    def frame_bgr(self, least: int = 0) -> np.ndarray:
        return self.turned(self.picture)


def real_episode() -> Path:
    """Return the folder of a real recording in shared/, in or beside the checkout. Skips the test if there is none."""
    return _shared("sample_episode/episode_*/episode_data.json", "a real recording").parent


def real_recordings() -> Path:
    """Return the folder of several whole real recordings in shared/. Skips the test if there is none."""
    return _shared("recordings/episode_*/frames", "several real recordings").parents[1]


def content_of(folder: Path) -> dict[str, Any]:
    """Return what an episode's file says."""
    return json.loads((folder / "episode_data.json").read_text())


def edit_json(path: Path, change: Callable[[Any], object]) -> None:
    """Rewrite a JSON file after `change` has altered its content in place."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def _shared(pattern: str, what: str) -> Path:
    for base in BESIDE:
        if found := sorted((base / "shared").glob(pattern)):
            return found[0]
    pytest.skip(f"no {what.split(maxsplit=1)[1]} here: put {what} at shared/{pattern} to run this test")


def pass_a_wall(
    gain: float, amplitude: float = 0.3, frames: int = 120, seed: int = 0, steering: np.ndarray | None = None
) -> Iterator[tuple[float, Any]]:
    """Yield (steering, picture) of a drive: steering of 1 moves what is seen by `gain` pixels a frame, four later.

    steering: (frames,); None: a sine of that amplitude.
    """
    rng = np.random.default_rng(seed)
    wall = cv2.resize(rng.integers(0, 255, (20, 200), np.uint8), (2000, 100), interpolation=cv2.INTER_LINEAR)
    if steering is None:
        steering = amplitude * np.sin(np.arange(frames) / 9 + rng.uniform(0, 6)) + rng.normal(0, amplitude / 20, frames)
    shift = np.cumsum(np.concatenate([np.zeros(4), gain * steering]))[:frames]
    for steered, moved in zip(steering, shift, strict=True):
        view = np.float32([[1, 0, -900 + moved], [0, 1, 0]])
        yield float(steered), cv2.cvtColor(cv2.warpAffine(wall, view, (160, 100)), cv2.COLOR_GRAY2BGR)


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


def record_there_and_back(folder: Path, car: Car) -> Path:
    """Record an episode of two seconds, whose second half goes backwards if the car can. Returns its folder."""
    with EpisodeWriter(folder, About("there and back", car=car), resolution=(64, 36)) as writer:
        for n in range(60):
            pulses = car.pwm.pulses(0.5, -0.1 if n >= 30 and car.reverses else 0.1)
            writer.control(n / 30, n * 33, pulses.steering_us, pulses.throttle_us, car.numbers[0], car.numbers[4])
            writer.frame(n / 30, np.full((36, 64, 3), n, np.uint8))
    return folder


def lerobot_dataset(
    root: Path, cameras: dict, names: Sequence[str], rate_hz: int, lengths: Sequence[int], kind: str, largest: float
) -> Path:
    """Write a dataset by LeRobot's own writer, of one episode of each of these lengths, in frames. Returns `root`.

    cameras: name -> (height, width). kind: "image" or "video". Actions are random, from 0 to `largest`; a state is the
    action before.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    sides, numbers = ["height", "width", "channels"], ("observation.state", "action")
    pictures = {f"observation.images.{name}": (*size, 3) for name, size in cameras.items()}
    features: dict[str, dict] = {key: {"dtype": kind, "shape": s, "names": sides} for key, s in pictures.items()}
    for key in numbers:
        features[key] = {"dtype": "float32", "shape": (len(names),), "names": list(names)}
    video = {"use_videos": kind == "video", "video_backend": "pyav"}
    made, rng = LeRobotDataset.create("local/made", rate_hz, features, root=root, **video), np.random.default_rng(0)
    for episode, frames in enumerate(lengths):
        before = np.zeros(len(names), np.float32)
        for _ in range(frames):
            row: dict[str, Any] = {key: smooth_frame(rng, *shape[:2]) for key, shape in pictures.items()}
            action = rng.uniform(0, largest, len(names)).astype(np.float32)
            row |= dict(zip(numbers, (before, action), strict=True))
            before = action
            made.add_frame(row | {"task": f"hit the {episode}. balloon"})
        made.save_episode()
    made.finalize()
    return root
