"""A policy on a Hailo chip, with a stand-in for HailoRT (see hailo_standin.py) that quantizes nothing."""

import shutil
import sys
import zipfile

import hailo_standin
import numpy as np
import pytest
from hailo_kit import normalised
from policies import memory_samples

from rover_hailo import compile as hailo_compile
from rover_lib.onboard.artifact import engines
from rover_lib.onboard.artifact.acceptance import inspect_artifact
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.kinds import kinds_of
from rover_lib.onboard.policy.load import load_policy
from rover_lib.workshop.act import ACT, inputs_of, predictions


@pytest.fixture(scope="module")
def packed(hailo_kit, tmp_path_factory):
    """The artifacts of both networks, compiled and packed."""
    kit = shutil.copytree(hailo_kit, tmp_path_factory.mktemp("packed") / "kit")
    with pytest.MonkeyPatch.context() as monkeypatch:
        hailo_standin.install(monkeypatch)
        hefs = {name: hailo_compile.compile_network(kit, "hailo8", name) for name in ("backbone", "whole")}
        return {name: hailo_compile.pack(kit, "hailo8", name, hef) for name, hef in hefs.items()}


@pytest.fixture(autouse=True)
def hailort(monkeypatch):
    hailo_standin.install(monkeypatch)
    monkeypatch.delitem(sys.modules, engines.MODULES[engines.HAILO], raising=False)
    yield
    sys.modules.pop(engines.MODULES[engines.HAILO], None)


def repacked(path, folder, **records: bytes):
    """Return a copy of the artifact with some records replaced."""
    changed = folder / path.name
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(changed, "w") as new:
        for name in old.namelist():
            new.writestr(name, records.get(name.rsplit("/", 1)[-1].replace(".", "_"), old.read(name)))
    return changed


@pytest.mark.parametrize("network", ["backbone", "whole"])
def test_is_the_policy(packed, tiny, network):
    policy, act = load_policy(packed[network], threads=1), normalised(tiny)
    assert policy.manifest["engine"] == "hailo" and len(content_hash(packed[network])) == 64
    model = ACT(act.config, act.weights)
    for sample in memory_samples(4, seed=9):
        state, frame = inputs_of(sample, act.config)
        expected = predictions(model, [(state, frame)])[0].numpy()
        assert expected.std() > 1e-3
        for _ in range(2):  # twice, because each inference uses the same buffers
            assert np.abs(policy.run(state[0].numpy(), [frame.numpy()]) - expected).max() < 1e-5
    policy.set_threads(2)
    assert policy.threads == 2
    assert np.abs(policy.run(state[0].numpy(), [frame.numpy()]) - expected).max() < 1e-5


def test_a_wrong_hef_is_refused_by_its_parity(packed, tmp_path):
    """Its network may have been right in the emulator. This one takes all colours for black."""
    with zipfile.ZipFile(packed["backbone"]) as z:
        hef = z.read("archive/network.hef")
    assert hef.count(b"[123.675, 116.28, 103.53]") == 1
    wrong = repacked(
        packed["backbone"],
        tmp_path,
        network_hef=hef.replace(b"[123.675, 116.28, 103.53]", b"[9999.99, 9999.9, 9999.9]"),
    )
    with pytest.raises(ArtifactError, match="computes something else here than where it was made"):
        load_policy(wrong)


def test_what_cannot_run_here_says_so(packed, tmp_path, monkeypatch):
    with pytest.raises(ArtifactError, match="Invalid HEF"):
        load_policy(repacked(packed["backbone"], tmp_path, network_hef=b"no HEF"))
    with zipfile.ZipFile(packed["whole"]) as z:
        other = z.read("archive/network.hef")
    with pytest.raises(ArtifactError, match="its HEF has"):
        load_policy(repacked(packed["backbone"], tmp_path, network_hef=other))
    with pytest.raises(ArtifactError, match="does not say how its network runs"):
        with zipfile.ZipFile(packed["whole"]) as z:
            manifest = z.read("archive/extra/manifest.json").replace(b'"network": "whole"', b'"network": "half"')
        load_policy(repacked(packed["whole"], tmp_path, manifest_json=manifest))
    monkeypatch.delitem(sys.modules, engines.MODULES[engines.HAILO], raising=False)
    monkeypatch.setitem(sys.modules, "hailo_platform", None)
    with pytest.raises(ArtifactError, match="needs hailo_platform, which cannot be imported here"):
        load_policy(packed["whole"])


def test_a_chip_that_answers_no_more_is_no_action(packed, monkeypatch):
    policy = load_policy(packed["whole"])
    monkeypatch.setattr(hailo_standin.Configured, "fails", True)
    (sample,) = memory_samples(1)
    with pytest.raises(RuntimeError, match="timeout"):
        policy.predict_chunk(sample.picture, sample.state)


def test_it_is_an_artifact_and_no_release_yet(packed):
    assert kinds_of(packed["backbone"]) == ("artifact",)
    with pytest.raises(ArtifactError, match="hailo_platform"):
        inspect_artifact(packed["backbone"], allow=("camera",))
