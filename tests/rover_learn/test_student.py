"""A student begins as a part of its teacher."""

from dataclasses import replace

import pytest
import torch

from rover_learn.student import StudentShape, initial_weights, refit_layer, student_config
from rover_lib.onboard.errors import CheckpointError, TrainingError
from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.act_config import weight_shapes
from tests.helpers.policies import memory_samples


@pytest.fixture(scope="module")
def inputs(tiny):
    return [inputs_of(s, tiny.config) for s in memory_samples(6)]


def test_at_another_size_it_is_the_teacher(tiny):
    config = student_config(tiny, StudentShape(54, 96))
    weights = initial_weights(tiny, config, [])
    assert (config.image_sizes, config.vae_layers) == (((54, 96),), 0)
    assert {name: tuple(weight.shape) for name, weight in weights.items()} == weight_shapes(config)
    smaller = tiny.at_size(54, 96)
    observations = [inputs_of(s, config) for s in memory_samples(2)]
    expected = predictions(ACT(smaller.config, smaller.weights), observations)
    assert torch.equal(predictions(ACT(config, weights), observations), expected)


def test_a_refit_by_hand():
    """Of inputs a, c and b, the last is left out, and is always as a is: so a takes its weight, but for the ridge."""
    whole = torch.tensor([[3.0], [2.0], [1.0], [0.5]], dtype=torch.float64)  # of a, c, b, and the bias
    gram = torch.diag(torch.tensor([1.0, 3.0, 1.0, 1.0], dtype=torch.float64))
    gram[0, 2] = gram[2, 0] = 1
    refit = refit_layer(whole, gram, torch.tensor([0, 1]))
    ridge = 1e-4 * (1 + 3) / 2
    assert refit.flatten().tolist() == pytest.approx([3 + 1 / (1 + ridge), 2, 0.5], abs=1e-9)


def test_units_that_do_nothing_are_the_ones_to_go(tiny, inputs):
    """Every second unit is made dead: leaving just these out changes nothing, so least squares must find as much."""
    dead = {k: v.clone() for k, v in tiny.weights.items()}
    for name in dead:
        if "vae" not in name and name.endswith("linear1.weight"):
            dead[name][::2] = 0
            dead[name.replace("weight", "bias")][::2] = -1
    config = student_config(tiny, StudentShape(feedforward=64))
    weights = initial_weights(replace(tiny, weights=dead), config, inputs)
    assert torch.equal(weights["encoder.layers.0.linear1.weight"], dead["encoder.layers.0.linear1.weight"][1::2])
    expected = predictions(ACT(tiny.config, dead), inputs)
    assert (predictions(ACT(config, weights), inputs) - expected).abs().max() < 1e-5


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"height": 144}, TrainingError),
        ({"decoder_layers": 3}, TrainingError),
        ({"feedforward": 0}, TrainingError),
        ({"backbone_channels": 0}, TrainingError),
        ({"height": 72, "width": 72}, CheckpointError),  # another aspect ratio
    ],
)
def test_a_student_is_no_larger_than_its_teacher_and_sees_as_it_does(tiny, wrong, error):
    with pytest.raises(error):
        student_config(tiny, StudentShape(**wrong))


def test_an_arm_teaches_no_car_and_channels_of_a_bottleneck_stay(tiny):
    arm = replace(tiny.config, state_names=("left", "right"), action_names=("left", "right"))
    for config in (arm, replace(tiny.config, backbone="resnet50")):
        with pytest.raises(TrainingError):
            student_config(replace(tiny, config=config), StudentShape(backbone_channels=0.5))
