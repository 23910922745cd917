"""Checkpoints that we write are read back unchanged, by us and by LeRobot itself."""

import json
import resource
from dataclasses import replace

import pytest
import torch
from policies import TINY, check_is, lerobot_policy, memory_samples

from rover_lib.onboard.errors import CheckpointError, RoverError
from rover_lib.workshop.act import ACT, Affine, inputs_of, predictions
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.checkpoint.files import save_torch, trainer_can_hold, write_lerobot, write_trainer
from rover_lib.workshop.recordings.samples import Layout

SETTINGS = {
    "learning_rate": 1e-4, "batch_size": 4, "data_dir": "episodes", "output_dir": "fast", "device": "cpu", "seed": 0
}  # fmt: skip
ORIGIN = {"teacher_sha256": "ab" * 32, "steps": 3}


@pytest.fixture(scope="module")
def weights():
    policy = lerobot_policy(**TINY, use_vae=False)
    return {k.removeprefix("model."): v for k, v in policy.state_dict().items()}


@pytest.fixture(scope="module")
def config(tiny):
    return replace(tiny.config, vae_layers=0)


def test_the_trainers_file(config, weights, tmp_path):
    for path in (tmp_path / "best_model.pth", tmp_path / "again.pth"):
        write_trainer(path, config, weights, 0.25, ORIGIN, **SETTINGS)
    assert path.read_bytes() == (tmp_path / "best_model.pth").read_bytes()  # the same weights have one hash
    read = load_checkpoint(path)
    assert read.config == config and read.report["best_val_loss"] == 0.25
    assert read.report["trainer_config"]["origin"] == ORIGIN
    assert all(torch.equal(read.weights[name], weight) for name, weight in weights.items())


@pytest.mark.parametrize(
    "norms",
    [{}, {"state_norm": Affine((2.0, 9.0), (-0.1, 0.4)), "action_unnorm": Affine((0.4, 0.02), (0.1, 0.05))}],
    ids=["raw actions", "normalised"],
)
def test_lerobots_folder(config, weights, tmp_path, norms):
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    config = replace(config, **norms)
    write_lerobot(tmp_path / "pretrained_model", config, weights, ORIGIN)
    read = load_checkpoint(tmp_path / "pretrained_model")
    (sample,) = memory_samples(1)
    expected = predictions(ACT(config, weights), [inputs_of(sample, config)])[0]
    ours = predictions(ACT(read.config, read.weights), [inputs_of(sample, config)])[0]
    assert (ours - expected).abs().max() < 1e-5
    policy = ACTPolicy.from_pretrained(tmp_path / "pretrained_model")
    check_is(read, policy, *make_pre_post_processors(policy.config, str(tmp_path / "pretrained_model")))


def test_a_full_disk_is_one_sentence(config, weights, tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
        with pytest.raises(RoverError, match="disk full"):
            save_torch(tmp_path / "policy", weights)
        with pytest.raises(RoverError, match="disk full"):
            write_lerobot(tmp_path / "folder", config, weights, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_rate_of_its_own_is_kept_with_lerobots_folder(config, weights, tmp_path):
    """Driven at 30 steps a second, a student of 15 would drive twice as fast; the trainer's file cannot hold a rate."""
    slow = replace(config, rate_hz=15.0)
    write_lerobot(tmp_path, slow, weights, ORIGIN)
    read = load_checkpoint(tmp_path)
    assert read.config.rate_hz == read.recorded_as(Layout()).config.rate_hz == 15
    assert read.recorded_as(Layout(("cam_front",), rate_hz=15.0)) is read
    with pytest.raises(CheckpointError, match="15 steps"):
        read.recorded_as(Layout(("cam_front",), rate_hz=30.0))
    assert json.loads((tmp_path / "origin.json").read_text()) == ORIGIN | {"rate_hz": 15.0}
    for other in (slow, replace(config, action_unnorm=Affine((0.4, 0.02), (0.1, 0.05)))):
        assert not trainer_can_hold(other)
    (tmp_path / "origin.json").write_text('{"rate_hz": NaN}')
    with pytest.raises(CheckpointError, match="rate_hz must be a number from 5 to 120, found nan"):
        load_checkpoint(tmp_path)
