"""A backbone with fewer channels inside its blocks, in LeRobot's shape: those left out are zeros in the file.

    weights = without_channels(weights, config, 0.5, pictures, rng)

A basic block's first convolution gives channels that its second one alone reads. One after the other is kept that those
before it explain least, and the second convolution is refitted to what all of them gave. Our policies are built without
channels that are always zero (`act.fold_block`), and training keeps them so: they get no gradient.
"""

from collections.abc import Iterable, Iterator

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rover_learn.lessons import BatchedPolicy
from rover_learn.student import grams_of, refit_layer
from rover_lib.workshop.act import Weights, norm_gain
from rover_lib.workshop.act_config import ActConfig, backbone_blocks

TILE = 16  # XNNPACK's INT8 kernels compute 16 channels at a time: 17 cost as much as 32
PATCHES = 8  # taken of a picture's feature map in each block, at random
TAPS = 9  # of a kernel of 3x3
CENTRE = TAPS // 2


def kept_of(channels: int, share: float) -> int:
    """How many of a block's inner channels stay: the nearest multiple of TILE, one at least."""
    return min(channels, max(1, int(channels * share / TILE + 0.5)) * TILE)


@torch.no_grad()
def without_channels(
    weights: dict[str, Tensor], config: ActConfig, share: float, pictures: Iterable[Tensor], rng: np.random.Generator
) -> dict[str, Tensor]:
    """The same policy with that share of each block's inner channels; the others are zeros.

    weights: by LeRobot's names without `model.`, of a backbone of basic blocks. share: above 0, at most 1. pictures:
    (B, height, width, 3) uint8 RGB each, of the policy's size. rng: chooses where in the pictures. Returns float32.
    """
    narrowed = {name: weight.detach().float().cpu().clone() for name, weight in weights.items()}
    names = backbone_blocks(config.backbone)
    widths = {name: len(narrowed[f"{name}.bn1.weight"]) for name in names}
    names = [name for name in names if kept_of(widths[name], share) < widths[name]]
    policy = BatchedPolicy(config, narrowed)
    readers = {name: policy.backbone.get_submodule(f"{name.removeprefix('backbone.')}.conv2") for name in names}

    def some_patches(x: Tensor) -> Iterator[Tensor]:
        for patches in F.unfold(x, 3, padding=1).transpose(1, 2):  # (B, places, channels * TAPS)
            yield patches[rng.permutation(len(patches))[:PATCHES]]

    grams = grams_of(readers, some_patches, lambda: [policy.features(images).shape for images in pictures])
    for name, gram in grams.items():
        indices = _choose(gram, narrowed[f"{name}.conv2.weight"], kept_of(widths[name], share))
        _leave_out(narrowed, name, indices, gram)
    return narrowed


def _choose(gram: Tensor, reader: Tensor, count: int) -> Tensor:
    """(count,) channels, in order: the next is always the one that those before it explain least, times its reader.

    That is a Cholesky decomposition with pivots.
    """
    channels = reader.shape[1]
    centres = torch.cat([torch.arange(channels) * TAPS + CENTRE, torch.tensor([len(gram) - 1])])
    rest = gram[centres][:, centres]
    read = reader.double().square().sum((0, 2, 3))
    picked: list[int] = []
    for _ in range(count + 1):
        last = picked[-1] if picked else channels  # first the 1: a channel that never changes is in the bias
        rest -= torch.outer(rest[:, last], rest[last]) / rest[last, last].clamp(min=1e-12)
        unexplained = rest.diagonal()[:-1] * read
        unexplained[picked] = -torch.inf
        picked.append(int(unexplained.argmax()))
    return torch.tensor(picked[:count]).sort().values


def _leave_out(weights: dict[str, Tensor], name: str, kept: Tensor, gram: Tensor) -> None:
    """Zero a block's other channels and refit their reader, in place; its batch norm takes the constant."""
    reader = weights[f"{name}.conv2.weight"]
    outputs, channels = reader.shape[:2]
    whole = torch.cat([reader.double().flatten(1), torch.zeros(outputs, 1, dtype=torch.float64)], 1).T
    inputs = (kept[:, None] * TAPS + torch.arange(TAPS)).flatten()
    refit = refit_layer(whole, gram, inputs)
    gone = torch.ones(channels, dtype=torch.bool)
    gone[kept] = False
    for part in ("conv1.weight", "bn1.weight", "bn1.bias"):
        weights[f"{name}.{part}"][gone] = 0
    reader.zero_()
    reader[:, kept] = refit[:-1].T.reshape(outputs, len(kept), 3, 3).float()
    weights[f"{name}.bn2.bias"] += norm_gain(Weights(weights).at(f"{name}.bn2")) * refit[-1].float()
