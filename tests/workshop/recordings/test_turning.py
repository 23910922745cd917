"""Which side positive steering turns to, on pictures of which it is known."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from recorded import real_recordings

from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import Episode, Recordings, Sample, Source
from rover_lib.workshop.recordings.turning import LEAST_SPREAD, measure_sides, measure_turning


@dataclass(frozen=True, eq=False)
class Seen(Sample):
    picture: np.ndarray | None = None

    def frame_bgr(self):
        return self.turned(self.picture)


def drive(name, gain, amplitude=0.3, frames=120, seed=0):
    """A drive before a wall: steering of 1 moves what is seen by `gain` pixels a frame, four frames later."""
    rng = np.random.default_rng(seed)
    wall = cv2.resize(rng.integers(0, 255, (20, 200), np.uint8), (2000, 100), interpolation=cv2.INTER_LINEAR)
    steering = amplitude * np.sin(np.arange(frames) / 9 + rng.uniform(0, 6)) + rng.normal(0, amplitude / 20, frames)
    shift = np.cumsum(np.concatenate([np.zeros(4), gain * steering]))[:frames]
    samples = []
    for i in range(frames):
        view = np.float32([[1, 0, -900 + shift[i]], [0, 1, 0]])
        frame = cv2.cvtColor(cv2.warpAffine(wall, view, (160, 100)), cv2.COLOR_GRAY2BGR)
        chunk = np.float32([[steering[i], 0.05]])
        samples.append(
            Seen(name, Path("x"), i / 30, chunk[0], chunk, np.zeros(1, bool), i, picture=frame)
        )  # fmt: skip
    return Episode(name, Path(name), "", frames / 30, frames, frames, tuple(samples), ())


def recordings(*episodes):
    return Recordings(Path("episodes"), episodes, (), Source(Path("episodes")))


@pytest.mark.parametrize(
    ("gain", "amplitude", "side"),
    [(-8, 0.3, "right"), (8, 0.3, "left"), (-8, 0.1, "right"), (-8, LEAST_SPREAD, None), (0, 0.3, None), (8, 0, None)],
)
def test_the_side_is_that_of_the_background(gain, amplitude, side):
    found = measure_turning("a", drive("a", gain, amplitude).samples)
    assert found.side == side and ("not sure" in found.words() or "too few" in found.words()) == (side is None)


def test_what_disagrees_with_the_others_is_mirrored():
    sides = measure_sides(recordings(*(drive(f"e{i}", 8 if i == 2 else -8, seed=i) for i in range(4))))
    assert sides.side == "right" and sides.mirrored == ["e2"] and sides.words().endswith("mirrored: e2")
    odd = drive("e2", 8, seed=2).samples
    turned = [Seen(**{**vars(s), "mirrored": True}) for s in odd]
    assert measure_turning("e2", turned).side == "right"
    assert (
        measure_sides(recordings()).words() == "" and "too little" in measure_sides(recordings(drive("a", 0))).words()
    )


def test_the_real_recordings_turn_right_and_one_is_mirrored():
    sides = measure_sides(load_recordings(real_recordings()))
    assert sides.side == "right" and sides.mirrored == ["episode_20251005_192655"]
    assert all(t.side for t in sides.turnings)
