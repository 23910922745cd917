"""Write a policy, or a part of one, as an ONNX graph: FX traces it, and each node is written in turn.

    model = onnx_model(graph_of(ACT(config, weights)), {"state": state, "frame_front": frame}, ("chunk",))
    model = onnx_model(quantized.module, {"state": state, "frame_front": frame}, ("chunk",))

A policy that `quantize` made is written as QDQ with exactly the scales, zero points, INT8 weights and INT32 biases of
the static artifact, so another engine computes the same numbers wherever its arithmetic is exact. torch's own exporter
is not used: it goes through TorchScript, which torch is retiring, does not know columns of pixels, and rounds biases
again. Any module that FX can trace and that is built of ACT's parts can be written. So a part of a policy, for example
for an accelerator, is a module of its own given to `graph_of`, with any number of inputs and outputs.

The graph has static shapes, one domain and operators of opset 17, which ONNX Runtime and the parsers of accelerators
know; weights are initializers inside. The same module always gives the same bytes.
"""

import itertools
import math
import operator
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.ao.nn.intrinsic import ConvReLU2d
from torch.ao.nn.intrinsic import quantized as fused_int8
from torch.ao.nn.quantized import modules as int8
from torch.fx import GraphModule, Interpreter, Node, Tracer

from rover_lib.onboard.errors import ArtifactError
from rover_lib.workshop.act import Columns

OPSET = 17  # the first with LayerNormalization, the last that Hailo's parser documents
IR_VERSION = 8  # the version of ONNX's file format that belongs to that opset
ONNX_TYPES = {torch.float32: TensorProto.FLOAT, torch.uint8: TensorProto.UINT8, torch.int8: TensorProto.INT8}


class _Leaves(Tracer):
    def is_leaf_module(self, m: nn.Module, module_qualified_name: str) -> bool:
        return isinstance(m, Columns) or super().is_leaf_module(m, module_qualified_name)


def graph_of(module: nn.Module) -> GraphModule:
    """Trace a float module of ours with FX. The module of a quantized policy is a graph already."""
    return module if isinstance(module, GraphModule) else GraphModule(module, _Leaves().trace(module))


def onnx_model(graph: GraphModule, inputs: Mapping[str, Tensor], outputs: Sequence[str]) -> onnx.ModelProto:
    """Write a graph as an ONNX model, checked by onnx.checker.

    inputs: examples keyed by the names of the model's inputs, in the order of the graph's arguments; the model takes
    their shapes and dtypes. outputs: names for what the graph returns, a tensor or a tuple of tensors. Raises
    ArtifactError for a part that this module cannot write, and names it.
    """
    writer = _Writer(graph, inputs, outputs)
    with torch.inference_mode():
        writer.run(*inputs.values())
    model = writer.model()
    onnx.checker.check_model(model, full_check=True)
    return model


class _Writer(Interpreter):
    """Runs a graph once, to learn its shapes and quantization parameters, and writes each node as ONNX."""

    def __init__(self, graph: GraphModule, inputs: Mapping[str, Tensor], outputs: Sequence[str]):
        super().__init__(graph)
        self._inputs, self._outputs = dict(inputs), list(outputs)
        self._names: dict[Node, Any] = {}  # each node's ONNX value, or a list of names for several
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[str, onnx.TensorProto] = {}
        self._made: list[Tensor] = []  # what the graph returned
        self._taken = 0  # inputs that have been given to placeholders
        self.calls: Counter[Any] = Counter()  # how often each INT8 convolution was called

    def model(self) -> onnx.ModelProto:
        """Return the ONNX model of the graph that has run."""
        used = {name for node in self._nodes for name in node.input}
        graph = helper.make_graph(
            self._nodes,
            "policy",
            [_info(name, tensor) for name, tensor in self._inputs.items()],
            [_info(name, tensor) for name, tensor in zip(self._outputs, self._made, strict=True)],
            # A scale that torch reads from a constant is not used.
            [c for name, c in self._constants.items() if name in used],
        )
        opset = helper.make_opsetid("", OPSET)
        return helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="rover_lib")

    # --- walking ---

    def run_node(self, n: Node) -> Any:
        result = super().run_node(n)
        if n.op == "output":
            self._made = list(result) if isinstance(result, (tuple, list)) else [result]
            (returned,) = _args(n)
            for name, source in zip(self._outputs, _as_list(returned), strict=True):
                self._add("Identity", [self._float(source)], name)
        else:
            self._names[n] = self._write(n, result)
        return result

    def _write(self, n: Node, result: Any) -> Any:
        if n.op == "placeholder":
            names = list(self._inputs)[self._taken :]
            if str(n.target).startswith("*"):
                return names
            self._taken += 1
            return names[0]
        if n.op == "get_attr":
            return self._constant(str(n.target), result) if isinstance(result, Tensor) else None
        module = self.fetch_attr(str(n.target)) if n.op == "call_module" else None
        kind = n.target if module is None else type(module)
        write = WRITERS.get(kind) or WRITERS.get(getattr(kind, "__name__", ""))
        if write is None:
            what = getattr(kind, "__name__", kind)
            raise ArtifactError(f"{n.name}: {what} has no form in ONNX here", remedy="add it to onnx_graph.py")
        return write(self, n, result) if module is None else write(self, n, result, module)

    # --- what writers use ---

    def _add(self, kind: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        self._nodes.append(helper.make_node(kind, list(inputs), [output], name=output, **attributes))
        return output

    def _constant(self, name: str, value: Tensor | np.ndarray) -> str:
        if name not in self._constants:
            array = value.detach().contiguous().numpy() if isinstance(value, Tensor) else value
            self._constants[name] = numpy_helper.from_array(array, name)
        return name

    def _ints(self, name: str, values: Sequence[int]) -> str:
        return self._constant(name, np.array(values, np.int64))

    def _value(self, n: Any) -> Tensor:
        """Return the tensor that a node gave in this run."""
        return self.env[n]

    def _name(self, n: Any) -> str:
        return self._names[n]

    def _unary(self, kind: str, n: Node, *constants: str, **attributes: Any) -> str:
        """Write a node of one operator, that takes the node's first argument as it is, and constants."""
        return self._add(kind, [self._name(n.args[0]), *constants], n.name, **attributes)

    def _is_columns(self, n: Any) -> bool:
        return n.op == "call_module" and isinstance(self.fetch_attr(n.target), Columns)

    def _float(self, n: Any, user: str = "output") -> str:
        """Return the name of a value in floats. Each user of an INT8 value gets its own DequantizeLinear, as in QDQ."""
        value = self._value(n)
        if not value.is_quantized:
            return self._name(n)
        output = f"{self._name(n)}_for_{user}"
        return self._add("DequantizeLinear", [self._name(n), *self._steps(self._name(n), value)], output)

    def _steps(self, name: str, value: Tensor) -> tuple[str, str]:
        """Return the names of the constants for an INT8 value's scale and zero point."""
        dtype = value.int_repr().numpy().dtype
        scale = self._constant(f"{name}_scale", np.array(value.q_scale(), np.float32))
        return scale, self._constant(f"{name}_zero_point", np.array(value.q_zero_point(), dtype))

    def _quantized(self, name: str, value: Tensor, source: str) -> str:
        """Quantize a float of the ONNX graph with the scale and zero point that torch used."""
        return self._add("QuantizeLinear", [source, *self._steps(name, value)], name)


def _info(name: str, tensor: Tensor) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, ONNX_TYPES[tensor.dtype], list(tensor.shape))


def _as_list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, (tuple, list)) else [value]


def _args(n: Node) -> list[Any]:
    """Return the nodes and plain values that a node was called with."""
    return list(n.args)


def _lowest(value: Tensor) -> int:
    return -128 if value.dtype == torch.qint8 else 0


# --- modules: (writer, node, result, module) -> name -----------------------------------------------------------------


def _columns(w: _Writer, n: Node, result: Tensor, m: Columns) -> str:
    """Cut windows of 8 pixels in each of 4 rows, 96 bytes, that begin at every second pixel of every second row.

    The stem's 7x1 convolution over 24 channels becomes one of 2x1 over these 96 (see `stacked`), because ONNX Runtime's
    kernels for a convolution are made for 64 channels, and copy and round again if there are fewer. In a row, the
    windows with the numbers p, p + 4, p + 8, ... follow each other without a gap. So the row from pixel 2 p on is,
    without moving a byte, a quarter of its windows, and the four quarters are then interleaved in pieces of 24 bytes.
    """
    (frame,) = _args(n)
    height, width, channels = w._value(frame).shape
    name = n.name
    flat = w._add("Reshape", [w._name(frame), w._ints(f"{name}_rows", [height, width * channels])], f"{name}_pixels")
    fours, phases, out_rows = -(-m.out_width // 4), m.WINDOW // 2, (m.rows - 5) // 2
    stacks = out_rows + STRIDE  # each of 4 rows; a row of the output reads two of them
    surplus = 4 * fours - m.out_width  # windows that are cut off again, if their number is no multiple of four
    right = torch.cat([m.right, m.top[:1, : 6 * surplus].expand(height, -1)], 1)
    top, bottom = (torch.cat([e, e[:, : 6 * surplus]], 1) for e in (m.top, m.bottom))
    bottom = torch.cat([bottom, top[:1]])  # the eighth row, whose weight is 0
    edges = {"left": m.left, "right": right, "top": top, "bottom": bottom}
    if m.dtype == torch.qint8:  # pixel - 128: add 128 without a carry, and read the same bits as signed
        shifted = w._add("Add", [flat, w._constant(f"{name}_128", np.array(128, np.uint8))], f"{name}_shifted")
        flat = w._add("Cast", [shifted], f"{name}_signed", to=TensorProto.INT8)
        edges = {side: (edge.to(torch.int16) - 128).to(torch.int8) for side, edge in edges.items()}
    before, after, above, below = (w._constant(f"{name}_{side}", edge) for side, edge in edges.items())
    rows = w._add("Concat", [before, flat, after], f"{name}_wide", axis=1)
    rows = w._add("Concat", [above, rows, below], f"{name}_high", axis=0)
    shape = w._ints(f"{name}_part", [stacks, fours, 1, 3 * m.WINDOW])
    axes, steps = w._ints(f"{name}_axes", [0, 1]), w._ints(f"{name}_steps", [STRIDE, 1])
    parts = []
    for p, r in itertools.product(range(phases), range(STACK)):
        start = w._ints(f"{name}_from_{p}_{r}", [r, 6 * p])
        end = w._ints(f"{name}_to_{p}_{r}", [r + STRIDE * stacks - 1, 6 * p + 24 * fours])
        part = w._add("Slice", [rows, start, end, axes, steps], f"{name}_slice_{p}_{r}")
        parts.append(w._add("Reshape", [part, shape], f"{name}_part_{p}_{r}"))
    columns = w._add("Concat", parts, f"{name}_windows", axis=2)
    whole = w._ints(f"{name}_whole", [1, stacks, 4 * fours, STACK * 3 * m.WINDOW])
    columns = w._add("Reshape", [columns, whole], f"{name}_columns")
    if surplus:
        start, end, axis = (
            w._ints(f"{name}_{k}", [v]) for k, v in (("first", 0), ("last", m.out_width), ("across", 2))
        )
        columns = w._add("Slice", [columns, start, end, axis], f"{name}_asked")
    if not result.is_quantized:
        scale = w._constant(f"{name}_scale", np.array(m.scale, np.float32))
        floats = [columns, scale, w._constant(f"{name}_zero_point", np.array(m.zero_pixel, np.uint8))]
        columns = w._add("DequantizeLinear", floats, f"{name}_floats")
    return w._add("Transpose", [columns], name, perm=[0, 3, 1, 2])


STACK, STRIDE = 4, 2  # rows in a stack of columns, and rows from one stack's first to the next one's


def stack_stem(weight: Tensor) -> Tensor:
    """Turn the stem's weight over columns, (out, 24, 7, 1), into one over stacks of 4 rows: (out, 96, 2, 1)."""
    out_channels, in_channels, _, _ = weight.shape
    eight = F.pad(weight, (0, 0, 0, 1)).reshape(out_channels, in_channels, 2, STACK)
    return eight.permute(0, 3, 1, 2).reshape(out_channels, STACK * in_channels, 2, 1)


def _geometry(m: nn.Conv2d | int8.Conv2d | nn.MaxPool2d, *, of_stacks: bool = False) -> dict[str, list[int]]:
    if of_stacks:
        return {"kernel_shape": [2, 1], "strides": [1, 1], "pads": [0] * 4, "dilations": [STACK // STRIDE, 1]}

    def both(value: Any) -> list[int]:
        return [value, value] if isinstance(value, int) else list(value)

    return {
        "kernel_shape": both(m.kernel_size),
        "strides": both(m.stride),
        "pads": both(m.padding) * 2,
        "dilations": both(m.dilation),
    }


def _conv(w: _Writer, n: Node, result: Tensor, m: Any, output: str = "") -> str:
    assert m.bias is not None
    source, of_stacks = _args(n)[0], w._is_columns(_args(n)[0])
    weight = stack_stem(m.weight) if of_stacks else m.weight
    inputs = [w._float(source, n.name), w._constant(f"{n.target}.weight", weight)]
    inputs.append(w._constant(f"{n.target}.bias", m.bias))
    return w._add("Conv", inputs, output or n.name, **_geometry(m, of_stacks=of_stacks))


def _conv_relu(w: _Writer, n: Node, result: Tensor, m: ConvReLU2d) -> str:
    return w._add("Relu", [_conv(w, n, result, m[0], f"{n.name}_sums")], n.name)


def _int8_conv(w: _Writer, n: Node, result: Tensor, m: int8.Conv2d) -> str:
    """Write a convolution between DequantizeLinear and QuantizeLinear. Engines compute it in INT8 with INT32 sums."""
    source, weight, bias = _args(n)[0], m.weight(), m.bias()
    assert bias is not None
    scales, zeros = weight.q_per_channel_scales(), weight.q_per_channel_zero_points()
    sums = scales * w._value(source).q_scale()
    whole_bias = torch.quantize_per_channel(bias.detach(), sums, torch.zeros_like(zeros), 0, torch.qint32).int_repr()
    of_stacks = w._is_columns(source)
    inputs = [w._float(source, n.name)]
    w.calls[n.target] += 1
    again = f"_{w.calls[n.target]}" if w.calls[n.target] > 1 else ""
    for part, values, steps, zero_type in (
        ("weight", stack_stem(weight.int_repr()) if of_stacks else weight.int_repr(), scales, np.int8),
        ("bias", whole_bias, sums, np.int32),
    ):
        # The backbone runs once for each camera. Its weights are stored once, its biases for each camera, because their
        # scale depends on that of the camera's pixels.
        made = f"{n.target}.{part}{again}"
        name = f"{n.target}.{part}" if part == "weight" else made
        scale = w._constant(f"{name}_scale", steps.float())
        zero = w._constant(f"{name}_zero_point", np.zeros(len(steps), zero_type))
        inputs.append(w._add("DequantizeLinear", [w._constant(name, values), scale, zero], f"{made}_floats", axis=0))
    sums_name = w._add("Conv", inputs, f"{n.name}_sums", **_geometry(m, of_stacks=of_stacks))
    return _rounded(w, n, result, sums_name, relu=isinstance(m, fused_int8.ConvReLU2d))


def _rounded(w: _Writer, n: Node, result: Tensor, source: str, *, relu: bool) -> str:
    """Quantize a result, after a ReLU if there is one and clipping at the zero point does not do the same."""
    if relu and result.q_zero_point() != _lowest(result):
        source = w._add("Relu", [source], f"{n.name}_positive")
    return w._quantized(n.name, result, source)


def _linear(w: _Writer, n: Node, result: Tensor, m: nn.Linear) -> str:
    weight = w._constant(f"{n.target}.weight", m.weight.T)
    product = w._add("MatMul", [w._float(_args(n)[0], n.name), weight], f"{n.name}_product")
    return w._add("Add", [product, w._constant(f"{n.target}.bias", m.bias)], n.name)


def _max_pool(w: _Writer, n: Node, result: Tensor, m: nn.MaxPool2d) -> str:
    return w._unary("MaxPool", n, **_geometry(m))  # works on INT8 values too


def _layer_norm(w: _Writer, n: Node, result: Tensor, m: nn.LayerNorm) -> str:
    inputs = [w._float(_args(n)[0], n.name), w._constant(f"{n.target}.weight", m.weight)]
    inputs.append(w._constant(f"{n.target}.bias", m.bias))
    return w._add("LayerNormalization", inputs, n.name, axis=-1, epsilon=m.eps)


def _relu(w: _Writer, n: Node, result: Tensor, m: nn.ReLU) -> str:
    return w._add("Relu", [w._float(_args(n)[0], n.name)], n.name)


def _gelu(w: _Writer, n: Node, result: Tensor, m: nn.GELU) -> str:
    x = w._float(_args(n)[0], n.name)
    parts = {"root": math.sqrt(2), "one": 1.0, "half": 0.5}
    root, one, half = (w._constant(f"gelu_{k}", np.array(v, np.float32)) for k, v in parts.items())
    y = w._add("Erf", [w._add("Div", [x, root], f"{n.name}_scaled")], f"{n.name}_erf")
    y = w._add("Mul", [x, w._add("Add", [y, one], f"{n.name}_share")], f"{n.name}_twice")
    return w._add("Mul", [y, half], n.name)


def _same(w: _Writer, n: Node, result: Any, m: nn.Module | None = None) -> str:
    return w._name(_args(n)[0])


# --- functions and methods: (writer, node, result) -> name ------------------------------------------------------------


def _getitem(w: _Writer, n: Node, result: Any) -> Any:
    source, index = _args(n)
    if isinstance(names := w._name(source), list):
        return names[index]
    parts = _as_list(index)
    if any(p is not None and p != slice(None) for p in parts):
        raise ArtifactError(f"{n.name}: only new axes are taken, not [{index}]", remedy="add it to onnx_graph.py")
    axes = [i for i, p in enumerate(parts) if p is None]
    return w._add("Unsqueeze", [names, w._ints(f"{n.name}_axes", axes)], n.name)


def _transpose(w: _Writer, n: Node, result: Tensor) -> str:
    _, *axes = _args(n)
    perm = list(range(result.dim()))
    if n.target == "permute":
        perm = [a % result.dim() for a in axes]
    else:
        a, b = axes
        perm[a], perm[b] = perm[b], perm[a]
    return w._unary("Transpose", n, perm=perm)


def _reshape(w: _Writer, n: Node, result: Tensor) -> str:
    return w._unary("Reshape", n, w._ints(f"{n.name}_shape", result.shape))


def _squeeze(w: _Writer, n: Node, result: Tensor) -> str:
    return w._unary(str(n.target).capitalize(), n, w._ints(f"{n.name}_axes", _args(n)[1:]))


def _cast(w: _Writer, n: Node, result: Tensor) -> str:
    return w._unary("Cast", n, to=ONNX_TYPES[result.dtype])


def _cat(w: _Writer, n: Node, result: Tensor) -> str:
    parts, axis = _args(n)
    return w._add("Concat", [w._float(p, n.name) for p in parts], n.name, axis=axis)


def _binary(kind: str) -> Callable[[_Writer, Node, Tensor], str]:
    return lambda w, n, result: w._add(kind, [w._float(x, n.name) for x in _args(n)], n.name)


def _addcmul(w: _Writer, n: Node, result: Tensor) -> str:
    x, y, scale = (w._float(a, n.name) for a in _args(n))
    return w._add("Add", [x, w._add("Mul", [y, scale], f"{n.name}_product")], n.name)


def _attend(w: _Writer, n: Node, result: Tensor) -> str:
    q, k, v = (w._float(a, n.name) for a in _args(n))
    scale = w._constant(f"{n.name}_scale", np.array(1 / math.sqrt(result.shape[-1]), np.float32))
    q = w._add("Mul", [q, scale], f"{n.name}_queries")
    k = w._add("Transpose", [k], f"{n.name}_keys", perm=[0, 1, 3, 2])
    shares = w._add("Softmax", [w._add("MatMul", [q, k], f"{n.name}_scores")], f"{n.name}_shares", axis=-1)
    return w._add("MatMul", [shares, v], n.name)


def _quantize(w: _Writer, n: Node, result: Tensor) -> str:
    return w._quantized(n.name, result, w._float(_args(n)[0], n.name))


def _dequantize(w: _Writer, n: Node, result: Tensor) -> str:
    return w._float(_args(n)[0], n.name)


def _int8_add(w: _Writer, n: Node, result: Tensor) -> str:
    x, y, *_ = _args(n)
    both = [w._float(x, f"{n.name}_left"), w._float(y, f"{n.name}_right")]
    return _rounded(w, n, result, w._add("Add", both, f"{n.name}_sum"), relu=n.target is torch.ops.quantized.add_relu)


WRITERS: dict[Any, Callable[..., Any]] = {
    Columns: _columns,
    nn.Conv2d: _conv,
    ConvReLU2d: _conv_relu,
    int8.Conv2d: _int8_conv,
    fused_int8.ConvReLU2d: _int8_conv,
    nn.Linear: _linear,
    nn.MaxPool2d: _max_pool,
    nn.LayerNorm: _layer_norm,
    nn.ReLU: _relu,
    nn.GELU: _gelu,
    nn.Identity: _same,
    operator.getitem: _getitem,
    **dict.fromkeys(("transpose", "permute"), _transpose),
    **dict.fromkeys(("flatten", "unflatten", "reshape"), _reshape),
    **dict.fromkeys(("squeeze", "unsqueeze"), _squeeze),
    "float": _cast,
    torch.cat: _cat,
    **dict.fromkeys((operator.add, "add"), _binary("Add")),  # "add": a constant plus a value, in this order
    **dict.fromkeys((operator.mul, "mul"), _binary("Mul")),
    torch.addcmul: _addcmul,
    F.scaled_dot_product_attention: _attend,
    torch.quantize_per_tensor: _quantize,
    "dequantize": _dequantize,
    "int_repr": _same,
    torch.ops.quantized.add_relu: _int8_add,
    torch.ops.quantized.add: _int8_add,
}
