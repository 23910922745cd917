"""Runs inside the emulated Pi: an artifact as a whole, and the same graph cut in pieces, one after the other.

    parts.py ARTIFACT FOLDER

FOLDER holds what `lab.a76.parts` left: `observation.npz` (state (S,) float32, frame (h, w, 3) uint8 BGR),
`pieces.json` ([{"takes": [names], "gives": [names]}]), their modules `0000.pt`..., `values.pt` (the graph's inputs by
name) and `nothing.pt`, a module that does nothing. Each is run STEADY times and the last is counted: the whole
prediction is section 0, of it what comes before the graph section 1, a call that does nothing section 2, and piece i
section FIRST + i. Leaves in FOLDER `whole.npy` and `pieces.npy`, the graph's output (1, C, A) both ways, and `maps`.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from mark import mark

from rover_lib.onboard import load_policy
from rover_lib.onboard.errors import RoverError

STEADY = 3
WHOLE, FRAME, NOTHING, FIRST = 0, 1, 2, 3


class Watched:
    """The artifact's graph; a call ends the section of what came before it."""

    def __init__(self, graph):
        self.graph, self.counts = graph, False

    def __call__(self, *inputs):
        if self.counts:
            mark(False, FRAME)
        self.given = self.graph(*inputs)
        return self.given


def run_whole(artifact: str, folder: Path) -> None:
    policy = load_policy(artifact, threads=1)
    with np.load(folder / "observation.npz") as seen:
        state, frame = seen["state"], seen["frame"]
    for _ in range(STEADY - 1):
        policy.predict_chunk(frame, state)
    mark(True, WHOLE)
    policy.predict_chunk(frame, state)
    mark(False, WHOLE)
    policy._module = watched = Watched(policy._module)
    watched.counts = True
    mark(True, FRAME)
    policy.predict_chunk(frame, state)
    np.save(folder / "whole.npy", watched.given.numpy())


def run_pieces(folder: Path) -> None:
    torch.set_num_threads(1)
    torch.backends.quantized.engine = "qnnpack"
    pieces = json.loads((folder / "pieces.json").read_text())
    modules = [torch.jit.load(str(folder / f"{i:04d}.pt")).eval() for i in range(len(pieces))]
    inputs = torch.load(folder / "values.pt", weights_only=True)
    nothing = torch.jit.load(str(folder / "nothing.pt")).eval()
    with torch.inference_mode(), torch.jit.optimized_execution(False):
        for turn in range(STEADY):
            counts = turn == STEADY - 1
            values = dict(inputs)
            given = call(nothing, (torch.zeros(1),), counts, NOTHING)
            for i, (piece, module) in enumerate(zip(pieces, modules, strict=True)):
                given = call(module, [values[name] for name in piece["takes"]], counts, FIRST + i)
                values.update(zip(piece["gives"], given, strict=True))
                for name in piece["last_used"]:
                    del values[name]
        np.save(folder / "pieces.npy", given[0].numpy())


def call(module, takes, counts: bool, section: int):
    if not counts:
        return module(*takes)
    mark(True, section)
    given = module(*takes)
    mark(False, section)
    return given


def main(artifact: str, folder: str) -> None:
    print("whole", flush=True)
    run_whole(artifact, Path(folder))
    print("pieces", flush=True)
    run_pieces(Path(folder))
    (Path(folder) / "maps").write_text(Path("/proc/self/maps").read_text())
    print("done", flush=True)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except RoverError as e:
        sys.exit(f"error: {e}")
