"""Where an artifact's instructions go, part by part, on the emulated Cortex-A76.

    count_parts("runs/demo")      # writes runs/demo/parts.json

Marks cannot be set inside a TorchScript graph. So the quantized graph is cut where one part of the policy ends and the
next begins, each piece is traced and frozen like the whole, and the emulated Pi runs the pieces one after the other,
each with what the pieces before it gave, in the layout in which they gave it. What such a call costs by itself is
measured on a piece that does nothing and taken off.
"""

import json
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx, nn

from lab.a76 import count as arm
from lab.a76.count import LABEL, SDOT_MACS, ArmError, Machine, Names, Progress, by_kernel, prepare
from rover_lib.onboard.artifact import read_manifest
from rover_lib.onboard.stage import sha256_of, write_stage
from rover_lib.workshop import act
from rover_lib.workshop import quantize as q
from rover_lib.workshop.session import opened

GUEST = arm.GUEST.with_name("parts.py")
WHOLE, FRAME_ONLY, NOTHING, FIRST = 0, 1, 2, 3  # sections, as in the guest
FRAME, REST = "frame", "rest"  # before the first convolution; norms, concatenation, head and all else between blocks
KERNELS = 12  # named per part, the rest summed up
SAME = 1e-4  # action units: the pieces and the artifact run the same kernels on the same core


@dataclass(frozen=True, eq=False)
class Piece:
    """A stretch of the graph. module: traced and frozen, takes and gives the values of these names."""

    part: str
    takes: tuple[str, ...]
    gives: tuple[str, ...]
    module: torch.jit.ScriptModule


# --- cutting ----------------------------------------------------------------------------------------------------------


def graph_of(module: nn.Module) -> fx.GraphModule:
    """The quantized graph inside a policy's module, which may have a wrapper. Raises ArmError if there is none."""
    for m in module.modules():
        if isinstance(m, fx.GraphModule):
            return m
    raise ArmError("only a static or mixed policy has parts to count: this one has no quantized graph")


def part_of_nodes(graph: fx.Graph, blocks: Sequence[str]) -> dict[fx.Node, str]:
    """The part of each node that computes something: one of `blocks`, FRAME or REST."""
    before_stem: set[fx.Node] = set()
    waiting = [n for n in graph.nodes if n.op == "call_module" and act.block_of(str(n.target)) == "backbone.stem"][:1]
    while waiting:
        for n in waiting.pop().all_input_nodes:
            if n not in before_stem:
                before_stem.add(n)
                waiting.append(n)
    nodes = [n for n in graph.nodes if n.op in ("call_module", "call_function", "call_method")]
    found: dict[fx.Node, str] = {}
    for n in nodes:
        stack = n.meta.get("nn_module_stack")
        if n in before_stem:
            found[n] = FRAME
        elif n.op == "call_module" or stack:
            name = act.block_of(str(n.target) if n.op == "call_module" else list(stack.values())[-1][0])
            found[n] = name if name in blocks else REST
        elif n.target is not torch.quantize_per_tensor:  # FX's own nodes belong where their input is from
            origins = {found[a] for a in n.all_input_nodes if a in found}
            found[n] = origins.pop() if len(origins) == 1 else REST
    for n in reversed(nodes):  # but quantizing is for who comes next
        if n not in found:
            found[n] = next((found[u] for u in n.users if u in found), REST)
    return found


def cut(
    graph: fx.GraphModule, inputs: tuple[Tensor, ...], parts: dict[fx.Node, str]
) -> tuple[list[Piece], dict[str, Tensor]]:
    """The graph as pieces that give, run one after the other, exactly what it gives; and its inputs by name.

    parts: as `part_of_nodes` gives them; a piece ends where the part changes. Raises ArmError if the pieces give
    something else.
    """
    stretches: list[list[fx.Node]] = []
    for n in graph.graph.nodes:
        if n in parts:
            if not stretches or parts[stretches[-1][-1]] != parts[n]:
                stretches.append([])
            stretches[-1].append(n)
    (output,) = next(n for n in graph.graph.nodes if n.op == "output").all_input_nodes
    values = _inputs_by_name(graph, inputs)
    started = dict(values)
    pieces = []
    with torch.inference_mode():
        for stretch in stretches:
            inside = set(stretch)
            gives = [n for n in stretch if n is output or not inside.issuperset(n.users)]
            module, takes = _stretch_module(graph, stretch, gives)
            example = tuple(values[t] for t in takes)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a constant of the graph is a constant of the policy
                traced = torch.jit.freeze(torch.jit.trace(module, example, check_trace=False).eval())
            values |= zip((n.name for n in gives), traced(*example), strict=True)
            pieces.append(Piece(parts[stretch[0]], takes, tuple(n.name for n in gives), traced))
        expected = graph(*inputs)
    if not torch.equal(values[output.name], expected):
        gap = (values[output.name] - expected).abs().max().item()
        raise ArmError(f"the graph in pieces gives something else than in one: {gap:.3g} apart")
    return pieces, started


def _inputs_by_name(graph: fx.GraphModule, inputs: tuple[Tensor, ...]) -> dict[str, Tensor]:
    """What the graph is given, by the names that its nodes have for it; one of *frames is a node of its own."""
    values: dict[str, Tensor] = {}
    left = list(inputs)
    for n in graph.graph.nodes:
        if n.op == "placeholder":
            if str(n.target).startswith("*"):
                values |= {f"{n.name}.{i}": x for i, x in enumerate(left)}
            else:
                values[n.name] = left.pop(0)
    return values


def _stretch_module(
    graph: fx.GraphModule, stretch: list[fx.Node], gives: list[fx.Node]
) -> tuple[nn.Module, tuple[str, ...]]:
    """Nodes in a row as a module of their own, with the names of what it takes, in order."""
    made = fx.Graph()
    known: dict[fx.Node, fx.Node] = {}
    copies: dict[str, fx.Node] = {}
    takes: list[str] = []

    def taken(name: str) -> fx.Node:
        if name not in copies:
            takes.append(name)
            copies[name] = made.placeholder(f"x{len(takes)}")
        return copies[name]

    outside = [a for n in stretch for a in n.all_input_nodes if a not in set(stretch)]
    for a in outside:  # placeholders come first in a graph
        if a.op != "get_attr" and not _is_packed(a):
            known[a] = taken(a.name)
    for n in stretch:
        if any(_is_packed(a) for a in n.all_input_nodes):  # frames[i]
            known[n] = taken(f"{n.args[0].name}.{n.args[1]}")
            continue
        for a in n.all_input_nodes:
            if a.op == "get_attr" and a not in known:
                known[a] = made.get_attr(str(a.target))
        known[n] = made.node_copy(n, known.__getitem__)
    made.output(tuple(known[n] for n in gives))
    return fx.GraphModule(graph, made).eval(), tuple(takes)


def _is_packed(node: fx.Node) -> bool:
    return node.op == "placeholder" and str(node.target).startswith("*")


def graph_inputs(quantized: q.QuantizedPolicy, sample: Any) -> tuple[Tensor, ...]:
    """What the graph is given for a recorded sample, by whatever stands before it in the policy's module."""
    graph, taken = graph_of(quantized.module), []
    hook = graph.register_forward_pre_hook(lambda _, args: taken.append(args))
    try:
        with torch.inference_mode():
            quantized.module(*q.inputs_of(sample, quantized.config))
    finally:
        hook.remove()
    return taken[0]


# --- counting ---------------------------------------------------------------------------------------------------------


class Nothing(nn.Module):
    def forward(self, x: Tensor) -> tuple[Tensor]:
        return (x,)


@dataclass(frozen=True, eq=False)
class Row:
    """What one part executes in a steady inference, in instructions; kernels as of `arm.by_kernel`."""

    instructions: int
    simd: int
    sdot: int
    pieces: int
    kernels: dict[str, tuple[int, int, int]]


@dataclass(frozen=True, eq=False)
class Parts:
    """A prediction as a whole and in parts; call: what running one piece costs by itself, taken off the rows."""

    whole: Row
    rows: dict[str, Row]
    call: int

    def total(self) -> int:
        return sum(row.instructions for row in self.rows.values())


def count_pieces(
    machine: Machine,
    artifact: Path | str,
    quantized: q.QuantizedPolicy,
    sample: Any,
    *,
    name_nodes: Callable[[fx.Graph, Sequence[str]], dict[fx.Node, str]] = part_of_nodes,
) -> Parts:
    """Count one prediction of an artifact as a whole, and cut by part.

    quantized: the policy that the artifact was exported from. sample: with frame_bgr() and state, as recorded.
    name_nodes: how the graph is cut. Raises ArmError if the two do not give the same actions on the emulated core.
    """
    graph = graph_of(quantized.module)
    names = name_nodes(graph.graph, act.blocks(quantized.config))
    pieces, values = cut(graph, graph_inputs(quantized, sample), names)
    with tempfile.TemporaryDirectory(prefix="rover-parts-") as scratch:
        folder = Path(scratch)
        np.savez(folder / "observation.npz", state=np.asarray(sample.state, np.float32), frame=sample.frame_bgr())
        for i, piece in enumerate(pieces):
            piece.module.save(str(folder / f"{i:04d}.pt"))
        torch.jit.script(Nothing()).save(str(folder / "nothing.pt"))
        torch.save(values, folder / "values.pt")
        (folder / "pieces.json").write_text(json.dumps(_plan(pieces)))
        done = arm.emulate_script(machine, GUEST, [Path(artifact).resolve(), folder], folder)
        whole, found = np.load(folder / "whole.npy"), np.load(folder / "pieces.npy")
        if whole.shape != found.shape or not np.abs(whole - found).max() <= SAME:
            raise ArmError(f"{artifact}: is not what these pieces were cut from; quantize again")
        names = Names((folder / "maps").read_text())
        call = done.total(NOTHING)
        sections: dict[str, list[int]] = {FRAME: [FRAME_ONLY]}
        for i, piece in enumerate(pieces):
            sections.setdefault(piece.part, []).append(FIRST + i)
        rows = {part: _row(done, chosen, names, call) for part, chosen in sections.items()}
        return Parts(_row(done, [WHOLE], names, 0), rows, call)


def _plan(pieces: Sequence[Piece]) -> list[dict[str, Any]]:
    """pieces.json: with each piece the values that nobody needs after it, so that memory stays as in the whole."""
    last = {name: i for i, piece in enumerate(pieces) for name in (*piece.takes, *piece.gives)}
    return [
        {"takes": p.takes, "gives": p.gives, "last_used": [name for name, at in last.items() if at == i]}
        for i, p in enumerate(pieces)
    ]


def _row(done: arm.Emulation, sections: Sequence[int], names: Names, call: int) -> Row:
    pieces = [s for s in sections if s >= FIRST]
    kernels = by_kernel(np.concatenate([done.sections[s] for s in sections]), names, KERNELS)
    return Row(
        sum(done.total(s) for s in sections) - call * len(pieces),
        sum(done.total(s, "simd") for s in sections),
        sum(done.total(s, "sdot") for s in sections),
        len(pieces),
        kernels,
    )


def count_parts(run_dir: Path | str, progress: Progress = None, artifact: str = "policy_static") -> dict[str, Any]:
    """Count the parts of a run's static artifact, write its parts.json and return what is in it.

    One prediction of a held-out frame. Raises ArmError, or what reading the run raises.
    """
    run_dir = Path(run_dir)
    path = run_dir / f"{artifact}.pt"
    manifest = read_manifest(path)
    if manifest["mode"] not in ("static", "mixed"):
        raise ArmError(f"{path}: only a static or mixed artifact has parts to count, found {manifest['mode']}")
    again = opened(run_dir)
    if not again.parts.held_out:
        raise ArmError(f"{run_dir}: its recordings have no held-out frames to count with; record more episodes")
    machine = prepare(progress)
    quantized = arm.requantized(run_dir, again.checkpoint, artifact)
    counted = count_pieces(machine, path, quantized, again.parts.held_out[0])
    macs = act.multiply_accumulates(act.ACT(again.checkpoint.config, again.checkpoint.weights))
    metrics = {"label": LABEL, **parts_metrics(counted, macs)}
    return write_stage(
        run_dir / "parts.json",
        "parts",
        params={"artifact": artifact, "cpu": "cortex-a76", "threads": 1},
        metrics=metrics,
        inputs={path.name: sha256_of(path)},
    )


def parts_metrics(counted: Parts, macs: dict[str, int]) -> dict[str, Any]:
    """What parts.json says; _g are 10**9 instructions. macs: by block, what is no part's is the rest's."""

    def row_metrics(row: Row, n: int | None) -> dict[str, Any]:
        return {
            "instructions_g": row.instructions / 1e9,
            "simd_g": row.simd / 1e9,
            "sdot_g": row.sdot / 1e9,
            "floor_g": None if n is None else n / SDOT_MACS / 1e9,
            "pieces": row.pieces,
            "kernels": {name: [v / 1e9 for v in found] for name, found in row.kernels.items()},
        }

    rest = sum(n for name, n in macs.items() if name not in counted.rows)
    floors = {FRAME: 0, REST: rest} | {name: n for name, n in macs.items() if name in counted.rows}
    return {
        "parts": {name: row_metrics(row, floors.get(name)) for name, row in counted.rows.items()},
        "whole": row_metrics(counted.whole, sum(macs.values())),
        "sum_g": counted.total() / 1e9,
        "call_g": counted.call / 1e9,
    }


def table(content: dict[str, Any]) -> str:
    """parts.json for people: one line per part, in the order of the data."""
    found = content["metrics"]
    lines = [
        f"{LABEL}, M instructions of one inference; floor: multiply-accumulates / {SDOT_MACS}",
        f"{'':26} {'executed':>9} {'SIMD':>8} {'SDOT':>8} {'floor':>8} {'x floor':>7}",
    ]
    for name, row in [*found["parts"].items(), ("whole", found["whole"])]:
        floor = row["floor_g"]
        times = f"{row['instructions_g'] / floor:7.2f}" if floor else f"{'-':>7}"
        cells = "".join(f" {1e3 * row[k]:8.2f}" for k in ("simd_g", "sdot_g", "floor_g"))
        lines.append(f"{name:26} {1e3 * row['instructions_g']:9.2f}{cells} {times}")
    return "\n".join([*lines, f"{'sum of the parts':26} {1e3 * found['sum_g']:9.2f}"])
