"""Which side positive steering turns to, on pictures of which it is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rover_lib.workshop.pictures.turning import LEAST_SPREAD, measure_sides, with_late
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import Episode, Recordings
from rover_lib.workshop.recordings.source import Source
from tests.helpers.recorded import PictureSample, pass_a_wall, real_recordings


def drive(name, gain, amplitude=0.3, frames=120, seed=0, wandering=None):
    samples = []
    for i, (steering, frame) in enumerate(pass_a_wall(gain, amplitude, frames, seed, wandering)):
        chunk = np.float32([[steering, 0.05]])
        samples.append(PictureSample(name, Path("x"), i / 30, chunk[0], chunk, np.zeros(1, bool), i, picture=frame))
    return Episode(name, Path(name), "", frames / 30, frames, frames, tuple(samples), ())


def recordings(*episodes):
    return Recordings(Path("episodes"), episodes, (), Source(Path("episodes")))


@pytest.mark.parametrize(
    ("gain", "amplitude", "side"),
    [(-8, 0.3, "right"), (8, 0.3, "left"), (-8, 0.1, "right"), (-8, LEAST_SPREAD, None), (0, 0.3, None), (8, 0, None)],
)
def test_the_side_is_that_of_the_background(gain, amplitude, side):
    (found,) = measure_sides(recordings(drive("a", gain, amplitude))).turnings
    why = "steers too little" if amplitude <= LEAST_SPREAD else "too few pictures that move"  # the latter, of both
    assert found.side == side and (why in found.words()) == (side is None)


def test_what_disagrees_with_the_others_is_mirrored():
    sides = measure_sides(recordings(*(drive(f"e{i}", 8 if i == 2 else -8, seed=i) for i in range(4))))
    assert sides.side == "right" and sides.mirrored == ["e2"] and sides.words().endswith("mirrored: e2")
    odd = drive("e2", 8, seed=2)
    turned = replace(odd, samples=tuple(replace(s, mirrored=True) for s in odd.samples))
    assert measure_sides(recordings(turned)).side == "right"
    assert measure_sides(recordings()).words() == ""
    assert "too little" in measure_sides(recordings(drive("a", 0))).words()
    plain = tuple(replace(s, picture=np.zeros_like(s.picture)) for s in odd.samples)
    assert "too little" in measure_sides(recordings(replace(odd, samples=plain))).words()


@pytest.mark.parametrize("late_s", [1.0, -0.8, 0.1])
def test_pictures_that_are_late_are_told(late_s):
    episodes = []
    for i in range(2):
        wandering = np.convolve(np.random.default_rng(i).normal(0, 0.05, 615), np.ones(16), "valid")
        drove = drive(f"e{i}", -8, frames=600, seed=i, wandering=wandering)
        samples = drove.samples
        k = round(30 * late_s)
        late = [replace(s, picture=samples[min(max(s.row - k, 0), 599)].picture) for s in samples]
        episodes.append(replace(drove, samples=tuple(late)))
    together = recordings(*episodes)
    sides = measure_sides(together)
    cautions = with_late(together, sides).cautions()
    if late_s == 0.1:
        assert sides.late_s is None and sides.side == "right" and not cautions
    else:
        assert sides.late_s == pytest.approx(late_s, abs=0.2)
        assert f"s {'later' if late_s > 0 else 'earlier'} than the actions" in cautions[0]


def test_pictures_that_are_all_mirrored_are_held_against_the_cars_file():
    """They were said to turn left, as if this car did, and nothing asked whether the camera was mirrored."""
    all_turned = recordings(*(drive(f"e{i}", 8, seed=i) for i in range(3)))
    sides = measure_sides(all_turned)
    assert sides.denied and "their car's file says right: is the camera's picture mirrored?" in sides.words()
    other = replace(all_turned, layout=replace(all_turned.layout, rate_hz=30.0))  # a dataset, whose car is not known
    assert not measure_sides(other).denied and not measure_sides(recordings(drive("a", -8))).denied


def test_the_real_recordings_turn_right_and_one_is_mirrored():
    sides = measure_sides(load_recordings(real_recordings()))
    assert sides.side == "right" and sides.mirrored == ["episode_20251005_192655"]
    assert all(t.side for t in sides.turnings)
