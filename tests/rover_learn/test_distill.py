"""A student is taught from recordings alone, and an interrupted training goes on where it stopped."""

import json

import pytest
import torch

from rover_learn import distill as distill_module
from rover_learn import training
from rover_learn.distill import Distillation, DistillRecipe, distill, summary
from rover_learn.phases import Learned
from rover_learn.student import StudentShape
from rover_learn.training import Machine
from rover_lib.onboard.errors import TrainingError
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from tests.helpers.interrupted import interrupt, save_each_step
from tests.helpers.recorded import record_drives

SHAPE = StudentShape(54, 96, decoder_layers=1, feedforward=64)


@pytest.fixture(scope="module")
def episodes(tmp_path_factory):
    return record_drives(tmp_path_factory.mktemp("episodes"))


@pytest.fixture(scope="module")
def recipe():
    few = {"samples": 20, "batch": 4, "unit_frames": 8, "judged_frames": 8, "rate": 1e-3}
    return DistillRecipe.of(backbone_steps=3, transformer_steps=8, together_steps=3, **few)


@pytest.fixture(scope="module")
def taught(car_policy, episodes, recipe, module_cache):
    return distill(car_policy, episodes, "fast", SHAPE, runs_dir=module_cache, recipe=recipe, machine=Machine.of("cpu"))


def metrics_of(folder):
    return json.loads((folder / "distill.json").read_text())["metrics"]


@pytest.mark.slow
def test_what_is_left_is_one_policy_in_two_formats_judged_on_held_out_episodes(taught, car_policy):
    ours, lerobots = load_checkpoint(taught / "best_model.pth"), load_checkpoint(taught / "pretrained_model")
    assert ours.config.image_sizes == lerobots.config.image_sizes == ((54, 96),)
    assert (ours.config.decoder_layers, ours.config.feedforward) == (1, 64)
    assert all(torch.equal(weight, lerobots.weights[name]) for name, weight in ours.weights.items())
    origin = json.loads((taught / "pretrained_model" / "origin.json").read_text())
    assert origin == ours.report["trainer_config"]["origin"] | {"rate_hz": 30.0}
    assert origin["teacher_sha256"] == load_checkpoint(car_policy).sha256
    assert sorted(p.name for p in taught.iterdir()) == ["best_model.pth", "curves", "distill.json", "pretrained_model"]
    content = json.loads((taught / "distill.json").read_text())
    of_teacher, of_student = content["metrics"]["students"]
    assert of_teacher["teacher_steering_pct"] == of_teacher["teacher_throttle_pct"] == 0
    assert of_student["teacher_steering_pct"] > 0 and of_student["gmac"] < of_teacher["gmac"]
    losses = {phase: len(found) for phase, found in content["metrics"]["losses"].items() if found}
    assert losses == {"backbone": 3, "transformer": 8, "together": 3}
    assert "96x54" in summary(content) and len(content["inputs"]) > 4 * 24


@pytest.mark.slow
def test_killed_twice_in_the_middle_it_goes_on_and_gives_the_same(
    car_policy, episodes, recipe, taught, tmp_path, monkeypatch
):
    save_each_step(monkeypatch, distill_module)
    arguments = {"runs_dir": tmp_path, "recipe": recipe, "machine": Machine.of("cpu")}
    for at in (2, 8):  # in the backbone's phase with one step done, and in the transformer's with eight
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            interrupt(patch, training, "descend", at)
            distill(car_policy, episodes, "fast", SHAPE, **arguments)
        assert not (tmp_path / "fast").exists()
    steps = interrupt(monkeypatch, training, "descend", at=0)
    folder = distill(car_policy, episodes, "fast", SHAPE, **arguments)
    assert len(steps) == 3 + 8 + 3 - 8
    weights, expected = (load_checkpoint(f / "best_model.pth").weights for f in (folder, taught))
    assert all(torch.equal(weight, expected[name]) for name, weight in weights.items())
    assert metrics_of(folder)["losses"] == metrics_of(taught)["losses"]


@pytest.mark.slow
def test_a_student_of_half_the_channels_keeps_its_zeros(car_policy, episodes, recipe, tmp_path, monkeypatch):
    """They stay zero in all phases, through an interrupt."""
    shape = StudentShape(backbone_channels=0.5)
    arguments = {"runs_dir": tmp_path, "recipe": recipe, "machine": Machine.of("cpu")}
    save_each_step(monkeypatch, distill_module)
    steps = interrupt(monkeypatch, training, "descend", at=2)
    with pytest.raises(KeyboardInterrupt):
        distill(car_policy, episodes, "thin", shape, **arguments)
    folder = distill(car_policy, episodes, "thin", shape, **arguments)
    assert len(steps) == 8 + 3 + 1  # no backbone phase, and only the interrupted step is repeated
    weights = load_checkpoint(folder / "pretrained_model").weights
    for name in (f"backbone.layer{i}.{j}" for i in (1, 2, 3, 4) for j in (0, 1)):
        left = weights[f"{name}.conv1.weight"].flatten(1).any(1)
        assert left.sum() * 2 == len(left)
        for part in ("bn1.weight", "bn1.bias"):
            assert torch.equal(weights[f"{name}.{part}"] != 0, left), part
    of_teacher, of_student = metrics_of(folder)["students"]
    assert of_student["gmac"] < 0.56 * of_teacher["gmac"] and of_student["backbone_channels"] == 0.5


def test_a_run_that_is_there_is_not_overwritten(car_policy, episodes, tmp_path, monkeypatch):
    def learn(self):  # meanwhile another command makes it
        (tmp_path / "fast").mkdir()
        return Learned({}, {}, tmp_path / "gone")

    monkeypatch.setattr(Distillation, "learn", learn)
    monkeypatch.setattr(Distillation, "leave", lambda self, new, *_: (new / "distill.json").touch())
    for _ in range(2):
        with pytest.raises(TrainingError, match="is there already"):
            distill(car_policy, episodes, "fast", SHAPE, runs_dir=tmp_path, machine=Machine.of("cpu"))
    assert not list((tmp_path / "fast").iterdir())


@pytest.mark.parametrize("options", [{"shape": StudentShape()}, {"device": "tpu"}, {"name": "../fast"}])
def test_what_cannot_be_taught_is_refused(car_policy, episodes, tmp_path, options):
    given = {"name": "fast", "shape": SHAPE, "runs_dir": tmp_path / "runs", "device": "cpu", **options}
    with pytest.raises(TrainingError):
        distill(car_policy, episodes, machine=Machine.of(given.pop("device")), **given)
    assert not (tmp_path / "runs").exists()
