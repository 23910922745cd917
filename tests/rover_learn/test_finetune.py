"""A policy learns on from what humans drove, and from nothing else; interrupted, it goes on where it stopped."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from interrupted import interrupt, save_each_step
from policies import of_a_cars_size, smooth_frame

from rover_learn import finetune as finetune_module
from rover_learn import training
from rover_learn.finetune import FinetuneRecipe, finetune, human_samples
from rover_lib.cli import main
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.recording.episode import HUMAN, NOBODY, POLICY, About, EpisodeWriter
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.recordings.samples import Episode, Sample

FRAMES = 24
TAKEN_OVER = [POLICY] * 8 + [HUMAN] * 12 + [NOBODY] * 4


def record(root, drives=4, drivers=(HUMAN,) * FRAMES, size=(96, 54), offset=0, car=None, rate_hz=30):
    """Record drives in which steering, throttle and pictures change. drivers: who drives at each frame."""
    rng, pwm = np.random.default_rng(offset), PwmCalibration()
    for drive in range(drives):
        with EpisodeWriter(root / f"episode_{offset + drive}", About("", car=car), resolution=size) as writer:
            for i, driver in enumerate(drivers):
                t_s = i / rate_hz
                pulses = pwm.pulses(0.5 * math.sin(4 * t_s + drive), 0.05 + 0.04 * math.cos(3 * t_s + drive))
                writer.frame(t_s, smooth_frame(rng, size[1], size[0]))
                measured = pulses.steering_us, pulses.throttle_us, 21316, 1016
                writer.control(t_s + 0.004, 500 + 33 * i, *measured, driver=driver)
    return root


@pytest.fixture(scope="module")
def old(tmp_path_factory):
    return record(tmp_path_factory.mktemp("recordings") / "old")


@pytest.fixture(scope="module")
def new(tmp_path_factory):
    return record(tmp_path_factory.mktemp("recordings") / "new", drives=3, drivers=TAKEN_OVER, offset=50)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return of_a_cars_size(tmp_path_factory.mktemp("parent") / "best_model.pth")


@pytest.fixture(scope="module")
def recipe():
    few = {"samples": 20, "batch": 4, "judged_frames": 4, "rate": 1e-3}
    return FinetuneRecipe.of(params(), transformer_steps=6, together_steps=3, **few)


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def taught(checkpoint, old, new, recipe, tmp_path_factory):
    folder = tmp_path_factory.mktemp("taught")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROVER_CACHE", str(folder / "cache"))
        return finetune(checkpoint, [old, new], "better", runs_dir=folder, recipe=recipe, device="cpu")


# --- what is learned from ---


def episode_of(drivers, chunk=8, missing=()):
    samples = []
    for row, driver in enumerate(drivers):
        if row not in missing:
            pad = np.arange(chunk) + row >= len(drivers)
            samples.append(Sample("e", None, row / 30, np.zeros(2), np.full((chunk, 2), row), pad, 100 + row, driver))
    return Episode("e", None, "", 1.0, len(drivers), len(drivers), tuple(samples), ())


def test_a_plan_that_began_before_the_takeover_is_not_taught():
    """A plan during a takeover has no step from after the human let go."""
    learned = human_samples(episode_of([POLICY] * 5 + [HUMAN] * 4 + [NOBODY] * 3 + [HUMAN] * 2))
    assert [s.row - 100 for s in learned] == [5, 6, 7, 8, 12, 13]
    assert [int((~s.is_pad).sum()) for s in learned] == [4, 3, 2, 1, 2, 1]


# --- what it leaves ---


@pytest.mark.slow
def test_what_is_left_is_one_policy_in_two_formats_with_its_parent_and_recipe(taught, checkpoint):
    ours, lerobots = load_checkpoint(taught / "best_model.pth"), load_checkpoint(taught / "pretrained_model")
    parent = load_checkpoint(checkpoint)
    assert ours.config == parent.config  # including the VAE's encoder, so that the trainer can go on with it
    assert set(ours.weights) == set(parent.weights)
    assert all(torch.equal(weight, lerobots.weights[name]) for name, weight in ours.weights.items())
    moved = {name for name, weight in ours.weights.items() if not torch.equal(weight, parent.weights[name])}
    assert any(name.startswith("backbone.") for name in moved) and any(name.startswith("decoder.") for name in moved)
    assert not any(name.startswith("vae_") for name in moved)
    origin = json.loads((taught / "pretrained_model" / "origin.json").read_text())
    assert origin == ours.report["trainer_config"]["origin"] | {"rate_hz": 30.0}
    assert origin["parent_sha256"] == parent.sha256 and origin["finetuned_by"]["transformer_steps"] == 6
    assert sorted(p.name for p in taught.iterdir()) == ["best_model.pth", "finetune.json", "pretrained_model"]


@pytest.mark.slow
def test_finetune_json_says_what_was_learned_from_and_judges_each_episode(taught):
    metrics = read_stage(taught / "finetune.json", "finetune")["metrics"]
    assert metrics["learned_from"] == {
        "demonstrations": 20,
        "new_demonstrations": 0,
        "corrections": 24,
        "not_imitated": 3 * (8 + 3),  # nobody's first frame makes no sample: the action before it was the human's
    } | {"corrections": 20}
    assert [(row["kind"], row["frames"]) for row in metrics["held_out"]] == [("old", 4)] * 2 + [("new", 4)]
    assert all(row[f"{when}_steering_pct"] > 0 for row in metrics["held_out"] for when in ("before", "after"))
    assert metrics["verdict"]["better"] is None and "2 old and 1 new" in metrics["verdict"]["why"]
    assert {phase: len(losses) for phase, losses in metrics["losses"].items()} == {"transformer": 6, "together": 3}


@pytest.mark.slow
def test_killed_in_both_phases_it_goes_on_and_gives_the_same(
    checkpoint, old, new, recipe, taught, tmp_path, monkeypatch
):
    save_each_step(monkeypatch, finetune_module)
    arguments = {"runs_dir": tmp_path, "recipe": recipe, "device": "cpu"}
    for at in (1, 4, 4, 2):  # with 0, 3, 6 and 7 steps done, of which the first phase has 6
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            interrupt(patch, training, "descend", at)
            finetune(checkpoint, [old, new], "better", **arguments)
        assert not (tmp_path / "better").exists()
    steps = interrupt(monkeypatch, training, "descend", at=0)
    folder = finetune(checkpoint, [old, new], "better", **arguments)
    assert len(steps) == 6 + 3 - 7
    assert_same(folder, taught)


def assert_same(folder, other):
    expected = load_checkpoint(other / "best_model.pth").weights
    weights = load_checkpoint(folder / "best_model.pth").weights
    assert all(torch.equal(weight, expected[name]) for name, weight in weights.items())
    losses = [json.loads((f / "finetune.json").read_text())["metrics"]["losses"] for f in (folder, other)]
    assert losses[0] == losses[1]


@pytest.mark.slow
def test_a_lerobot_folder_learns_on_and_recordings_of_one_folder_do(taught, old, new, recipe, tmp_path):
    """Episodes in which a policy drove count as new in any folder. `rover finetune` itself leaves a LeRobot folder."""
    both = tmp_path / "both"
    both.mkdir()
    for path in (*old.iterdir(), *new.iterdir()):
        (both / path.name).symlink_to(path)
    short = replace(recipe, transformer_steps=1, together_steps=0)
    folder = finetune(taught / "pretrained_model", [both], "again", runs_dir=tmp_path, recipe=short, device="cpu")
    metrics = read_stage(folder / "finetune.json", "finetune")["metrics"]
    assert [row["kind"] for row in metrics["held_out"]] == ["old", "old", "new"]
    weights = load_checkpoint(folder / "pretrained_model").weights
    assert set(weights) == set(load_checkpoint(taught / "pretrained_model").weights)


# --- what cannot be ---


def refused(says, checkpoint, episodes, tmp_path, **options):
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(TrainingError, match=says) as error:
        finetune(checkpoint, episodes, **{"name": "better", "runs_dir": tmp_path / "runs", "device": "cpu", **options})
    assert "\n" not in str(error.value) and sorted(tmp_path.rglob("*")) == before


def test_a_run_that_is_there_is_not_overwritten(checkpoint, old, new, tmp_path):
    (tmp_path / "runs" / "better").mkdir(parents=True)
    refused("is there already", checkpoint, [old, new], tmp_path)


def test_without_a_new_episode_there_is_nothing_to_learn(checkpoint, old, tmp_path):
    refused("no new episode", checkpoint, [old], tmp_path)


def test_drives_in_which_no_human_drove_teach_nothing(checkpoint, old, tmp_path):
    alone = record(tmp_path / "alone", drives=2, drivers=[POLICY] * 20 + [NOBODY] * 4)
    refused("no human drove", checkpoint, [old, alone], tmp_path)


def test_another_camera_is_refused(checkpoint, old, tmp_path):
    square = record(tmp_path / "square", drives=1, drivers=TAKEN_OVER, size=(64, 64))
    refused("another camera", checkpoint, [old, square], tmp_path)


def test_recordings_of_another_rate_are_refused(checkpoint, old, tmp_path):
    """A plan has 30 steps a second: learned from 15, the car would do all of it in half the time."""
    dark = record(tmp_path / "dark", drives=2, drivers=TAKEN_OVER, offset=90, rate_hz=15)
    refused("another rate", checkpoint, [old, dark], tmp_path)


def test_another_car_is_refused(checkpoint, old, tmp_path):
    other = Car()
    channel = replace(other.pwm.steering, neutral_pct=7.0)
    other = replace(other, pwm=replace(other.pwm, steering=channel))
    others = record(tmp_path / "other", drives=1, drivers=TAKEN_OVER, car=other)
    refused("another car", checkpoint, [old, others], tmp_path)


def test_the_same_recordings_twice_are_refused(checkpoint, old, tmp_path):
    refused("given twice", checkpoint, [old, old.parent / "." / old.name], tmp_path)


def test_an_artifact_does_not_learn(old, new, tmp_path):
    refused("is an artifact", tmp_path / "policy_static.pt", [old, new], tmp_path)


@pytest.mark.slow
def test_the_command_prints_what_it_learned_from_and_where_it_left_it(checkpoint, old, new, tmp_path):
    given_ = [
        "--name", "better", "--runs-dir", tmp_path, "--samples", 8, "--steps", 2, "--weight", 3, "--device", "cpu",
    ]  # fmt: skip
    result = CliRunner().invoke(main, [str(a) for a in ("finetune", checkpoint, old, new, *given_)])
    assert result.exit_code == 0, result.output
    assert "8 corrections" in result.output and f"done: {tmp_path / 'better'}" in result.output
    assert read_stage(tmp_path / "better" / "finetune.json", "finetune")["params"]["correction_weight"] == 3
