"""Pictures vary as the recipe says, by hand-made numbers, and not at all where it says nothing."""

import numpy as np
import pytest
import torch

from rover_learn.augment import BLUR, GAIN, NOISE, Augmentation, vary

PICTURES = np.random.default_rng(0).integers(0, 256, (3, 8, 10, 3), np.uint8)


def constant(name: str, value: float) -> dict[str, torch.Tensor]:
    return {name: torch.full((3, 1, 1, 1), value)}


def test_without_a_recipe_pictures_stay_as_they_are():
    drawn = Augmentation().draw(3, np.random.default_rng(0))
    as_taken = torch.from_numpy(PICTURES).permute(0, 3, 1, 2).float()
    assert torch.equal(vary(torch.from_numpy(PICTURES), {k: torch.from_numpy(v) for k, v in drawn.items()}), as_taken)
    assert np.array_equal(Augmentation().shifted(PICTURES, np.random.default_rng(0)), PICTURES)


@pytest.mark.parametrize(("name", "value", "gives"), [(GAIN, 0.5, 50.0), (GAIN, 4.0, 255.0), (BLUR, 1.0, 100.0)])
def test_a_grey_picture_becomes(name, value, gives):
    grey = torch.full((3, 4, 4, 3), 100, dtype=torch.uint8)
    assert torch.equal(vary(grey, constant(name, value)), torch.full((3, 3, 4, 4), gives))


def test_blur_is_the_mean_of_nine_and_noise_has_the_size_that_was_drawn():
    dot = torch.zeros(3, 5, 5, 3, dtype=torch.uint8)
    dot[:, 2, 2] = 90
    blurred = vary(dot, constant(BLUR, 1.0))
    assert blurred[0, 0, 1:4, 1:4].tolist() == [[10.0] * 3] * 3 and blurred.sum() == 3 * 3 * 90
    grey = torch.full((3, 200, 200, 3), 128, dtype=torch.uint8)
    assert vary(grey, constant(NOISE, 5.0)).std().item() == pytest.approx(5, rel=0.02)


def test_light_is_drawn_evenly_between_darker_and_brighter():
    gain = Augmentation(light=0.25).draw(4000, np.random.default_rng(0))[GAIN]
    assert 0.8 <= gain.min() < 0.81 and 1.24 < gain.max() <= 1.25
    assert np.log(gain).mean() == pytest.approx(0, abs=0.01)


def test_a_shifted_picture_is_the_same_elsewhere_with_its_edge_repeated():
    picture = np.zeros((1, 20, 20, 3), np.uint8)
    picture[0, 10, 10] = 255
    picture[0, :, 0] = 7
    places = set()
    for seed in range(40):
        moved = Augmentation(shift=0.1).shifted(picture, np.random.default_rng(seed))[0, :, :, 0]
        down, right = np.argwhere(moved == 255)[0] - 10
        places.add((int(down), int(right)))
        assert (moved[:, : max(right, 0)] == 7).all()
    assert max(abs(k) for place in places for k in place) == 2 and len(places) > 10
