"""The camera's watch on recordings: it stops at no real picture, but at black ones and at those that never change."""

from types import SimpleNamespace

import numpy as np
import pytest
from recorded import real_recordings

from lab.repository.real_recordings import watch_pictures
from rover_lib.workshop.recordings.episodes import load_recordings


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
