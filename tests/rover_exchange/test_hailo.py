"""A kit for Hailo's compiler, and compile.py, which makes an artifact of it.

That such artifacts compute what the policy does is seen in tests/onboard/policy/test_hailo_engine.py.
"""

import json
import shutil
import zipfile
from types import SimpleNamespace

import hailo_standin
import numpy as np
import onnx
import pytest
from hailo_kit import FRAMES, normalised, opened
from policies import memory_samples

from rover_exchange.hailo import compile as hailo_compile
from rover_exchange.hailo import kit as kits
from rover_exchange.hailo.networks import networks
from rover_lib.onboard.errors import ArtifactError
from rover_lib.workshop.act import ACT, inputs_of


def test_the_network_has_fixed_shapes_of_few_ranks(tiny):
    checkpoint = normalised(tiny)
    network, _ = networks(ACT(checkpoint.config, checkpoint.weights))
    inferred = onnx.shape_inference.infer_shapes(network.model, strict_mode=True).graph
    for value in [*inferred.input, *inferred.output, *inferred.value_info]:
        sizes = [d.dim_value for d in value.type.tensor_type.shape.dim]
        assert all(sizes) and len(sizes) <= 4, value.name
    onnx.checker.check_model(network.model, full_check=True)
    assert [node.op_type for node in network.model.graph.node if node.name == network.end] == ["Conv"]


def test_a_kit_is_packed_with_what_was_recorded(hailo_kit, tiny, tmp_path):
    kit = shutil.copytree(hailo_kit, tmp_path / "kit")
    frames = np.load(kit / "calibration_frame_cam_front.npy")
    for frame, sample in zip(frames, memory_samples(FRAMES), strict=True):
        assert np.array_equal(frame, inputs_of(sample, normalised(tiny).config)[1].numpy())
    hef = hailo_standin.compile_kit(kit)
    with zipfile.ZipFile(hailo_compile.pack(kit, "hailo8", hef)) as z:
        assert z.read("archive/network.hef") == hef.read_bytes() and "archive/model.onnx" in z.namelist()
        manifest = json.loads(z.read("archive/extra/manifest.json"))
    assert manifest["hailo"]["chip"] == "hailo8" and manifest["engine"] == "hailo"
    assert set(manifest["parity"]["tolerance"].values()) == {2.5e-4}  # of what this kit's INT8 may be off


def test_what_makes_no_kit_leaves_nothing(tiny, tmp_path):
    """Too few frames; no run; two cameras; a folder that is there."""
    loaded = opened(normalised(tiny))
    for samples in (1024, FRAMES):
        with pytest.raises(ArtifactError):
            kits.write_kit(loaded, tmp_path / "no run", tmp_path / "kit", samples=samples)
    with pytest.raises(ArtifactError):
        networks(SimpleNamespace(config=SimpleNamespace(sees_state=True, cameras=("left", "right"))))
    assert not list(tmp_path.iterdir())
    (tmp_path / "link").symlink_to("gone")  # onto which no folder can be moved
    with pytest.raises(ArtifactError, match="exists"):
        kits.write_kit(loaded, tmp_path, tmp_path / "link", samples=FRAMES)
