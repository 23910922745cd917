"""A stand-in for HailoRT's Python package, which nobody here has. It does what the documentation says, and no more.

`hailo_platform` runs a HEF in ONNX Runtime, behind the interface of hailort v4.23 and v5.2
(hailo_platform/pyhailort/pyhailort.py), with channels last. Such a HEF is a kit's network and the normalisation of its
input. Nothing is quantized, so that any difference from the policy is an error of the kit or of the runner.
"""

import json
import re
import sys
import types
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

MAGIC = b"stand-in HEF"
NORMALIZATION = r"normalization\d+ = normalization\((\[[^]]*\]), (\[[^]]*\])\)"


class HailoRTException(Exception):
    pass


class Stream:
    """An input or output, of a model and of its bindings."""

    def __init__(self, name: str, shape: list[int]):
        self.name, self.shape, self.type = name, shape, np.uint8

    def set_format_type(self, type: type) -> None:
        self.type = type

    def set_buffer(self, buffer: np.ndarray) -> None:
        wanted = int(np.prod(self.shape)) * np.dtype(self.type).itemsize
        if not buffer.flags.c_contiguous or buffer.nbytes != wanted:
            raise HailoRTException(f"Buffer size {buffer.nbytes} is different than expected {wanted} for '{self.name}'")
        self.buffer = buffer


class InferModel:
    """A network of one input on the chip: also what configure() and create_bindings() return of it."""

    fails = False  # True: the chip no longer answers

    def __init__(self, hef: bytes):
        if not hef.startswith(MAGIC):
            raise HailoRTException("Invalid HEF. See hailort.log for more information")
        about, _, model = hef.removeprefix(MAGIC).partition(b"\0")
        self.about = json.loads(about)
        self.session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
        self.inputs, self.outputs = ([Stream(*stream)] for stream in self.about["streams"])

    def input(self, name: str) -> Stream:
        return {s.name: s for s in self.inputs}[name]

    def output(self, name: str) -> Stream:
        return {s.name: s for s in self.outputs}[name]

    def configure(self) -> "InferModel":
        return self

    create_bindings = configure

    def run(self, bindings: list["InferModel"], timeout: int) -> None:
        if InferModel.fails:
            raise HailoRTException("Received a timeout - hailort has failed because a timeout had occurred")
        (given,), (answer,), (mean, std) = self.inputs, self.outputs, self.about["normalization"]
        x = given.buffer.reshape(given.shape).astype(np.float32)
        x = (x - np.array(mean, np.float32)) / np.array(std, np.float32)
        (y,) = self.session.run(None, {self.about["picture"]: x.transpose(2, 0, 1)[None]})
        answer.buffer[...] = y[0].transpose(1, 2, 0).reshape(answer.buffer.shape)


def compile_kit(kit: Path) -> Path:
    """Do what Hailo's compiler would, and return the path of the HEF."""
    content, model = json.loads((kit / "kit.json").read_text()), onnx.load(kit / "backbone.onnx")
    _, depth, *grid = (d.dim_value for d in model.graph.output[0].type.tensor_type.shape.dim)
    found = re.search(NORMALIZATION, (kit / "backbone.alls").read_text())
    about = {
        "streams": [("input", [*content["shape"][2:], 3]), ("output", [*grid, depth])],
        "picture": content["input"],
        "normalization": [json.loads(found[1]), json.loads(found[2])],
    }
    path = kit / "backbone.hef"
    path.write_bytes(MAGIC + json.dumps(about).encode() + b"\0" + model.SerializeToString())
    return path


def install(monkeypatch) -> None:
    """Install the package until the test ends."""
    formats = types.SimpleNamespace(UINT8=np.uint8, FLOAT32=np.float32)
    device = types.SimpleNamespace(create_infer_model=InferModel)
    package = types.SimpleNamespace(VDevice=lambda: device, FormatType=formats)
    monkeypatch.setitem(sys.modules, "hailo_platform", package)
