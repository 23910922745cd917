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
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from torch.ao.nn.intrinsic import quantized as fused_int8
from torch.ao.nn.quantized import dynamic as dynamic_int8
from torch.ao.nn.quantized import modules as int8
from torch.ao.quantization import per_channel_dynamic_qconfig, quantize_dynamic
from torch.ao.quantization.backend_config import get_qnnpack_backend_config
from torch.ao.quantization.quantize_fx import convert_fx
from torch.fx import Graph, GraphModule, Node, Tracer

from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.policy.load import give_back_freed
from rover_lib.workshop.act import ACT, Columns, block_of, example_inputs, inputs_of
from rover_lib.workshop.act_config import ActConfig
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.hooks import watched
from rover_lib.workshop.int8 import observe
from rover_lib.workshop.int8.observe import AGAIN, Calibration, restore_observed, scale_model
from rover_lib.workshop.int8.scales import projections
from rover_lib.workshop.int8.scheme import ENGINE, HIGH, LOW, SMALLEST_SCALE, STAYS_FLOAT, Scheme
from rover_lib.workshop.recordings.samples import Sample

Int8Layer = int8.Conv2d | int8.Linear | fused_int8.ConvReLU2d | dynamic_int8.Linear
INT8_MODULES = (int8.Conv2d, int8.Linear, fused_int8.ConvReLU2d, dynamic_int8.Linear)


@dataclass(frozen=True)
class QuantizedPolicy:
    """An INT8 policy in eager form; `module` is called like ACT. `report` goes into quantize.json."""

    scheme: Scheme
    module: nn.Module = field(repr=False)
    report: dict[str, Any] = field(repr=False)


def quantize(checkpoint: Checkpoint, scheme: Scheme, calibration: Calibration) -> QuantizedPolicy:
    """Quantize a checkpoint.

    Args:
        checkpoint: the policy.
        scheme: what becomes INT8, and by which observers.
        calibration: of this checkpoint.

    Returns:
        The policy in INT8, with a report.

    Raises:
        ArtifactError: not everything that the scheme names became INT8, or the calibration is another checkpoint's.
    """
    start = time.monotonic()
    config = checkpoint.config
    static = scheme.mode != "dynamic"
    model = ACT(config, checkpoint.weights, for_int8=static)
    module: nn.Module
    if static:
        module = convert(restore_observed(checkpoint, scheme, calibration), config, scheme).eval()
        convs = [n for n, m in model.named_modules() if isinstance(m, nn.Conv2d)]
        expected = [n for n in convs if block_of(n) not in (*scheme.float_blocks, *STAYS_FLOAT)]
    else:
        module = _dynamic(checkpoint, calibration).eval()
        expected = list(projections(model))
    layers = int8_layers(module)
    check_acted(layers, expected)
    if static:
        check_fast(module, example_inputs(config))
    dead = _check_scales(layers)
    report = {
        "int8_modules": len(layers),
        "float_blocks": list(scheme.float_blocks),
        "warnings": [f"{', '.join(dead[:3])}: output never changed in calibration; is it dead?"] if dead else [],
        "seconds": time.monotonic() - start,
    }
    return QuantizedPolicy(scheme, module, report)


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
    """Free the converted policies that nobody has any more: only the collector does, and it counts objects, not MB."""
    gc.collect()
    if not gc.get_freeze_count():
        gc.freeze()  # what is there at the first call is of libraries
    give_back_freed()


@torch.inference_mode()
def check_fast(module: nn.Module, example: tuple[Tensor, ...]) -> None:
    """Raise ArtifactError, naming the layers, unless every static INT8 layer dispatches to XNNPACK's SDOT kernels."""
    slow: list[str] = []
    static = int8_layers(module)

    def watch(name: str, layer: Int8Layer, inputs: tuple[Tensor, ...]) -> None:
        if not _is_fast(layer, inputs[0]):
            slow.append(name)

    with watched(static, watch, before=True):
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


def _check_scales(layers: Mapping[str, Int8Layer]) -> list[str]:
    """Return the layers whose output never changed. Raises ArtifactError for a scale that is no positive number."""
    dead = []
    for name, m in layers.items():
        own = [] if isinstance(m, dynamic_int8.Linear) else [float(m.scale)]
        for scale in (m.weight().q_per_channel_scales().min().item(), *own):
            if not 0 < scale < float("inf"):
                raise ArtifactError(f"{name}: empty calibration range", found=scale, remedy=AGAIN)
        if own == [SMALLEST_SCALE]:
            dead.append(name)
    return dead


def convert(prepared: GraphModule, config: ActConfig, scheme: Scheme, only: Iterable[str] | None = None) -> GraphModule:
    """The observed graph with its blocks in INT8: all but the scheme's float blocks, or `only` those."""
    shared = {id(p): p for p in prepared.parameters()}  # conversion reads them and makes its own
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        converted = convert_fx(
            copy.deepcopy(prepared, shared),
            qconfig_mapping=observe.qconfig_mapping(config, scheme, only),
            backend_config=get_qnnpack_backend_config(),
        )
    return _columns_are_int8(converted)


def _columns_are_int8(converted: GraphModule) -> GraphModule:
    """Let columns arrive quantized, as they are, where FX has put a quantization behind them."""
    for node in list(converted.graph.nodes):
        if node.op != "call_module" or not isinstance(columns := converted.get_submodule(str(node.target)), Columns):
            continue
        for user in list(node.users):
            if user.target is torch.quantize_per_tensor:
                columns.quantized = True
                user.replace_all_uses_with(node)
                converted.graph.erase_node(user)
    converted.graph.eliminate_dead_code()
    converted.recompile()
    return converted


@torch.inference_mode()
def most_clipped(
    quantized: QuantizedPolicy, checkpoint: Checkpoint, calibration: Calibration, samples: Sequence[Sample]
) -> dict[str, Any]:
    """The static INT8 layer that clips most: {layer, clipped_pct}, the share of its float values outside its range.

    samples: which calibration should not have seen.
    """
    prepared = restore_observed(checkpoint, quantized.scheme, calibration)
    layers = int8_layers(quantized.module)
    clipped = Counter[str]()
    totals = Counter[str]()

    def watch(name: str, _: nn.Module, __: Any, x: Tensor) -> None:
        layer = layers[name]
        floor = (LOW - layer.zero_point - 0.5) * layer.scale
        ceiling = (HIGH - layer.zero_point + 0.5) * layer.scale
        clipped[name] += int(((x < floor) | (x > ceiling)).sum())
        totals[name] += x.numel()

    with watched({name: prepared.get_submodule(name) for name in layers}, watch):
        for s in samples:
            prepared(*inputs_of(s, checkpoint.config))
    shares = {name: 100 * clipped[name] / count for name, count in totals.items()}
    layer = max(shares, key=lambda name: shares[name])
    return {"layer": layer, "clipped_pct": shares[layer]}


class _Leaves(Tracer):
    def is_leaf_module(self, m: nn.Module, module_qualified_name: str) -> bool:
        return isinstance(m, Columns) or super().is_leaf_module(m, module_qualified_name)


def graph_of(module: nn.Module) -> GraphModule:
    """Trace a float module of ours with FX. The module of a quantized policy is a graph already."""
    return module if isinstance(module, GraphModule) else GraphModule(module, _Leaves().trace(module))


def with_embedding(module: nn.Module, *, alone: bool = False) -> GraphModule:
    """Return a policy's graph that gives, beside the actions, the encoder's output averaged over the tokens: (1, D).

    alone: without the actions, and what only they need. Its weights are the module's own, and its operators the same.
    """
    source = graph_of(module)
    copied = Graph()
    nodes = dict[Node, Node]()
    actions = copied.graph_copy(source.graph, nodes)
    encoded = next(nodes[node] for node in source.graph.nodes if node.target == "encoder_norm")
    embedding = copied.call_method("mean", (encoded, 1))
    copied.output(embedding if alone else (actions, embedding))
    graph = GraphModule(source, copied)
    graph.graph.eliminate_dead_code()
    graph.recompile()
    return graph
