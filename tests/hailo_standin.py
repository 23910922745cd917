"""Stand-ins for Hailo's two Python packages, which nobody here has. They do what the documentation says, and no more.

`hailo_sdk_client` is the compiler: its ClientRunner writes an ONNX file and the normalisation of its inputs into a
"HEF". `hailo_platform` belongs to the driver: it runs such a HEF in ONNX Runtime, behind the interface of hailort v4.23
and v5.2 (hailo_platform/pyhailort/pyhailort.py), with channels last. Nothing is quantized, so that any difference from
the policy is an error of the kit or of the runner.
"""

import json
import re
import sys
import types
from enum import Enum
from pathlib import Path
from typing import ClassVar

import numpy as np
import onnx
import onnxruntime

MAGIC = b"stand-in HEF"
NORMALIZATION = r"normalization\d+ = normalization\((\[[^]]*\]), (\[[^]]*\])\)"


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
    """A network of one input on the chip: also what configure() and create_bindings() return of it, and its HEF."""

    fails = False  # True: the chip no longer answers

    def __init__(self, hef: bytes):
        if not hef.startswith(MAGIC):
            raise HailoRTException("Invalid HEF. See hailort.log for more information")
        about, _, model = hef.removeprefix(MAGIC).partition(b"\0")
        self.about, self.hef = json.loads(about), self
        self.session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
        self.inputs, self.outputs = ([Stream(name, shape)] for name, shape, _ in self.about["streams"])

    def get_original_names_from_vstream_name(self, name: str) -> list[str]:
        return [original for stream, _, original in self.about["streams"] if stream == name]

    def input(self, name: str) -> Stream:
        return next(s for s in self.inputs if s.name == name)

    def output(self, name: str) -> Stream:
        return next(s for s in self.outputs if s.name == name)

    def configure(self) -> "InferModel":
        return self

    create_bindings = configure

    def run(self, bindings: list["InferModel"], timeout: int) -> None:
        if InferModel.fails:
            raise HailoRTException("Received a timeout - hailort has failed because a timeout had occurred")
        (given,), (answer,), (mean, std) = self.inputs, self.outputs, self.about["normalization"]
        x = given.buffer.reshape(given.shape).astype(np.float32)
        x = (x - np.array(mean, np.float32)) / np.array(std, np.float32)
        (y,) = self.session.run(None, {self.about["streams"][0][2]: x.transpose(2, 0, 1)[None]})
        answer.buffer[...] = y[0].transpose(1, 2, 0).reshape(answer.buffer.shape)


class VDevice:
    def create_infer_model(self, hef_source: bytes) -> InferModel:
        return InferModel(hef_source)


class ClientRunner:
    first: ClassVar[int] = 1  # number of the first input layer
    calibrated: ClassVar[np.ndarray]  # the data given to the last optimize()

    def __init__(self, hw_arch: str):
        assert hw_arch in ("hailo8", "hailo8l", "hailo10h")

    def translate_onnx_model(self, path, name, *, start_node_names, end_node_names, net_input_shapes):
        self._model, self._name = onnx.load(path), name
        ((self._original, (_, c, self._height, self._width)),) = net_input_shapes.items()
        assert start_node_names == [i.name for i in self._model.graph.input] == [self._original] and c == 3
        made = {node.name: node.output[0] for node in self._model.graph.node}
        assert [made[node] for node in end_node_names] == [o.name for o in self._model.graph.output]
        self._layer, self._end = f"{name}/input_layer{self.first}", end_node_names[0]

    def get_hn_dict(self) -> dict:
        return {"layers": {self._layer: {"original_names": [self._original]}}}

    def save_har(self, path: str) -> None:
        Path(path).write_bytes(b"stand-in HAR")

    def load_model_script(self, path: str) -> None:
        found = re.search(NORMALIZATION, Path(path).read_text())
        self._normalization = json.loads(found[1]), json.loads(found[2])

    def optimize(self, data: np.ndarray) -> None:
        assert data.shape[1:] == (self._height, self._width, 3)
        ClientRunner.calibrated = data

    def compile(self) -> bytes:
        _, *grid = (d.dim_value for d in self._model.graph.output[0].type.tensor_type.shape.dim)
        streams = [
            (self._layer, [self._height, self._width, 3], self._original),
            (f"{self._name}/{self._end}", [*grid[1:], grid[0]], self._end),
        ]
        about = json.dumps({"streams": streams, "normalization": self._normalization})
        return MAGIC + about.encode() + b"\0" + self._model.SerializeToString()


def install(monkeypatch) -> None:
    """Install both packages until the test ends."""
    platform, client = types.ModuleType("hailo_platform"), types.ModuleType("hailo_sdk_client")
    platform.VDevice, platform.FormatType, client.ClientRunner = VDevice, FormatType, ClientRunner
    monkeypatch.setitem(sys.modules, "hailo_platform", platform)
    monkeypatch.setitem(sys.modules, "hailo_sdk_client", client)
