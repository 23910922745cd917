"""The full-size policy, at the small size: what counting needs of it is there, and is one policy."""

import json

import pytest

from lab.a76 import full
from lab.a76.full import LEARNED_NOTE, NOTE, SIZES, STEPS, full_run
from rover_learn import train as train_module
from rover_lib.onboard.errors import WorldError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.onboard.stage import read_stage, sha256_of, write_stage
from rover_lib.workshop.int8.observe import Calibration
from rover_lib.workshop.int8.quantize import quantize
from rover_lib.workshop.int8.scheme import Scheme
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.session import open_run

pytestmark = pytest.mark.slow  # each makes a policy of a size that is no toy's

SIZE = {"size": "small", "drives": 5, "samples": 6, "sizes": ((54, 96),), "curve": ((36, 64),)}


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return full_run(tmp_path_factory.mktemp("runs") / "full", steps=5, **SIZE)


def test_leaves_what_counting_needs(run_dir):
    artifacts = {p.stem: load_policy(p) for p in run_dir.glob("policy_*") if p.is_file()}
    assert {name: p.image_size for name, p in artifacts.items()} == {
        "policy_fp32": (72, 128), "policy_fp32.onnx": (72, 128), "policy_static": (72, 128),
        "policy_static.onnx": (72, 128), "policy_fp32_54x96": (54, 96), "policy_static_54x96": (54, 96),
        "policy_static_36x64": (36, 64),
    }  # fmt: skip
    assert len({p.manifest["checkpoint"]["sha256"] for p in artifacts.values()}) == 1
    again = open_run(run_dir)
    assert len(pick_evenly(again.parts.held_out, 50)) == 50
    assert read_stage(run_dir / "load.json", "load")["metrics"]["note"] == NOTE and "does not drive" in NOTE
    assert read_stage(run_dir / "calibrate.json", "calibrate")["metrics"]["samples"] == 6
    assert STEPS < 100 and (180, 320) in SIZES


@pytest.mark.parametrize("suffix", ["", "_54x96"])
def test_quantize_json_says_how_to_make_it_again(run_dir, suffix):
    made = read_stage(run_dir / "quantize.json", "quantize")["metrics"]["modes"][f"static{suffix}"]
    scheme = Scheme.of(made["scheme"])
    checkpoint = open_run(run_dir).checkpoint
    checkpoint = checkpoint.at_size(54, 96) if suffix else checkpoint
    again = quantize(checkpoint, scheme, Calibration.load(run_dir / f"calibration{suffix}.pt"))
    assert json.loads(json.dumps(again.report["layers"])) == made["layers"]


@pytest.fixture
def checkpoint_alone(monkeypatch):
    """A run quantizes nothing, which takes longer than to train it."""
    monkeypatch.setattr(full, "_quantize", lambda *_, **__: {})
    monkeypatch.setattr(full, "write_quantize", lambda *_: None)
    monkeypatch.setattr(full, "export_onnx", lambda *_: None)


def test_what_was_made_before_is_taken_from_the_cache(run_dir, checkpoint_alone, tmp_path):
    again = full_run(tmp_path / "full", steps=5, **SIZE | {"sizes": (), "curve": ()})
    assert sha256_of(again / "best_model.pth") == sha256_of(run_dir / "best_model.pth")


def test_the_whole_recipe_is_that_of_the_balloon_world(checkpoint_alone, tmp_path, monkeypatch):
    """So that a checkpoint that `rover train` left in the cache is used."""
    short = train_module.RECIPES["small", "cpu"].of_steps(4)
    monkeypatch.setitem(train_module.RECIPES, ("small", "cpu"), short)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    run_dir = full_run(tmp_path / "full", steps=None, **SIZE | {"sizes": (), "curve": ()})
    assert read_stage(run_dir / "load.json", "load")["metrics"]["note"] == LEARNED_NOTE
    monkeypatch.setattr(train_module, "_train", None)
    trained = train_module.train(run_dir / "episodes", tmp_path / "mine.pth", "small")
    assert sha256_of(trained) == sha256_of(run_dir / "best_model.pth")
    with pytest.raises(WorldError, match="holds a run on another checkpoint"):
        full_run(run_dir, steps=5, **SIZE)


def test_another_run_of_that_name_is_left_alone(tmp_path):
    metrics = {"checkpoint": {}, "split": {}}
    write_stage(tmp_path / "load.json", "load", params={"checkpoint": "mine.pth"}, metrics=metrics)
    with pytest.raises(WorldError, match="holds a run on another checkpoint"):
        full_run(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["load.json"]
