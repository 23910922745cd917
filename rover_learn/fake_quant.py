"""Static INT8 that can be trained: the graph that export quantizes, rounding as export rounds, with gradients.

    rounded = RoundedPolicy(checkpoint, scheme, calibration)
    plans = rounded(weights, frames, states)       # weights: the checkpoint's names; gradients reach them
    loss(plans).backward()

Activations are rounded where the observed graph has its observers, by the ranges of the calibration; weights by one
scale per output channel, folded, scaled and as columns of pixels first, as `quantize` has them. Rounding lets gradients
through, but for what it clips. Ranges and channel scales stay those of the calibration.
"""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.fx import GraphModule

from rover_lib.workshop.act import (
    ACT,
    BACKBONES,
    ActConfig,
    Columns,
    Pair,
    Weights,
    backbone_blocks,
    block_of,
    fits_columns,
    fold,
    fold_block,
    of_columns,
)
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.int8.observe import Calibration, RangeObserver, restore_observed, scale_model
from rover_lib.workshop.int8.scheme import KINDS, SMALLEST_SCALE, STAYS_FLOAT, Scheme


class Rounded(nn.Module):
    """Rounds an activation as INT8 would, by what its observer saw."""

    def __init__(self, observer: RangeObserver):
        super().__init__()
        scale, zero_point = observer.calculate_qparams()
        self.scale, self.zero_point = scale.item(), int(zero_point.item())
        self.low, self.high = observer.quant_min, observer.quant_max

    def forward(self, x: Tensor) -> Tensor:
        return torch.fake_quantize_per_tensor_affine(x, self.scale, self.zero_point, self.low, self.high)


class RoundedPolicy(nn.Module):
    """A checkpoint's static INT8 policy whose weights are given anew with every call.

    Decoder queries and positions, and what the first decoder layer computes of them alone, are constants of the graph:
    no gradient reaches those weights.
    """

    def __init__(self, checkpoint: Checkpoint, scheme: Scheme, calibration: Calibration):
        super().__init__()
        self.config = checkpoint.config
        self.graph = restore_observed(checkpoint, scheme, calibration)
        _round_activations(self.graph)
        plain = ACT(checkpoint.config, checkpoint.weights, for_int8=True)
        scaled = scale_model(checkpoint, calibration, for_int8=True)
        self.rounds = {
            name
            for name, module in plain.named_modules()
            if isinstance(module, nn.Conv2d) and block_of(name) not in STAYS_FLOAT
        }
        _, self.low, self.high = KINDS[scheme.kind]
        self._places = {name: _place(self.graph, name) for name, _ in parameters(self.config, checkpoint.weights)}
        # Channel scales, element by element; 0 where nothing is to be scaled, and nothing to be learned.
        before, after = dict(plain.named_parameters()), dict(scaled.named_parameters())
        self._shapes = {name: value.shape for name, value in before.items()}
        self._scales: dict[str, Tensor] = {}
        for name, value in before.items():
            if not torch.equal(value, after[name]):
                self._scales[name] = torch.where(value == 0, 0, after[name] / value)

    def parameters_of(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The graph's parameters, rounded, as functions of a checkpoint's weights."""
        made = {}
        for name, (weight, bias) in parameters(self.config, weights):
            weight, bias = self._scaled(f"{name}.weight", weight), self._scaled(f"{name}.bias", bias)
            place = self._places[name]
            made[f"{place}.weight"] = _round_weight(weight) if name in self.rounds else weight
            made[f"{place}.bias"] = bias
        return made

    def _scaled(self, name: str, value: Tensor) -> Tensor:
        value, scale = value.reshape(self._shapes[name]), self._scales.get(name)
        return value if scale is None else value * scale.to(value.device)

    def forward(self, weights: Mapping[str, Tensor], frames: Tensor, states: Tensor) -> Tensor:
        """weights: by LeRobot's names without `model.`; frames: (B, height, width, 3) uint8 RGB; states: (B, 2) raw.

        Returns (B, C, A) raw actions.
        """
        made = self.parameters_of(weights)
        plans = [
            functional_call(self.graph, made, (state[None], frame))
            for state, frame in zip(states, frames, strict=True)  # the graph is for one observation
        ]
        return torch.cat(plans)


def _round_activations(graph: GraphModule) -> None:
    """Put rounding in every observer's place, in place; columns of pixels are INT8 already."""
    for node in graph.graph.nodes:
        if node.op != "call_module" or not isinstance(observer := graph.get_submodule(str(node.target)), RangeObserver):
            continue
        (source,) = node.args
        exact = source.op == "call_module" and isinstance(graph.get_submodule(str(source.target)), Columns)
        graph.set_submodule(str(node.target), nn.Identity() if exact else Rounded(observer))


def _round_weight(weight: Tensor) -> Tensor:
    """A convolution's weight as INT8 with a scale per output channel, in [-127, 127], has it."""
    scale = (weight.detach().flatten(1).abs().amax(1) / 127).clamp(min=SMALLEST_SCALE)
    zero = torch.zeros(len(scale), dtype=torch.int32, device=weight.device)
    return torch.fake_quantize_per_channel_affine(weight, scale, zero, 0, -127, 127)


def _place(graph: GraphModule, name: str) -> str:
    """Where FX has put a module: with its ReLU, if the two were fused."""
    return f"{name}.0" if isinstance(graph.get_submodule(name), nn.Sequential) else name


def parameters(config: ActConfig, weights: Mapping[str, Tensor]) -> Iterator[tuple[str, Pair]]:
    """Weight and bias of each of `ACT(..., for_int8=True)`'s modules, as functions of the checkpoint's weights.

    Shaped for linears; a projection there is a convolution of one pixel, with the same numbers.
    """
    w = Weights(dict(weights))

    def pair(at: Weights) -> Pair:
        return at["weight"], at["bias"]

    stem = fold(w.at("backbone.conv1"), w.at("backbone.bn1"))
    yield "backbone.stem.0", of_columns(*stem, config.image_norm[0]) if fits_columns(config) else stem
    kind, _, _ = BACKBONES[config.backbone]
    for name in backbone_blocks(config.backbone):
        for i, folded_pair in enumerate(fold_block(w.at(name), kind)):
            yield f"{name}.body.{2 * i}", folded_pair
        if f"{name}.downsample" in w:
            yield f"{name}.shortcut", fold(w.at(f"{name}.downsample.0"), w.at(f"{name}.downsample.1"))
    yield "image_project", pair(w.at("encoder_img_feat_input_proj"))
    if config.sees_state:
        yield "state_project", pair(w.at("encoder_robot_state_input_proj"))
    if config.pre_norm:
        yield "encoder_norm", pair(w.at("encoder.norm"))
    for part, count in (("encoder", config.encoder_layers), ("decoder", config.decoder_layers)):
        for i in range(count):
            yield from _layer(f"{part}.{i}", w.at(f"{part}.layers.{i}"), first_of_decoder=part == "decoder" and i == 0)
    yield "norm", pair(w.at("decoder.norm"))
    yield "head", pair(w.at("action_head"))


def _layer(name: str, w: Weights, *, first_of_decoder: bool) -> Iterator[tuple[str, Pair]]:
    attentions = {"self_attn": "attention", "multihead_attn": "cross_attention"}
    for lerobots, ours in attentions.items():
        if lerobots not in w or (first_of_decoder and ours == "attention"):
            continue
        split = [w[f"{lerobots}.in_proj_{p}"].chunk(3) for p in ("weight", "bias")]
        for p, weight, bias in zip("qkv", *split, strict=True):
            if not (first_of_decoder and p == "q"):
                yield f"{name}.{ours}.{p}", (weight, bias)
        yield f"{name}.{ours}.o", (w[f"{lerobots}.out_proj.weight"], w[f"{lerobots}.out_proj.bias"])
    yield f"{name}.feed_forward.up", (w["linear1.weight"], w["linear1.bias"])
    yield f"{name}.feed_forward.down", (w["linear2.weight"], w["linear2.bias"])
    for norm in ("norm1", "norm2", "norm3"):
        if norm in w and not (first_of_decoder and norm == "norm1"):
            yield f"{name}.{norm}", (w[f"{norm}.weight"], w[f"{norm}.bias"])
