"""A run goes on from what its notebook 01 loaded, and from nothing else."""

import json
from dataclasses import replace

import pytest
from recorded import record_drives

from rover_lib.onboard.errors import CheckpointError, RoverError
from rover_lib.workshop.act import Affine
from rover_lib.workshop.checkpoint.files import write_lerobot
from rover_lib.workshop.run import session
from rover_lib.workshop.run.pipeline import write_load
from rover_lib.workshop.run.session import load, open_run


@pytest.fixture
def written(tiny, tmp_path):
    """Writes the tiny policy as a LeRobot folder whose throttle has that scale."""

    def write(scale):
        config = replace(tiny.config, action_unnorm=Affine((0.4, scale), (0.1, 0.05)))
        write_lerobot(tmp_path / "pretrained_model", config, tiny.weights, {})
        return tmp_path / "pretrained_model"

    return write


@pytest.mark.slow
def test_what_changed_since_is_refused(written, tmp_path):
    """Of the same weights: the plans of an artifact that is made now would be other ones than the run judged."""
    drives = record_drives(tmp_path / "episodes", frames=40)
    write_load(tmp_path, load(written(0.02), drives))
    assert open_run(tmp_path).checkpoint.config.action_unnorm.scale == pytest.approx((0.4, 0.02))
    written(0.03)
    with pytest.raises(RoverError, match="not what notebook 01 loaded"):
        open_run(tmp_path)
    written(0.02)
    stage = json.loads((tmp_path / "load.json").read_text())
    stage["metrics"]["recordings"]["layout"] = (
        "camera: the car's; state: throttle, steering; action: steering, throttle"
    )
    (tmp_path / "load.json").write_text(json.dumps(stage))
    with pytest.raises(RoverError, match="says something else"):
        open_run(tmp_path)
    stage["metrics"] |= {"split": {}, "recordings": {}}
    (tmp_path / "load.json").write_text(json.dumps(stage))
    with pytest.raises(RoverError, match="other episodes"):
        open_run(tmp_path)


@pytest.mark.parametrize(
    "change, says",
    [
        ({"chunk": 257}, "found 257"),
        ({"rate_hz": 2.0}, "found 2"),
        ({"image_sizes": ((8, 16),)}, "found 8"),
        ({"cameras": ("left/right",)}, "names of cameras"),
        ({"action_names": ("steering", "t" * 65)}, "names of actions"),
        ({"state_names": tuple(f"joint{i}" for i in range(65))}, "found 65"),
    ],
)
def test_what_no_artifact_may_hold_is_refused(change, says, tiny):
    policy = replace(tiny, config=replace(tiny.config, **change))
    with pytest.raises(CheckpointError, match=says):
        session._check_limits(policy)


def test_sizes_are_refused_before_any_recording_is_read(tiny, monkeypatch):
    """Plans of a million steps, in a file of a few megabytes, would fill the memory with the samples of a drive."""
    long = replace(tiny, config=replace(tiny.config, chunk=1_000_000))
    monkeypatch.setattr(session, "load_checkpoint", lambda *_: long)
    monkeypatch.setattr(session, "load_recordings", lambda *given: pytest.fail("they were read"))
    with pytest.raises(CheckpointError, match=r"from 1 to 256, found 1e\+06"):
        load(long.path, "episodes")


def test_a_rate_of_the_recordings_is_refused_before_anything_is_calibrated(tiny, tmp_path, monkeypatch):
    slow = replace(tiny, config=replace(tiny.config, rate_hz=2.0))
    monkeypatch.setattr(session, "load_checkpoint", lambda *_: slow)
    with pytest.raises(CheckpointError, match="from 5 to 120, found 2"):
        load(slow.path, record_drives(tmp_path / "episodes", frames=300))
