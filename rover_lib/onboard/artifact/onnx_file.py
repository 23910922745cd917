"""Check what an .onnx file would run, without running it and without the package onnx: read its protobuf by fields.

    with open_archive("policy_static.onnx.zip") as z:
        check_model(z, "policy_static.onnx.zip")

The models of this project have one form: one graph of one opset of the standard operators, numbers as attributes, and
weights whose bytes are all there. Anything else that ONNX can say (other files to read weights from, operators of a
library to load, functions, loops and branches, strings) is refused before ONNX Runtime sees it, known here or not.
"""

import math
import zipfile
from collections.abc import Iterator
from pathlib import Path

from rover_lib.onboard.artifact.archive import ONNX, Unknown, nothing_unknown, read_record

OPSET, NODES, NAME_BYTES = 17, 5000, 200
LARGEST_NUMBER = 10_000_000  # in an attribute
OPERATORS = frozenset({
    "Add", "Cast", "Concat", "Conv", "DequantizeLinear", "Div", "Erf", "Identity", "LayerNormalization", "MatMul",
    "MaxPool", "Mul", "QuantizeLinear", "Relu", "Reshape", "Slice", "Softmax", "Squeeze", "Transpose", "Unsqueeze",
})  # fmt: skip
ATTRIBUTES = frozenset(
    {"axis", "dilations", "epsilon", "kernel_shape", "pads", "perm", "strides", "to"}
)  # each a number or a list of numbers
ITEM_BYTES = {1: 4, 2: 1, 3: 1, 6: 4, 7: 8}  # by data type of onnx.TensorProto: float32, uint8, int8, int32, int64

# From onnx.proto: the fields of each message that are accepted, by number
MODEL = {1: "ir_version", 2: "producer_name", 7: "graph", 8: "opset_import"}
GRAPH = {1: "node", 2: "name", 5: "initializer", 11: "input", 12: "output"}
NODE = {1: "input", 2: "output", 3: "name", 4: "op_type", 5: "attribute"}
ATTRIBUTE = {1: "name", 2: "f", 3: "i", 7: "floats", 8: "ints", 20: "type"}
TENSOR = {1: "dims", 2: "data_type", 8: "name", 9: "raw_data"}
OPSET_IMPORT = {1: "domain", 2: "version"}
VARINT, EIGHT_BYTES, BYTES, FOUR_BYTES = 0, 1, 2, 5  # protobuf's wire types

Value = int | memoryview


def check_model(z: zipfile.ZipFile, path: Path | str) -> None:
    """Raise ArtifactError unless the archive's model is of the one form that artifacts have.

    z: an archive from open_archive(). Nothing in it is run, and no tensor is made.
    """
    with nothing_unknown(path, "model"):
        _Model(memoryview(read_record(z, ONNX)))


class _Model:
    """Checks a model's protobuf. Raises Unknown if it is not of the one form that artifacts have."""

    def __init__(self, model: memoryview):
        graphs, opsets = 0, []
        for field, value in self._fields(model, MODEL, "a model"):
            if field == "graph":
                graphs += 1
                self._check_graph(_bytes(value))
            elif field == "opset_import":
                known = dict(self._fields(_bytes(value), OPSET_IMPORT, "an opset"))
                opsets.append((_text(known.get("domain", memoryview(b""))), known.get("version")))
        if graphs != 1:
            raise Unknown(f"{graphs} graphs")
        if opsets != [("", OPSET)]:
            raise Unknown(f"the operator sets {opsets}"[:80])

    def _check_graph(self, graph: memoryview) -> None:
        nodes = 0
        for field, value in self._fields(graph, GRAPH, "a graph"):
            if field == "node":
                nodes += 1
                self._check_node(_bytes(value))
            elif field == "initializer":
                self._check_tensor(_bytes(value))
        if nodes > NODES:
            raise Unknown(f"{nodes} nodes")

    def _check_node(self, node: memoryview) -> None:
        kind = ""
        for field, value in self._fields(node, NODE, "a node"):
            text = "" if field == "attribute" else _text(value)
            if field == "op_type":
                kind = text
            elif field == "attribute":
                self._check_attribute(_bytes(value))
        if kind not in OPERATORS:
            raise Unknown(f"the operator {kind!r}"[:80])

    def _check_attribute(self, attribute: memoryview) -> None:
        for field, value in self._fields(attribute, ATTRIBUTE, "an attribute"):
            if field == "name" and (name := _text(value)) not in ATTRIBUTES:
                raise Unknown(f"the attribute {name!r}"[:80])
            if field in ("i", "ints"):
                number = value if isinstance(value, int) else LARGEST_NUMBER + 1
                number -= (number >> 63) << 64  # two's complement
                if abs(number) > LARGEST_NUMBER:
                    raise Unknown(f"the number {number}")

    def _check_tensor(self, tensor: memoryview) -> None:
        sizes, kind, stored = [], 0, 0
        for field, value in self._fields(tensor, TENSOR, "a tensor"):
            if field == "name":
                _text(value)
            elif field == "raw_data":
                stored += len(_bytes(value))
            elif not isinstance(value, int):
                raise Unknown(f"a tensor whose {field} is no number")
            elif field == "dims":
                sizes.append(value)
            else:
                kind = value
        if kind not in ITEM_BYTES:
            raise Unknown(f"a tensor of type {kind}")
        if math.prod(sizes) * ITEM_BYTES[kind] != stored:
            raise Unknown(f"a tensor of {sizes} in {stored} bytes"[:80])

    def _fields(self, message: memoryview, known: dict[int, str], what: str) -> Iterator[tuple[str, Value]]:
        """Yield (field, value) for each field of a protobuf message; a value is a number or bytes.

        Raises Unknown for a field that is not in `known`, and for a damaged message.
        """
        at, end = 0, len(message)
        while at < end:
            key, at = _varint(message, at)
            number, wire = key >> 3, key & 7
            if number not in known:
                raise Unknown(f"{what} with field {number}")
            if wire == VARINT:
                value, at = _varint(message, at)
                yield known[number], value
                continue
            if wire == BYTES:
                size, at = _varint(message, at)
            elif wire in (EIGHT_BYTES, FOUR_BYTES):
                size = 8 if wire == EIGHT_BYTES else 4
            else:
                raise Unknown(f"{what} of wire type {wire}")
            if size > end - at:
                raise Unknown(f"{what} that is cut short")
            yield known[number], message[at : at + size]
            at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """Return a number and the position after it. Raises Unknown if it does not end."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            break
        byte, at = message[at], at + 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise Unknown("a number without end")


def _bytes(value: Value) -> memoryview:
    if isinstance(value, int):
        raise Unknown("a number where bytes should be")
    return value


def _text(value: Value) -> str:
    raw = _bytes(value)
    if len(raw) > NAME_BYTES:
        raise Unknown(f"a name of {len(raw)} bytes")
    return bytes(raw).decode("utf-8", "replace")
