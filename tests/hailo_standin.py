"""Stand-ins for Hailo's two Python packages, which nobody here has. They do what the documentation says, and no more.

`hailo_sdk_client` is the compiler: its ClientRunner keeps an ONNX file and those lines of a model script that change a
network's input, and writes both into a "HEF". `hailo_platform` belongs to the driver: it runs such a HEF in ONNX
Runtime, behind the interface of hailort v4.23 and v5.2 (hailo_platform/pyhailort/pyhailort.py), with channels last and
with the same checks of buffers. Nothing is quantized, so that any difference from the policy is an error of the kit or
of the runner.
"""

import contextlib
import json
import re
import struct
import sys
import types
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import ClassVar

import numpy as np
import onnx
import onnxruntime

MAGIC = b"stand-in HEF"


class HailoRTException(Exception):
    pass


class FormatType(Enum):
    AUTO = None
    UINT8 = np.uint8
    UINT16 = np.uint16
    FLOAT32 = np.float32


class Network:
    """The content of a "HEF": an ONNX model and, for each input, what the model script does to it."""

    def __init__(self, hef: bytes):
        if not hef.startswith(MAGIC):
            raise HailoRTException("Invalid HEF. See hailort.log for more information")
        (size,) = struct.unpack_from("<I", hef, len(MAGIC))
        start = len(MAGIC) + 4
        self.about = json.loads(hef[start : start + size])
        self.session = onnxruntime.InferenceSession(hef[start + size :], providers=["CPUExecutionProvider"])

    def infer(self, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        """Run the network. inputs: by the compiler's names, (h, w, c) each. Returns the outputs in the same layout."""
        given = {}
        for layer, value in inputs.items():
            about = self.about["inputs"][layer]
            x = value.astype(np.float32)
            if norm := about["normalization"]:
                x = (x - np.array(norm[0], np.float32)) / np.array(norm[1], np.float32)
            given[about["original"]] = x.transpose(2, 0, 1)[None]
        return [y[0].transpose(1, 2, 0) if y.ndim == 4 else y for y in self.session.run(None, given)]


class Stream:
    """One input or output, of a model (set_format_type) or of bindings (set_buffer, get_buffer)."""

    def __init__(self, name: str, shape: tuple[int, ...]):
        self.name, self.shape, self.type, self._buffer = name, list(shape), FormatType.UINT8, None

    def copy(self) -> "Stream":
        stream = Stream(self.name, tuple(self.shape))
        stream.type = self.type
        return stream

    def set_format_type(self, type: FormatType) -> None:
        assert isinstance(type, FormatType)
        self.type = type

    def set_buffer(self, buffer: np.ndarray) -> None:
        if not buffer.flags.c_contiguous:
            raise HailoRTException("Buffer must be C_CONTIGUOUS")
        wanted = int(np.prod(self.shape)) * np.dtype(self.type.value).itemsize
        if buffer.nbytes != wanted:
            raise HailoRTException(f"Buffer size {buffer.nbytes} is different than expected {wanted} for '{self.name}'")
        self._buffer = buffer

    def get_buffer(self) -> np.ndarray:
        return self._buffer


class Bindings:
    def __init__(self, model: "InferModel"):
        self._inputs, self._outputs = (
            {s.name: s.copy() for s in model.inputs},
            {s.name: s.copy() for s in model.outputs},
        )

    def input(self, name: str = "") -> Stream:
        return self._inputs[name] if name else next(iter(self._inputs.values()))

    def output(self, name: str = "") -> Stream:
        return self._outputs[name] if name else next(iter(self._outputs.values()))


class InferModel:
    def __init__(self, network: Network):
        self._network, about = network, network.about
        self.inputs = [Stream(name, part["shape"]) for name, part in about["inputs"].items()]
        self.outputs = [Stream(name, part["shape"]) for name, part in about["outputs"].items()]
        self.hef = self

    def get_original_names_from_vstream_name(self, name: str) -> list[str]:
        about = self._network.about
        return [(about["inputs"].get(name) or about["outputs"][name])["original"]]

    def _named(self, streams: list[Stream], name: str) -> Stream:
        return next(s for s in streams if s.name == name or (not name and len(streams) == 1))

    def input(self, name: str = "") -> Stream:
        return self._named(self.inputs, name)

    def output(self, name: str = "") -> Stream:
        return self._named(self.outputs, name)

    def configure(self) -> "Configured":
        return Configured(self)


class Configured:
    fails = False  # True: the chip no longer answers

    def __init__(self, model: InferModel):
        self._model = model

    def create_bindings(self) -> Bindings:
        return Bindings(self._model)

    def run(self, bindings: list[Bindings], timeout: int) -> None:
        assert isinstance(bindings, list) and isinstance(timeout, int)
        if Configured.fails:
            raise HailoRTException("Received a timeout - hailort has failed because a timeout had occurred")
        for b in bindings:
            inputs = {s.name: b.input(s.name).get_buffer().reshape(s.shape) for s in self._model.inputs}
            for stream, answer in zip(self._model.outputs, self._model._network.infer(inputs), strict=True):
                b.output(stream.name).get_buffer()[...] = answer.reshape(b.output(stream.name).get_buffer().shape)


class VDevice:
    def create_infer_model(self, hef_source: str | bytes, name: str = "") -> InferModel:
        return InferModel(Network(hef_source if type(hef_source) is bytes else Path(hef_source).read_bytes()))

    def release(self) -> None:
        pass


# --- the compiler -----------------------------------------------------------------------------------------------------


class InferenceContext(Enum):
    SDK_NATIVE = 1
    SDK_FP_OPTIMIZED = 2
    SDK_QUANTIZED = 3


class ClientRunner:
    renamed: ClassVar[dict[str, str]] = {}  # expected name of a layer -> what this compiler calls it
    calibrated: ClassVar[dict[str, np.ndarray]] = {}  # the data given to the last optimize()

    def __init__(self, hw_arch: str):
        assert hw_arch in ("hailo8", "hailo8l", "hailo10h")

    def translate_onnx_model(self, path, name, *, start_node_names, end_node_names, net_input_shapes):
        self._model, self._name = onnx.load(path), name
        graph = self._model.graph
        assert start_node_names == [i.name for i in graph.input] == list(net_input_shapes)
        made = {node.name: node.output[0] for node in graph.node}
        assert [made[node] for node in end_node_names] == [o.name for o in graph.output]
        constants = {i.name: len(i.dims) for i in graph.initializer}
        numbers: dict[str, int] = {}
        self._layers = {}

        def add(kind: str, original: str, **more) -> str:
            numbers[kind] = numbers.get(kind, 0) + 1
            layer = f"{name}/{self.renamed.get(f'{kind}{numbers[kind]}', f'{kind}{numbers[kind]}')}"
            self._layers[layer] = {"type": kind, "original_names": [original], **more}
            return layer

        for i in graph.input:
            add("input_layer", i.name)
        for node in graph.node:
            if node.op_type == "Conv" or (node.op_type == "MatMul" and node.input[1] in constants):
                add("conv", node.name)
            elif node.op_type == "Add" and not any(constants.get(x) == 1 for x in node.input):
                add("ew_add", node.name)
            elif node.op_type == "LayerNormalization":
                add("layer_normalization", node.name)

    def get_hn_dict(self) -> dict:
        return {"layers": self._layers}

    def save_har(self, path: str) -> None:
        Path(path).write_bytes(b"stand-in HAR")

    def load_model_script(self, path: str) -> None:
        """Accept only the commands that the model zoo's scripts use, and only names of layers that exist."""
        self._script = Path(path).read_text()
        for line in self._script.splitlines():
            command = line.partition("#")[0].strip()
            if command:
                known = (
                    r"(\w+ = )?(normalization|model_optimization_config|model_optimization_flavor|quantization_param"
                    r"|(pre|post)_quantization_optimization)\(.*\)"
                )
                assert re.fullmatch(known, command), command
            for layer in re.findall(rf"{self._name}/\w+", command):
                assert layer in self._layers, layer

    def _inputs(self) -> dict[str, dict]:
        shapes = {i.name: [d.dim_value for d in i.type.tensor_type.shape.dim] for i in self._model.graph.input}
        layers = [n for n, about in self._layers.items() if about["type"] == "input_layer"]
        norms = re.findall(r"normalization\((\[[^]]*\]), (\[[^]]*\])(?:, (\S+?))?\)", self._script)
        described = {}
        for layer, (original, (_, c, h, w)) in zip(layers, shapes.items(), strict=True):
            norm = [[json.loads(a), json.loads(b)] for a, b, on in norms if on == layer or len(layers) == 1]
            described[layer] = {"original": original, "shape": [h, w, c], "normalization": norm[0] if norm else None}
        return described

    def optimize(self, data) -> None:
        inputs = self._inputs()
        data = data if isinstance(data, dict) else dict.fromkeys(inputs, data)
        assert data.keys() == inputs.keys()
        for layer, about in inputs.items():
            assert list(data[layer].shape[1:]) == about["shape"], (layer, data[layer].shape)
        ClientRunner.calibrated = data

    @contextlib.contextmanager
    def infer_context(self, context: InferenceContext) -> Iterator[InferenceContext]:
        yield context

    def infer(self, context: InferenceContext, data):
        network = Network(self.compile())
        data = data if isinstance(data, dict) else dict.fromkeys(network.about["inputs"], data)
        rows = [network.infer({k: v[i] for k, v in data.items()}) for i in range(len(next(iter(data.values()))))]
        answers = [np.stack(column) for column in zip(*rows, strict=True)]
        return answers if len(answers) > 1 else answers[0]

    def compile(self) -> bytes:
        outputs = {}
        for o in self._model.graph.output:
            shape = [d.dim_value for d in o.type.tensor_type.shape.dim]
            node = next(n for n in self._model.graph.node if o.name in n.output)
            shape = [shape[2], shape[3], shape[1]] if len(shape) == 4 else shape
            outputs[f"{self._name}/{node.name}"] = {"original": node.name, "shape": shape}
        about = json.dumps({"inputs": self._inputs(), "outputs": outputs}).encode()
        return MAGIC + struct.pack("<I", len(about)) + about + self._model.SerializeToString()


def install(monkeypatch) -> None:
    """Install both packages until the test ends. The compiler's version reads 3.33.0."""
    platform, client = types.ModuleType("hailo_platform"), types.ModuleType("hailo_sdk_client")
    for thing in (VDevice, FormatType, HailoRTException):
        setattr(platform, thing.__name__, thing)
    for thing in (ClientRunner, InferenceContext):
        setattr(client, thing.__name__, thing)
    monkeypatch.setitem(sys.modules, "hailo_platform", platform)
    monkeypatch.setitem(sys.modules, "hailo_sdk_client", client)
    monkeypatch.setattr("importlib.metadata.version", lambda name: "3.33.0")
