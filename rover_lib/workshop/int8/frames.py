"""Odd frames: those that a policy answers far more strongly than the others, so that one scale hardly serves both.

    extremes = calibration.frames                # {place: (frames, 2)}, what each tensor's least and largest value was
    times = oddness(extremes)                    # {place: (frames,)}, of each frame against the median frame
    low, high = range_over(extremes[place], usual(extremes, 95), wider=0.25)

A place is a tensor of the graph, named after the layer that gives it, or after the layer that takes it.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from rover_lib.workshop.act import block_of
from rover_lib.workshop.recordings.samples import Sample, pick_evenly

Extremes = Mapping[str, Tensor]
Frame = tuple[str, int]  # episode, row
ODD = 10.0  # times the median frame's largest value; frames of policies that keep their gates with min-max stay below
ODD_FRAMES = 8  # at most this many odd frames of the calibration take part in choosing


def oddness(extremes: Extremes) -> dict[str, Tensor]:
    """How many times larger each frame's largest magnitude is than the median frame's, at each place: (frames,)."""
    largest = {place: extreme.abs().amax(1) for place, extreme in extremes.items()}
    return {place: x / x.median().clamp(min=1e-12) for place, x in largest.items()}


def oddest(extremes: Extremes) -> Tensor:
    """(frames,) of each frame's largest oddness at any place."""
    return torch.stack(list(oddness(extremes).values())).amax(0)


def usual(extremes: Extremes, usual_pct: float) -> Tensor:
    """(frames,) bool: all frames but the oddest, of which this many percent are left."""
    times = oddest(extremes)
    return times <= times.quantile(usual_pct / 100)


def range_over(extremes: Tensor, kept: Tensor, wider: float) -> tuple[float, float]:
    """The range of the frames that are kept, (frames,) bool, widened by a share of the way to all frames' range."""
    ends = []
    for usual_reach, whole_reach in zip(_reach(extremes[kept]), _reach(extremes), strict=True):
        ends.append(max(usual_reach, 1e-6) ** (1 - wider) * whole_reach**wider if whole_reach else 0.0)
    return -ends[0], ends[1]


def _reach(extremes: Tensor) -> tuple[float, float]:
    """How far the values of (frames, 2) least and largest ones reach below and above 0."""
    return -min(extremes[:, 0].min().item(), 0.0), max(extremes[:, 1].max().item(), 0.0)


def odd_samples(extremes: Extremes, seen: Sequence[Frame], samples: Sequence[Sample]) -> tuple[Sample, ...]:
    """Some of the samples on which calibration met odd frames, evenly chosen. seen: the frame of each row."""
    times = dict(zip(seen, oddest(extremes).tolist(), strict=True))
    odd = [s for s in samples if times.get((s.episode, s.row), 0) > ODD]
    return pick_evenly(sorted(odd, key=lambda s: times[s.episode, s.row]), ODD_FRAMES)


def odd_share(extremes: Extremes) -> float:
    """The share of the frames that are odd."""
    return float((oddest(extremes) > ODD).float().mean())


def describe_odd(extremes: Extremes, seen: Sequence[Frame]) -> dict[str, Any]:
    """What JSON says of the odd frames: share, the block that answers most and how many times more; {} for none."""
    odd = oddest(extremes) > ODD
    if not odd.any():
        return {}
    at = {place: times[odd].median().item() for place, times in oddness(extremes).items()}
    place = max(at, key=lambda p: at[p])
    frames = [frame for frame, is_odd in zip(seen, odd.tolist(), strict=True) if is_odd]
    return {
        "share_pct": 100 * odd_share(extremes),
        "block": block_of(place),
        "times": at[place],
        "episodes": dict(Counter(episode for episode, _ in frames).most_common()),
        "rows": [row for _, row in frames],
    }
