"""The pipeline once: what the command line makes is what a run makes."""

from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest

from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import sha256_of, write_stage
from rover_lib.workshop.int8.scheme import Scheme
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run import pipeline
from rover_lib.workshop.run.pipeline import export_onnx
from rover_lib.workshop.run.session import Opened
from tests.helpers.policies import memory_samples


def test_ranges_are_chosen_on_frames_that_calibration_has_not_seen(tiny, calibration):
    unseen, action_range = tuple(memory_samples(5, seed=1)), {"steering": (-0.5, 0.5), "throttle": (0.0, 0.5)}
    recordings = SimpleNamespace(action_range=lambda: action_range)
    for choosing in (unseen, ()):  # of a single episode nothing is left
        parts = SimpleNamespace(calibration=tuple(memory_samples(12)), choosing=choosing, held_out=())
        chooser = pipeline.prepare_chooser(tiny, Opened(tiny, recordings, parts), calibration, frames=3)
        expected = pick_evenly(choosing or parts.calibration, 3)
        states = [state.tolist() for state, _ in chooser.inputs]
        assert states == [[s.state.tolist()] for s in expected]


@pytest.mark.parametrize("another", ["artifact", "calibration"])
def test_a_run_whose_files_do_not_fit_each_other_gets_no_onnx_at_all(artifacts, thin, tmp_path, monkeypatch, another):
    """Not even the FP32 one, which would lie there beside a static policy that is another."""
    (policy, calibration), few = thin, tuple(memory_samples(3))
    parts = SimpleNamespace(calibration=few, choosing=few, held_out=())
    monkeypatch.setattr(pipeline, "open_run", lambda *_: Opened(policy, None, parts))
    calibration.save(tmp_path / "calibration.pt")
    made = artifacts["static"] if another == "calibration" else artifacts["mixed"]
    (tmp_path / "policy_static.pt").write_bytes(made.read_bytes())
    described = {"content_hash": content_hash(artifacts["static"]), "scheme": asdict(Scheme())}
    inputs = {"calibration.pt": sha256_of(tmp_path / "calibration.pt")}
    given = {"params": {}, "metrics": {"modes": {"static": described}}, "inputs": inputs}
    write_stage(tmp_path / "quantize.json", "quantize", **given)
    if another == "calibration":
        replace(calibration, seconds=0.0).save(tmp_path / "calibration.pt")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(RoverError):
        export_onnx(tmp_path)
    assert sorted(tmp_path.iterdir()) == before
