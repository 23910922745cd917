"""Softened plans against a line that is known."""

import numpy as np
import pytest
import torch

from rover_learn.backbone import FEATURES
from rover_learn.soften import RIDGES, soften
from rover_learn.training import ACTION, IS_PAD, SOFTENED, RowFile, error_of

LEARNED, JUDGED, NOISE = 1200, 300, 0.5


def test_noise_is_taken_from_plans_and_what_the_features_say_stays(tmp_path):
    rng = np.random.default_rng(0)
    line = np.zeros((FEATURES, 6))
    line[:4] = rng.normal(0, 1, (4, 6))
    files, said = [], []
    for name, count in (("learned", LEARNED), ("judging", JUDGED)):
        averages = rng.normal(0, 1, (count, FEATURES))
        maps = RowFile(tmp_path / name, (FEATURES, 2, 3))
        around = rng.normal(0, 0.1, (count, FEATURES, 2, 3))
        maps.append(averages[..., None, None] + around - around.mean((2, 3), keepdims=True))
        files.append(maps)
        said.append((averages @ line + 3).reshape(count, 3, 2))
    recorded = (said[0] + rng.normal(0, NOISE, said[0].shape)).astype(np.float32)
    errors = []

    def judge(plans):
        errors.append(float(np.abs(plans - said[1]).mean()))
        return errors[-1]

    softened = soften(files[0], recorded, 0.5, files[1], judge)
    assert softened.dtype == np.float32 and softened.shape == recorded.shape and len(errors) == len(RIDGES)
    line_itself = 2 * softened - recorded
    off = np.std(line_itself - said[0])
    # what least squares leaves of the noise with 512 of 1,200 numbers free is 0.65 of it, a ridge less
    assert off < 0.65 * NOISE and min(errors) < errors[0]
    assert np.std(softened - said[0]) == pytest.approx(np.hypot(NOISE, off) / 2, rel=0.35)
    assert np.allclose(soften(files[0], recorded, 0.0, files[1], judge), recorded)


def test_squared_errors_count_from_softened_plans_and_absolute_ones_from_recorded_ones():
    recorded, softened, planned = (torch.full((1, 2, 1), value) for value in (1.0, 2.0, 4.0))
    is_pad = torch.tensor([[False, True]])
    batch = {ACTION: recorded, IS_PAD: is_pad}
    weights = torch.tensor([0.5])
    assert float(error_of(planned, batch, weights)) == 1.5 + 1.5**2
    assert float(error_of(planned, batch | {SOFTENED: softened}, weights)) == 1.5 + 1.0**2
