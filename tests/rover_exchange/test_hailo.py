"""A kit for Hailo's compiler: both halves compute the policy, and what comes back is judged as a mode is."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import onnx
import pytest

from rover_exchange import hailo
from rover_lib.onboard.errors import ArtifactError, PolicyError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.onboard.policy.onnx_engine import session_of
from rover_lib.workshop.act import ACT, Affine
from rover_lib.workshop.recordings.episodes import Split
from rover_lib.workshop.run.session import Opened
from tests.helpers.policies import memory_samples


@pytest.fixture
def loaded(thin, monkeypatch):
    recorded = {"chunk": np.zeros((32, 2), np.float32), "is_pad": np.zeros(32, bool)}
    held_out = [SimpleNamespace(**vars(s), frame_bgr=s.frame_bgr, **recorded) for s in memory_samples(3, seed=1)]
    parts = Split(tuple(memory_samples(6)), (), tuple(held_out), None)
    ranges = SimpleNamespace(action_range=lambda: {"steering": (-0.5, 0.5), "throttle": (0.0, 0.5)})
    opened = Opened(thin[0], ranges, parts)
    monkeypatch.setattr(hailo, "open_run", lambda *_: opened)
    return opened


def features_by_script(kit, gain=1.0):
    """What a chip without any error gives: pixels normalised as the model script says, features channels last."""
    script = (kit / "backbone.alls").read_text().splitlines()[0]
    mean, std = json.loads(script.removeprefix("normalization1 = normalization(").removesuffix(")").join("[]"))
    session, made = session_of((kit / "backbone.onnx").read_bytes(), 1), []
    for frame in np.load(kit / "judged.npy"):
        picture = ((frame - np.float32(mean)) / np.float32(std)).transpose(2, 0, 1)[None]
        made.append(session.run(None, {"picture": np.ascontiguousarray(picture, np.float32)})[0][0].transpose(1, 2, 0))
    np.save(kit / "features.npy", gain * np.stack(made))


def test_the_halves_compute_the_policy_and_what_comes_back_is_judged(loaded, artifacts, tmp_path):
    facts = hailo.write_kit(tmp_path)
    kit, fp32 = tmp_path / "hailo", load_policy(artifacts["fp32"])
    assert facts["gap"] < 1e-5 and sum(facts["gmac"].values()) == pytest.approx(fp32.manifest["gmac"], rel=0.01)
    assert hailo.judge(tmp_path, fp32, loaded) is None
    features_by_script(kit)
    assert hailo.judge(tmp_path, fp32, loaded).relative("hailo") < 1e-4
    features_by_script(kit, gain=0.5)
    assert hailo.judge(tmp_path, fp32, loaded).relative("hailo") > 1e-3
    graph = onnx.shape_inference.infer_shapes(onnx.load(kit / "backbone.onnx"), strict_mode=True).graph
    shapes = [[d.dim_value for d in v.type.tensor_type.shape.dim] for v in (*graph.input, *graph.value_info)]
    assert all(all(shape) and len(shape) <= 4 for shape in shapes) and graph.node[-1].op_type == "Conv"
    assert np.load(kit / "calibration.npy").shape == (6, *loaded.checkpoint.config.image_sizes[0], 3)
    np.save(kit / "features.npy", np.load(kit / "features.npy").transpose(0, 3, 1, 2))
    with pytest.raises(PolicyError, match="channels last"):
        hailo.judge(tmp_path, fp32, loaded)
    hailo.write_kit(tmp_path)
    assert not (kit / "features.npy").exists()  # they were of another kit


def test_a_split_that_computes_something_else_is_not_written(loaded, tmp_path, monkeypatch):
    shifted = replace(loaded.checkpoint.config, action_unnorm=Affine((1.0, 1.0), (0.0, 0.01)))
    real = hailo.halves
    monkeypatch.setattr(hailo, "halves", lambda policy: real(ACT(shifted, loaded.checkpoint.weights)))
    with pytest.raises(ArtifactError, match="nothing was written"):
        hailo.write_kit(tmp_path)
    assert not list(tmp_path.iterdir())


def test_two_cameras_are_refused():
    with pytest.raises(ArtifactError, match="one camera"):
        hailo.halves(SimpleNamespace(config=SimpleNamespace(sees_state=True, cameras=("left", "right"))))
