"""A training that is ended at any moment gives what one gives that was not."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from rover_learn import training
from rover_learn.augment import GAIN, Augmentation
from rover_learn.training import (
    ACTION,
    IMAGE,
    STATE,
    Best,
    Frames,
    Machine,
    Phase,
    RepeatablePool,
    Resumable,
    RowFile,
    batch_of,
    normalised,
)
from rover_lib.onboard.errors import TrainingError
from tests.helpers.policies import normalise

STEPS, CPU = 6, Machine(torch.device("cpu"))


class Killed(Exception):
    pass


def train(folder: Path, kill_at: int = -1, workers: int = 0, **options) -> tuple[list[float], torch.Tensor, float]:
    """Two phases of a small network with dropout. Returns all losses, its weights, and what is drawn after them.

    kill_at: the step, of both phases together, in whose middle it ends; the file of rows has that step's already.
    workers: with any, batches are drawn ahead by a thread.
    """
    rng = np.random.default_rng(0)
    made = 0
    torch.manual_seed(0)
    with Resumable(folder, Machine(torch.device("cpu"), workers), **{"every_s": 0.0, **options}) as saved:
        model = nn.Sequential(nn.Linear(3, 8), nn.Dropout(0.5), nn.Linear(8, 1))
        rows = RowFile(folder / "rows", (3,))
        for _, drawn in saved.steps("features", STEPS, rng, lambda _: rng.normal(size=(2, 3)), rows=rows):
            rows.append(drawn)
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


@pytest.mark.parametrize(("every_s", "workers"), [(0.0, 0), (3.0, 0), (3.0, 2)])
def test_ended_in_any_step_it_gives_the_same_to_the_last_bit(tmp_path, whole, every_s, workers):
    """every_s by a clock that goes one second a look: saved after each step, after some, at each phase's end."""
    for kill_at in range(1, 2 * STEPS + 1):
        ticks = iter(range(10_000))
        options = {"workers": workers, "every_s": every_s, "clock": lambda ticks=ticks: float(next(ticks))}
        with pytest.raises(Killed):
            train(tmp_path / str(kill_at), kill_at, **options)
        losses, weights, after = train(tmp_path / str(kill_at), **options)
        assert torch.equal(weights, whole[1])
        assert (losses, after) == (whole[0], whole[2])


def test_what_two_gpus_saved_goes_on_without_one(tmp_path, whole, monkeypatch):
    """Their random numbers and their fused optimiser are in what was saved."""

    def save(file, content):
        if "optimizer" in content["parts"]:
            content["parts"]["optimizer"]["param_groups"][0]["fused"] = True
        torch.save(content | {"cuda": [torch.get_rng_state()] * 2}, file)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(training, "save_torch", save)
        patch.setattr("torch.serialization.location_tag", lambda _: "cuda:1")
        train(tmp_path, kill_at=2 * STEPS)
    losses, weights, _ = train(tmp_path)
    assert np.allclose(losses, whole[0], rtol=1e-4) and torch.allclose(weights, whole[1], rtol=1e-4)


def test_a_repeatable_pool_is_resnets():
    results = []
    for pool in (RepeatablePool(), nn.MaxPool2d(3, 2, 1)):
        pictures = torch.linspace(-1, 1, 252).sin().reshape(1, 2, 9, 14).requires_grad_()
        pooled = pool(pictures)
        pooled.square().sum().backward()
        results.append((pooled, pictures.grad))
    assert torch.equal(results[0][0], results[1][0]) and torch.allclose(results[0][1], results[1][1], atol=1e-6)


def test_two_processes_do_not_train_the_same(tmp_path):
    with Resumable(tmp_path, CPU), pytest.raises(TrainingError, match="another process"), Resumable(tmp_path, CPU):
        pass
    with Resumable(tmp_path, CPU):
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
    with Resumable(folder, CPU) as saved:
        phase = Phase("p", steps, 0.1)
        saved.train(phase, model, rng, lambda _: torch.ones(1, 1), lambda x: loss(model(x)), best(model))
    return model.weight.item()


def test_a_loss_that_is_not_finite_ends_the_training(tmp_path):
    with pytest.raises(TrainingError, match="not finite"):
        learn(tmp_path, 1, lambda y: y.sum() * math.nan, lambda _: None)


@pytest.mark.parametrize(("steps", "judged"), [(20, 2 + training.PATIENCE), (100, 2 + 20)])
def test_the_best_weights_are_kept_and_what_learns_by_heart_stops(tmp_path, monkeypatch, steps, judged):
    """A longer phase is patient for longer: a fifth of its judgements."""
    monkeypatch.setattr(training, "JUDGE_EVERY", 1)
    errors, weights = iter([3.0, 1.0, *[2.0] * steps]), []

    def best(model):
        return Best(lambda: weights.append(model.weight.item()) or [next(errors)])

    kept = learn(tmp_path, steps, lambda y: y.square().sum(), best)
    assert len(weights) == judged and kept == weights[1] != weights[-1]
    assert learn(tmp_path, steps, lambda _: pytest.fail("trained again"), best) == kept


def test_pictures_become_a_policys_input_as_on_the_rover():
    pictures = np.random.default_rng(0).integers(0, 256, (2, 6, 5, 3), np.uint8)
    assert np.array_equal(normalised(torch.from_numpy(pictures)).numpy(), normalise(pictures))
    gain = np.array([0.8, 1.25], np.float32)[:, None, None, None]
    lit = normalised(torch.from_numpy(pictures), {GAIN: torch.from_numpy(gain)}).numpy()
    assert np.array_equal(lit, normalise(np.minimum(pictures * gain, 255)))


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried"), "cuda:1: its memory is full.*run again.*--batch"),
        (RuntimeError("CUDA error: unspecified launch failure\nCompile with"), "lost, found CUDA error.*failure; run"),
    ],
)
def test_a_gpu_that_fails_is_a_sentence(monkeypatch, error, says):
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", "")
    with pytest.raises(TrainingError, match=says), Machine(torch.device("cuda:1")).computing():
        assert torch.are_deterministic_algorithms_enabled()
        raise error
    assert not torch.are_deterministic_algorithms_enabled()
    with pytest.raises(RuntimeError, match="another"), CPU.computing():
        raise RuntimeError("another error")


@pytest.mark.parametrize(
    ("asked", "gpus", "gives"),
    [
        *[(None, 0, "cpu"), (None, 2, "cuda:0"), ("cpu", 2, "cpu"), ("cuda", 1, "cuda:0"), ("cuda:1", 2, "cuda:1")],
        *[("cuda", 0, None), ("cuda:2", 2, None), ("tpu", 2, None), ("cuda:x", 2, None), ("cpu:1", 2, None)],
    ],
)
def test_a_device_is_chosen_or_refused(monkeypatch, asked, gpus, gives):
    for name, value in {"is_available": gpus > 0, "device_count": gpus, "current_device": 0}.items():
        monkeypatch.setattr(torch.cuda, name, lambda value=value: value)
    if gives is None:
        with pytest.raises(TrainingError, match=f"{asked}"):
            Machine.of(asked)
    else:
        machine = Machine.of(asked)
        assert str(machine.device) == gives and (machine.workers > 0) == (machine.device.type == "cuda")


def test_half_of_the_states_in_motion_are_another_moving_frames():
    """A hundred frames stand, and the others drive, each with a steering of its own."""
    states = np.stack([np.linspace(-1, 1, 1000), np.repeat([0.0, 0.1], [100, 900])], 1).astype(np.float32)
    swapped = training.swap_states(SimpleNamespace(states=states), np.arange(1000), np.random.default_rng(0))
    changed = (swapped != states).any(1)
    assert not changed[:100].any() and 400 < changed.sum() < 500
    assert np.isin(swapped[changed, 0], states[100:, 0]).all()


def test_a_mirrored_sample_is_mirrored_whole():
    """Picture, state and actions: a state that kept its side would tell the policy the wrong one."""
    pictures = np.random.default_rng(0).integers(0, 256, (32, 2, 3, 3), np.uint8)
    states, chunks = np.tile(np.float32([0.5, 0]), (32, 1)), np.tile(np.float32([0.25, 0.1]), (32, 4, 1))
    kept = dict(enumerate(pictures))
    data = Frames((None,) * 32, (2, 3), states, chunks, np.zeros((32, 4), bool), None, kept)
    batch = batch_of(data, np.arange(32), np.random.default_rng(0), CPU.device, Augmentation(), 0.5)
    for i, image in enumerate(batch[IMAGE].numpy()):
        side = 1 if np.array_equal(image, pictures[i]) else -1
        assert np.array_equal(image, pictures[i][:, ::side])
        assert batch[STATE][i].tolist() == [side * 0.5, 0]
        assert np.array_equal(batch[ACTION][i], np.tile(np.float32([side * 0.25, 0.1]), (4, 1)))


@pytest.mark.parametrize("shape", [(2, 512, 3, 4), (1, 512, 5, 5)])
def test_a_wide_convolution_computes_the_same_in_another_way(shape):
    torch.manual_seed(0)
    conv, x = torch.nn.Conv2d(512, 8, 3, padding=1, bias=False), torch.randn(shape)
    expected = conv(x)
    expected.square().sum().backward()
    gradient, names = conv.weight.grad.clone(), list(conv.state_dict())
    conv.zero_grad()
    taken = Machine.of("cpu").taking(torch.nn.Sequential(conv))[0]
    computed = taken(x)
    computed.square().sum().backward()
    assert type(taken) is training.UnfoldedConv and list(taken.state_dict()) == names
    torch.testing.assert_close(computed, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(taken.weight.grad, gradient, rtol=1e-3, atol=1e-3)
