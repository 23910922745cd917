"""The artifact alone: what it holds, what loading it refuses, and that it drives without the workshop."""

import mmap
from dataclasses import replace

import numpy as np
import pytest
import torch

from rover_lib.onboard import load_policy
from rover_lib.onboard.artifact.acceptance import inspect_artifact
from rover_lib.onboard.errors import ArtifactError, PolicyError
from rover_lib.onboard.policy.torch_engine import _originals, give_back_packed_weights
from tests.helpers.policies import memory_samples

FRAME = memory_samples(1)[0].picture
STATE = np.zeros(2, np.float32)


@pytest.mark.parametrize("mode", ["fp32", "dynamic", "static", "mixed"])
def test_drives(artifacts, mode):
    policy = load_policy(artifacts[mode])
    assert policy.manifest["mode"] == mode and policy.action_names == ("steering", "throttle")
    assert policy.rate_hz == 30
    chunk = policy.predict_chunk(FRAME, STATE)
    assert chunk.shape == (policy.chunk, 2) and chunk.dtype == np.float32
    assert (np.abs(chunk[:, 0]) <= 1).all() and (chunk[:, 1] >= 0).all() and (chunk[:, 1] <= 1).all()
    assert np.array_equal(chunk, policy.predict_chunk(FRAME, STATE))  # nothing is kept between two calls
    assert not np.array_equal(chunk, policy.predict_chunk(255 - FRAME, STATE))  # the picture matters
    big = np.repeat(np.repeat(FRAME, 5, 0), 5, 1)
    assert np.allclose(policy.predict_chunk(big, STATE), chunk, atol=1e-5)  # the camera may have any size


@pytest.mark.slow
def test_a_policy_of_gelu_drives_and_is_accepted(tiny, tmp_path):
    """If an operator has changed since it was new, as gelu has, torch names a record of its archive differently."""
    from rover_lib.workshop.act import ACT
    from rover_lib.workshop.int8.export import Exporter

    other, path = replace(tiny, config=replace(tiny.config, activation="gelu")), tmp_path / "policy_fp32.pt"
    content, _ = Exporter(other, memory_samples(1, seed=9)).export(ACT(other.config, other.weights), path)
    assert load_policy(path).predict_chunk(FRAME, STATE).std() > 0
    assert inspect_artifact(path, allow=("mode",)).content_hash == content


def test_refuses_what_is_not_an_observation_and_plans_that_are_not_finite(artifacts, monkeypatch):
    policy = load_policy(artifacts["fp32"])
    for frame, state in (
        (None, STATE),
        (FRAME[:, :, 0], STATE),
        (FRAME, np.zeros(3)),
        (FRAME, np.array([np.nan, 0])),
        ({"other": FRAME}, STATE),
    ):
        with pytest.raises(PolicyError):
            policy.predict_chunk(frame, state)
    monkeypatch.setattr(policy._engine, "run", lambda *x: [np.full((1, 32, 2), np.nan, np.float32)])
    with pytest.raises(PolicyError):
        policy.predict_chunk(FRAME, STATE)


@pytest.mark.slow
def test_weights_that_torch_holds_twice_are_given_back_and_predictions_stay(tiny, calibration, tmp_path, monkeypatch):
    from rover_lib.workshop.int8.export import Exporter
    from rover_lib.workshop.int8.quantize import quantize
    from rover_lib.workshop.int8.scheme import Scheme

    static = quantize(tiny, Scheme(), calibration)
    Exporter(tiny, memory_samples(1)).export(static, tmp_path / "p.pt", calibration)
    asked, (state, frame) = [], (np.full(2, 0.1, np.float32), 255 - FRAME)
    monkeypatch.setattr(
        "rover_lib.onboard.policy.torch_engine.give_back_packed_weights", lambda module: asked.append(module) or 0
    )
    policy = load_policy(tmp_path / "p.pt")
    before = policy.predict_chunk(frame, state)
    (module,) = asked
    weights = list(_originals(module.graph))
    total = sum(w.untyped_storage().nbytes() for w in weights)
    assert all(w.int_repr().any() for w in weights)
    given = give_back_packed_weights(module)
    assert 0.9 * total < given <= total  # all but the two ends, which are no whole pages
    largest = max(weights, key=torch.Tensor.numel)
    assert largest.numel() > 1e6 and largest.int_repr().count_nonzero() <= 2 * mmap.PAGESIZE  # only the ends are left
    assert np.array_equal(policy.predict_chunk(frame, state), before)


def test_refuses_a_policy_that_changes_when_memory_is_given_back(artifacts, monkeypatch):
    def take_what_is_used(module):
        bias = next(n.output().toIValue() for n in module.graph.nodes() if str(n.output().type()) == "Tensor")
        bias.zero_()
        return bias.nbytes

    monkeypatch.setattr("rover_lib.onboard.policy.torch_engine.give_back_packed_weights", take_what_is_used)
    with pytest.raises(ArtifactError, match="without its original weights"):
        load_policy(artifacts["static"])


def test_refuses_damaged_files(artifacts, tmp_path):
    whole = artifacts["static"].read_bytes()
    path, expected = tmp_path / "x.pt", load_policy(artifacts["static"]).predict_chunk(FRAME, STATE)
    with pytest.raises(ArtifactError, match="not found"):
        load_policy(path)
    for at in range(0, len(whole), len(whole) // 25):  # flip a bit anywhere, in weights too
        flipped = bytearray(whole)
        flipped[at] ^= 0x10
        path.write_bytes(flipped)
        try:
            same = np.array_equal(load_policy(path).predict_chunk(FRAME, STATE), expected)
        except ArtifactError:
            continue
        assert same  # a flip may pass only in bytes without a meaning, such as padding between records
