"""A kit for Hailo's compiler, and compile.py, which makes an artifact of it.

That such artifacts compute what the policy does is seen in tests/onboard/policy/test_hailo_engine.py.
"""

import json
import re
import shutil
import zipfile

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
from rover_lib.workshop.act import ACT, imagenet, inputs_of


@pytest.fixture
def kit(hailo_kit, tmp_path, monkeypatch):
    hailo_standin.install(monkeypatch)
    return shutil.copytree(hailo_kit, tmp_path / "kit")


def test_networks_have_fixed_shapes_of_few_ranks(tiny):
    checkpoint = normalised(tiny)
    front, whole, _ = networks(ACT(checkpoint.config, checkpoint.weights))
    for network in (front, whole):
        inferred = onnx.shape_inference.infer_shapes(network.model, strict_mode=True).graph
        for value in [*inferred.input, *inferred.output, *inferred.value_info]:
            sizes = [d.dim_value for d in value.type.tensor_type.shape.dim]
            assert all(sizes) and len(sizes) <= 4, value.name
        assert all(len(shape) == 4 and shape[0] == 1 for shape in network.inputs.values())
        onnx.checker.check_model(network.model, full_check=True)
        ends = [node.op_type for node in network.model.graph.node if node.name in network.outputs.values()]
        assert ends == ["Conv" if network is front else "Add"]


@pytest.mark.parametrize("network", ["backbone", "whole"])
def test_compiles_what_was_recorded_and_packs_it(kit, tiny, network):
    config = normalised(tiny).config
    hef = hailo_compile.compile_network(kit, "hailo8", network)
    calibrated = hailo_standin.ClientRunner.calibrated
    frames = next(v for v in calibrated.values() if v.dtype == np.uint8)
    states = next((v for v in calibrated.values() if v.dtype == np.float32), None)
    assert len(frames) == FRAMES and (states is None) == (network == "backbone")
    for i, sample in enumerate(memory_samples(FRAMES)):
        assert np.array_equal(frames[i], inputs_of(sample, config)[1].numpy())
        wanted = sample.state * np.array([2, 3]) + np.array([0.1, -0.2])
        assert states is None or np.allclose(states[i, 0, 0], wanted, atol=1e-6)
    with zipfile.ZipFile(hailo_compile.pack(kit, "hailo8", network, hef)) as z:
        assert z.read("archive/network.hef") == hef.read_bytes()
        assert ("archive/model.onnx" in z.namelist()) == (network == "backbone")
        manifest = json.loads(z.read("archive/extra/manifest.json"))
    assert manifest["hailo"]["chip"] == "hailo8" and manifest["engine"] == "hailo"
    assert set(manifest["parity"]["tolerance"].values()) == {2.5e-4}  # of what this kit's INT8 may be off


def test_model_scripts_normalise_and_the_kit_lists_its_files(kit):
    script = (kit / "backbone.alls").read_text()
    mean, std = (json.loads(x) for x in re.search(r"normalization\((\[.*?\]), (\[.*?\])\)", script).groups())
    norm = imagenet()  # pixel / 255 * scale + shift
    assert np.allclose([-m / s for m, s in zip(mean, std, strict=True)], norm.shift, atol=1e-4)
    assert np.allclose([255 / s for s in std], norm.scale, rtol=1e-5)
    assert f"calibset_size={FRAMES}" in script
    listed = (kit / "KIT.md").read_text().replace("<camera>", "cam_front")
    assert all(path.name in listed for path in kit.iterdir() if path.name != "KIT.md")


def test_other_names_of_inputs_are_refused(kit, monkeypatch):
    monkeypatch.setattr(hailo_standin.ClientRunner, "first", 0)
    with pytest.raises(SystemExit, match="input_layer1 for 'state'"):
        hailo_compile.compile_network(kit, "hailo8", "whole")
    assert not list(kit.glob("*.hef"))


def test_too_few_frames_or_a_folder_that_exists_or_a_failure_leave_nothing(tiny, tmp_path, monkeypatch):
    loaded = opened(normalised(tiny))
    with pytest.raises(ArtifactError, match="1024 frames"):
        kits.write_kit(loaded, tmp_path, tmp_path / "kit")
    with pytest.raises(ArtifactError):
        kits.write_kit(loaded, tmp_path / "no run", tmp_path / "kit", samples=FRAMES)
    assert not list(tmp_path.iterdir())
    (tmp_path / "link").symlink_to("gone")  # onto which no folder can be moved
    with pytest.raises(ArtifactError, match="exists"):
        kits.write_kit(loaded, tmp_path, tmp_path / "link", samples=FRAMES)
