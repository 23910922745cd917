"""Channel scales around the transformer's projections: they even out its activations before anything is rounded.

Activations have one scale per tensor, so a channel ten times larger than the rest takes the precision of all others.
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from rover_lib.workshop.act import ACT, Attention, FeedForward, Projection
from rover_lib.workshop.hooks import watched

Maxima = dict[str, dict[str, Tensor]]  # by projection: in_max and out_max, the largest magnitude of each channel


def projections(model: ACT) -> dict[str, Projection]:
    """The transformer's projections by name: what channel scales surround."""
    kinds = (nn.Linear, nn.Conv2d)
    parts = ("encoder.", "decoder.")
    return {name: m for name, m in model.named_modules() if isinstance(m, kinds) and name.startswith(parts)}


@torch.inference_mode()
def channel_maxima(model: ACT, inputs: Iterable[tuple[Tensor, ...]]) -> Maxima:
    """The largest magnitude per channel at each projection's input and output: {name: {in_max, out_max}}."""
    layers = projections(model)
    maxima: Maxima = {name: {} for name in layers}

    def watch(name: str, _: nn.Module, inputs: tuple[Tensor], output: Tensor) -> None:
        for key, x in (("in_max", inputs[0]), ("out_max", output)):
            # of (1, channels, h, w), or (1, tokens, channels)
            largest = x.abs().amax((0, 2, 3) if x.dim() == 4 else (0, 1))
            maxima[name][key] = torch.maximum(maxima[name].get(key, largest), largest)

    with watched(layers, watch):
        for x in inputs:
            model(*x)
    return maxima


def apply_channel_scales(model: ACT, maxima: Maxima, smooth: float) -> None:
    """Put channel scales around the transformer's projections, in place; the float function stays the same.

    y = so * L'(x * si), L' = diag(1 / so) W diag(1 / si). ReLU lets positive scales pass, so `up` may deliver directly
    in the scale that `down` wants. smooth: SmoothQuant's a, how much moves from activations to weights.
    """
    _scale_memory(model, maxima, smooth)
    for name, part in model.named_modules():
        if isinstance(part, Attention):
            _scale_attention(name, part, model.memory, maxima, smooth)
        elif isinstance(part, FeedForward):
            _scale_feed_forward(name, part, maxima, smooth)


def _scale_memory(model: ACT, maxima: Maxima, smooth: float) -> None:
    """All cross-attentions take the memory by the same scales, so that it is quantized once."""
    crosses = {name: m for name, m in model.named_modules() if isinstance(m, Attention) and m.cross}
    for p in "kv":
        even = []
        for name, cross in crosses.items():
            largest = maxima[f"{name}.{p}"]
            even.append(_matrix(getattr(cross, p)) / _output_scale(largest["out_max"])[:, None])
        setattr(model.memory, f"{p}_in", _input_scale(largest["in_max"], even, smooth))


def _scale_attention(name: str, part: Any, memory: Any, maxima: Maxima, smooth: float) -> None:
    out = {}
    even = {}
    for p in "kvo" if part.constant_q is not None else "qkvo":
        out[p] = _output_scale(maxima[f"{name}.{p}"]["out_max"])
        even[p] = _matrix(getattr(part, p)) / out[p][:, None]

    def input_scale(p: str, *matrices: Tensor) -> Tensor:
        return _input_scale(maxima[f"{name}.{p}"]["in_max"], list(matrices), smooth)

    if part.cross:
        k_in = memory.k_in
        v_in = memory.v_in
    else:  # self-attention: one input for Q and K
        k_in, v_in = part.k_in, part.v_in = input_scale("k", even["q"], even["k"]), input_scale("v", even["v"])
    o_in = input_scale("o", even["o"])
    if part.constant_q is not None:
        part.constant_q = part.constant_q * out["k"]
    else:
        q_in = k_in
        if part.cross:
            q_in = part.q_in = input_scale("q", even["q"])
        _rescale(part.q, 1 / out["q"], 1 / q_in)
        part.q_out = out["q"] * out["k"]
    for p, columns in (("k", k_in), ("v", v_in), ("o", o_in)):
        _rescale(getattr(part, p), 1 / out[p], 1 / columns)
    part.v_out = out["v"] * o_in
    part.o_out = out["o"]


def _scale_feed_forward(name: str, part: FeedForward, maxima: Maxima, smooth: float) -> None:
    part.down_out = _output_scale(maxima[f"{name}.down"]["out_max"])
    middle = _input_scale(maxima[f"{name}.down"]["in_max"], [_matrix(part.down) / part.down_out[:, None]], smooth)
    _rescale(part.down, 1 / part.down_out, 1 / middle)
    rows = middle
    if not isinstance(part.act, nn.ReLU):
        rows = torch.ones(len(middle))
        part.down_in = middle
    part.up_in = _input_scale(maxima[f"{name}.up"]["in_max"], [_matrix(part.up) * rows[:, None]], smooth)
    _rescale(part.up, rows, 1 / part.up_in)


def _matrix(m: Projection) -> Tensor:
    """A projection's weight as (outputs, inputs)."""
    return m.weight.flatten(1)


def _rescale(m: Projection, rows: Tensor, columns: Tensor) -> None:
    """weight[o, i] * rows[o] * columns[i]; bias[o] * rows[o]."""
    assert m.bias is not None
    m.weight = nn.Parameter((_matrix(m) * rows.reshape(-1, 1) * columns).view_as(m.weight), requires_grad=False)
    m.bias = nn.Parameter(m.bias * rows, requires_grad=False)


def _output_scale(out_max: Tensor) -> Tensor:
    """Per channel, the largest at 1 so that magnitudes stay natural; a dead channel does not blow its weights up."""
    return (out_max / out_max.max().clamp(min=1e-12)).clamp(min=1 / 64)


def _input_scale(in_max: Tensor, weights: list[Tensor], smooth: float) -> Tensor:
    """SmoothQuant's w^(1-a) / x^a per input channel (Xiao et al. 2022), with the largest input left as it was."""
    w = torch.stack([w.abs().amax(0) for w in weights]).amax(0).clamp(min=1e-8)
    x = in_max.clamp(min=in_max.max() * 1e-4).clamp(min=1e-8)
    scale = w ** (1 - smooth) / x**smooth
    scale = scale.clamp(min=scale.max() * 1e-4)
    return scale * (in_max.max() / (in_max * scale).max().clamp(min=1e-12))
