"""A policy on a Hailo chip, with a stand-in for HailoRT (see hailo_standin.py) that quantizes nothing."""

import re
import shutil
import sys

import hailo_standin
import numpy as np
import pytest
from archives import rewritten
from hailo_kit import normalised
from policies import memory_samples

from rover_exchange.hailo import compile as hailo_compile
from rover_lib.onboard.artifact import engines
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.workshop.act import ACT, inputs_of, predictions


@pytest.fixture(scope="module")
def packed(hailo_kit, tmp_path_factory):
    """The artifact, compiled and packed."""
    kit = shutil.copytree(hailo_kit, tmp_path_factory.mktemp("packed") / "kit")
    return hailo_compile.pack(kit, "hailo8", hailo_standin.compile_kit(kit))


@pytest.fixture(autouse=True)
def hailort(monkeypatch):
    hailo_standin.install(monkeypatch)
    monkeypatch.delitem(sys.modules, engines.MODULES[engines.HAILO], raising=False)
    yield
    sys.modules.pop(engines.MODULES[engines.HAILO], None)


def test_is_the_policy(packed, tiny):
    policy, act = load_policy(packed, threads=1), normalised(tiny)
    model = ACT(act.config, act.weights)
    for sample in memory_samples(4, seed=9):
        state, frame = inputs_of(sample, act.config)
        expected = predictions(model, [(state, frame)])[0].numpy()
        assert expected.std() > 1e-3
        for _ in range(2):  # twice, because each inference uses the same buffers
            assert np.abs(policy.run(state[0].numpy(), [frame.numpy()]) - expected).max() < 1e-5


def test_what_cannot_run_here_says_so(packed, tmp_path, monkeypatch):
    """A HEF of colours taken for black is refused by its parity; the others before they run."""
    black = b"[9999.99, 9999.9, 9999.9]"
    for edit, message in (
        (lambda hef: hef.replace(b"[123.675, 116.28, 103.53]", black), "computes something else"),
        (lambda hef: b"no HEF", "Invalid HEF"),
        (lambda hef: re.sub(rb"\[\d+, \d+, 3\]", b"[8, 8, 3]", hef), "its HEF has"),
    ):
        with pytest.raises(ArtifactError, match=message):
            load_policy(rewritten(packed, tmp_path / "x.zip", {"network.hef": edit}))
    policy = load_policy(packed)
    monkeypatch.setattr(hailo_standin.InferModel, "fails", True)
    (sample,) = memory_samples(1)
    with pytest.raises(RuntimeError, match="timeout"):
        policy.predict_chunk(sample.picture, sample.state)
