"""A tiny training of LeRobot's ACT leaves a checkpoint of the user's trainer, the same after a kill in any phase."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import torchvision
from lerobot.policies.act.modeling_act import ACTPolicy

from rover_learn import act_phases
from rover_learn import train as train_module
from rover_learn import training as training_module
from rover_learn.act_phases import Overrides
from rover_learn.backbone import IMAGENET, Pretrained
from rover_learn.train import SIZES, train
from rover_learn.training import Machine
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.act_config import lerobot_act
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from tests.helpers.command import rover
from tests.helpers.interrupted import interrupt
from tests.helpers.recorded import record_drives

pytestmark = pytest.mark.slow
CPU, READING_AHEAD = Machine.of("cpu"), Machine.of("cpu", workers=2)

# the keys of the user's best_model.pth
CHECKPOINT_KEYS = [
    "epoch", "model_state_dict", "optimizer_state_dict", "scheduler_state_dict", "best_val_loss", "config",
]  # fmt: skip

# The full size's phases on a handful of small frames: trained at a quarter of the pixels, and carried to its own.
CARRIED = "train: {small: {backbone_steps: 2, backbone_rounds: 2, transformer_steps: 3, together_steps: 2, "
CARRIED += "together_rounds: 1, carry_steps: 2, batch: 4, "
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
    for kill_at in (2, 4, 4, 3):  # in each round of the backbone's, in the transformer's steps, and in all together's
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
    assert [len(curves["losses"][name]) for name in ("backbone", "transformer", "at full size")] == [4, 3, 2]
    assert list(curves["actions"]) == ["steering", "throttle"] and len(curves["errors"]["backbone"][0]) == 3
    assert curves["errors"]["at full size"][0][0] == 0 and (tmp_path / "killed_curves/curves.png").stat().st_size > 1000
    lerobots = ACTPolicy.from_pretrained(tmp_path / "killed_pretrained_model").state_dict()
    assert all(torch.equal(v, lerobots[k]) for k, v in whole["model_state_dict"].items())
    with monkeypatch.context() as patch:  # now it is taken from the cache
        patch.setattr(train_module, "train_in_phases", lambda *_: pytest.fail("trained again"))
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
    monkeypatch.setattr(train_module, "train_in_phases", interrupted)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "a GPU")
    said = []
    for kind in ("cuda", "cpu"):
        with pytest.raises(KeyboardInterrupt):
            train(drives, tmp_path / "policy.pth", machine=Machine(torch.device(kind)), say=said.append)
    assert len(list(tmp_path.glob("training-*"))) == 1 + anew
    said_anew = ["begins anew" in words for words in said]
    assert sum(said_anew) == anew and said_anew[-1] == anew


@pytest.mark.parametrize(
    "wrong", [{"size": "huge"}, {"device": "tpu"}, {"overrides": Overrides(0)}, {"seed": -1}, {"episodes": "."}]
)
def test_what_cannot_be_trained_is_refused(drives, tmp_path, wrong, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RoverError):
        machine = Machine.of(wrong.pop("device", "cpu"))
        train(**{"episodes": drives, "out_path": tmp_path / "best_model.pth", "machine": machine, **wrong})
    assert not list(tmp_path.iterdir())


def save_resnet(path, change=lambda weights: None):
    """Save torchvision's random weights after a change; return them."""
    torch.manual_seed(3)
    weights = torchvision.models.resnet18(weights=None).state_dict()
    change(weights)
    torch.save(weights, path)
    return weights


def test_a_training_begins_with_the_backbone_of_a_file_and_says_so(drives, tmp_path, set_params):
    few = "transformer_steps: 1, together_steps: 0, batch: 4, transformer_batch: 4, samples: 20, feature_samples: 8, "
    set_params(f"train: {{small: {{backbone_steps: 1, backbone_rate: 1.0e-9, {few}judged: 8}}}}")
    weights = save_resnet(tmp_path / "resnet18.pth")
    out = train(drives, tmp_path / "policy.pth", backbone=tmp_path / "resnet18.pth", machine=CPU)
    made = torch.load(out, weights_only=False)
    learned = made["model_state_dict"]
    assert torch.allclose(learned["model.backbone.conv1.weight"], weights["conv1.weight"], atol=1e-6)
    assert torch.allclose(learned["model.backbone.layer4.1.conv2.weight"], weights["layer4.1.conv2.weight"], atol=1e-6)
    said = json.loads((tmp_path / "policy_pretrained_model/config.json").read_text())
    assert made["config"]["pretrained_backbone"] and said["pretrained_backbone_weights"] is None, "nothing to download"
    assert "resnet18.pth" in (tmp_path / "policy_pretrained_model/origin.json").read_text()


def drop(weights):
    del weights["layer1.0.conv1.weight"]


def spoil(weights):
    weights["conv1.weight"][0, 0, 0, 0] = torch.nan


@pytest.mark.parametrize(
    ("change", "says"),
    [(drop, "layer1.0.conv1.weight is missing"), (spoil, "not finite"), (None, "not a file of weights")],
)
def test_a_file_of_another_backbone_is_refused(tmp_path, change, says):
    file = tmp_path / "weights.pth"
    if change:
        save_resnet(file, change)
    else:
        file.write_text("weights")
    with pytest.raises(RoverError, match=says):
        Pretrained.of(file, print)


def test_without_internet_the_backbone_begins_at_random_and_says_so(monkeypatch):
    def refused(*_, **__):
        raise OSError("no network")

    monkeypatch.setattr("torch.hub.load_state_dict_from_url", refused)
    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", refused)
    said = []
    assert Pretrained.of(IMAGENET, said.append) is None
    assert said == ["the backbone begins with random weights: ImageNet's cannot be fetched (no network)"]


@pytest.mark.parametrize(
    ("errors", "fits", "learned", "kept"),
    [
        ([5, 4, 3, 2], True, 4, 4),  # as many rounds as the recipe has
        ([5, 4, 3.99, 2], True, 3, 3),  # it hardly falls any more
        ([5, 4, 6, 2], True, 3, 2),  # it rises: the round before stays
        ([5, 4, 3, 2], False, 1, 1),  # the budget lasts for one
    ],
)
def test_rounds_go_on_while_the_error_falls(errors, fits, learned, kept):
    module, said, rounds = torch.nn.Linear(1, 1, bias=False), [], []
    saved = SimpleNamespace(may_begin=lambda *_: fits, judged={})
    judges = SimpleNamespace(words=lambda errors_pct: f"steering {errors_pct[0]:.1f} %")
    training = SimpleNamespace(saved=saved, judges=judges, say=said.append, recipe=SimpleNamespace(minutes=3))

    def learn(phase, number):
        rounds.append(phase)
        torch.nn.init.constant_(module.weight, number)

    def judge():
        error = errors[len(rounds) - 1]
        return error, np.array([error])

    act_phases._in_rounds(training, module, "backbone", 4, 0.5, learn, judge)
    assert len(rounds) == learned and module.weight.item() == kept
    assert rounds[:2] == ["backbone", "backbone, round 2"][:learned]
    assert said[0] == "backbone: steering 5.0 %" and ("budget" in said[-1]) == (not fits)
    assert saved.judged["backbone"] == [[k + 1, errors[k]] for k in range(learned)]


@pytest.mark.parametrize(
    ("steering", "says"), [(7.1, "rover run 'my policy.pth' "), (15.6, "steering was not learned: 15.6 % off")]
)
def test_a_command_to_go_on_is_printed_only_for_what_was_learned(drives, tmp_path, monkeypatch, steering, says):
    found = {"error_pct": steering, "blind_pct": 15.6, "varies": True, "learned": steering < 15}

    def trained(_episodes, out, **_options):
        curves = train_module.curves_of(out)
        curves.mkdir()
        (curves / "curves.json").write_text(json.dumps({"actions": {"steering": found}}))
        return out

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_module, "train", trained)
    result = rover("train", drives, "my policy.pth", "--backbone", "none")
    assert result.exit_code == 0 and says in result.output, result.output
    assert ("next:" in result.output) == (steering < 15)


def test_pictures_that_show_nothing_are_named_before_a_training(tmp_path, monkeypatch):
    drives = record_drives(tmp_path / "episodes")
    for picture in (drives / "episode_1").rglob("*.jpg"):
        cv2.imwrite(str(picture), np.zeros((54, 96, 3), np.uint8))
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path))
    monkeypatch.setattr(train_module, "cache_folder", lambda *_: pytest.fail("as it is to train"))
    said = []
    with pytest.raises(pytest.fail.Exception, match="as it is"):
        train(drives, tmp_path / "policy.pth", machine=CPU, say=said.append)
    assert said[-1] == "episode_1: 100% of its pictures are black, and show nothing: leave them out"


@pytest.mark.parametrize(
    ("varies", "errors", "is_held"), [(False, [1.0, 9.0], True), (False, [1.0, 2.0], False), (True, [1.0, 9.0], False)]
)
def test_a_throttle_that_hardly_varies_and_was_not_learned_is_held(varies, errors, is_held):
    head = torch.nn.Linear(3, 2)
    policy = SimpleNamespace(model=SimpleNamespace(action_head=head))
    blind_pct = np.array([8.0, 5.0])
    judges = SimpleNamespace(varies=np.array([True, varies]), blind_pct=blind_pct, names=["steering", "throttle"])
    said = []
    act_phases._hold(policy, judges, np.array(errors), np.array([0.1, 0.4], np.float32), said.append)
    planned = head(torch.rand(5, 3))
    assert torch.allclose(planned[:, 1], torch.tensor(0.4)) == is_held
    assert not torch.allclose(planned[:, 0], torch.tensor(0.1))
    assert said == (["throttle hardly varies, and is held at 0.400"] if is_held else [])
