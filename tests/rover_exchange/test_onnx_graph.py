"""Policies written as ONNX, run by ONNX Runtime, against the same modules run by torch."""

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import nn

from rover_exchange.onnx_graph import onnx_model, stack_stem
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.policy.onnx_engine import session_of
from rover_lib.workshop.act import ACT, ActConfig, inputs_of, predictions
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.int8.observe import calibrate
from rover_lib.workshop.int8.quantize import graph_of, int8_layers, quantize
from rover_lib.workshop.int8.scheme import Scheme
from tests.helpers.command import rover
from tests.helpers.policies import (
    TINY,
    MemorySample,
    lerobot_policy,
    memory_samples,
    saved,
    saved_normalised,
    smooth_frame,
)

SHAPES = {
    "tiny": TINY,
    "pre-norm, gelu": {**TINY, "pre_norm": True, "feedforward_activation": "gelu", "n_decoder_layers": 3},
    "dilation": {**TINY, "vision_backbone": "resnet50", "replace_final_stride_with_dilation": True},
    "two cameras, odd": {**TINY, "cameras": {"observation.images.a": (75, 131), "observation.images.b": (64, 96)}},
}


def named(inputs, config: ActConfig) -> dict[str, torch.Tensor]:
    return dict(zip(["state", *(f"frame_{c}" for c in config.cameras)], inputs, strict=True))


def answers(model: onnx.ModelProto, inputs, config: ActConfig, exact: bool = False) -> np.ndarray:
    """exact: with nothing fused, so that INT8 gives what its numbers say; fusing two cameras of odd sizes fails."""
    content, options = model.SerializeToString(), onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    run = (onnxruntime.InferenceSession(content, options) if exact else session_of(content, threads=1)).run
    return np.concatenate([run(None, {k: v.numpy() for k, v in named(x, config).items()})[0] for x in inputs])


def observations(config: ActConfig, count: int = 3) -> list[tuple[torch.Tensor, ...]]:
    rng = np.random.default_rng(3)
    made = []
    for _ in range(count):
        state = rng.uniform(-0.5, 0.5, (1, len(config.state_names))).astype(np.float32)
        frames = (rng.integers(0, 256, (*size, 3), np.uint8) for size in config.image_sizes)
        made.append((torch.from_numpy(state), *(torch.from_numpy(f) for f in frames)))
    return made


@pytest.mark.parametrize("name", ["tiny", *(pytest.param(n, marks=pytest.mark.slow) for n in SHAPES if n != "tiny")])
def test_float_policy_is_the_same(name, tmp_path):
    saved(lerobot_policy(**SHAPES[name]), tmp_path)
    checkpoint = load_checkpoint(tmp_path)
    model = ACT(checkpoint.config, checkpoint.weights)
    inputs = observations(checkpoint.config)
    written = onnx_model(graph_of(model), named(inputs[0], checkpoint.config), ("chunk",))
    expected = predictions(model, inputs).numpy()
    # Sums in another order, which a ResNet-50 has many of
    tolerance = 2e-5 if name == "dilation" else 4e-6
    assert np.abs(answers(written, inputs, checkpoint.config) - expected).max() < tolerance
    assert {o.domain for o in written.opset_import} == {""}
    assert not [i for i in written.graph.initializer if i.external_data]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tiny", "two cameras, odd"])
def test_int8_policy_is_the_same_up_to_flipped_roundings(name, tmp_path):
    """Two cameras share a backbone's weights, but not the steps of its numbers."""
    saved(lerobot_policy(**SHAPES[name]), tmp_path)
    checkpoint, rng = load_checkpoint(tmp_path), np.random.default_rng(0)
    sizes = dict(zip(checkpoint.config.cameras, checkpoint.config.image_sizes, strict=True))
    samples = []
    for s in memory_samples(12):
        seen = {camera: smooth_frame(rng, *size) // at for at, (camera, size) in enumerate(sizes.items(), 1)}
        samples.append(MemorySample(s.state, seen))
    quantized = quantize(checkpoint, Scheme(), calibrate(checkpoint, samples[:8]))
    inputs = [inputs_of(s, checkpoint.config) for s in samples[8:]]
    written = onnx_model(graph_of(quantized.module), named(inputs[0], checkpoint.config), ("chunk",))
    torchs = predictions(quantized.module, inputs).numpy()
    own_error = np.abs(torchs - predictions(ACT(checkpoint.config, checkpoint.weights), inputs).numpy()).max()
    # A rounding that flips grows over the layers: 0.4 times its own error to FP32
    found = answers(written, inputs, checkpoint.config, exact=len(sizes) > 1)
    assert np.abs(found - torchs).max() < 1.5 * own_error
    assert len(written.SerializeToString()) < 15e6  # 12 with one camera
    stored = {i.name: onnx.numpy_helper.to_array(i) for i in written.graph.initializer}
    for layer_name, layer in int8_layers(quantized.module).items():
        weight = layer.weight().int_repr()
        weight = stack_stem(weight) if layer_name == "backbone.stem.0" else weight
        assert np.array_equal(stored[f"{layer_name}.weight"], weight.numpy())


def test_part_with_two_outputs():
    class Part(nn.Module):
        def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return x.transpose(1, 2), x + x

    x = torch.randn(1, 2, 3)
    written = onnx_model(graph_of(Part()), {"x": x}, ("turned", "twice"))
    turned, twice = session_of(written.SerializeToString(), 1).run(None, {"x": x.numpy()})
    assert np.array_equal(turned, x.transpose(1, 2).numpy()) and np.array_equal(twice, 2 * x.numpy())
    with pytest.raises(ArtifactError, match="Tanh has no form in ONNX"):
        onnx_model(graph_of(nn.Sequential(nn.Tanh())), {"x": torch.zeros(1, 2)}, ("y",))


def test_a_checkpoint_alone_becomes_a_graph_that_computes_what_lerobot_does(tmp_path, monkeypatch):
    """The contract in export_graph's docstring: names, shapes, RGB bytes in, actions out; no recordings, no run."""
    monkeypatch.chdir(tmp_path)
    policy = lerobot_policy(**TINY)
    inner, outer = saved_normalised(policy, tmp_path / "my policy")
    assert (done := rover("export", "my policy", "--onnx")).exit_code == 0, done.output
    session = onnxruntime.InferenceSession("my policy.onnx")
    shapes = {each.name: (each.type, each.shape) for each in (*session.get_inputs(), *session.get_outputs())}
    frame_name = "frame_cam_front"
    wanted = {"state": ("tensor(float)", [1, 2]), frame_name: ("tensor(uint8)", [72, 128, 3])}
    assert shapes == wanted | {"chunk": ("tensor(float)", [1, 32, 2])}
    known = session.get_modelmeta().custom_metadata_map
    assert known["guessed"] == "actions,rate" and known["actions"] == "steering,throttle"
    rgb, state = smooth_frame(np.random.default_rng(1), 72, 128), np.float32([[0.3, 0.1]])
    picture = torch.from_numpy(rgb).permute(2, 0, 1).float() / 255
    seen = inner({"observation.images.cam_front": picture, "observation.state": torch.from_numpy(state[0])})
    with torch.inference_mode():
        expected = outer(policy.predict_action_chunk(seen)[0]).numpy()[None]
    (chunk,) = session.run(None, {"state": state, frame_name: rgb})
    assert expected.std() > 1e-3 and np.abs(chunk - expected).max() < 1e-5
    (turned,) = session.run(None, {"state": state, frame_name: rgb[..., ::-1].copy()})
    assert np.abs(turned - expected).max() > 1e-4  # BGR would be another picture
    assert rover("export", "my policy", "--card").exit_code == 1  # which is of a run
