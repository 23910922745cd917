"""The trainable form of static INT8 rounds as the real one does."""

import pytest
import torch
from policies import TINY, lerobot_policy, memory_samples, saved, trainer_content

from rover_learn.fake_quant import RoundedPolicy, parameters
from rover_lib.workshop.act import ACT, inputs_of
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
