"""From an observed policy to INT8, and the proof that it happened.

    quantized = quantize(checkpoint, Scheme("static"), calibration)

Static INT8 covers convolutions, token projections and the backbone's adds. The residual stream, LayerNorm, the products
of attention and the two-row head stay float: 2 % of the arithmetic, and quantizing them costs more than it saves.
Only this module and `observe` touch torch.ao.quantization, whose last version is torch 2.8's.
"""

import copy
import gc
import time
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.ao.nn.intrinsic import quantized as fused_int8
from torch.ao.nn.quantized import dynamic as dynamic_int8
from torch.ao.nn.quantized import modules as int8
from torch.ao.quantization import per_channel_dynamic_qconfig, quantize_dynamic
from torch.ao.quantization.backend_config import get_qnnpack_backend_config
from torch.ao.quantization.quantize_fx import convert_fx
from torch.fx import GraphModule, Node

from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.policy.memory import give_back_freed
from rover_lib.workshop.act import ACT, EMBEDDINGS, ActConfig, Columns, block_of, example_inputs, inputs_of
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.int8 import observe
from rover_lib.workshop.int8.observe import AGAIN, Calibration, RangeObserver, restore_observed, scale_model
from rover_lib.workshop.int8.scales import projections
from rover_lib.workshop.int8.scheme import ENGINE, KINDS, SMALLEST_SCALE, STAYS_FLOAT, Scheme
from rover_lib.workshop.recordings.episodes import Sample

Int8Layer = int8.Conv2d | int8.Linear | fused_int8.ConvReLU2d | dynamic_int8.Linear
INT8_MODULES = (int8.Conv2d, int8.Linear, fused_int8.ConvReLU2d, dynamic_int8.Linear)


@dataclass(frozen=True)
class QuantizedPolicy:
    """An INT8 policy in eager form; `module` is called like ACT. `report` goes into quantize.json."""

    scheme: Scheme
    config: ActConfig
    module: nn.Module = field(repr=False)
    report: dict[str, Any] = field(repr=False)


def quantize(checkpoint: Checkpoint, scheme: Scheme, calibration: Calibration) -> QuantizedPolicy:
    """Quantize a checkpoint by a scheme.

    Raises ArtifactError when nothing, or not everything that the scheme names, became INT8, or when a scale is not a
    positive finite number. Warnings, by layer, are in the report.
    """
    start, config = time.monotonic(), checkpoint.config
    static = scheme.mode != "dynamic"
    model = ACT(config, checkpoint.weights, for_int8=static)
    module: nn.Module
    if static:
        module = convert(restore_observed(checkpoint, scheme, calibration), config, scheme).eval()
        convs = [n for n, m in model.named_modules() if isinstance(m, nn.Conv2d)]
        expected = [n for n in convs if block_of(n) not in (*scheme.float_blocks, *STAYS_FLOAT)]
    else:
        module, expected = _dynamic(checkpoint, calibration).eval(), list(projections(model))
    layers = int8_layers(module)
    check_acted(layers, expected)
    if static and scheme.kind == "symmetric":
        check_fast(module, example_inputs(config))
    rows = [_layer_row(n, m) for n, m in layers.items()]
    dead = [row["name"] for row in rows if row["out_scale"] == SMALLEST_SCALE]
    report = {
        "layers": rows,
        "int8_modules": len(layers),
        "float_blocks": list(scheme.float_blocks),
        "embeddings": dict(EMBEDDINGS),
        "warnings": [f"{name}: its output never changed during calibration; is it dead?" for name in dead],
        "seconds": time.monotonic() - start,
    }
    return QuantizedPolicy(scheme, config, module, report)


def int8_layers(module: nn.Module) -> dict[str, Int8Layer]:
    """The INT8 layers of a quantized module, by name."""
    return {n: m for n, m in module.named_modules() if isinstance(m, INT8_MODULES)}


def check_acted(layers: Mapping[str, nn.Module], expected: Sequence[str]) -> None:
    """Raise ArtifactError, naming the layers, unless every expected layer was quantized."""
    if not layers:
        raise ArtifactError("nothing was quantized: the qconfig mapping matched no module")
    if missing := [n for n in expected if n not in layers]:
        raise ArtifactError(f"{len(missing)} of {len(expected)} layers stayed float: {', '.join(missing[:5])}")


def forget_graphs() -> None:
    """Free the converted policies that nobody has any more.

    A graph and its module refer to each other, so only the collector frees them, and it counts objects, not megabytes:
    without this a full-size run holds a dozen of them. malloc would keep gigabytes in pieces. What is there at the
    first call is of libraries, and stays: the collector takes up to 0.3 s to look at it, and does so once.
    """
    gc.collect()
    if not gc.get_freeze_count():
        gc.freeze()
    give_back_freed()


@torch.inference_mode()
def check_fast(module: nn.Module, example: tuple[Tensor, ...]) -> None:
    """Raise ArtifactError, naming the layers, unless every static INT8 layer dispatches to XNNPACK's SDOT kernels.

    Another layer would run QNNPACK's kernels, several times slower on a Cortex-A76, or not at all.
    """
    slow: list[str] = []
    static = int8_layers(module)
    with ExitStack() as hooks:
        for name, layer in static.items():

            def watch(m: Int8Layer, args: tuple[Tensor, ...], name: str = name) -> None:
                if not _is_fast(m, args[0]):
                    slow.append(name)

            hooks.enter_context(layer.register_forward_pre_hook(watch))
        try:
            module(*example)
        except RuntimeError as e:
            # torch refuses some of these itself, without saying where; the hook of that layer has just run.
            if not slow:
                raise ArtifactError(f"the quantized policy does not run: {str(e).splitlines()[0][:200]}") from None
    if slow:
        named = ", ".join(slow[:5])
        raise ArtifactError(f"{len(slow)} of {len(static)} layers would miss the fast kernels: {named}")


def _is_fast(m: Int8Layer, x: Tensor) -> bool:
    """What torch 2.8 asks of a layer (`can_use_xnnp` in aten's qconv), and XNNPACK of its scales' ratio."""
    w = m.weight()
    if x.dtype != torch.qint8 or w.dtype != torch.qint8 or not isinstance(m, int8.Conv2d):
        return False
    symmetric = w.int_repr().min() >= -127 and not w.q_per_channel_zero_points().any()
    ratio = w.q_per_channel_scales().double() * x.q_scale() / m.scale
    return bool(symmetric and ((ratio >= 2**-32) & (ratio < 2**8)).all())


def _dynamic(checkpoint: Checkpoint, calibration: Calibration) -> nn.Module:
    torch.backends.quantized.engine = ENGINE
    model = scale_model(checkpoint, calibration, for_int8=False)
    spec = dict.fromkeys(projections(model), per_channel_dynamic_qconfig)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return quantize_dynamic(model, spec, dtype=torch.qint8)


def _layer_row(name: str, m: Int8Layer) -> dict[str, Any]:
    scales = m.weight().q_per_channel_scales()
    static = not isinstance(m, dynamic_int8.Linear)
    row: dict[str, Any] = {
        "name": name,
        "block": block_of(name),
        "kind": type(m).__name__,
        "per_channel": True,
        "weight_scale_min": scales.min().item(),
        "weight_scale_max": scales.max().item(),
        "out_scale": float(m.scale) if static else None,
        "out_zero_point": int(m.zero_point) if static else None,
    }
    for key in ("weight_scale_min", "out_scale"):
        if row[key] is not None and not 0 < row[key] < float("inf"):
            raise ArtifactError(f"{name}: empty calibration range", found=f"{key} {row[key]}", remedy=AGAIN)
    return row


def convert(prepared: GraphModule, config: ActConfig, scheme: Scheme, only: Iterable[str] | None = None) -> GraphModule:
    """The observed graph with its blocks in INT8: all but the scheme's float blocks, or `only` those.

    What stays float shares its weights with `prepared`, which is as before.
    """
    shared = {id(p): p for p in prepared.parameters()}  # conversion reads them and makes its own
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        converted = convert_fx(
            copy.deepcopy(prepared, shared),
            qconfig_mapping=observe.qconfig_mapping(config, scheme, only),
            backend_config=get_qnnpack_backend_config(),
        )
    return _columns_are_int8(converted, KINDS[scheme.kind][0])


class Rangeable:
    """A policy that was converted once and takes the ranges of other schemes: as `convert` makes it, to the last bit.

    graph: observed; `take` follows what its observers now choose. Every block is INT8.
    """

    def __init__(self, graph: GraphModule, config: ActConfig, scheme: Scheme):
        called = {node.target for node in graph.graph.nodes}  # a second camera's observers stay behind, and saw nothing
        self.observers = [m for n, m in graph.named_modules() if n in called and isinstance(m, RangeObserver)]
        of = {}  # each observer by a scale that is its own: by this it is found again behind the conversion
        for i, observer in enumerate(self.observers, 1):
            observer.choice, observer.of_frames = "frames", (-float(i), float(i))
            of[observer.calculate_qparams()[0].item()] = observer
        self.module, self.config, self.kind = convert(graph, config, scheme).eval(), config, scheme.kind
        self.layers = [(m, *m._weight_bias(), of[m.scale]) for m in int8_layers(self.module).values()]
        self.buffers = []
        for node in self.module.graph.nodes:
            for x, y in pairwise(node.args):
                if isinstance(x, Node) and isinstance(y, Node) and x.op == y.op == "get_attr":
                    scale, zero = (self.module.get_buffer(str(attribute.target)) for attribute in (x, y))
                    self.buffers.append((scale, zero, of[scale.item()]))

    def take(self) -> None:
        """Take the ranges of the observers. Raises ArtifactError as `check_fast` does."""
        now = {observer: [x.item() for x in observer.calculate_qparams()] for observer in self.observers}
        for layer, weight, bias, observer in self.layers:
            layer.scale, layer.zero_point = now[observer]
            layer.set_weight_bias(weight, bias)  # a kernel packs them for the scales that it first meets
        for *buffers, observer in self.buffers:
            for buffer, value in zip(buffers, now[observer], strict=True):
                buffer.fill_(value)
        if self.kind == "symmetric":
            check_fast(self.module, example_inputs(self.config))


def _columns_are_int8(converted: GraphModule, dtype: torch.dtype) -> GraphModule:
    """Let columns arrive quantized, as they are, where FX has put a quantization behind them."""
    for node in list(converted.graph.nodes):
        if node.op != "call_module" or not isinstance(columns := converted.get_submodule(str(node.target)), Columns):
            continue
        for user in list(node.users):
            if user.target is torch.quantize_per_tensor:
                columns.dtype = dtype
                user.replace_all_uses_with(node)
                converted.graph.erase_node(user)
    converted.graph.eliminate_dead_code()
    converted.recompile()
    return converted


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
    prepared = restore_observed(checkpoint, quantized.scheme, calibration)
    layers = int8_layers(quantized.module)
    _, low, high = KINDS[quantized.scheme.kind]
    totals = {n: np.zeros(4) for n in layers}  # clipped, count, signal power, error power
    for s in samples:
        inputs = inputs_of(s, checkpoint.config)
        floats = _outputs({n: prepared.get_submodule(n) for n in layers}, prepared, inputs)
        int8s = _outputs(layers, quantized.module, inputs)
        for n, m in layers.items():
            floor, ceiling = (low - m.zero_point - 0.5) * m.scale, (high - m.zero_point + 0.5) * m.scale
            for x, y in zip(floats[n], int8s[n], strict=True):
                clipped = ((x < floor) | (x > ceiling)).sum().item()
                error = x - y.dequantize()
                totals[n] += (clipped, x.numel(), x.square().sum().item(), error.square().sum().item())
    return [
        {
            "name": n,
            "block": block_of(n),
            "out_scale": float(m.scale),
            "out_zero_point": int(m.zero_point),
            "clipped_pct": float(100 * totals[n][0] / max(totals[n][1], 1)),
            "snr_db": float(10 * np.log10(max(totals[n][2], 1e-20) / max(totals[n][3], 1e-20))),
        }
        for n, m in layers.items()
    ]


def _outputs(layers: Mapping[str, nn.Module], module: nn.Module, inputs: tuple[Tensor, ...]) -> dict[str, list[Tensor]]:
    """What each of a module's layers gives in one inference: a tensor for each of its calls."""
    given: dict[str, list[Tensor]] = {n: [] for n in layers}
    with ExitStack() as hooks:
        for n, layer in layers.items():
            hooks.enter_context(layer.register_forward_hook(lambda m, args, out, n=n: given[n].append(out)))
        module(*inputs)
    return given


def warn_of_clipping(rows: list[dict[str, Any]], limit_pct: float) -> list[str]:
    """A sentence for each layer that clips more than `limit_pct` of its values."""
    return [
        f"{r['name']}: {r['clipped_pct']:.1f} % of its values are clipped (more than {limit_pct} %); "
        "calibrate on recordings that cover what it meets"
        for r in rows
        if r["clipped_pct"] > limit_pct
    ]
