"""A policy learns on from what humans drove, and from nothing else; a rule that chance does not pass judges it."""

import json
import math
import shutil
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner

from rover_learn.finetune import FinetuneRecipe, chance_of, change_points, finetune, human_samples, verdict
from rover_learn.training import Machine
from rover_lib.cli import main
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.recording.episode import HUMAN, NOBODY, POLICY, About, EpisodeWriter
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.recordings.samples import Episode, Sample
from tests.helpers.policies import smooth_frame

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
def recipe():
    few = {"samples": 20, "batch": 4, "judged_frames": 4, "rate": 1e-3}
    return FinetuneRecipe.of(transformer_steps=6, together_steps=3, **few)


@pytest.fixture(scope="module")
def taught(car_policy, old, new, recipe, module_cache):
    return finetune(car_policy, [old, new], "better", runs_dir=module_cache, recipe=recipe, machine=Machine.of("cpu"))


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
def test_what_is_left_says_what_it_learned_from(taught, car_policy):
    ours, parent = load_checkpoint(taught / "best_model.pth"), load_checkpoint(car_policy)
    assert ours.config == parent.config  # including the VAE's encoder, so that the trainer can go on with it
    assert set(ours.weights) == set(parent.weights)
    moved = {name for name, weight in ours.weights.items() if not torch.equal(weight, parent.weights[name])}
    assert {name.split(".")[0] for name in moved} >= {"backbone", "decoder"}
    assert not any(name.startswith("vae_") for name in moved)
    origin = json.loads((taught / "pretrained_model" / "origin.json").read_text())
    assert origin["parent_sha256"] == parent.sha256 and origin["finetuned_by"]["transformer_steps"] == 6
    metrics = read_stage(taught / "finetune.json", "finetune")["metrics"]
    learned = {"demonstrations": 20, "new_demonstrations": 0, "corrections": 20}
    # nobody's first frame makes no sample: the action before it was the human's
    assert metrics["learned_from"] == learned | {"not_imitated": 3 * (8 + 3)}
    assert [(row["kind"], row["frames"]) for row in metrics["held_out"]] == [("old", 4)] * 2 + [("new", 4)]
    assert all(row[f"{when}_steering_pct"] > 0 for row in metrics["held_out"] for when in ("before", "after"))
    assert metrics["verdict"]["better"] is None
    assert {phase: len(losses) for phase, losses in metrics["losses"].items()} == {"transformer": 6, "together": 3}


@pytest.mark.slow
def test_a_lerobot_folder_learns_on_and_recordings_of_one_folder_do(taught, old, new, recipe, tmp_path):
    """Episodes in which a policy drove count as new in any folder. `rover finetune` itself leaves a LeRobot folder."""
    (both := tmp_path / "both").mkdir()
    for path in (*old.iterdir(), *new.iterdir()):
        (both / path.name).symlink_to(path)
    (both / "episode_0").unlink()
    shutil.copytree(old / "episode_0", both / "episode_0")
    for picture in (both / "episode_0").rglob("*.jpg"):
        cv2.imwrite(str(picture), smooth_frame(np.random.default_rng(0), 54, 96) * 0)
    short = replace(recipe, transformer_steps=1, together_steps=0)
    how = {"runs_dir": tmp_path, "recipe": short, "machine": Machine.of("cpu")}
    folder = finetune(taught / "pretrained_model", [both], "again", **how)
    metrics = read_stage(folder / "finetune.json", "finetune")["metrics"]
    assert [row["kind"] for row in metrics["held_out"]] == ["old", "old", "new"]
    assert "episode_0: 100% of its pictures are black, and show nothing: leave them out" in metrics["warnings"]
    weights = load_checkpoint(folder / "pretrained_model").weights
    assert set(weights) == set(load_checkpoint(taught / "pretrained_model").weights)


# --- what cannot be ---


def shifted():
    """Another car."""
    car = Car()
    return replace(car, pwm=replace(car.pwm, steering=replace(car.pwm.steering, neutral_pct=7.0)))


@pytest.mark.parametrize(
    ("says", "options"),
    [
        ("no human drove", {"drivers": [POLICY] * 20 + [NOBODY] * 4}),
        ("another camera", {"size": (64, 64)}),
        ("another rate", {"rate_hz": 15}),  # a plan has 30 steps a second: the car would do all in half the time
        ("another car", {"car": shifted()}),
        ("another car, found episode_9.: steering .1 turns", {"car": replace(Car(), positive="left")}),
    ],
)
def test_recordings_that_do_not_belong_to_the_old_ones_are_refused(says, options, car_policy, old, tmp_path):
    others = record(tmp_path / "others", drives=2, offset=90, **{"drivers": TAKEN_OVER, **options})
    with pytest.raises(TrainingError, match=says):
        finetune(car_policy, [old, others], "better", runs_dir=tmp_path / "runs", machine=Machine.of("cpu"))
    assert not (tmp_path / "runs").exists()


def test_what_cannot_learn_is_refused(car_policy, old, new, tmp_path):
    (tmp_path / "runs" / "there").mkdir(parents=True)
    for episodes, name, says in (
        ([old, new], "there", "is there already"),
        ([old], "better", "no human drove in a new episode"),
        ([old, old.parent / "." / old.name], "better", "given twice"),
    ):
        with pytest.raises(TrainingError, match=says):
            finetune(car_policy, episodes, name, runs_dir=tmp_path / "runs", machine=Machine.of("cpu"))
    assert [p.name for p in (tmp_path / "runs").iterdir()] == ["there"]


@pytest.mark.slow
def test_the_command_says_what_it_learned_from(car_policy, old, new, tmp_path, set_params):
    set_params("finetune: {samples: 8, correction_weight: 3}")
    words = ["--name", "better", "--runs-dir", tmp_path, "--steps", 2, "--device", "cpu"]
    result = CliRunner().invoke(main, [str(a) for a in ("finetune", car_policy, old, new, *words)])
    assert result.exit_code == 0 and "8 corrections" in result.output, result.output
    assert read_stage(tmp_path / "better" / "finetune.json", "finetune")["params"]["correction_weight"] == 3


# --- is it better? ---


def rows_of(kind, *changes):
    """Episodes that are better or worse by these points, in steering; throttle never changes."""
    never = {"before_throttle_pct": None, "after_throttle_pct": None}
    return [{"kind": kind, "before_steering_pct": 5.0, "after_steering_pct": 5.0 + c} | never for c in changes]


def test_chance_is_the_share_of_all_signs():
    changes = [-1.0, -2.0, 0.5, -0.25, -3.0]
    every = [abs(sum(s * c for s, c in zip(signs, changes, strict=True))) for signs in product((-1, 1), repeat=5)]
    assert chance_of(changes) == sum(e >= abs(sum(changes)) - 1e-12 for e in every) / 32


@pytest.mark.parametrize(
    ("old", "new", "better"),
    [
        ([0.1, -0.1] * 4, [-1.0] * 8, True),
        ([0.1, -0.1] * 4, [-1.0] * 5, None),  # too few
        ([0.5] * 6, [-1.0], False),  # enough that became worse
        ([0.1, -0.1] * 4, [-1.0, 1.0] * 4, None),  # may be chance
        ([0.5] * 8, [-1.0] * 8, False),
        ([0.1, -0.1] * 4, [1.0] * 8, False),
    ],
)
def test_the_rule(old, new, better):
    assert verdict(rows_of("old", *old) + rows_of("new", *new))["better"] is better


def test_an_action_that_never_changes_is_not_judged():
    (row,) = rows_of("new", -1.0)
    assert change_points(row) == -1.0
    assert change_points({"before_throttle_pct": None, "after_throttle_pct": None}) == 0.0
