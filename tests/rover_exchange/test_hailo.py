"""A kit for Hailo's compiler, compile.py, which makes an artifact of it, and its engine on a stand-in for HailoRT."""

import json
import re
import sys
import zipfile
from dataclasses import replace
from types import SimpleNamespace

import hailo_standin
import numpy as np
import onnx
import pytest
from archives import rewritten
from policies import memory_samples

from rover_exchange.hailo import compile as hailo_compile
from rover_exchange.hailo import kit as kits
from rover_exchange.hailo.networks import networks
from rover_lib.onboard.artifact import engines
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.workshop.act import ACT, Affine, inputs_of, predictions
from rover_lib.workshop.int8.export import Exporter
from rover_lib.workshop.recordings.episodes import Split
from rover_lib.workshop.run.session import Opened

pytestmark = pytest.mark.slow  # a kit takes ten seconds to make
FRAMES = 6


@pytest.fixture(scope="module")
def checkpoint(tiny):
    """A tiny policy whose state, actions and colours are all normalised."""
    norms = {"state_norm": Affine((2.0, 3.0), (0.1, -0.2)), "action_unnorm": Affine((0.2, 0.1), (0.05, 0.3))}
    return replace(tiny, config=replace(tiny.config, **norms))


@pytest.fixture(scope="module")
def opened(checkpoint):
    parts = Split(tuple(memory_samples(FRAMES)), tuple(memory_samples(4, seed=1)), (), None)
    return Opened(checkpoint, None, parts)


@pytest.fixture(scope="module")
def kit(checkpoint, opened, tmp_path_factory):
    """FP32 stands for the run's static INT8 too: the stand-in for the chip quantizes nothing."""
    folder, exporter = tmp_path_factory.mktemp("run"), Exporter(checkpoint, memory_samples(4, seed=1))
    for name in ("policy_fp32.pt", "policy_static.pt"):
        exporter.export(exporter.float_policy, folder / name)
    kits.write_kit(opened, folder, folder / "kit", samples=FRAMES)
    return folder / "kit"


@pytest.fixture(scope="module")
def packed(kit):
    """The artifact, compiled and packed."""
    return hailo_compile.pack(kit, "hailo8", hailo_standin.compile_kit(kit))


@pytest.fixture(autouse=True)
def hailort(monkeypatch):
    hailo_standin.install(monkeypatch)
    monkeypatch.delitem(sys.modules, engines.MODULES[engines.HAILO], raising=False)
    yield
    sys.modules.pop(engines.MODULES[engines.HAILO], None)


def test_the_network_has_fixed_shapes_of_few_ranks(checkpoint):
    network, _ = networks(ACT(checkpoint.config, checkpoint.weights))
    inferred = onnx.shape_inference.infer_shapes(network.model, strict_mode=True).graph
    for value in [*inferred.input, *inferred.output, *inferred.value_info]:
        sizes = [d.dim_value for d in value.type.tensor_type.shape.dim]
        assert all(sizes) and len(sizes) <= 4, value.name
    onnx.checker.check_model(network.model, full_check=True)
    assert [node.op_type for node in network.model.graph.node if node.name == network.end] == ["Conv"]


def test_a_kit_is_packed_with_what_was_recorded(kit, packed, checkpoint):
    frames = np.load(kit / "calibration_frame_cam_front.npy")
    for frame, sample in zip(frames, memory_samples(FRAMES), strict=True):
        assert np.array_equal(frame, inputs_of(sample, checkpoint.config)[1].numpy())
    with zipfile.ZipFile(packed) as z:
        assert z.read("archive/network.hef") == (kit / "backbone.hef").read_bytes()
        assert "archive/model.onnx" in z.namelist()
        manifest = json.loads(z.read("archive/extra/manifest.json"))
    assert manifest["hailo"]["chip"] == "hailo8" and manifest["engine"] == "hailo"
    assert set(manifest["parity"]["tolerance"].values()) == {2.5e-4}  # of what this kit's INT8 may be off


def test_what_makes_no_kit_leaves_nothing(opened, tmp_path):
    """Too few frames; no run; two cameras; a folder that is there."""
    for samples in (1024, FRAMES):
        with pytest.raises(ArtifactError):
            kits.write_kit(opened, tmp_path / "no run", tmp_path / "kit", samples=samples)
    with pytest.raises(ArtifactError):
        networks(SimpleNamespace(config=SimpleNamespace(sees_state=True, cameras=("left", "right"))))
    assert not list(tmp_path.iterdir())
    (tmp_path / "link").symlink_to("gone")  # onto which no folder can be moved
    with pytest.raises(ArtifactError, match="exists"):
        kits.write_kit(opened, tmp_path, tmp_path / "link", samples=FRAMES)


def test_the_engine_computes_the_policy(packed, checkpoint):
    policy, model = load_policy(packed, threads=1), ACT(checkpoint.config, checkpoint.weights)
    for sample in memory_samples(4, seed=9):
        state, frame = inputs_of(sample, checkpoint.config)
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
