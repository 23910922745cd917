"""Write a policy, or a part of one, as an ONNX graph: FX traces it, and each node is written in turn.

    model = onnx_model(graph_of(ACT(config, weights)), {"state": state, "frame_front": frame}, ("chunk",))
    model = onnx_model(quantized.module, {"state": state, "frame_front": frame}, ("chunk",))

Static INT8 is written as QDQ with exactly the scales, zero points, INT8 weights and INT32 biases of the static
artifact, so another engine computes the same numbers wherever its arithmetic is exact. torch's own exporter does not
know columns of pixels, and rounds biases again. The graph has static shapes and operators of opset 17; the same module
always gives the same bytes.
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
from torch.ao.nn.intrinsic import quantized as fused_int8
from torch.ao.nn.quantized import modules as int8
from torch.fx import GraphModule, Interpreter, Node

from rover_lib.onboard.errors import ArtifactError
from rover_lib.workshop.act import Columns

OPSET = 17  # the first with LayerNormalization
IR_VERSION = 8  # the version of ONNX's file format that belongs to that opset
ONNX_TYPES = {torch.float32: TensorProto.FLOAT, torch.uint8: TensorProto.UINT8, torch.int8: TensorProto.INT8}


def onnx_model(graph: GraphModule, inputs: Mapping[str, Tensor], outputs: Sequence[str]) -> onnx.ModelProto:
    """Write a graph as an ONNX model, checked by onnx.checker.

    inputs: examples by name, in the order of the graph's arguments, whose shapes and dtypes the model takes. outputs:
    names for what the graph returns, a tensor or a tuple of them. Raises ArtifactError for a part that cannot be
    written.
    """
    writer = _Writer(graph, inputs, outputs)
    with torch.inference_mode():
        results = writer.run(*inputs.values())
    model = writer.model(_as_list(results))
    onnx.checker.check_model(model, full_check=True)
    return model


class _Writer(Interpreter):
    """Runs a graph once, to learn its shapes and quantization parameters, and writes each node as ONNX.

    names: by node, its ONNX value, or a list of them. env: by node, its value. calls: of each INT8 convolution.
    """

    def __init__(self, graph: GraphModule, inputs: Mapping[str, Tensor], outputs: Sequence[str]):
        super().__init__(graph)
        self._inputs = dict(inputs)
        self._outputs = list(outputs)
        self._free = iter(self._inputs)  # names that no placeholder has taken yet
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[str, onnx.TensorProto] = {}
        self.names: dict[Any, Any] = {}
        self.calls: Counter[Any] = Counter()

    def model(self, outputs: Sequence[Tensor]) -> onnx.ModelProto:
        """Return the ONNX model of the graph that has run. outputs: what it returned."""
        used = set[str]()
        for node in self._nodes:
            used.update(node.input)
        graph = helper.make_graph(
            self._nodes,
            "policy",
            [_info(name, tensor) for name, tensor in self._inputs.items()],
            [_info(name, tensor) for name, tensor in zip(self._outputs, outputs, strict=True)],
            # A scale that torch reads from a constant is not used.
            [c for name, c in self._constants.items() if name in used],
        )
        opset = helper.make_opsetid("", OPSET)
        return helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="rover_lib")

    def run_node(self, n: Node) -> Any:
        result = super().run_node(n)
        if n.op == "output":
            for name, source in zip(self._outputs, _as_list(n.args[0]), strict=True):
                self.add("Identity", [self.as_float(source)], name)
        else:
            self.names[n] = self._write(n, result)
        return result

    def _write(self, n: Node, result: Any) -> Any:
        if n.op == "placeholder":
            return list(self._free) if str(n.target).startswith("*") else next(self._free)
        if n.op == "get_attr":
            return self.constant(str(n.target), result) if isinstance(result, Tensor) else None
        module = self.fetch_attr(str(n.target)) if n.op == "call_module" else None
        kind = n.target if module is None else type(module)
        write = WRITERS.get(kind) or WRITERS.get(getattr(kind, "__name__", ""))
        if write is None:
            kind_name = getattr(kind, "__name__", kind)
            raise ArtifactError(f"{n.name}: {kind_name} has no form in ONNX here", remedy="add it to onnx_graph.py")
        return write(self, n, result, module)

    def add(self, kind: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        self._nodes.append(helper.make_node(kind, list(inputs), [output], name=output, **attributes))
        return output

    def unary(self, kind: str, n: Node, *constants: str, **attributes: Any) -> str:
        """Write a node of one operator, that takes the node's first argument as it is, and constants."""
        return self.add(kind, [self.names[n.args[0]], *constants], n.name, **attributes)

    def constant(self, name: str, value: Any) -> str:
        if name not in self._constants:
            array = value.detach().contiguous().numpy() if isinstance(value, Tensor) else value
            self._constants[name] = numpy_helper.from_array(array, name)
        return name

    def ints(self, name: str, values: Sequence[int]) -> str:
        return self.constant(name, np.array(values, np.int64))

    def floats(self, n: Node) -> list[str]:
        return [self.as_float(x, n.name) for x in n.args]

    def as_float(self, n: Any, user: str = "output") -> str:
        """Return the name of a value in floats. Each user of an INT8 value gets its own DequantizeLinear, as in QDQ."""
        value = self.env[n]
        name = self.names[n]
        if not value.is_quantized:
            return name
        return self.add("DequantizeLinear", [name, *self._steps(name, value)], f"{name}_for_{user}")

    def quantized(self, name: str, value: Tensor, source: str) -> str:
        """Quantize a float of the ONNX graph with the scale and zero point that torch used."""
        return self.add("QuantizeLinear", [source, *self._steps(name, value)], name)

    def _steps(self, name: str, value: Tensor) -> tuple[str, str]:
        """Return the names of the constants for an INT8 value's scale and zero point."""
        dtype = value.int_repr().numpy().dtype
        scale = self.constant(f"{name}_scale", np.array(value.q_scale(), np.float32))
        return scale, self.constant(f"{name}_zero_point", np.array(value.q_zero_point(), dtype))


def _info(name: str, tensor: Tensor) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, ONNX_TYPES[tensor.dtype], list(tensor.shape))


def _as_list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, (tuple, list)) else [value]


STACK, STRIDE = 4, 2  # rows in a stack of columns, and rows from one stack's first to the next one's


def _columns(w: _Writer, n: Node, result: Tensor, m: Columns) -> str:
    """Cut windows of 8 pixels in each of 4 rows, 96 bytes, that begin at every second pixel of every second row.

    The stem's 7x1 convolution over 24 channels becomes one of 2x1 over these 96 (see `stack_stem`), because ONNX
    Runtime's kernels are made for 64 channels. In a row, the windows p, p + 4, p + 8, ... follow each other without a
    gap, so the row from pixel 2 p on is a quarter of its windows, and the four quarters are then interleaved.
    """
    frame = n.all_input_nodes[0]
    name = n.name
    height, width, channels = w.env[frame].shape
    flat = w.add("Reshape", [w.names[frame], w.ints(f"{name}_rows", [height, width * channels])], f"{name}_pixels")
    fours = -(-m.out_width // 4)
    phases = m.WINDOW // 2
    out_rows = (m.rows - 5) // 2
    stacks = out_rows + STRIDE  # each of 4 rows; a row of the output reads two of them
    surplus = 4 * fours - m.out_width  # windows that are cut off again, if their number is no multiple of four
    right = torch.cat([m.right, m.top[:1, : 6 * surplus].expand(height, -1)], 1)
    top, bottom = (torch.cat([e, e[:, : 6 * surplus]], 1) for e in (m.top, m.bottom))
    bottom = torch.cat([bottom, top[:1]])  # the eighth row, whose weight is 0
    edges = {"left": m.left, "right": right, "top": top, "bottom": bottom}
    if m.quantized:  # pixel - 128: add 128 without a carry, and read the same bits as signed
        shifted = w.add("Add", [flat, w.constant(f"{name}_128", np.array(128, np.uint8))], f"{name}_shifted")
        flat = w.add("Cast", [shifted], f"{name}_signed", to=TensorProto.INT8)
        edges = {side: (edge.to(torch.int16) - 128).to(torch.int8) for side, edge in edges.items()}
    before, after, above, below = (w.constant(f"{name}_{side}", edge) for side, edge in edges.items())
    rows = w.add("Concat", [before, flat, after], f"{name}_wide", axis=1)
    rows = w.add("Concat", [above, rows, below], f"{name}_high", axis=0)
    shape = w.ints(f"{name}_part", [stacks, fours, 1, 3 * m.WINDOW])
    axes = w.ints(f"{name}_axes", [0, 1])
    steps = w.ints(f"{name}_steps", [STRIDE, 1])
    parts = []
    for p, r in itertools.product(range(phases), range(STACK)):
        start = w.ints(f"{name}_from_{p}_{r}", [r, 6 * p])
        end = w.ints(f"{name}_to_{p}_{r}", [r + STRIDE * stacks - 1, 6 * p + 24 * fours])
        part = w.add("Slice", [rows, start, end, axes, steps], f"{name}_slice_{p}_{r}")
        parts.append(w.add("Reshape", [part, shape], f"{name}_part_{p}_{r}"))
    columns = w.add("Concat", parts, f"{name}_windows", axis=2)
    whole = w.ints(f"{name}_whole", [1, stacks, 4 * fours, STACK * 3 * m.WINDOW])
    columns = w.add("Reshape", [columns, whole], f"{name}_columns")
    if surplus:
        ends = {"first": 0, "last": m.out_width, "across": 2}
        columns = w.add("Slice", [columns, *(w.ints(f"{name}_{k}", [v]) for k, v in ends.items())], f"{name}_asked")
    return w.add("Transpose", [columns], name, perm=[0, 3, 1, 2])


def stack_stem(weight: Tensor) -> Tensor:
    """Turn the stem's weight over columns, (out, 24, 7, 1), into one over stacks of 4 rows: (out, 96, 2, 1)."""
    out_channels, in_channels, _, _ = weight.shape
    eight = F.pad(weight, (0, 0, 0, 1)).reshape(out_channels, in_channels, 2, STACK)
    return eight.permute(0, 3, 1, 2).reshape(out_channels, STACK * in_channels, 2, 1)


def _geometry(m: Any) -> dict[str, list[int]]:
    sizes = {"kernel_shape": m.kernel_size, "strides": m.stride, "pads": m.padding, "dilations": m.dilation}
    both = {name: [size, size] if isinstance(size, int) else list(size) for name, size in sizes.items()}
    return both | {"pads": both["pads"] * 2}


def _conv(w: _Writer, n: Node, result: Tensor, m: nn.Conv2d) -> str:
    inputs = [*w.floats(n), w.constant(f"{n.target}.weight", m.weight), w.constant(f"{n.target}.bias", m.bias)]
    return w.add("Conv", inputs, n.name, **_geometry(m))


def _int8_conv(w: _Writer, n: Node, result: Tensor, m: int8.Conv2d) -> str:
    """Write a convolution between DequantizeLinear and QuantizeLinear. Engines compute it in INT8 with INT32 sums."""
    source = n.all_input_nodes[0]
    weight = m.weight()
    bias = m.bias()
    assert bias is not None
    scales = weight.q_per_channel_scales()
    zeros = weight.q_per_channel_zero_points()
    sums = scales * w.env[source].q_scale()
    whole_bias = torch.quantize_per_channel(bias.detach(), sums, torch.zeros_like(zeros), 0, torch.qint32).int_repr()
    whole_weight = weight.int_repr()
    geometry = _geometry(m)
    if source.op == "call_module" and isinstance(w.fetch_attr(str(source.target)), Columns):
        whole_weight = stack_stem(whole_weight)
        geometry = {"kernel_shape": [2, 1], "strides": [1, 1], "pads": [0] * 4, "dilations": [STACK // STRIDE, 1]}
    inputs = w.floats(n)
    w.calls[n.target] += 1
    again = f"_{w.calls[n.target]}" if w.calls[n.target] > 1 else ""
    for part, values, steps, zero_type in (
        ("weight", whole_weight, scales, np.int8),
        ("bias", whole_bias, sums, np.int32),
    ):
        # The backbone runs once for each camera: one weight, and a bias for each, whose scale is that of its pixels.
        node_name = f"{n.target}.{part}{again}"
        name = f"{n.target}.{part}" if part == "weight" else node_name
        scale = w.constant(f"{name}_scale", steps.float())
        zero = w.constant(f"{name}_zero_point", np.zeros(len(steps), zero_type))
        inputs.append(w.add("DequantizeLinear", [w.constant(name, values), scale, zero], f"{node_name}_floats", axis=0))
    sums_name = w.add("Conv", inputs, f"{n.name}_sums", **geometry)
    return _rounded(w, n, result, sums_name, relu=isinstance(m, fused_int8.ConvReLU2d))


def _rounded(w: _Writer, n: Node, result: Tensor, source: str, *, relu: bool) -> str:
    """Quantize a result, after a ReLU if there is one and clipping at the zero point does not do the same."""
    if relu and result.q_zero_point() != -128:
        source = w.add("Relu", [source], f"{n.name}_positive")
    return w.quantized(n.name, result, source)


def _linear(w: _Writer, n: Node, result: Tensor, m: nn.Linear) -> str:
    weight = w.constant(f"{n.target}.weight", m.weight.T)
    product = w.add("MatMul", [*w.floats(n), weight], f"{n.name}_product")
    return w.add("Add", [product, w.constant(f"{n.target}.bias", m.bias)], n.name)


def _max_pool(w: _Writer, n: Node, result: Tensor, m: nn.MaxPool2d) -> str:
    return w.unary("MaxPool", n, **_geometry(m))  # works on INT8 values too


def _layer_norm(w: _Writer, n: Node, result: Tensor, m: nn.LayerNorm) -> str:
    inputs = [*w.floats(n), w.constant(f"{n.target}.weight", m.weight), w.constant(f"{n.target}.bias", m.bias)]
    return w.add("LayerNormalization", inputs, n.name, axis=-1, epsilon=m.eps)


def _gelu(w: _Writer, n: Node, result: Tensor, m: nn.GELU) -> str:
    (x,) = w.floats(n)
    parts = {"root": math.sqrt(2), "one": 1.0, "half": 0.5}
    root, one, half = (w.constant(f"gelu_{k}", np.array(v, np.float32)) for k, v in parts.items())
    y = w.add("Erf", [w.add("Div", [x, root], f"{n.name}_scaled")], f"{n.name}_erf")
    y = w.add("Mul", [x, w.add("Add", [y, one], f"{n.name}_share")], f"{n.name}_twice")
    return w.add("Mul", [y, half], n.name)


def _same(w: _Writer, n: Node, result: Any, m: Any) -> str:
    return w.names[n.args[0]]


def _getitem(w: _Writer, n: Node, result: Any, m: None) -> Any:
    source = n.args[0]
    index = _as_list(n.args[1])
    if isinstance(names := w.names[source], list):
        return names[index[0]]
    if any(p is not None and p != slice(None) for p in index):
        raise ArtifactError(f"{n.name}: only new axes are taken, not {index}", remedy="add it to onnx_graph.py")
    axes = [i for i, p in enumerate(index) if p is None]
    return w.add("Unsqueeze", [names, w.ints(f"{n.name}_axes", axes)], n.name)


def _transpose(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    _, *axes = n.args
    perm: list[Any] = list(range(result.dim()))
    if n.target == "permute":
        perm = [a % result.dim() for a in axes]  # type: ignore[operator]
    else:
        a, b = axes
        perm[a], perm[b] = perm[b], perm[a]  # type: ignore[index]
    return w.unary("Transpose", n, perm=perm)


def _reshape(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    return w.unary("Reshape", n, w.ints(f"{n.name}_shape", result.shape))


def _squeeze(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    return w.unary(str(n.target).capitalize(), n, w.ints(f"{n.name}_axes", n.args[1:]))  # type: ignore[arg-type]


def _mean(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    return w.unary("ReduceMean", n, axes=[n.args[1]], keepdims=0)


def _cast(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    return w.unary("Cast", n, to=ONNX_TYPES[result.dtype])


def _cat(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    parts: Any = n.args[0]
    return w.add("Concat", [w.as_float(p, n.name) for p in parts], n.name, axis=n.args[1])


def _plain(kind: str) -> Callable[[_Writer, Node, Tensor, Any], str]:
    """Return the writer of an operator that takes all arguments in floats."""
    return lambda w, n, result, m: w.add(kind, w.floats(n), n.name)


def _addcmul(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    x, y, scale = w.floats(n)
    return w.add("Add", [x, w.add("Mul", [y, scale], f"{n.name}_product")], n.name)


def _attend(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    q, k, v = w.floats(n)
    scale = w.constant(f"{n.name}_scale", np.array(1 / math.sqrt(result.shape[-1]), np.float32))
    q = w.add("Mul", [q, scale], f"{n.name}_queries")
    k = w.add("Transpose", [k], f"{n.name}_keys", perm=[0, 1, 3, 2])
    shares = w.add("Softmax", [w.add("MatMul", [q, k], f"{n.name}_scores")], f"{n.name}_shares", axis=-1)
    return w.add("MatMul", [shares, v], n.name)


def _quantize(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    return w.quantized(n.name, result, w.as_float(n.args[0], n.name))


def _dequantize(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    return w.as_float(n.args[0], n.name)


def _int8_add(w: _Writer, n: Node, result: Tensor, m: None) -> str:
    x, y, *_ = n.args
    both = [w.as_float(x, f"{n.name}_left"), w.as_float(y, f"{n.name}_right")]
    return _rounded(w, n, result, w.add("Add", both, f"{n.name}_sum"), relu=n.target is torch.ops.quantized.add_relu)


WRITERS: dict[Any, Callable[..., Any]] = {
    Columns: _columns,
    nn.Conv2d: _conv,
    **dict.fromkeys((int8.Conv2d, fused_int8.ConvReLU2d), _int8_conv),
    nn.Linear: _linear,
    nn.MaxPool2d: _max_pool,
    nn.LayerNorm: _layer_norm,
    nn.ReLU: _plain("Relu"),
    nn.GELU: _gelu,
    **dict.fromkeys((nn.Identity, "int_repr"), _same),
    operator.getitem: _getitem,
    **dict.fromkeys(("transpose", "permute"), _transpose),
    **dict.fromkeys(("flatten", "unflatten", "reshape"), _reshape),
    **dict.fromkeys(("squeeze", "unsqueeze"), _squeeze),
    "float": _cast,
    "mean": _mean,
    torch.cat: _cat,
    **dict.fromkeys((operator.add, "add"), _plain("Add")),  # "add": a constant plus a value, in this order
    **dict.fromkeys((operator.mul, "mul"), _plain("Mul")),
    torch.addcmul: _addcmul,
    F.scaled_dot_product_attention: _attend,
    torch.quantize_per_tensor: _quantize,
    "dequantize": _dequantize,
    **dict.fromkeys((torch.ops.quantized.add_relu, torch.ops.quantized.add), _int8_add),
}
