"""The camera's watch on recordings: it stops at no real picture, but at black ones and at those that never change."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from recorded import real_recordings

from lab.repository.real_recordings import learn_each, watch_pictures
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import Episode, Recordings, Sample, Source


def recording_of(*pictures):
    samples = [SimpleNamespace(time_s=i / 30, frame_bgr=lambda p=p: p) for i, p in enumerate(pictures)]
    return SimpleNamespace(episodes=[SimpleNamespace(path="none", samples=samples)])


NOISE = [p for p in np.random.default_rng(0).integers(0, 255, (60, 96, 128, 3), np.uint8)]
NOISE = [np.ascontiguousarray(np.where(np.arange(128)[:, None] < 64, p // 4, p)) for p in NOISE]  # and some contrast


@pytest.mark.parametrize(
    ("pictures", "stops", "equal"),
    [(NOISE, False, 1), ([0 * NOISE[0]] * 60, True, 60), (NOISE[:20] + [NOISE[20]] * 40, True, 40)],
)
def test_pictures_at_which_a_driving_car_would_stop(pictures, stops, equal):
    found = watch_pictures(recording_of(*pictures))
    assert (found["stops"] > 0) is stops and found["most_equal"] == equal and found["pictures"] == 60
    assert found["frozen"] == found["stops"]  # the black ones are equal, too


def test_no_real_picture_stops_the_car():
    found = watch_pictures(load_recordings(real_recordings()))
    assert found["stops"] == 0 and found["pictures"] == 1172 and found["least"]["contrast"] > 4


class Seen(Sample):
    def frame_bgr(self):
        """A red post, where the steering is to go next."""
        picture = np.full((48, 64, 3), 60, np.uint8)
        picture[:, int(32 + 28 * self.chunk[-1, 0]) :][:, :4] = (0, 0, 220)
        return picture


@pytest.mark.slow
def test_a_small_model_learns_from_the_picture_what_the_last_action_does_not_say():
    """And its error falls with the recordings to learn from: the real ones' stays above the last action's."""
    rng, episodes = np.random.default_rng(0), []
    for name in "abcdef":
        goals, samples, is_pad = rng.uniform(-1, 1, (60, 2)) * (1, 0.05) + (0, 0.05), [], np.zeros(8, bool)
        for i, (goal, state) in enumerate(zip(goals[1:], goals, strict=False)):
            chunk = np.tile(goal * (1, 0) + (0, 0.05 + 0.02 * goal[0] ** 2), (8, 1)).astype(np.float32)
            samples.append(Seen(name, Path("x"), i / 30, state.astype(np.float32), chunk, is_pad, i))
        episodes.append(Episode(name, Path(name), "", 2.0, 59, 59, tuple(samples), ()))
    found = learn_each(Recordings(Path("x"), tuple(episodes), (), Source(Path("x"))), [])
    assert all(e < found["fade"]["errors_pct"][a] / 2 for a, e in found["picture"]["errors_pct"].items())
    assert not any(better.startswith("-") for better in found["picture"]["better"].values())
    assert found["curve"][5][0] < found["curve"][1][0]
