"""What a teacher is asked and a student is shown, in both views."""

from types import SimpleNamespace

import numpy as np
import torch

from rover_learn.augment import GAIN
from rover_learn.lessons import ACTION, FADED, IMAGE, MIRRORED, STATE, Lessons, lit
from rover_learn.training import Frames

STATES = np.float32([[0.5, 0], [0.25, 0]])  # too slow to be swapped for another's


def frames_of(states, size=(2, 3)):
    chunks = np.tile(np.float32([0.4, 0.1]), (len(states), 4, 1))
    return Frames((None,) * len(states), size, states, chunks, np.zeros((len(states), 4), bool), None, None)


def test_light_by_hand():
    """200 times 1.5 is 300, which is white and not black; 100 times 1.006 rounds up."""
    pictures = torch.tensor([200, 100], dtype=torch.uint8).reshape(2, 1, 1, 1)
    gain = torch.tensor([1.5, 1.006]).reshape(2, 1, 1, 1)
    assert lit({IMAGE: pictures, GAIN: gain}).flatten().tolist() == [255, 101]


def test_a_mirrored_view_has_its_steering_negated_and_its_throttle_not(tmp_path, monkeypatch):
    monkeypatch.setattr(Frames, "of", lambda samples, size: frames_of(STATES, size))
    config = SimpleNamespace(image_sizes=((2, 3),), grid=lambda h, w: (1, 1))
    teacher = SimpleNamespace(weights={"encoder_img_feat_input_proj.weight": torch.zeros(4, 8)})
    lessons = Lessons.open(tmp_path, (), config, teacher, np.random.default_rng(0))
    assert lessons.teacher_states.tolist() == [[0.5, 0], [-0.5, 0], [0.25, 0], [-0.25, 0]]
    lessons = Lessons(lessons.data, lessons.teacher_states, None, None, np.zeros((4, 4, 2), np.float32), None)
    rows, views = np.array([0, 1]), np.array([1 - MIRRORED, MIRRORED])
    for new in (False, True):
        shown = lessons.show(rows, views, new, np.random.default_rng(0))
        assert np.array_equal(shown[ACTION][:, 0], np.float32([[0.4, 0.1], [-0.4, 0.1]]))
        shares = shown[STATE][:, 0] / [0.5, -0.25]  # of a new recording's, a random share of the steering
        assert (shares >= FADED[0]).all() and (shares <= FADED[1]).all() and (new or shares.tolist() == [1, 1])
        assert shown[STATE][:, 1].tolist() == [0, 0]
