"""The trainable form of static INT8 rounds as the real one does."""

import pytest
import torch
from policies import TINY, lerobot_policy, memory_samples, saved, trainer_content
from torch.func import functional_call

from rover_learn.fake_quant import RoundedPolicy, parameters
from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.int8.observe import calibrate, scale_model
from rover_lib.workshop.int8.quantize import int8_layers, quantize
from rover_lib.workshop.int8.scheme import Scheme


@pytest.fixture(scope="module")
def rounded(tiny, calibration):
    return RoundedPolicy(tiny, Scheme("static"), calibration)


@pytest.fixture(scope="module")
def batch(tiny):
    inputs = [inputs_of(s, tiny.config) for s in memory_samples(3, seed=2)]
    return torch.stack([frame for _, frame in inputs]), torch.cat([state for state, _ in inputs])


def test_its_parameters_are_the_policys(tiny):
    model = dict(ACT(tiny.config, tiny.weights, for_int8=True).named_parameters())
    made = {}
    for name, (weight, bias) in parameters(tiny.config, tiny.weights):
        made |= {f"{name}.weight": weight, f"{name}.bias": bias}
    assert made.keys() == model.keys()
    assert all(torch.equal(value.reshape(model[name].shape), model[name]) for name, value in made.items())


@pytest.mark.slow
def test_its_weights_are_the_int8_weights_to_the_last_bit(tiny, calibration, rounded):
    layers = int8_layers(quantize(tiny, Scheme("static"), calibration).module)
    made = rounded.parameters_of(tiny.weights)
    assert rounded.rounds == set(layers)
    for name, layer in layers.items():
        weight = made[f"{rounded._places[name]}.weight"]
        assert (weight - layer.weight().dequantize()).abs().max() <= 1e-6 * weight.abs().max()


@pytest.mark.slow
def test_every_layer_gives_what_the_int8_layer_gives(tiny, calibration, rounded, batch):
    """Given each INT8 layer's input, it differs by a step only where XNNPACK breaks a tie the other way."""
    quantized = quantize(tiny, Scheme("static"), calibration).module
    seen = {}
    for name, layer in int8_layers(quantized).items():
        layer.register_forward_hook(lambda m, args, out, name=name: seen.update({name: (m, args[0], out)}))
    frames, states = batch
    with torch.no_grad():
        quantized(states[:1], frames[0])
        made = rounded.parameters_of(tiny.weights)
        for name, (layer, x, out) in seen.items():
            place = rounded._places[name]
            own = {key.removeprefix(f"{place}."): v for key, v in made.items() if key.startswith(f"{place}.")}
            module = rounded.graph.get_submodule(place)
            y = functional_call(module, own | {"weight": own["weight"].view_as(module.weight)}, (x.dequantize(),))
            y = y.relu() if place != name else y
            y = torch.fake_quantize_per_tensor_affine(y, layer.scale, layer.zero_point, -128, 127)
            steps = ((y - out.dequantize()) / layer.scale).round().abs()
            ties = 1e-3 * steps.numel()  # about; how many fall on a layer is chance
            assert steps.max() <= 1 and steps.sum() <= max(3, ties + 4 * ties**0.5), name


@pytest.mark.slow
def test_it_loses_as_much_as_the_int8_policy(tiny, calibration, rounded, batch):
    """Over the layers, flipped ties grow as large as INT8's error itself, so only the error's size can be compared."""
    frames, states = batch
    inputs = [(state[None], frame) for state, frame in zip(states, frames, strict=True)]
    exact = predictions(ACT(tiny.config, tiny.weights), inputs)
    int8 = predictions(quantize(tiny, Scheme("static"), calibration).module, inputs)
    with torch.no_grad():
        planned = rounded(tiny.weights, frames, states)
    assert 0.5 < (planned - exact).abs().mean() / (int8 - exact).abs().mean() < 2


@pytest.mark.slow
def test_gradients_reach_what_is_computed_from_observations(tiny, rounded, batch):
    weights = {name: value.clone().requires_grad_() for name, value in tiny.weights.items()}
    rounded(weights, *batch).square().sum().backward()
    reached = {name for name, value in weights.items() if value.grad is not None and value.grad.any()}
    assert {"backbone.conv1.weight", "backbone.layer4.1.bn2.weight", "action_head.weight"} <= reached
    assert {"encoder.layers.0.self_attn.in_proj_weight", "decoder.layers.1.linear2.weight"} <= reached
    constant = {
        "decoder_pos_embed.weight",
        "decoder.layers.0.self_attn.in_proj_weight",
        "encoder_latent_input_proj.bias",
    }
    assert not constant & reached and not any(name.startswith("vae_") for name in reached)


@pytest.mark.slow
def test_without_channel_scales(tiny, batch):
    calibration = calibrate(tiny, memory_samples(4), smooth=None)
    rounded = RoundedPolicy(tiny, Scheme("static", smooth=None), calibration)
    frames, states = batch[0][:1], batch[1][:1]
    with torch.no_grad():
        planned = rounded(tiny.weights, frames, states)
    exact = predictions(ACT(tiny.config, tiny.weights), [(states, frames[0])])
    assert 0 < (planned - exact).abs().mean() < 0.1 * exact.abs().mean()


@pytest.mark.slow
def test_its_gradients_lead_to_what_float_plans(tiny, rounded, batch):
    """Small steps along the gradients remove a part of what INT8 loses on one observation.

    Which step does so depends on which roundings flip, and so on the processor.
    """
    frames, states = batch[0][:1], batch[1][:1]
    with torch.no_grad():
        wanted = ACT(tiny.config, tiny.weights)(states, frames[0])
    weights = {name: value.clone().requires_grad_() for name, value in tiny.weights.items()}
    optimizer = torch.optim.Adam(weights.values(), lr=2e-7)
    losses = []
    for _ in range(6):
        optimizer.zero_grad()
        loss = (rounded(weights, frames, states) - wanted).abs().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert min(losses[1:]) < 0.9 * losses[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape", [{"pre_norm": True}, {"feedforward_activation": "gelu"}, {"vision_backbone": "resnet50"}]
)
def test_other_shapes(shape, tmp_path):
    policy = lerobot_policy(**TINY, **shape)
    if "vision_backbone" in shape:
        torch.save(trainer_content(policy), tmp_path / "best_model.pth")
        checkpoint = load_checkpoint(tmp_path / "best_model.pth")
    else:
        saved(policy, tmp_path)
        checkpoint = load_checkpoint(tmp_path)
    calibration = calibrate(checkpoint, memory_samples(4))
    rounded = RoundedPolicy(checkpoint, Scheme("static"), calibration)
    expected = dict(scale_model(checkpoint, calibration, for_int8=True).named_parameters())
    rounded.rounds = set()
    made = rounded.parameters_of(checkpoint.weights)
    assert {name.replace(".0.weight", ".weight") for name in made}
    for name, place in rounded._places.items():
        for part in ("weight", "bias"):
            ours, theirs = made[f"{place}.{part}"], expected[f"{name}.{part}"]
            assert (ours.reshape(theirs.shape) - theirs).abs().max() <= 1e-6 * theirs.abs().max()
