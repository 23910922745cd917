"""A run goes on from what its notebook 01 loaded, and from nothing else."""

import json
from dataclasses import replace

import pytest

from rover_lib.onboard.errors import CheckpointError, EpisodeError, RoverError
from rover_lib.workshop.act import Affine
from rover_lib.workshop.checkpoint.checkpoint import check_limits
from rover_lib.workshop.checkpoint.lerobot import write_lerobot
from rover_lib.workshop.recordings.source import Source
from rover_lib.workshop.run import session
from rover_lib.workshop.run.session import load, open_run
from tests.helpers.executed import run_cells
from tests.helpers.recorded import record_drives


@pytest.mark.slow
def test_what_changed_since_is_refused(tiny, tmp_path):
    """Of the same weights: the plans of an artifact that is made now would be other ones than the run judged."""

    def write(scale):
        config = replace(tiny.config, action_unnorm=Affine((0.4, scale), (0.1, 0.05)))
        write_lerobot(tmp_path / "pretrained_model", config, tiny.weights, {})

    write(0.02)
    drives = record_drives(tmp_path / "episodes", frames=40)
    run_cells("01_load", tmp_path, checkpoint=tmp_path / "pretrained_model", episodes=drives)
    assert open_run(tmp_path).checkpoint.config.action_unnorm.scale == pytest.approx((0.4, 0.02))
    write(0.03)
    with pytest.raises(RoverError, match="statistics have changed"):
        open_run(tmp_path)
    write(0.02)
    stage = json.loads((tmp_path / "load.json").read_text())
    then = "camera: the car's; state: throttle, steering; action: steering, throttle"
    for change in ({"recordings": {"layout": then}}, {"recordings": {}, "split": {}}):
        (tmp_path / "load.json").write_text(json.dumps(stage | {"metrics": stage["metrics"] | change}))
        with pytest.raises(RoverError, match="other episodes, or another order"):
            open_run(tmp_path)


def test_what_no_artifact_may_hold_is_refused(tiny):
    for change in ({"chunk": 257}, {"image_sizes": ((8, 16),)}, {"cameras": ("left/right",)}):
        with pytest.raises(CheckpointError):
            check_limits(tiny.path, replace(tiny.config, **change))


def test_a_rate_of_the_recordings_is_refused_before_anything_is_calibrated(tiny, tmp_path, monkeypatch):
    slow = replace(tiny, config=replace(tiny.config, rate_hz=0.5))
    monkeypatch.setattr(session, "load_checkpoint", lambda *_: slow)
    with pytest.raises(CheckpointError, match=r"from 1 to 120, found 0\.5"):
        load(slow.path, record_drives(tmp_path / "episodes", frames=300))


def test_a_camera_of_our_recordings_is_the_policys_own_or_refused(tiny, tmp_path):
    """They have one, without a name; a run of a LeRobot policy once stored its name for it."""
    write_lerobot(tmp_path / "pretrained_model", tiny.config, tiny.weights, {})
    drives = record_drives(tmp_path / "episodes", frames=40)
    for policy in (tiny.path, tmp_path / "pretrained_model"):
        with pytest.raises(EpisodeError, match="--camera left"):
            load(policy, Source.of(drives, camera="left"))
    own = Source.of(drives, camera=",".join(tiny.config.cameras))
    assert load(tmp_path / "pretrained_model", own).recordings.source.cameras == ()
