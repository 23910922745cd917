"""From a checkpoint and calibration samples to INT8. Only this module touches torch.ao.quantization (its last is 2.8).

    calibration = calibrate(checkpoint, samples)              # what flows through each layer
    quantized = quantize(checkpoint, Scheme("static"), calibration)
    export(quantized, checkpoint, path, ...)                  # the artifact

Static INT8 covers convolutions, token projections and the backbone's adds. The residual stream, LayerNorm, the products
of attention and the two-row head stay float: 2 % of the arithmetic, and quantizing them costs more than it saves.
"""

import copy
import re
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.ao.nn.intrinsic import quantized as fused_int8
from torch.ao.nn.quantized import dynamic as dynamic_int8
from torch.ao.nn.quantized import modules as int8
from torch.ao.quantization import (
    PerChannelMinMaxObserver,
    QConfig,
    QConfigMapping,
    float_qparams_weight_only_qconfig,
    per_channel_dynamic_qconfig,
    quantize_dynamic,
)
from torch.ao.quantization.backend_config import get_qnnpack_backend_config
from torch.ao.quantization.fx.custom_config import PrepareCustomConfig
from torch.ao.quantization.observer import UniformQuantizationObserverBase
from torch.ao.quantization.quantize_fx import convert_fx, prepare_fx
from torch.fx import GraphModule

import rover_lib
from rover_lib.onboard import artifact
from rover_lib.onboard.errors import QuantizeError
from rover_lib.onboard.preprocess import prepare_frame
from rover_lib.onboard.stage import atomic_path
from rover_lib.workshop import act
from rover_lib.workshop.act import ACT, Attention, FeedForward, block_of
from rover_lib.workshop.checkpoint import Checkpoint
from rover_lib.workshop.episodes import Sample

ENGINE = "qnnpack"
MODES = ("dynamic", "static", "mixed")
# XNNPACK's fast kernels want symmetric int8 activations and weights in [-127, 127] with scales of at least 2^-12;
# quint8 falls back to QNNPACK's kernels, which have no dot-product instructions in the wheel.
KINDS = {"symmetric": (torch.qint8, -128, 127), "affine": (torch.quint8, 0, 255)}
OBSERVERS = ("histogram", "minmax", "percentile")
SMALLEST_SCALE = 2**-12
INT8_MODULES = (int8.Conv2d, int8.Linear, fused_int8.ConvReLU2d, dynamic_int8.Linear)
STAYS_FLOAT = ("head", "state_project")

Progress = Callable[..., Iterable]


@dataclass(frozen=True)
class Scheme:
    """How to quantize. A scheme that exists is valid.

    mode: dynamic (INT8 weights of linears, activations quantized on the fly), static (both, calibrated), or mixed
    (static with `float_blocks` left in float). kind: of the activations of static and mixed. observer: how a range is
    read off what was seen. smooth: SmoothQuant's a of the channel scales, None for no scales.
    """

    mode: str = "static"
    kind: str = "symmetric"
    observer: str = "histogram"
    smooth: float | None = 0.5
    percentile: float = 99.99
    float_blocks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, value, known in (
            ("mode", self.mode, MODES),
            ("kind", self.kind, tuple(KINDS)),
            ("observer", self.observer, OBSERVERS),
        ):
            if value not in known:
                raise QuantizeError(f"scheme: {name} {value!r} is not known; known are {list(known)}")
        if self.smooth is not None and not 0 <= self.smooth <= 1:
            raise QuantizeError(f"scheme: smooth must be in [0, 1], found {self.smooth}")
        if not 50 < self.percentile <= 100:
            raise QuantizeError(f"scheme: percentile must be in (50, 100], found {self.percentile}")


class RangeObserver(UniformQuantizationObserverBase):
    """Sees a tensor's values during calibration; the range is chosen afterwards, in any of three ways.

    Keeps the exact minimum and maximum and a histogram over [-limit, limit] whose limit doubles when it is outgrown:
    two neighbouring bins merge into one, so nothing is ever re-binned by guess. One calibration serves all observers.
    """

    BINS = 4096

    def __init__(self, *, dtype: torch.dtype, quant_min: int, quant_max: int, choice: str, percentile: float):
        super().__init__(
            dtype=dtype,
            qscheme=torch.per_tensor_affine,
            quant_min=quant_min,
            quant_max=quant_max,
            eps=SMALLEST_SCALE,
        )
        self.choice, self.percentile, self.seeing = choice, percentile, True
        self.register_buffer("min_val", torch.tensor(torch.inf))
        self.register_buffer("max_val", torch.tensor(-torch.inf))
        self.register_buffer("limit", torch.tensor(0.0))
        self.register_buffer("histogram", torch.zeros(self.BINS))

    def forward(self, x: Tensor) -> Tensor:
        if not self.seeing:
            return x
        v = x.detach().flatten()
        low, high = torch.aminmax(v)
        if not (torch.isfinite(low) and torch.isfinite(high)):
            raise QuantizeError("calibration met NaN or Inf in an activation; check the checkpoint and the recordings")
        self.min_val.copy_(torch.minimum(self.min_val, low))
        self.max_val.copy_(torch.maximum(self.max_val, high))
        largest = max(abs(low.item()), abs(high.item()), 1e-6)
        if self.limit == 0:
            self.limit.fill_(largest)
        while largest > self.limit:
            merged = self.histogram.view(-1, 2).sum(1)
            quarter = self.BINS // 4
            self.histogram.zero_()[quarter : 3 * quarter] = merged
            self.limit.mul_(2)
        limit = self.limit.item()
        # A feature map has millions of values: every 17th draws the same histogram.
        self.histogram += torch.histc(v[::17] if v.numel() > 1 << 18 else v, self.BINS, -limit, limit)
        return x

    def range(self) -> tuple[float, float]:
        """The range [low, high] to represent, containing 0, by this observer's choice."""
        low, high = self.min_val.item(), self.max_val.item()
        if low > high:
            raise QuantizeError("an observer saw nothing: the calibration did not reach its layer")
        if self.choice == "percentile":
            low, high = self._percentiles(low, high)
        elif self.choice == "histogram":
            low, high = self._least_squares(low, high)
        return min(low, 0.0), max(high, 0.0)

    def _centres(self) -> Tensor:
        limit = self.limit.item()
        return (torch.arange(self.BINS) + 0.5) * (2 * limit / self.BINS) - limit

    def _percentiles(self, low: float, high: float) -> tuple[float, float]:
        share = self.histogram.cumsum(0) / self.histogram.sum()
        tail = (1 - self.percentile / 100) / 2
        centres = self._centres()
        inside = centres[(share >= tail) & (share <= 1 - tail)]
        if len(inside) == 0:
            return low, high
        return max(low, inside[0].item()), min(high, inside[-1].item())

    def _least_squares(self, low: float, high: float) -> tuple[float, float]:
        """The range whose rounding plus clipping has the least squared error over the histogram."""
        shrink = torch.linspace(1.0, 0.1, 31)
        lows, highs = torch.meshgrid(low * shrink, high * shrink, indexing="ij")
        lows, highs = lows.flatten(), highs.flatten()
        used = self.histogram > 0
        weight, x = self.histogram[used] / self.histogram.sum(), self._centres()[used]
        step = (highs.clamp(min=0) - lows.clamp(max=0)).clamp(min=1e-12) / 255
        clipped = torch.relu(x - highs[:, None]) ** 2 + torch.relu(lows[:, None] - x) ** 2
        best = int((step**2 / 12 + clipped @ weight).argmin())
        return lows[best].item(), highs[best].item()

    def calculate_qparams(self) -> tuple[Tensor, Tensor]:
        low, high = self.range()
        return self._calculate_qparams(torch.tensor(low), torch.tensor(high))


# --- channel scales -------------------------------------------------------------------------------------------------


def _projections(model: ACT) -> dict[str, nn.Module]:
    """The transformer's projections by name: what channel scales surround."""
    return {
        name: m
        for name, m in model.named_modules()
        if isinstance(m, (nn.Linear, nn.Conv2d)) and name.startswith(("encoder.", "decoder."))
    }


def _channel_axes(x: Tensor) -> tuple[int, ...]:
    return (0, 2, 3) if x.dim() == 4 else (0, 1)


@torch.inference_mode()
def channel_maxima(model: ACT, inputs: Iterable[tuple[Tensor, ...]]) -> dict[str, dict[str, Tensor]]:
    """The largest magnitude per channel at each projection's input and output: {name: {in_max, out_max}}."""
    found: dict[str, dict[str, Tensor]] = {}
    hooks = []

    def watch(name: str):
        def hook(_: nn.Module, args: tuple[Tensor], out: Tensor) -> None:
            for key, x in (("in_max", args[0]), ("out_max", out)):
                largest = x.abs().amax(_channel_axes(x))
                seen = found.setdefault(name, {})
                seen[key] = torch.maximum(seen[key], largest) if key in seen else largest

        return hook

    for name, m in _projections(model).items():
        hooks.append(m.register_forward_hook(watch(name)))
    try:
        for x in inputs:
            model(*x)
    finally:
        for h in hooks:
            h.remove()
    return {k: {n: t.clone() for n, t in v.items()} for k, v in found.items()}


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


def apply_channel_scales(model: ACT, maxima: dict[str, dict[str, Tensor]], smooth: float) -> None:
    """Put channel scales around the transformer's projections, in place; the float function stays the same.

    y = so * L'(x * si), L' = diag(1 / so) W diag(1 / si): activations have one scale per tensor, so a channel ten times
    larger than the rest takes the precision of all others; here it is moved into the weights, which have a scale per
    channel. ReLU lets positive scales pass, so `up` may deliver directly in the scale that `down` wants.
    """

    def matrix(m: nn.Module) -> Tensor:
        return m.weight.flatten(1)

    def rescale(m: nn.Module, rows: Tensor | float, columns: Tensor | float) -> None:
        """weight[o, i] * rows[o] * columns[i]; bias[o] * rows[o]."""
        rows, columns = torch.as_tensor(rows), torch.as_tensor(columns)
        m.weight = nn.Parameter((matrix(m) * rows.reshape(-1, 1) * columns).view_as(m.weight), requires_grad=False)
        m.bias = nn.Parameter(m.bias * rows, requires_grad=False)

    def input_scale(name: str, *matrices: Tensor) -> Tensor:
        return _input_scale(maxima[name]["in_max"], list(matrices), smooth)

    crosses = {f"decoder.{i}.cross_attention": layer.cross_attention for i, layer in enumerate(model.decoder)}
    for p in "kv":  # all cross-attentions take the memory by the same scales, so that it is quantized once
        even = [
            matrix(getattr(m, p)) / _output_scale(maxima[f"{n}.{p}"]["out_max"])[:, None] for n, m in crosses.items()
        ]
        setattr(model.memory, f"{p}_in", input_scale(f"{next(iter(crosses))}.{p}", *even))
    for name, part in model.named_modules():
        if isinstance(part, Attention):
            seen = {p: maxima[f"{name}.{p}"] for p in "qkvo" if f"{name}.{p}" in maxima}
            out = {p: _output_scale(s["out_max"]) for p, s in seen.items()}
            even = {p: matrix(getattr(part, p)) / out[p][:, None] for p in seen}
            if part.cross:
                k_in, v_in = model.memory.k_in, model.memory.v_in
            else:  # self-attention: one input for Q and K
                k_in = part.k_in = input_scale(f"{name}.k", even["q"], even["k"])
                v_in = part.v_in = input_scale(f"{name}.v", even["v"])
            o_in = input_scale(f"{name}.o", even["o"])
            if "q" not in seen:
                part.constant_q = part.constant_q * out["k"]
            else:
                part.q_in = input_scale(f"{name}.q", even["q"]) if part.cross else None
                rescale(part.q, 1 / out["q"], 1 / (part.q_in if part.cross else k_in))
                part.q_out = out["q"] * out["k"]
            rescale(part.k, 1 / out["k"], 1 / k_in)
            rescale(part.v, 1 / out["v"], 1 / v_in)
            part.v_out = out["v"] * o_in
            rescale(part.o, 1 / out["o"], 1 / o_in)
            part.o_out = out["o"]
        elif isinstance(part, FeedForward):
            part.down_out = _output_scale(maxima[f"{name}.down"]["out_max"])
            middle = input_scale(f"{name}.down", matrix(part.down) / part.down_out[:, None])
            rescale(part.down, 1 / part.down_out, 1 / middle)
            passes = isinstance(part.act, nn.ReLU)
            rows = middle if passes else torch.ones(len(part.up.bias))
            if not passes:
                part.down_in = middle
            part.up_in = input_scale(f"{name}.up", matrix(part.up) * rows[:, None])
            rescale(part.up, rows, 1 / part.up_in)


# --- calibration ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Calibration:
    """What flowed through the policy: enough for every scheme with the same `smooth`, without the recordings."""

    samples: int
    smooth: float | None
    checkpoint: str  # sha256
    image_sizes: tuple[tuple[int, int], ...]  # (height, width), one per camera
    channels: dict[str, dict[str, Tensor]] = field(repr=False)  # in_max, out_max, and the same after scaling
    observers: dict[str, Tensor] = field(repr=False)  # state of the prepared graph's observers
    ranges: dict[str, dict[str, float]] = field(repr=False)  # of each quantized layer's output: min, max
    seconds: float = 0.0

    def save(self, path: Path | str) -> None:
        with atomic_path(path) as temporary:
            torch.save(self.__dict__, temporary)

    @classmethod
    def load(cls, path: Path | str) -> "Calibration":
        """Raises QuantizeError if the file is missing or not a calibration."""
        try:
            return cls(**torch.load(path, weights_only=True))
        except FileNotFoundError:
            raise QuantizeError(f"{path}: not found; run notebook 02_calibrate first") from None
        except Exception as e:  # torch wraps what it meets in many types
            raise QuantizeError(
                f"{path}: not a calibration ({str(e).splitlines()[0][:120]}); calibrate again"
            ) from None


def inputs_of(sample: Sample, config: act.ActConfig) -> tuple[Tensor, Tensor]:
    """A recorded sample as the graph's inputs: (1, 2) float32 and (height, width, 3) uint8 RGB."""
    frame = prepare_frame(sample.frame_bgr(), *config.image_sizes[0])
    return torch.from_numpy(np.asarray(sample.state, np.float32))[None], torch.from_numpy(frame)


def _check_recordable(checkpoint: Checkpoint) -> None:
    c = checkpoint.config
    if len(c.cameras) != 1 or len(c.state_names) != 2 or len(c.action_names) != 2:
        raise QuantizeError(
            f"{checkpoint.path}: the recordings have one camera and [steering, throttle]; this policy has "
            f"{len(c.cameras)} cameras, {len(c.state_names)} states and {len(c.action_names)} actions"
        )


def calibrate(
    checkpoint: Checkpoint,
    samples: Sequence[Sample],
    *,
    smooth: float | None = 0.5,
    progress: Progress | None = None,
) -> Calibration:
    """Run the float policy over the samples, twice: for the channel scales, then for the observers behind them.

    smooth: SmoothQuant's a, None for no channel scales. progress: like tqdm. Raises QuantizeError without samples, for
    a policy that the recordings do not fit, and for activations that are not finite.
    """
    if not samples:
        raise QuantizeError("calibration needs samples, found none; give recordings with matching frames and controls")
    _check_recordable(checkpoint)
    torch.backends.quantized.engine = ENGINE
    start = time.monotonic()
    config = checkpoint.config

    def inputs(what: str) -> Iterable[tuple[Tensor, Tensor]]:
        yield from (inputs_of(s, config) for s in (progress(samples, desc=what) if progress else samples))

    model = ACT(config, checkpoint.weights, for_int8=True)
    channels = channel_maxima(model, inputs("channel maxima"))
    if bad := [n for n, s in channels.items() if not all(torch.isfinite(t).all() for t in s.values())]:
        raise QuantizeError(f"calibration met NaN or Inf at {bad[:3]}; check the checkpoint and the recordings")
    if smooth is not None:
        apply_channel_scales(model, channels, smooth)
        few = list(samples[:: max(1, len(samples) // 16)])
        for name, after in channel_maxima(model, (inputs_of(s, config) for s in few)).items():
            channels[name] |= {f"{k}_scaled": v for k, v in after.items()}
    prepared = _prepare(model, Scheme(smooth=smooth))
    with torch.inference_mode():
        for x in inputs("observers"):
            prepared(*x)
    observers = {k: v.clone() for k, v in prepared.state_dict().items() if "activation_post_process" in k}
    ranges = {}
    for node in prepared.graph.nodes:
        if node.op == "call_module" and _is_int8_name(str(node.target)) and (o := _observer_behind(prepared, node)):
            ranges[str(node.target)] = {"min": o.min_val.item(), "max": o.max_val.item()}
    return Calibration(
        samples=len(samples),
        smooth=smooth,
        checkpoint=checkpoint.sha256,
        image_sizes=config.image_sizes,
        channels=channels,
        observers=observers,
        ranges=ranges,
        seconds=time.monotonic() - start,
    )


def _observer_behind(prepared: nn.Module, node: Any) -> RangeObserver | None:
    for user in node.users:
        if user.op == "call_module" and isinstance(m := prepared.get_submodule(str(user.target)), RangeObserver):
            return m
    return None


# --- the transform --------------------------------------------------------------------------------------------------


def _pattern(block: str, relu: bool) -> str:
    """FX's regex of what is INT8 in a block: not the attention's own functions, whose products must stay float."""
    name = re.escape(block)
    if block.endswith("attention"):
        return rf"{name}\.(q|k|v|o)$"
    if block.endswith("feed_forward"):
        return rf"{name}\.(up|act|down)$" if relu else rf"{name}\.(up|down)$"
    return rf"{name}(\..*)?$"


def _is_int8_name(name: str) -> bool:
    return block_of(name) not in STAYS_FLOAT


def _mapping(config: act.ActConfig, scheme: Scheme, only: Iterable[str] | None = None) -> QConfigMapping:
    """The blocks to quantize (all but the scheme's float blocks, or `only` those); others map to None."""
    known = act.blocks(config)
    if unknown := [b for b in scheme.float_blocks if b not in known]:
        raise QuantizeError(f"scheme: float blocks {unknown} are not in this policy; known are {known}")
    wanted = set(known) - set(scheme.float_blocks) if only is None else set(only)
    mapping = QConfigMapping().set_global(None)
    # No table is left in the graph of ACT (see act.EMBEDDINGS); where one is, only its rows are worth quantizing.
    mapping.set_object_type(nn.Embedding, float_qparams_weight_only_qconfig)
    for block in known:
        qconfig = _qconfig(scheme) if block in wanted else None
        mapping.set_module_name_regex(_pattern(block, config.activation == "relu"), qconfig)
    return mapping


def _qconfig(scheme: Scheme) -> QConfig:
    dtype, low, high = KINDS[scheme.kind]
    activation = RangeObserver.with_args(
        dtype=dtype, quant_min=low, quant_max=high, choice=scheme.observer, percentile=scheme.percentile
    )
    weight = PerChannelMinMaxObserver.with_args(
        dtype=torch.qint8,
        qscheme=torch.per_channel_symmetric,
        quant_min=-127,
        quant_max=127,
        eps=SMALLEST_SCALE,
    )
    return QConfig(activation, weight)


def _prepare(model: ACT, scheme: Scheme) -> GraphModule:
    full = replace(scheme, float_blocks=())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecation: known, and the reason for this module's walls
        return prepare_fx(
            model,
            _mapping(model.config, full),
            act.example_inputs(model.config),
            PrepareCustomConfig().set_non_traceable_module_classes([act.Columns]),
            backend_config=get_qnnpack_backend_config(),
        )


def _convert(prepared: GraphModule, config: act.ActConfig, scheme: Scheme, only: Iterable[str] | None = None):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        converted = convert_fx(
            copy.deepcopy(prepared),
            qconfig_mapping=_mapping(config, scheme, only),
            backend_config=get_qnnpack_backend_config(),
        )
    return _columns_are_int8(converted, KINDS[scheme.kind][0])


def _columns_are_int8(converted: GraphModule, dtype: torch.dtype) -> GraphModule:
    """Let columns arrive quantized, as they are, where FX has put a quantization behind them."""
    for node in list(converted.graph.nodes):
        if node.op != "call_module" or not isinstance(
            columns := converted.get_submodule(str(node.target)), act.Columns
        ):
            continue
        for user in list(node.users):
            if user.target is torch.quantize_per_tensor:
                columns.dtype = dtype
                user.replace_all_uses_with(node)
                converted.graph.erase_node(user)
    converted.graph.eliminate_dead_code()
    converted.recompile()
    return converted


def _prepared(checkpoint: Checkpoint, scheme: Scheme, calibration: Calibration) -> GraphModule:
    """The observed graph as calibration left it, its observers seeing no more."""
    if calibration.checkpoint != checkpoint.sha256:
        raise QuantizeError("the calibration was made with another checkpoint; calibrate again")
    if calibration.image_sizes != checkpoint.config.image_sizes:
        raise QuantizeError(
            f"the calibration was made with images of {calibration.image_sizes}, the policy takes "
            f"{checkpoint.config.image_sizes} (height, width); calibrate again"
        )
    if scheme.smooth != calibration.smooth:
        raise QuantizeError(
            f"the calibration was made with smooth {calibration.smooth}, the scheme has {scheme.smooth}"
        )
    torch.backends.quantized.engine = ENGINE
    prepared = _prepare(_scaled(checkpoint, calibration, for_int8=True), scheme)
    state = prepared.state_dict()
    names = {k for k in state if "activation_post_process" in k}
    if names != set(calibration.observers):
        raise QuantizeError("the calibration's observers do not fit this graph; calibrate again with this version")
    prepared.load_state_dict(state | calibration.observers)
    for m in prepared.modules():
        if isinstance(m, RangeObserver):
            m.seeing = False
    return prepared


def _scaled(checkpoint: Checkpoint, calibration: Calibration, *, for_int8: bool) -> ACT:
    model = ACT(checkpoint.config, checkpoint.weights, for_int8=for_int8)
    if calibration.smooth is not None:
        apply_channel_scales(model, calibration.channels, calibration.smooth)
    return model


@dataclass(frozen=True)
class QuantizedPolicy:
    """An INT8 policy in eager form; `module` is called like ACT. `report` goes into quantize.json."""

    scheme: Scheme
    config: act.ActConfig
    module: nn.Module = field(repr=False)
    report: dict[str, Any] = field(repr=False)


def quantize(checkpoint: Checkpoint, scheme: Scheme, calibration: Calibration) -> QuantizedPolicy:
    """Quantize a checkpoint by a scheme.

    Raises QuantizeError when nothing, or not everything that the scheme names, became INT8, or when a scale is not a
    positive finite number. Warnings, by layer, are in the report.
    """
    start = time.monotonic()
    if scheme.mode == "dynamic":
        module = _dynamic(checkpoint, calibration)
        expected = [n for n in _projections(ACT(checkpoint.config, checkpoint.weights))]
    else:
        prepared = _prepared(checkpoint, scheme, calibration)
        module = _convert(prepared, checkpoint.config, scheme)
        left_float = {*scheme.float_blocks, *STAYS_FLOAT}
        convs = (
            n for n, m in _scaled(checkpoint, calibration, for_int8=True).named_modules() if isinstance(m, nn.Conv2d)
        )
        expected = [n for n in convs if block_of(n) not in left_float]
    found = {n: m for n, m in module.named_modules() if isinstance(m, INT8_MODULES)}
    check_acted(found, expected)
    if scheme.mode != "dynamic" and scheme.kind == "symmetric":
        check_fast(module.eval(), act.example_inputs(checkpoint.config))
    layers = [_layer(n, m) for n, m in found.items()]
    notes = [
        f"{row['name']}: its output never changed during calibration; is it dead?"
        for row in layers
        if row["out_scale"] == SMALLEST_SCALE
    ]
    report = {
        "layers": layers,
        "int8_modules": len(found),
        "float_blocks": list(scheme.float_blocks),
        "embeddings": dict(act.EMBEDDINGS),
        "warnings": notes,
        "seconds": time.monotonic() - start,
    }
    return QuantizedPolicy(scheme, checkpoint.config, module.eval(), report)


def check_acted(found: dict[str, nn.Module], expected: list[str]) -> None:
    """Raise QuantizeError, naming the layers, unless every expected layer was quantized."""
    if not found:
        raise QuantizeError("nothing was quantized: the qconfig mapping matched no module")
    if missing := [n for n in expected if n not in found]:
        raise QuantizeError(f"{len(missing)} of {len(expected)} layers stayed float: {', '.join(missing[:5])}")


@torch.inference_mode()
def check_fast(module: nn.Module, example: tuple[Tensor, ...]) -> None:
    """Raise QuantizeError, naming the layers, unless every static INT8 layer dispatches to XNNPACK's SDOT kernels.

    What torch 2.8 asks of a layer (`can_use_xnnp` in aten's qconv and qlinear) and XNNPACK of its scales: a qint8
    input, symmetric qint8 weights in [-127, 127], per channel for convolutions only, and an output scale that is
    neither 2^-32 nor 2^8 times the product of the others. A layer that fails would run QNNPACK's kernels, several
    times slower on a Cortex-A76, or not at all.
    """
    slow: dict[str, str] = {}

    def watch(name: str):
        def hook(m: nn.Module, args: tuple[Tensor, ...]) -> None:
            if reason := _why_slow(m, args[0]):
                slow[name] = reason

        return hook

    static = {n: m for n, m in module.named_modules() if isinstance(m, INT8_MODULES)}
    hooks = [m.register_forward_pre_hook(watch(n)) for n, m in static.items()]
    try:
        module(*example)
    except RuntimeError as e:
        # torch refuses some of these itself, without saying where; the hook of that layer has just run.
        if not slow:
            raise QuantizeError(f"the quantized policy does not run: {str(e).splitlines()[0][:200]}") from None
    finally:
        for h in hooks:
            h.remove()
    if slow:
        listed = "; ".join(f"{name}: {reason}" for name, reason in list(slow.items())[:5])
        raise QuantizeError(f"{len(slow)} of {len(static)} layers would miss the fast kernels: {listed}")


def _why_slow(m: nn.Module, x: Tensor) -> str | None:
    w = m.weight()
    per_channel, scales, zero_points = _weight_qparams(w)
    if x.dtype != torch.qint8:
        return f"its input is {str(x.dtype).removeprefix('torch.')}, not qint8"
    if w.dtype != torch.qint8 or w.int_repr().min() < -127:
        return "its weights are not qint8 in [-127, 127]"
    if zero_points.any():
        return "its weights are not symmetric: a zero point is not 0"
    if per_channel and isinstance(m, int8.Linear):
        return "a linear with a scale per channel; it must be a 1x1 convolution, or have one scale"
    ratio = scales.double() * x.q_scale() / m.scale
    if not ((ratio >= 2**-32) & (ratio < 2**8)).all():
        return f"its scales give a ratio of {ratio.max():.3g}, outside [2^-32, 2^8)"
    return None


def _dynamic(checkpoint: Checkpoint, calibration: Calibration) -> nn.Module:
    torch.backends.quantized.engine = ENGINE
    model = _scaled(checkpoint, calibration, for_int8=False)
    spec = dict.fromkeys(_projections(model), per_channel_dynamic_qconfig)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return quantize_dynamic(model, spec, dtype=torch.qint8)


def _weight_qparams(w: Tensor) -> tuple[bool, Tensor, Tensor]:
    """Whether a quantized weight has a scale per channel, its scales and its zero points, (channels,) or (1,) each."""
    if w.qscheme() in (torch.per_channel_affine, torch.per_channel_symmetric):
        return True, w.q_per_channel_scales(), w.q_per_channel_zero_points()
    return False, torch.tensor([w.q_scale()]), torch.tensor([w.q_zero_point()])


def _layer(name: str, m: nn.Module) -> dict[str, Any]:
    per_channel, scales, _ = _weight_qparams(m.weight())
    static = not isinstance(m, dynamic_int8.Linear)
    row = {
        "name": name,
        "block": block_of(name),
        "kind": type(m).__name__,
        "per_channel": per_channel,
        "weight_scale_min": scales.min().item(),
        "weight_scale_max": scales.max().item(),
        "out_scale": float(m.scale) if static else None,
        "out_zero_point": int(m.zero_point) if static else None,
    }
    for key in ("weight_scale_min", "out_scale"):
        if row[key] is not None and not 0 < row[key] < float("inf"):
            raise QuantizeError(f"{name}: {key} is {row[key]}; its calibration range is no range")
    return row


def backbone_of(quantized: QuantizedPolicy) -> nn.Module:
    """The INT8 part of a static policy that is the same to the last bit on every processor: all up to the tokens.

    Called like the policy; returns what `image_project` gives for the first camera, (1, D, h, w) int8. Raises
    QuantizeError where that is not INT8.
    """
    module = copy.deepcopy(quantized.module)
    nodes = [n for n in module.graph.nodes if n.target == "image_project"] if isinstance(module, GraphModule) else []
    if not nodes or not isinstance(module.get_submodule("image_project"), INT8_MODULES):
        raise QuantizeError(f"a {quantized.scheme.mode} policy whose image_project is not INT8 has no INT8 backbone")
    (output,) = (n for n in module.graph.nodes if n.op == "output")
    with module.graph.inserting_before(output):
        output.args = (module.graph.call_method("int_repr", (nodes[0],)),)
    module.graph.eliminate_dead_code()
    module.delete_all_unused_submodules()
    module.recompile()
    return module


# --- measuring ------------------------------------------------------------------------------------------------------


@torch.inference_mode()
def predictions(module: nn.Module, inputs: Iterable[tuple[Tensor, ...]]) -> Tensor:
    """(n, C, A) of raw, unclipped actions."""
    return torch.cat([module(*x) for x in inputs])


def mae_pct(found: Tensor, reference: Tensor, action_range: dict[str, tuple[float, float]]) -> dict[str, float]:
    """Mean absolute difference per action, in percent of the recorded range, as {name_mae_pct: value}."""
    error = (found - reference).abs().mean((0, 1))
    spans = [max(high - low, 1e-9) for low, high in action_range.values()]
    return {f"{n}_mae_pct": 100 * e.item() / s for n, e, s in zip(action_range, error, spans, strict=True)}


class Bench:
    """The float policy and its answers on a few choosing samples, prepared once for many conversions."""

    def __init__(
        self,
        checkpoint: Checkpoint,
        calibration: Calibration,
        samples: Sequence[Sample],
        action_range: dict[str, tuple[float, float]],
    ):
        if not samples:
            raise QuantizeError(
                "choosing needs samples that calibration has not seen, found none; record more episodes"
            )
        self.checkpoint, self.calibration, self.range = checkpoint, calibration, action_range
        self.inputs = [inputs_of(s, checkpoint.config) for s in samples]
        self.reference = predictions(ACT(checkpoint.config, checkpoint.weights), self.inputs)

    def error(self, module: nn.Module) -> dict[str, float]:
        return mae_pct(predictions(module, self.inputs), self.reference, self.range)

    def choose_observer(
        self, scheme: Scheme, observers: Sequence[str] = OBSERVERS, progress: Progress | None = None
    ) -> tuple[Scheme, dict[str, dict[str, float]]]:
        """Quantize with each observer; the one whose worse action has the least error wins."""
        table = {}
        for o in progress(observers, desc="observers") if progress else observers:
            module = quantize(self.checkpoint, replace(scheme, observer=o), self.calibration).module
            table[o] = self.error(module)
        best = min(table, key=lambda o: max(table[o].values()))
        return replace(scheme, observer=best), table

    def sensitivity(self, scheme: Scheme, progress: Progress | None = None) -> dict[str, dict[str, float]]:
        """Each block quantized alone, everything else in float: {block: {action_mae_pct}}."""
        prepared = _prepared(self.checkpoint, scheme, self.calibration)
        config = self.checkpoint.config
        names = act.blocks(config)
        return {
            block: self.error(_convert(prepared, config, replace(scheme, float_blocks=()), only=[block]))
            for block in (progress(names, desc="blocks") if progress else names)
        }

    def choose_mixed(
        self,
        scheme: Scheme,
        sensitivity: dict[str, dict[str, float]],
        *,
        budget_pct: float,
        max_blocks: int,
    ) -> tuple[Scheme, list[dict[str, Any]]]:
        """Leave the most sensitive blocks in float, one more at a time, until every action's error is in the budget.

        Returns the mixed scheme and each step {float_blocks, <action>_mae_pct}; if `max_blocks` do not reach the
        budget, the best step is taken and the last one shows it.
        """
        prepared = _prepared(self.checkpoint, scheme, self.calibration)
        config = self.checkpoint.config
        order = sorted(sensitivity, key=lambda b: max(sensitivity[b].values()), reverse=True)
        steps: list[dict[str, Any]] = []
        for n in range(min(max_blocks, len(order) - 1) + 1):
            trial = replace(scheme, mode="mixed", float_blocks=tuple(order[:n]))
            error = self.error(_convert(prepared, config, trial))
            steps.append({"float_blocks": list(trial.float_blocks), **error})
            if max(error.values()) <= budget_pct:
                break
        best = min(steps, key=lambda s: (max(max(v for k, v in s.items() if k != "float_blocks"), budget_pct)))
        return replace(scheme, mode="mixed", float_blocks=tuple(best["float_blocks"])), steps


@torch.inference_mode()
def inspect_layers(
    quantized: QuantizedPolicy, checkpoint: Checkpoint, calibration: Calibration, samples: Sequence[Sample]
) -> list[dict[str, Any]]:
    """Per static INT8 layer: scale, zero point, share of values clipped and signal-to-noise against float.

    Both run over the samples (which calibration should not have seen). clipped_pct: of the float values that lie
    outside the INT8 range; snr_db: 10 log10 of signal over error power, errors that arrive from before included.
    """
    if quantized.scheme.mode == "dynamic":
        return []
    prepared = _prepared(checkpoint, quantized.scheme, calibration)
    int8_layers = {n: m for n, m in quantized.module.named_modules() if isinstance(m, INT8_MODULES)}
    _, low, high = KINDS[quantized.scheme.kind]
    seen: dict[str, Tensor] = {}
    totals = {n: np.zeros(4) for n in int8_layers}  # clipped, count, signal power, error power

    def keep(name: str):
        def hook(_: nn.Module, __: tuple, out: Tensor) -> None:
            seen[name] = out

        return hook

    def measure(name: str, m: nn.Module):
        floor, ceiling = (low - m.zero_point - 0.5) * m.scale, (high - m.zero_point + 0.5) * m.scale

        def hook(_: nn.Module, __: tuple, out: Tensor) -> None:
            x, y = seen.pop(name), out.dequantize()
            clipped = ((x < floor) | (x > ceiling)).sum().item()
            totals[name] += (clipped, x.numel(), x.square().sum().item(), (x - y).square().sum().item())

        return hook

    hooks = [prepared.get_submodule(n).register_forward_hook(keep(n)) for n in int8_layers]
    hooks += [m.register_forward_hook(measure(n, m)) for n, m in int8_layers.items()]
    try:
        for s in samples:
            x = inputs_of(s, checkpoint.config)
            prepared(*x)
            quantized.module(*x)
    finally:
        for h in hooks:
            h.remove()
    return [
        {
            "name": n,
            "block": block_of(n),
            "out_scale": float(m.scale),
            "out_zero_point": int(m.zero_point),
            "clipped_pct": float(100 * totals[n][0] / max(totals[n][1], 1)),
            "snr_db": float(10 * np.log10(max(totals[n][2], 1e-20) / max(totals[n][3], 1e-20))),
        }
        for n, m in int8_layers.items()
    ]


def clipped_warnings(rows: list[dict[str, Any]], limit_pct: float) -> list[str]:
    """A sentence for each layer that clips more than `limit_pct` of its values."""
    return [
        f"{r['name']}: {r['clipped_pct']:.1f} % of its values are clipped (more than {limit_pct} %); "
        "calibrate on recordings that cover what it meets"
        for r in rows
        if r["clipped_pct"] > limit_pct
    ]


# --- the artifact ---------------------------------------------------------------------------------------------------


def export(
    policy: ACT | QuantizedPolicy,
    checkpoint: Checkpoint,
    path: Path | str,
    *,
    samples: Sequence[Sample],
    calibration: Calibration | None = None,
    tolerance: float = 1e-4,
    int8_errors: float = 2.0,
    vectors: int = 3,
) -> str:
    """Trace, freeze and write the artifact; return its content hash.

    samples: recorded observations, of which `vectors`, evenly chosen, become the parity vectors; how far a rerun may
    differ is `tolerance` (action units) for FP32, and for INT8 at least that and `int8_errors` times the largest error
    against FP32 over all the samples: flipped roundings on another processor are of the size of quantization itself.
    Raises QuantizeError if the traced graph does not give what the policy gave, or anything that is not finite.
    """
    config = checkpoint.config
    quantized = isinstance(policy, QuantizedPolicy)
    module = policy.module if quantized else policy
    reference = ACT(config, checkpoint.weights) if quantized else policy
    inputs = [inputs_of(s, config) for s in samples]
    if not inputs:
        raise QuantizeError("an artifact needs parity vectors, found no samples; give at least one")
    with warnings.catch_warnings(), torch.inference_mode():
        warnings.simplefilter("ignore")
        traced = torch.jit.freeze(torch.jit.trace(module, act.example_inputs(config), check_trace=False).eval())
    chosen = np.unique(np.linspace(0, len(inputs) - 1, vectors).round().astype(int))
    for i in chosen:
        inputs[i] = (inputs[i][0], _in_blocks(inputs[i][1]))
    expected = predictions(module, inputs)
    with torch.jit.optimized_execution(False):
        found = predictions(traced, inputs)
    if not torch.isfinite(found).all():
        raise QuantizeError(f"{path}: the policy gives NaN or Inf on recorded frames; nothing was written")
    gap = (found - expected).abs().max().item()
    allowed = {n: tolerance for n in config.action_names}
    if quantized:
        error = (found - predictions(reference, inputs)).abs().amax((0, 1))
        allowed = {n: max(tolerance, int8_errors * e.item()) for n, e in zip(config.action_names, error, strict=True)}
    if gap > max(allowed.values()):
        raise QuantizeError(f"{path}: the traced graph differs from the policy by {gap:.3g}; nothing was written")
    parity = {
        "state": np.stack([inputs[i][0][0].numpy() for i in chosen]),
        f"frame_{config.cameras[0]}": np.stack([inputs[i][1].numpy() for i in chosen]),
        "chunk": np.stack([found[i].numpy() for i in chosen]),
    }
    scheme = policy.scheme if quantized else None
    mode = scheme.mode if scheme else "fp32"
    static = mode in ("static", "mixed")
    manifest = {
        "schema": artifact.SCHEMA,
        "mode": mode,
        "scheme": scheme.kind if static else "dynamic" if scheme else "float",
        "engine": ENGINE,
        "cameras": [
            {"name": n, "height": h, "width": w} for n, (h, w) in zip(config.cameras, config.image_sizes, strict=True)
        ],
        "state_names": list(config.state_names),
        "action_names": list(config.action_names),
        "chunk": config.chunk,
        "rate_hz": config.rate_hz,
        "normalisation": "inside the graph: uint8 RGB frames and raw states in, raw actions out",
        "checkpoint": {"sha256": checkpoint.sha256, "format": checkpoint.format},
        "calibration": None
        if calibration is None
        else {
            "samples": calibration.samples,
            "observer": scheme.observer if static else None,
            "channel_scales": calibration.smooth,
            "float_blocks": list(scheme.float_blocks) if scheme else [],
        },
        "weights_mb": _weights_mb(module, config, checkpoint, quantized),
        "gmac": sum(act.multiply_accumulates(reference).values()) / 1e9,
        "parity": {
            "tolerance": allowed,
            "reason": "float parts round differently on another processor, and flipped INT8 roundings grow over layers"
            if quantized
            else "another processor sums in another order",
        },
        "versions": {"torch": torch.__version__.split("+")[0], "rover_lib": rover_lib.__version__},
    }
    return artifact.save_artifact(path, traced, manifest, parity)


def _in_blocks(frame: Tensor, size: int = 4) -> Tensor:
    """The frame in squares of one colour: as good a question, and a twentieth of the bytes in the artifact."""
    height, width, _ = frame.shape
    return frame[::size, ::size].repeat_interleave(size, 0).repeat_interleave(size, 1)[:height, :width].contiguous()


def _weights_mb(module: nn.Module, config: act.ActConfig, checkpoint: Checkpoint, quantized: bool) -> float:
    """Weights and biases alone: INT8 weights at a byte, the rest at four."""
    total = sum(p.numel() * 4 for p in module.parameters())
    if quantized:
        for m in module.modules():
            if isinstance(m, INT8_MODULES):
                total += m.weight().numel() + (m.bias().numel() * 4 if m.bias() is not None else 0)
    return total / 1e6
