"""A training that is ended at any moment gives what one gives that was not."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from rover_learn import training
from rover_learn.training import Best, Phase, Resumable, RowFile
from rover_lib.onboard.errors import TrainingError

STEPS = 6


class Killed(Exception):
    pass


def train(folder: Path, kill_at: int = -1, **options) -> tuple[list[float], torch.Tensor, float]:
    """Two phases of a small network with dropout. Returns all losses, its weights, and what is drawn after them.

    kill_at: the step, of both phases together, in whose middle it ends; the file of rows has that step's already.
    """
    rng = np.random.default_rng(0)
    made = 0
    torch.manual_seed(0)
    with Resumable(folder, **{"every_s": 0.0, **options}) as saved:
        model = nn.Sequential(nn.Linear(3, 8), nn.Dropout(0.5), nn.Linear(8, 1))
        rows = RowFile(folder / "rows", (3,))
        for _ in saved.steps("features", STEPS, rng, rows=rows):
            rows.append(rng.normal(size=(2, 3)))
            made += 1
            if made == kill_at:
                raise Killed

        def batch(step):
            nonlocal made
            made += 1
            if made == kill_at:
                raise Killed
            return torch.from_numpy(rows[rng.choice(len(rows), 4)])

        saved.train(Phase("network", STEPS, 0.1), model, rng, batch, lambda x: model(x).square().mean())
        assert len(rows) == 2 * STEPS
        after = rng.random() + torch.rand(1).item()
        return saved.losses["network"], torch.cat([p.flatten() for p in model.parameters()]), after


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return train(tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("every_s", [0.0, 3.0])
def test_ended_in_any_step_it_gives_the_same_to_the_last_bit(tmp_path, whole, every_s):
    """every_s by a clock that goes one second a look: saved after each step, after some, at each phase's end."""
    for kill_at in range(1, 2 * STEPS + 1):
        ticks = iter(range(10_000))
        options = {"every_s": every_s, "clock": lambda ticks=ticks: float(next(ticks))}
        with pytest.raises(Killed):
            train(tmp_path / str(kill_at), kill_at, **options)
        losses, weights, after = train(tmp_path / str(kill_at), **options)
        assert torch.equal(weights, whole[1])
        assert (losses, after) == (whole[0], whole[2])


def test_two_processes_do_not_train_the_same(tmp_path):
    with Resumable(tmp_path), pytest.raises(TrainingError, match="another process"), Resumable(tmp_path):
        pass
    with Resumable(tmp_path):
        pass


@pytest.mark.parametrize(
    ("name", "left", "says"),
    [
        ("features.pt", slice(-200), r"features\.pt.*remove .* from the beginning"),
        ("rows", slice(0), "rows are missing, found 0 of 2"),
    ],
)
def test_a_damaged_file_is_named(tmp_path, name, left, says):
    with pytest.raises(Killed):
        train(tmp_path, kill_at=2)
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[left])
    with pytest.raises(TrainingError, match=says):
        train(tmp_path)


def learn(folder, steps, loss, best=None):
    """A phase of a network of one weight, which it returns."""
    model, rng = nn.Linear(1, 1), np.random.default_rng(0)
    with Resumable(folder) as saved:
        saved.train(
            Phase("p", steps, 0.1), model, rng, lambda _: torch.ones(1, 1), lambda x: loss(model(x)), best(model)
        )
    return model.weight.item()


def test_a_loss_that_is_not_finite_ends_the_training(tmp_path):
    with pytest.raises(TrainingError, match="not finite"):
        learn(tmp_path, 1, lambda y: y.sum() * math.nan, lambda _: None)


def test_the_best_weights_are_kept_and_what_learns_by_heart_stops(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "JUDGE_EVERY", 1)
    errors, weights = iter([3.0, 1.0, *[2.0] * 20]), []

    def best(model):
        return Best(lambda: weights.append(model.weight.item()) or next(errors))

    kept = learn(tmp_path, 20, lambda y: y.square().sum(), best)
    assert len(weights) == 2 + training.PATIENCE and kept == weights[1] != weights[-1]
