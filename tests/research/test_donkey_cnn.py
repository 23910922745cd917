"""The network like donkeycar's, on pictures in which it can see where to steer."""

import numpy as np
import pytest
import torch

from research import donkey_cnn
from research.donkey_cnn import AHEAD_S, linear, predict, r2, tensors, train
from rover_learn.augment import Augmentation
from tests.helpers.policies import memory_samples

RATE_HZ = 20.0


def samples(count, seed):
    """A light stands where the driver steers to: soon, but not in a second."""
    rng, made = np.random.default_rng(seed), memory_samples(count, 60, 80, seed)
    for sample in made:
        where = rng.integers(5, 75)
        sample.picture[20:40, where - 5 : where + 5] = 255
        chunk = np.zeros((32, 2), np.float32)
        chunk[:15, 0], chunk[15:, 0] = (where - 40) / 40, rng.uniform(-1, 1)
        object.__setattr__(sample, "chunk", chunk)
        object.__setattr__(sample, "is_pad", np.arange(32) >= 25 if seed else np.zeros(32, bool))
    return made


def test_it_has_the_layout_of_keras_linear():
    shapes = [tuple(layer.weight.shape) for layer in linear() if hasattr(layer, "weight")]
    assert shapes[:5] == [(24, 3, 5, 5), (32, 24, 5, 5), (64, 32, 5, 5), (64, 64, 3, 3), (64, 64, 3, 3)]
    assert [shape[0] for shape in shapes[5:]] == [100, 50, len(AHEAD_S)]


def test_r2_by_hand():
    wanted = torch.tensor([0.0, 1.0, 2.0, 3.0])
    assert r2(torch.tensor([0.0, 1.0, 2.0, 1.0]), wanted) == pytest.approx(0.2)  # 4 of 5
    assert r2(torch.full((4,), 1.5), wanted) == 0


@pytest.mark.research
def test_it_learns_what_can_be_seen(monkeypatch):
    monkeypatch.setattr(donkey_cnn, "EPOCHS", 6)
    learning, choosing = tensors(samples(500, 0), RATE_HZ), tensors(samples(100, 1), RATE_HZ)
    assert choosing[2][0].tolist() == [True, True, True, True]  # a second ahead is step 20
    network, epochs = train(learning, choosing, 0, Augmentation(light=0.25))
    answers = predict(network, choosing[0])
    assert epochs == 6
    assert r2(answers[:, 0], choosing[1][:, 0]) > 0.5 > 0.2 > r2(answers[:, 3], choosing[1][:, 3])
