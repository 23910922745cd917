"""The full-size policy, at the small size: what counting needs of it is there, and is one policy."""

import pytest

from lab.a76.full import NOTE, SIZES, STEPS, full_run
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.onboard.stage import read_stage, write_stage
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.session import open_run

pytestmark = pytest.mark.slow  # each makes a policy of a size that is no toy's

SIZE = {"size": "small", "drives": 5, "samples": 6, "sizes": ((54, 96),)}


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    return full_run(tmp_path_factory.mktemp("runs") / "full", steps=5, **SIZE)


def test_leaves_what_counting_needs(run_dir):
    artifacts = {p.stem: load_policy(p) for p in run_dir.glob("policy_*") if p.is_file()}
    assert {name: p.image_size for name, p in artifacts.items()} == {
        "policy_fp32": (72, 128), "policy_fp32.onnx": (72, 128), "policy_static": (72, 128),
        "policy_static.onnx": (72, 128), "policy_fp32_54x96": (54, 96), "policy_static_54x96": (54, 96),
    }  # fmt: skip
    assert len({p.manifest["checkpoint"]["sha256"] for p in artifacts.values()}) == 1
    again = open_run(run_dir)
    assert len(pick_evenly(again.parts.held_out, 50)) == 50
    assert read_stage(run_dir / "load.json", "load")["metrics"]["note"] == NOTE and "does not drive" in NOTE
    assert read_stage(run_dir / "calibrate.json", "calibrate")["metrics"]["samples"] == 6
    assert STEPS < 100 and (180, 320) in SIZES


def test_another_run_of_that_name_is_left_alone(tmp_path):
    metrics = {"checkpoint": {}, "split": {}}
    write_stage(tmp_path / "load.json", "load", params={"checkpoint": "mine.pth"}, metrics=metrics)
    with pytest.raises(TrainingError, match="holds a run on another checkpoint"):
        full_run(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["load.json"]
