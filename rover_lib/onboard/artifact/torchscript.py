"""Check what a TorchScript archive would run, without running it: such a file is code, and anybody can write one.

    with open_archive("policy_static.pt") as z:
        check_program(z, "policy_static.pt")

The graphs of this project have one form: one class without attributes, one method without a branch, a few dozen
operators on tensors, constants and numbers. This module accepts that form and nothing else, and it does so before torch
sees the archive. For torch.jit.load calls __setstate__ of every class that it finds in a pickle, and believes what the
pickle says about a tensor's size without checking that its bytes are there (torch 2.8;
tests/onboard/artifact/test_hostile_artifacts.py shows both).
"""

import ast
import contextlib
import io
import math
import pickle
import pickletools
import re
import reprlib
import zipfile
from pathlib import Path
from typing import Any

from rover_lib.onboard.artifact.archive import Unknown, nothing_unknown, read_record

LARGEST_NUMBER = 10_000_000  # for a size or an index in the program
PARSED = 5  # attempts to parse a program, because Python may fail by a fault of its own
TO_THE_END = 2**63 - 1  # the end of a slice that has none

OPERATORS = frozenset({
    "torch._convolution", "torch._make_per_tensor_quantized_tensor", "torch.add", "torch.addcmul", "torch.as_strided",
    "torch.bitwise_xor", "torch.cat", "torch.contiguous", "torch.dequantize", "torch.flatten", "torch.gelu",
    "torch.layer_norm", "torch.linear", "torch.max_pool2d", "torch.mul", "torch.permute", "torch.quantize_per_tensor",
    "torch.relu", "torch.scaled_dot_product_attention", "torch.slice", "torch.squeeze", "torch.sub", "torch.to",
    "torch.transpose", "torch.unflatten", "torch.unsqueeze",
    "ops.quantized.add_relu", "ops.quantized.conv2d", "ops.quantized.conv2d_relu", "ops.quantized.linear_dynamic",
})  # fmt: skip
# The nodes that torch makes of the program besides operators.
NODES = frozenset({"prim::Constant", "prim::ListConstruct", "prim::GetAttr"})
RESERVED = frozenset({"torch", "ops", "CONSTANTS", "self", "Tensor", "Module"})
# No strings, comments or escapes, which Python and torch could read differently.
SOURCE = re.compile(rb"[\w \n().,:=>\[\]-]*", re.ASCII)

# The opcodes that a pickle in such an archive consists of
OPCODES = frozenset({
    "PROTO", "STOP", "MARK", "GLOBAL", "REDUCE", "NEWOBJ", "BUILD", "BINPERSID", "BINUNICODE", "BININT", "BININT1",
    "BININT2", "BINFLOAT", "LONG1", "NONE", "NEWTRUE", "NEWFALSE", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3",
    "EMPTY_LIST", "APPEND", "APPENDS", "EMPTY_DICT", "SETITEM", "SETITEMS", "BINPUT", "LONG_BINPUT", "BINGET",
    "LONG_BINGET",
})  # fmt: skip
ITEM_BYTES = {
    "torch.FloatStorage": 4, "torch.DoubleStorage": 8, "torch.LongStorage": 8, "torch.IntStorage": 4,
    "torch.ShortStorage": 2, "torch.ByteStorage": 1, "torch.CharStorage": 1, "torch.BoolStorage": 1,
    "torch.QInt8Storage": 1, "torch.QUInt8Storage": 1, "torch.QInt32Storage": 4,
}  # fmt: skip


# The program


def check_program(z: zipfile.ZipFile, path: Path | str) -> None:
    """Raise ArtifactError unless the archive's code and constants are of the one form that artifacts have.

    z: from open_archive(). Nothing in it is run, and no tensor is made.
    """
    with nothing_unknown(path, "program"):
        sizes = {r.filename.removeprefix("archive/"): r.file_size for r in z.infolist()}
        programs = [n for n in sizes if n.endswith(".py") and sizes[n]]
        if len(programs) != 1:
            raise Unknown(f"{len(programs)} programs")
        name = _Program(read_record(z, f"archive/{programs[0]}")).name
        module = programs[0].removeprefix("code/").removesuffix(".py").replace("/", ".")
        for record in [n for n in sizes if n.endswith(".debug_pkl")]:
            _check_opcodes(read_record(z, f"archive/{record}"), {"torch.jit._pickle.build_intlist"})
        attributes = _read_pickle(read_record(z, "archive/data.pkl"), {}, f"{module}.{name}")
        if not isinstance(attributes, _Module):
            raise Unknown("data that is not a module")
        stored = {n.removeprefix("constants/"): size for n, size in sizes.items() if n.startswith("constants/")}
        if not isinstance(_read_pickle(read_record(z, "archive/constants.pkl"), stored), tuple):
            raise Unknown("constants that are not a tuple")


def unknown_operators(graph: Any) -> list[str]:
    """Return the kinds of nodes in a torch graph that no artifact has, to compare our list with torch's own reading."""
    known = NODES | {f"aten::{o.removeprefix('torch.')}" for o in OPERATORS}
    known |= {o.removeprefix("ops.").replace(".", "::") for o in OPERATORS}
    kinds: set[str] = set()
    for node in graph.nodes():
        kinds.add(node.kind())
        if list(node.blocks()):
            kinds.add("a block")
    return sorted(kinds - known)


def _parse(source: bytes) -> ast.Module:
    """Parse a program. Raises like ast.parse(), but SystemError only if each of PARSED attempts does.

    Python 3.11 counts a tree's depth for the whole process. If another thread parses at the same time, or if garbage
    collection interrupts, a correct program fails with "AST constructor recursion depth mismatch"
    (python/cpython#106905).
    """
    for _ in range(PARSED - 1):
        with contextlib.suppress(SystemError):
            return ast.parse(source)
    return ast.parse(source)


class _Program:
    """A program in TorchScript's text form. Raises Unknown unless it has the one form that artifacts have."""

    def __init__(self, source: bytes):
        if not SOURCE.fullmatch(source):
            raise Unknown(f"the character {SOURCE.sub(b'', source, count=1)[:1].decode('latin-1')!r}")
        try:
            body = _parse(source).body
        except (SyntaxError, ValueError, RecursionError, MemoryError, SystemError) as e:
            raise Unknown(f"a program that cannot be read ({type(e).__name__})") from None
        match body:
            case [ast.ClassDef(name=name, bases=[ast.Name(id="Module")], keywords=[], decorator_list=[], body=parts)]:
                self.name = name
            case _:
                raise Unknown("more than a class of type Module")
        match parts:
            case [
                ast.Assign(targets=[ast.Name(id="__parameters__")], value=ast.List(elts=[])),
                ast.Assign(targets=[ast.Name(id="__buffers__")], value=ast.List(elts=[])),
                ast.FunctionDef(name="forward", decorator_list=[]) as forward,
            ]:
                self._known: set[str] = set()
                self._method(forward)
            case _:
                raise Unknown(f"a class with {', '.join(self._describe(p) for p in parts[:5])}")

    def _method(self, forward: ast.FunctionDef) -> None:
        given = forward.args
        if given.posonlyargs or given.vararg or given.kwonlyargs or given.kwarg or given.defaults or not given.args:
            raise Unknown("arguments of another form")
        for argument in given.args[1:]:
            match argument.annotation:
                case ast.Name(id="Tensor"):
                    self._define(argument.arg)
                case _:
                    raise Unknown("an argument that is no tensor")
        *steps, last = forward.body
        for step in steps:
            match step:
                case ast.Assign(targets=[ast.Name(id=name)], value=value):
                    self._expression(value)
                    self._define(name)
                case _:
                    raise Unknown(self._describe(step))
        match last:
            case ast.Return(value=ast.expr() as value):
                self._expression(value)
            case _:
                raise Unknown(self._describe(last))

    def _define(self, name: str) -> None:
        if name in RESERVED:
            raise Unknown(f"a variable called {name}")
        self._known.add(name)

    def _expression(self, value: ast.expr) -> None:
        match value:
            case ast.Name(id=name) if name in self._known:
                return
            case ast.Attribute(value=ast.Name(id="CONSTANTS"), attr=name) if re.fullmatch(r"c\d+", name, re.ASCII):
                return
            case ast.Constant(value=None | bool() | float()):
                return
            case ast.Constant(value=int(number)) if number <= LARGEST_NUMBER or number == TO_THE_END:
                return
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant() as operand):
                return self._expression(operand)
            case ast.List(elts=parts):
                pass
            case ast.Call(func=called, args=parts, keywords=[]):
                if (name := ast.unparse(called)) not in OPERATORS:
                    raise Unknown(name[:80])
            case _:
                raise Unknown(self._describe(value))
        for part in parts:
            self._expression(part)

    @staticmethod
    def _describe(node: ast.AST) -> str:
        return ast.unparse(node).splitlines()[0][:80]


# Its constants


def _check_opcodes(raw: bytes, names: set[str] | None = None) -> None:
    """Raise Unknown for an opcode that is not in OPCODES, or for a global that is not in `names`.

    names: None allows any global here.
    """
    count = 0
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(raw)):
            if opcode.name not in OPCODES:
                raise Unknown(f"a pickle with {opcode.name}")
            if opcode.name == "GLOBAL" and names is not None and (name := str(argument).replace(" ", ".")) not in names:
                raise Unknown(f"a pickle with {name[:80]}")
            # The readers of Python and torch would reserve room for as many entries as this number.
            if "PUT" in opcode.name and isinstance(argument, int) and argument > count:
                raise Unknown(f"a pickle with {opcode.name} {argument}")
    except ValueError as e:
        raise Unknown(f"a pickle that cannot be read ({str(e)[:80]})") from None


def _read_pickle(raw: bytes, storages: dict[str, int], module: str = "") -> Any:
    """Return what a pickle of the archive describes, without calling anything that it names.

    storages: the sizes in bytes of the archive's tensors, by the name of their record. module: the module's name, if
    the pickle describes the module and not its constants.
    """
    _check_opcodes(raw)
    try:
        return _Reader(raw, storages, module).load()
    except Unknown:
        raise
    except Exception as e:  # whatever keeps Python from reading it
        raise Unknown(f"a pickle that cannot be read ({type(e).__name__})") from None


class _Storage(tuple):
    """The memory behind a tensor: (bytes of an item, number of items)."""


class _Tensor(tuple):
    """The dimensions of a tensor whose bytes are in the archive."""


class _Module:
    """What data.pkl describes: an object without attributes."""

    def __setstate__(self, state: Any) -> None:
        if state != {}:
            raise Unknown(f"attributes, {reprlib.repr(state)[:80]}")


class _Conv2d:
    """The weights of a convolution as torch packs them: ("2", [config, weight], [bias or None])."""

    def __setstate__(self, state: Any) -> None:
        match state:
            case ("2", [_Tensor() as config, _Tensor() as weight], [_Tensor() | None]):
                if config == (11,) and len(weight) == 4:
                    return
        raise Unknown("weights of a convolution in another form")


class _Linear:
    """The weights of a linear layer: (weight, bias or None)."""

    def __setstate__(self, state: Any) -> None:
        match state:
            case (_Tensor() as weight, _Tensor() | None) if len(weight) == 2:
                return
        raise Unknown("weights of a linear layer in another form")


class _Reader(pickle.Unpickler):
    """Turns what a pickle describes into values of this module, and refuses everything else."""

    def __init__(self, raw: bytes, storages: dict[str, int], module: str):
        super().__init__(io.BytesIO(raw))
        self._storages, self._module = storages, module
        self._known = {
            "torch._utils._rebuild_tensor_v2": self._tensor,
            "torch._utils._rebuild_qtensor": self._quantized,
            "torch.jit._pickle.build_tensorlist": self._list,
            "torch.jit._pickle.restore_type_tag": self._list,
            "collections.OrderedDict": self._hooks,
            "torch.per_channel_affine": "per_channel_affine",
            "torch.per_tensor_affine": "per_tensor_affine",
            "__torch__.torch.classes.quantized.Conv2dPackedParamsBase": _Conv2d,
            "__torch__.torch.classes.quantized.LinearPackedParamsBase": _Linear,
            **({module: _Module} if module else {}),
            **{name: name for name in ITEM_BYTES},
        }

    def find_class(self, module: str, name: str) -> Any:
        if (known := self._known.get(f"{module}.{name}")) is None:
            raise Unknown(f"{module}.{name}"[:80])
        return known

    def persistent_load(self, pid: Any) -> _Storage:
        match pid:
            case ("storage", str(kind), str(key), "cpu", int(items)) if kind in ITEM_BYTES:
                if self._storages.get(key) == items * ITEM_BYTES[kind]:
                    return _Storage((ITEM_BYTES[kind], items))
        raise Unknown(f"a tensor without its bytes, {reprlib.repr(pid)[:80]}")

    # These are methods because a pickle could change the defaults and other attributes of functions.

    def _hooks(self) -> dict[str, Any]:
        return {}

    def _tensor(self, storage: Any, offset: Any, sizes: Any, strides: Any, needs_gradient: Any, hooks: Any) -> _Tensor:
        numbers = (offset, *sizes, *strides)
        if not isinstance(storage, _Storage) or not all(type(n) is int and n >= 0 for n in numbers):
            raise Unknown("a tensor of another form")
        last = offset + sum((n - 1) * stride for n, stride in zip(sizes, strides, strict=True))
        if math.prod(sizes) > storage[1] or (math.prod(sizes) and last >= storage[1]):
            raise Unknown(f"a tensor of {list(sizes)} on {storage[1]} items")
        return _Tensor(sizes)

    def _quantized(
        self, storage: Any, offset: Any, sizes: Any, strides: Any, scheme: Any, needs_gradient: Any, hooks: Any
    ) -> _Tensor:
        match scheme:
            case ("per_tensor_affine", float(), int()):
                pass
            case ("per_channel_affine", _Tensor() as scales, _Tensor() as zero_points, int(axis)) if 0 <= axis < len(
                sizes
            ) and scales == zero_points == (sizes[axis],):
                pass
            case _:
                raise Unknown("a quantized tensor of another form")
        return self._tensor(storage, offset, sizes, strides, needs_gradient, hooks)

    def _list(self, values: Any, kind: Any = "List[Optional[Tensor]]") -> list:
        if not isinstance(values, list) or kind != "List[Optional[Tensor]]":
            raise Unknown(f"a list of {kind[:80] if isinstance(kind, str) else reprlib.repr(kind)[:80]}")
        return values
