"""Stand-ins for Hailo's two Python packages, which nobody here has. They do what the documentation says, and no more.

`hailo_sdk_client` is the compiler: its ClientRunner writes an ONNX file and the normalisation of its inputs into a
"HEF". `hailo_platform` belongs to the driver: it runs such a HEF in ONNX Runtime, behind the interface of hailort v4.23
and v5.2 (hailo_platform/pyhailort/pyhailort.py), with channels last and with the same checks of buffers. Nothing is
quantized, so that any difference from the policy is an error of the kit or of the runner.
"""

import json
import re
import struct
import sys
import types
from enum import Enum
from pathlib import Path
from typing import ClassVar

import numpy as np
import onnx
import onnxruntime

MAGIC = b"stand-in HEF"
COMMAND = (
    r"(\w+ = )?(normalization|model_optimization_config|model_optimization_flavor|quantization_param"
    r"|pre_quantization_optimization)\(.*\)"
)


class HailoRTException(Exception):
    pass


class FormatType(Enum):
    UINT8 = np.uint8
    FLOAT32 = np.float32


class Stream:
    """One input or output, of a model and of its bindings."""

    def __init__(self, name: str, shape: list[int]):
        self.name, self.shape, self.type = name, shape, FormatType.UINT8

    def set_format_type(self, type: FormatType) -> None:
        self.type = FormatType(type)

    def set_buffer(self, buffer: np.ndarray) -> None:
        wanted = int(np.prod(self.shape)) * np.dtype(self.type.value).itemsize
        if not buffer.flags.c_contiguous or buffer.nbytes != wanted:
            raise HailoRTException(f"Buffer size {buffer.nbytes} is different than expected {wanted} for '{self.name}'")
        self.buffer = buffer


class InferModel:
    """A network on the chip: also what configure() and create_bindings() return of it."""

    def __init__(self, hef: bytes):
        if not hef.startswith(MAGIC):
            raise HailoRTException("Invalid HEF. See hailort.log for more information")
        (size,) = struct.unpack_from("<I", hef, len(MAGIC))
        start = len(MAGIC) + 4
        self.about, self.hef = json.loads(hef[start : start + size]), self
        self.session = onnxruntime.InferenceSession(hef[start + size :], providers=["CPUExecutionProvider"])
        self.inputs = [Stream(name, part["shape"]) for name, part in self.about["inputs"].items()]
        self.outputs = [Stream(name, part["shape"]) for name, part in self.about["outputs"].items()]

    def get_original_names_from_vstream_name(self, name: str) -> list[str]:
        return [(self.about["inputs"] | self.about["outputs"])[name]["original"]]

    def input(self, name: str) -> Stream:
        return next(s for s in self.inputs if s.name == name)

    def output(self, name: str) -> Stream:
        return next(s for s in self.outputs if s.name == name)

    def configure(self) -> "Configured":
        return Configured(self)


class Configured:
    fails = False  # True: the chip no longer answers

    def __init__(self, model: InferModel):
        self._model = model

    def create_bindings(self) -> InferModel:
        return self._model

    def run(self, bindings: list[InferModel], timeout: int) -> None:
        if Configured.fails:
            raise HailoRTException("Received a timeout - hailort has failed because a timeout had occurred")
        (model,), given = bindings, {}
        for stream in model.inputs:
            about, x = model.about["inputs"][stream.name], stream.buffer.reshape(stream.shape).astype(np.float32)
            if norm := about["normalization"]:
                x = (x - np.array(norm[0], np.float32)) / np.array(norm[1], np.float32)
            given[about["original"]] = x.transpose(2, 0, 1)[None]
        for stream, y in zip(model.outputs, model.session.run(None, given), strict=True):
            stream.buffer[...] = (y[0].transpose(1, 2, 0) if y.ndim == 4 else y).reshape(stream.buffer.shape)


class VDevice:
    def create_infer_model(self, hef_source: str | bytes) -> InferModel:
        return InferModel(hef_source if type(hef_source) is bytes else Path(hef_source).read_bytes())


class ClientRunner:
    first: ClassVar[int] = 1  # number of the first input layer
    calibrated: ClassVar[dict[str, np.ndarray]] = {}  # the data given to the last optimize()

    def __init__(self, hw_arch: str):
        assert hw_arch in ("hailo8", "hailo8l", "hailo10h")

    def translate_onnx_model(self, path, name, *, start_node_names, end_node_names, net_input_shapes):
        self._model, self._name = onnx.load(path), name
        graph = self._model.graph
        assert start_node_names == [i.name for i in graph.input] == list(net_input_shapes)
        made = {node.name: node.output[0] for node in graph.node}
        assert [made[node] for node in end_node_names] == [o.name for o in graph.output]
        self._inputs = {}
        for i, (original, (_, c, h, w)) in enumerate(net_input_shapes.items(), self.first):
            self._inputs[f"{name}/input_layer{i}"] = {"original": original, "shape": [h, w, c], "normalization": None}

    def get_hn_dict(self) -> dict:
        return {"layers": {layer: {"original_names": [about["original"]]} for layer, about in self._inputs.items()}}

    def save_har(self, path: str) -> None:
        Path(path).write_bytes(b"stand-in HAR")

    def load_model_script(self, path: str) -> None:
        """Accept only the commands that the model zoo's scripts use."""
        for line in Path(path).read_text().splitlines():
            command = line.partition("#")[0].strip()
            assert not command or re.fullmatch(COMMAND, command), command
            if found := re.search(r"normalization\((\[[^]]*\]), (\[[^]]*\])(?:, (\S+))?\)", command):
                self._inputs[found[3] or next(iter(self._inputs))]["normalization"] = [
                    json.loads(found[1]),
                    json.loads(found[2]),
                ]

    def optimize(self, data) -> None:
        data = data if isinstance(data, dict) else dict.fromkeys(self._inputs, data)
        assert {layer: list(x.shape[1:]) for layer, x in data.items()} == {
            layer: about["shape"] for layer, about in self._inputs.items()
        }
        ClientRunner.calibrated = data

    def compile(self) -> bytes:
        outputs = {}
        for o in self._model.graph.output:
            shape = [d.dim_value for d in o.type.tensor_type.shape.dim]
            node = next(n for n in self._model.graph.node if o.name in n.output)
            shape = [shape[2], shape[3], shape[1]] if len(shape) == 4 else shape
            outputs[f"{self._name}/{node.name}"] = {"original": node.name, "shape": shape}
        about = json.dumps({"inputs": self._inputs, "outputs": outputs}).encode()
        return MAGIC + struct.pack("<I", len(about)) + about + self._model.SerializeToString()


def install(monkeypatch) -> None:
    """Install both packages until the test ends."""
    platform, client = types.ModuleType("hailo_platform"), types.ModuleType("hailo_sdk_client")
    platform.VDevice, platform.FormatType, client.ClientRunner = VDevice, FormatType, ClientRunner
    monkeypatch.setitem(sys.modules, "hailo_platform", platform)
    monkeypatch.setitem(sys.modules, "hailo_sdk_client", client)
