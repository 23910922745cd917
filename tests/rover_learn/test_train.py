"""A tiny training of LeRobot's ACT leaves a checkpoint of the user's trainer, the same after a kill in any phase."""

import json

import numpy as np
import pytest
import torch
from interrupted import interrupt
from lerobot.policies.act.modeling_act import ACTPolicy
from recorded import record_drives

from rover_learn import train as train_module
from rover_learn import training as training_module
from rover_learn.train import SIZES, train
from rover_learn.training import Machine
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.act_config import lerobot_act
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint

pytestmark = pytest.mark.slow
CPU, READING_AHEAD = Machine.of("cpu"), Machine.of("cpu", workers=2)

# the keys of the user's best_model.pth
CHECKPOINT_KEYS = [
    "epoch", "model_state_dict", "optimizer_state_dict", "scheduler_state_dict", "best_val_loss", "config",
]  # fmt: skip

# The full size's phases on a handful of small frames: trained at a quarter of the pixels, and carried to its own.
CARRIED = "train: {small: {backbone_steps: 2, transformer_steps: 3, together_steps: 2, carry_steps: 2, batch: 4, "
CARRIED += "transformer_batch: 4, together_batch: 2, samples: 40, feature_samples: 12, judged: 8, at: [36, 64]}}"


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    return record_drives(tmp_path_factory.mktemp("episodes"))


@pytest.fixture(scope="module")
def trained(drives, tmp_path_factory, set_params):
    """A checkpoint of a few steps on the processor, in a cache of its own."""
    set_params(CARRIED)
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROVER_CACHE", str(folder / "cache"))
        return train(drives, folder / "best_model.pth", machine=CPU)


def test_the_checkpoint_is_the_trainers(trained):
    checkpoint = torch.load(trained, weights_only=False)
    assert list(checkpoint) == CHECKPOINT_KEYS
    assert type(checkpoint["best_val_loss"]) is np.float64 and 0 < checkpoint["best_val_loss"] < 10
    config = checkpoint["config"]
    assert (config["image_height"], config["image_width"], config["chunk_size"]) == (72, 128, 32)
    assert (config["hidden_size"], config["n_heads"], config["feedforward_dim"]) == (128, 4, 512)
    assert "/" not in config["data_dir"] + config["output_dir"]
    assert load_checkpoint(trained).config.image_sizes == ((72, 128),)
    with pytest.raises(Exception, match="numpy"):  # as the user's own
        torch.load(trained, weights_only=True)
    # LeRobot's policy takes weights and optimiser
    policy, weights = lerobot_act(SIZES["small"]), checkpoint["model_state_dict"]
    assert not policy.load_state_dict(weights, strict=True)[0]
    assert all(torch.isfinite(v).all() and v.is_contiguous() for v in weights.values())
    # LeRobot's own start, mean 0 and variance 1, would leave a backbone without pretrained weights dead.
    assert not any(torch.all(v == 1) for k, v in weights.items() if k.endswith("running_var"))
    state = checkpoint["optimizer_state_dict"]["state"]
    trainable = [p for p in policy.parameters() if p.requires_grad]
    assert sum(s["exp_avg"].numel() for s in state.values()) == sum(p.numel() for p in trainable)


def test_a_training_ended_in_each_phase_gives_the_same_weights(drives, trained, tmp_path, monkeypatch):
    """Also with threads that read ahead, of which the one that was not ended had none."""
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "cache"))
    torch.rand(3)  # the state of the global generator must not matter, nor change
    before, out = torch.get_rng_state(), tmp_path / "killed.pth"
    for kill_at in (2, 4, 6):  # in the second of backbone's steps, then of the transformer's and of all together's
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            interrupt(patch, training_module, "descend", kill_at)
            train(drives, out, machine=READING_AHEAD)
        assert not out.exists()
    resumed = train(drives, out, machine=READING_AHEAD)
    killed, whole = (torch.load(path, weights_only=False) for path in (resumed, trained))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(v, killed["model_state_dict"][k]) for k, v in whole["model_state_dict"].items())
    assert killed["best_val_loss"] == whole["best_val_loss"]
    assert killed["optimizer_state_dict"]["state"][0]["step"] == 2
    assert not list((tmp_path / "cache").glob("training-*")), "what was saved on the way is of no use any more"
    curves = json.loads((tmp_path / "killed_curves/curves.json").read_text())
    assert [len(curves["losses"][name]) for name in ("backbone", "transformer", "at full size")] == [2, 3, 2]
    assert curves["errors"]["at full size"][0][0] == 0 and (tmp_path / "killed_curves/curves.png").stat().st_size > 1000
    lerobots = ACTPolicy.from_pretrained(tmp_path / "killed_pretrained_model").state_dict()
    assert all(torch.equal(v, lerobots[k]) for k, v in whole["model_state_dict"].items())
    with monkeypatch.context() as patch:  # now it is taken from the cache
        patch.setattr(train_module, "_train", lambda *_: pytest.fail("trained again"))
        assert train(drives, tmp_path / "again.pth", machine=CPU).read_bytes() == out.read_bytes()
    other = torch.load(train(drives, tmp_path / "other.pth", seed=1, machine=CPU), weights_only=False)
    name = "model.action_head.weight"
    assert not torch.equal(other["model_state_dict"][name], whole["model_state_dict"][name])


@pytest.mark.parametrize(("differs", "anew"), [("", False), (", small_cuda: {backbone_steps: 3}", True)])
def test_what_a_lost_gpu_began_goes_on_or_is_said_to_begin_anew(
    drives, tmp_path, monkeypatch, set_params, differs, anew
):
    def interrupted(*_):
        raise KeyboardInterrupt

    set_params(CARRIED[:-1] + differs + "}")
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path))
    monkeypatch.setattr(train_module, "_train", interrupted)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "a GPU")
    said = []
    for kind in ("cuda", "cpu"):
        with pytest.raises(KeyboardInterrupt):
            train(drives, tmp_path / "policy.pth", machine=Machine(torch.device(kind)), say=said.append)
    assert len(list(tmp_path.glob("training-*"))) == 1 + anew
    assert ["begins anew" in words for words in said] == [False, False, True][: 2 + anew]


@pytest.mark.parametrize("wrong", [{"size": "huge"}, {"device": "tpu"}, {"steps": 0}, {"seed": -1}, {"episodes": "."}])
def test_what_cannot_be_trained_is_refused(drives, tmp_path, wrong, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RoverError):
        machine = Machine.of(wrong.pop("device", "cpu"))
        train(**{"episodes": drives, "out_path": tmp_path / "best_model.pth", "machine": machine, **wrong})
    assert not list(tmp_path.iterdir())
