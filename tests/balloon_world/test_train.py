from dataclasses import replace

import numpy as np
import pytest
import torch

from balloon_world.trial import run_trials
from balloon_world.world import World
from rover_learn import train as train_module
from rover_learn import training as training_module
from rover_learn.train import FULL, RECIPES, SIZES, train
from rover_learn.training import descend
from rover_lib.onboard.errors import RoverError, TrainingError
from rover_lib.workshop.act import lerobot_act
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.judge.compare import LerobotEager

pytestmark = pytest.mark.slow

# the keys of the user's best_model.pth
CHECKPOINT_KEYS = [
    "epoch", "model_state_dict", "optimizer_state_dict", "scheduler_state_dict", "best_val_loss", "config",
]  # fmt: skip
CONFIG_KEYS = {
    "image_width", "image_height", "n_obs_steps", "chunk_size", "n_action_steps", "hidden_size", "n_encoder_layers",
    "n_decoder_layers", "n_heads", "feedforward_dim", "dropout", "kl_weight", "vision_encoder", "pretrained_backbone",
    "learning_rate", "weight_decay", "betas", "grad_clip", "num_epochs", "batch_size", "train_split", "data_dir",
    "output_dir", "device", "seed", "log_freq", "save_freq", "num_workers",
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def few_frames():
    """The recipes' three phases, on a handful of frames."""
    recipes = {kind: replace(r, batch=4, transformer_batch=8, samples=24) for kind, r in RECIPES.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train_module, "RECIPES", recipes)
        yield


@pytest.fixture(scope="module")
def trained(recorded, tmp_path_factory):
    """A checkpoint of a few steps on the processor."""
    out = tmp_path_factory.mktemp("trained") / "best_model.pth"
    return train(recorded, out, size="small", steps=3, device="cpu")


@pytest.fixture(scope="module")
def checkpoint(trained):
    return torch.load(trained, weights_only=False)


def test_the_checkpoint_has_the_trainers_keys(checkpoint):
    assert list(checkpoint) == CHECKPOINT_KEYS
    assert type(checkpoint["config"]) is dict
    assert set(checkpoint["config"]) == CONFIG_KEYS
    assert type(checkpoint["best_val_loss"]) is np.float64
    assert 0 < checkpoint["best_val_loss"] < 10


def test_the_config_says_what_was_trained(checkpoint):
    config = checkpoint["config"]
    assert (config["image_height"], config["image_width"]) == (72, 128)
    assert (config["hidden_size"], config["n_heads"], config["feedforward_dim"]) == (128, 4, 512)
    assert (config["chunk_size"], config["n_action_steps"], config["n_obs_steps"]) == (32, 32, 1)
    assert config["vision_encoder"] == "resnet18"
    assert config["pretrained_backbone"] is True
    assert "/" not in config["data_dir"] + config["output_dir"]


def test_plain_weights_only_refuses_it_as_it_does_the_users(trained):
    with pytest.raises(Exception, match=r"numpy\..*scalar"):
        torch.load(trained, weights_only=True)


def test_lerobots_policy_takes_the_weights(checkpoint):
    policy = lerobot_act(SIZES["small"])
    assert not policy.load_state_dict(checkpoint["model_state_dict"], strict=True)[0]
    assert all(name.startswith("model.") for name in checkpoint["model_state_dict"])
    assert all(torch.isfinite(v).all() for v in checkpoint["model_state_dict"].values())


def test_the_optimizers_state_covers_all_parameters(checkpoint):
    state = checkpoint["optimizer_state_dict"]["state"]
    trainable = [p for p in lerobot_act(SIZES["small"]).parameters() if p.requires_grad]
    assert sum(s["exp_avg"].numel() for s in state.values()) == sum(p.numel() for p in trainable)
    optimizer = torch.optim.AdamW(trainable)
    optimizer.load_state_dict(checkpoint["optimizer_state_dict"])


def test_frozen_statistics_are_of_data(checkpoint):
    """LeRobot's own start, mean 0 and variance 1, would leave a backbone without pretrained weights dead."""
    weights = checkpoint["model_state_dict"]
    variances = [v for k, v in weights.items() if k.endswith("running_var")]
    assert len(variances) == 20
    assert not any(torch.all(v == 1) for v in variances)
    policy = lerobot_act(SIZES["small"])
    policy.load_state_dict(weights)
    with torch.no_grad():
        features = policy.model.backbone(torch.randn(2, 3, 72, 128))["feature_map"]
    assert 0.05 < features.std() < 50


def test_the_workshop_reads_it(trained):
    config = load_checkpoint(trained).config
    assert config.image_sizes == ((72, 128),)
    assert (config.chunk, config.dim, config.latent, config.vae_layers) == (32, 128, 32, 1)


def test_training_is_deterministic(recorded, trained, tmp_path, monkeypatch):
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "another"))
    torch.rand(3)  # the state of the global generator must not matter, nor change
    before = torch.get_rng_state()
    again = torch.load(train(recorded, tmp_path / "again.pth", steps=3, device="cpu"), weights_only=False)
    assert torch.equal(torch.get_rng_state(), before)
    first = torch.load(trained, weights_only=False)
    assert all(torch.equal(v, first["model_state_dict"][k]) for k, v in again["model_state_dict"].items())
    assert again["best_val_loss"] == first["best_val_loss"]


class Killed(Exception):
    pass


@pytest.fixture(scope="module")
def carried_recipe():
    """The full size's recipe, on a handful of small frames."""
    steps = {"backbone_steps": 2, "transformer_steps": 3, "together_steps": 2, "carry_steps": 2}
    batches = {"batch": 4, "transformer_batch": 4, "together_batch": 2}
    return replace(FULL, **steps, **batches, samples=40, feature_samples=12, judged=8, at=(36, 64))


def test_a_training_ended_in_each_phase_gives_the_same_weights(recorded, carried_recipe, tmp_path, monkeypatch):
    """Trained at a quarter of the pixels and carried to the policy's own, killed once in each of these phases."""
    monkeypatch.setitem(train_module.RECIPES, ("small", "cpu"), carried_recipe)
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "whole"))
    whole = torch.load(train(recorded, tmp_path / "whole.pth", device="cpu"), weights_only=False)

    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "killed"))
    made, kill_at, bars = [], [2, 6, 13], []

    def descend_until_killed(*args):
        made.append(descend(*args))
        if len(made) in kill_at:
            raise Killed
        return made[-1]

    def progress(items, **options):
        bars.append({"ticks": 0, **options})
        for item in items:
            bars[-1]["ticks"] += 1
            yield item

    monkeypatch.setattr(training_module, "descend", descend_until_killed)
    out = tmp_path / "killed.pth"
    for _ in kill_at:
        with pytest.raises(Killed):
            train(recorded, out, device="cpu", progress=progress)
        assert not out.exists()
    killed = torch.load(train(recorded, out, device="cpu", progress=progress), weights_only=False)
    assert all(torch.equal(v, killed["model_state_dict"][k]) for k, v in whole["model_state_dict"].items())
    assert killed["best_val_loss"] == whole["best_val_loss"]
    assert killed["optimizer_state_dict"]["state"][0]["step"] == carried_recipe.carry_steps
    assert (killed["config"]["image_height"], killed["config"]["image_width"]) == (72, 128)
    assert bars[-1]["initial"] > 0 and bars[-1]["initial"] + bars[-1]["ticks"] == bars[-1]["total"]
    assert not list((tmp_path / "killed").glob("training-*")), "what was saved on the way is of no use any more"


def test_another_seed_gives_other_weights(recorded, checkpoint, tmp_path):
    other = torch.load(train(recorded, tmp_path / "other.pth", seed=1, steps=3, device="cpu"), weights_only=False)
    name = "model.action_head.weight"
    assert not torch.equal(other["model_state_dict"][name], checkpoint["model_state_dict"][name])


def test_a_checkpoint_that_was_made_is_taken_from_the_cache(recorded, trained, monkeypatch):
    def never(*args):
        raise AssertionError("trained again")

    monkeypatch.setattr(train_module, "_train", never)
    before = trained.read_bytes()
    trained.unlink()
    assert train(recorded, trained, steps=3, device="cpu").read_bytes() == before
    with pytest.raises(AssertionError, match="trained again"):
        train(recorded, trained.with_name("more.pth"), steps=4, device="cpu")
    assert [p.name for p in trained.parent.iterdir()] == [trained.name]


def test_the_policy_can_be_driven(trained):
    driver = LerobotEager(load_checkpoint(trained))
    chunk = driver.predict_chunk(World(1).render(), np.zeros(2, np.float32))
    assert chunk.shape == (32, 2) and chunk.dtype == np.float32
    assert abs(chunk[:, 0]).max() < 0.65 and 0 < chunk[:, 1].mean() < 0.2, "mild, however short the training"
    assert run_trials(driver, worlds=1).trials == 1


def test_the_full_size_is_the_users():
    size = SIZES["full"]
    assert (size.image_sizes, size.dim, size.heads) == (((360, 640),), 512, 8)
    assert (size.encoder_layers, size.decoder_layers, size.feedforward) == (4, 7, 3200)


@pytest.mark.parametrize("recipe", RECIPES.values())
@pytest.mark.parametrize("steps", [1, 7, 100, 5000])
def test_a_recipe_of_few_steps_keeps_all_phases(recipe, steps):
    short = recipe.of_steps(steps)
    phases = [short.backbone_steps, short.transformer_steps, short.together_steps]
    phases += [short.carry_steps] if recipe.carry_steps else []
    assert min(phases) >= 1
    assert abs(sum(phases) - steps) <= 4
    assert bool(short.carry_steps) == bool(recipe.carry_steps)
    assert short.samples <= recipe.samples and short.feature_samples <= recipe.feature_samples


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"size": "huge"}, "small, full"),
        ({"device": "tpu"}, "device must be"),
        ({"steps": 0}, "at least 1 step"),
        ({"seed": -1}, "seed from 0"),
    ],
)
def test_what_cannot_be_trained_is_refused(recorded, tmp_path, wrong, match):
    with pytest.raises(TrainingError, match=match):
        train(recorded, tmp_path / "best_model.pth", **wrong)
    assert not list(tmp_path.iterdir())


def test_no_recordings_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(RoverError):
        train(tmp_path / "empty", tmp_path / "best_model.pth", steps=3)
    assert [p.name for p in tmp_path.iterdir()] == ["empty"]
