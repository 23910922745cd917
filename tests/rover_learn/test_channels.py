"""Channels are left out of a backbone: LeRobot's shape stays, nothing else changes, and training keeps them out."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from rover_learn.channels import _leave_out, without_channels
from rover_learn.lessons import BatchedPolicy
from rover_learn.student import Gram
from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.int8.observe import calibrate
from rover_lib.workshop.int8.quantize import int8_layers, quantize
from rover_lib.workshop.int8.scheme import Scheme
from tests.helpers.policies import memory_samples

BLOCKS = [f"backbone.layer{stage}.{block}" for stage in (1, 2, 3, 4) for block in (0, 1)]
PARTS = ("conv1.weight", "bn1.weight", "bn1.bias")


@pytest.fixture(scope="module")
def thin(tiny):
    """Return the tiny policy with every second inner channel zero.

    In half of the blocks the bias is negative, so that only the ReLU makes the channel zero.
    """
    weights = {k: v.clone() for k, v in tiny.weights.items()}
    for i, name in enumerate(BLOCKS):
        for part in PARTS:
            weights[f"{name}.{part}"][::2] = 0
        weights[f"{name}.bn1.bias"][::2] = -(i % 2)
    return replace(tiny, weights=weights)


def lerobots(checkpoint, samples):
    """Return the chunks, (n, C, A), that LeRobot's own forward plans."""
    policy = BatchedPolicy(checkpoint.config, checkpoint.weights)
    states, frames = zip(*(inputs_of(s, checkpoint.config) for s in samples), strict=True)
    with torch.inference_mode():
        return policy(torch.stack(frames), torch.cat(states))


def test_channels_that_are_always_zero_are_not_there_and_nothing_changes(tiny, thin):
    model, samples = ACT(thin.config, thin.weights), memory_samples(2)
    assert model.backbone.layer4[1].body[0].weight.shape == (256, 512, 3, 3)
    assert model.backbone.layer4[1].body[2].weight.shape == (512, 256, 3, 3)
    expected = lerobots(thin, samples)
    assert expected.std() > 1e-3 and (expected - lerobots(tiny, samples)).abs().max() > 1e-3
    assert (predictions(model, [inputs_of(s, thin.config) for s in samples]) - expected).abs().max() < 1e-5


def patches_of(h):
    return F.unfold(h, 3, padding=1).transpose(1, 2).flatten(0, 1)


@pytest.fixture
def block():
    """Return a block's weights by LeRobot's names, and 8 channels: 4 mix the other 4, of which one is constant."""
    generator = torch.Generator().manual_seed(0)
    h = torch.rand(20, 8, 5, 6, generator=generator)
    h[:, [1, 3, 4, 7]] = torch.einsum("oi,nihw->nohw", torch.rand(4, 4, generator=generator), h[:, [0, 2, 5, 6]])
    h[:, 5] = 0.7
    sizes = {"conv1.weight": (8, 6, 3, 3), "conv2.weight": (6, 8, 3, 3), "bn1.weight": (8,), "bn1.bias": (8,)}
    sizes |= {"bn2.weight": (6,), "bn2.bias": (6,), "bn2.running_var": (6,)}
    gram = Gram()
    gram.add(patches_of(h))
    weights = {f"b.{name}": torch.rand(size, generator=generator) + 0.1 for name, size in sizes.items()}
    return SimpleNamespace(h=h, weights=weights, gram=gram.mean())


def test_the_reader_is_refitted_by_least_squares(block):
    """Compare with torch's lstsq on the patches themselves."""
    kept, before = torch.tensor([0, 2]), {k: v.clone() for k, v in block.weights.items()}
    _leave_out(block.weights, "b", kept, block.gram)
    w = block.weights
    assert not w["b.conv1.weight"][[1, 3, 4, 5, 6, 7]].any() and not w["b.conv2.weight"][:, [1, 3, 4, 5, 6, 7]].any()
    assert torch.equal(w["b.conv1.weight"][kept], before["b.conv1.weight"][kept])

    def normed(weights, h):
        gain = weights["b.bn2.weight"] / (weights["b.bn2.running_var"] + 1e-5).sqrt()
        out = F.conv2d(h, weights["b.conv2.weight"], padding=1).transpose(0, 1).flatten(1)
        return out * gain[:, None], weights["b.bn2.bias"][:, None]

    (wanted, shift), (own, own_shift) = normed(before, block.h), normed(w, block.h)
    few = patches_of(block.h[:, kept]).double()
    few = torch.cat([few, few.new_ones(len(few), 1)], 1)
    best = few @ torch.linalg.lstsq(few, wanted.T.double()).solution - wanted.T
    off = (own + own_shift - wanted - shift).norm()
    assert best.norm() <= off < 1.01 * best.norm()


@pytest.mark.slow
def test_a_policy_in_lerobots_shape_that_computes_half(tiny):
    """Its INT8 layers in the blocks have half the channels, and its plans are LeRobot's."""
    pictures = torch.stack([inputs_of(s, tiny.config)[1] for s in memory_samples(16)])
    made = without_channels(tiny.weights, tiny.config, 0.5, pictures.split(4), np.random.default_rng(0))
    assert {k: v.shape for k, v in made.items()} == {k: v.shape for k, v in tiny.weights.items()}
    half, samples = replace(tiny, weights=made), memory_samples(3, seed=5)
    layers = int8_layers(quantize(half, Scheme(), calibrate(half, memory_samples(4))).module)
    assert layers["backbone.layer4.0.body.0"].weight().shape == (256, 256, 3, 3)
    ours = predictions(ACT(tiny.config, made), [inputs_of(s, tiny.config) for s in samples])
    assert (ours - lerobots(half, samples)).abs().max() < 1e-5
