"""A student begins as a part of its teacher."""

from dataclasses import replace

import pytest
import torch
from policies import memory_samples

from rover_learn.student import StudentShape, initial_weights, student_config
from rover_lib.onboard.errors import CheckpointError, DistillError
from rover_lib.workshop.act import ACT, expected_shapes, inputs_of, predictions


@pytest.fixture(scope="module")
def inputs(tiny):
    return [inputs_of(s, tiny.config) for s in memory_samples(6)]


def shapes(weights):
    return {name: tuple(weight.shape) for name, weight in weights.items()}


def test_at_another_size_it_is_the_teacher(tiny):
    config = student_config(tiny, StudentShape(54, 96))
    weights, narrowed = initial_weights(tiny, config, [])
    assert (config.image_sizes, config.vae_layers, narrowed) == (((54, 96),), 0, [])
    assert shapes(weights) == expected_shapes(config)
    smaller = tiny.at_size(54, 96)
    observations = [inputs_of(s, config) for s in memory_samples(2)]
    expected = predictions(ACT(smaller.config, smaller.weights), observations)
    assert torch.equal(predictions(ACT(config, weights), observations), expected)


def test_the_first_decoder_layers_stay(tiny, inputs):
    config = student_config(tiny, StudentShape(decoder_layers=1, feedforward=48))
    weights, _ = initial_weights(tiny, config, inputs)
    assert shapes(weights) == expected_shapes(config)
    name = "decoder.layers.0.multihead_attn.in_proj_weight"
    assert torch.equal(weights[name], tiny.weights[name])


def test_units_that_do_nothing_are_the_ones_to_go(tiny, inputs):
    """Every second unit is made dead: leaving just these out changes nothing, so least squares must find as much."""
    dead = {k: v.clone() for k, v in tiny.weights.items()}
    for name in dead:
        if "vae" not in name and name.endswith("linear1.weight"):
            dead[name][::2] = 0
            dead[name.replace("weight", "bias")][::2] = -1
    config = student_config(tiny, StudentShape(feedforward=64))
    weights, narrowed = initial_weights(replace(tiny, weights=dead), config, inputs)
    assert torch.equal(weights["encoder.layers.0.linear1.weight"], dead["encoder.layers.0.linear1.weight"][1::2])
    expected = predictions(ACT(tiny.config, dead), inputs)
    assert (predictions(ACT(config, weights), inputs) - expected).abs().max() < 1e-5
    assert all(note["error_refit_pct"] < 1e-2 for note in narrowed)


def test_down_is_refitted_by_least_squares(tiny, inputs):
    """Against torch's lstsq on the activations themselves."""
    config = student_config(tiny, StudentShape(feedforward=32))
    weights, narrowed = initial_weights(tiny, config, inputs)
    assert len(narrowed) == 3
    note = next(n for n in narrowed if n["layer"] == "encoder.layers.0")
    hidden = []
    model = ACT(tiny.config, tiny.weights)
    down = model.encoder[0].feed_forward.down
    down.register_forward_pre_hook(lambda _, args: hidden.append(args[0][0].double()))
    predictions(model, inputs)
    h = torch.cat(hidden)
    all_units, bias = (tiny.weights[f"encoder.layers.0.linear1.{p}"] for p in ("weight", "bias"))
    kept = [int((all_units == row).all(1).nonzero()) for row in weights["encoder.layers.0.linear1.weight"]]
    wanted = h @ down.weight.T.double() + down.bias
    ones = torch.ones(len(h), 1, dtype=h.dtype)
    few = torch.cat([h[:, kept], ones], 1)
    best = (few @ torch.linalg.lstsq(few, wanted).solution - wanted).norm() / wanted.norm()
    refit = (
        h[:, kept] @ weights["encoder.layers.0.linear2.weight"].T.double() + weights["encoder.layers.0.linear2.bias"]
    )
    own = (refit - wanted).norm() / wanted.norm()
    assert best <= own < 1.1 * best + 1e-6
    assert own.item() == pytest.approx(note["error_refit_pct"] / 100, rel=1e-3)
    assert note["error_refit_pct"] < note["error_pct"]
    assert torch.equal(weights["encoder.layers.0.linear1.bias"], bias[kept])


@pytest.mark.parametrize(
    ("shape", "says"),
    [
        (StudentShape(height=144, width=256), "height must be from 1 to its teacher's, 72"),
        (StudentShape(decoder_layers=3), "decoder layers must be from 1 to its teacher's, 2, found 3"),
        (StudentShape(decoder_layers=0), "found 0"),
        (StudentShape(feedforward=129), "feed-forward must be from 1"),
        (StudentShape(backbone_channels=0), "above 0, at most 1, found 0"),
        (StudentShape(backbone_channels=1.5), "found 1.5"),
    ],
)
def test_a_student_is_no_larger_than_its_teacher(tiny, shape, says):
    with pytest.raises(DistillError, match=says):
        student_config(tiny, shape)


@pytest.mark.parametrize(("height", "width", "says"), [(72, 72, "aspect ratio"), (18, 32, "at least 32")])
def test_a_picture_that_the_policy_cannot_see_is_refused(tiny, height, width, says):
    with pytest.raises(CheckpointError, match=says):
        student_config(tiny, StudentShape(height, width))


def test_a_policy_of_an_arm_teaches_no_car(tiny):
    names = tuple(f"joint_{i}" for i in range(6))
    for other, found in ((names, "joint_0, joint_1, "), (("left", "right"), "of state left, right, of action left")):
        arm = replace(tiny, config=replace(tiny.config, state_names=other, action_names=other))
        with pytest.raises(DistillError, match=found):
            student_config(arm, StudentShape())


def test_channels_of_a_bottleneck_stay(tiny):
    deep = replace(tiny, config=replace(tiny.config, backbone="resnet50"))
    with pytest.raises(DistillError, match="basic blocks only, found resnet50"):
        student_config(deep, StudentShape(backbone_channels=0.5))


def test_units_are_chosen_by_frames(tiny):
    with pytest.raises(DistillError, match="needs frames"):
        initial_weights(tiny, student_config(tiny, StudentShape(feedforward=32)), [])
