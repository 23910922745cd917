"""Runs inside the emulated Pi: one artifact through rover_lib.onboard alone, as a Pi would run it.

    predict.py ARTIFACT OBSERVATIONS FOLDER COUNTED
    predict.py --backbone ENGINE MODULE INPUTS

OBSERVATIONS is an npz of `state` (n, S) float32 and `frame_0000`... (h, w, 3) uint8 BGR; they are predicted in that
order, and again from the first if there are fewer than COUNTED. Loading is section 0 of the plugin's counts, the first
COUNTED inferences are sections 1, 2, ...; a frame is read outside of them, and prepared inside. Leaves in FOLDER
`chunks.npy` (n, chunk, A) float32, `maps` (where what is loaded) and `versions.json`. Each line on stdout says what
begins.

The second form runs a TorchScript part of a policy, for its bits and not for a count: INPUTS is an npz of `state`
(n, S) and prepared frames, as the part takes them; leaves `backbone.npy` (n, ...) of what it gave, in its folder.
"""

import json
import platform
import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from mark import mark

from rover_lib.onboard import load_policy
from rover_lib.onboard.errors import RoverError


def main(artifact: str, observations: str, folder: str, counted: str) -> None:
    print("load", flush=True)
    mark(True, 0)
    policy = load_policy(artifact, threads=1)
    mark(False, 0)
    chunks = []
    with np.load(observations) as seen:
        states = seen["state"]
        for i in range(max(len(states), int(counted))):
            state, frame = states[i % len(states)], seen[f"frame_{i % len(states):04d}"]
            print("predict", flush=True)
            if i < int(counted):
                mark(True, i + 1)
                chunk = policy.predict_chunk(frame, state)
                mark(False, i + 1)
            else:
                chunk = policy.predict_chunk(frame, state)
            chunks.append(chunk)
    out = Path(folder)
    np.save(out / "chunks.npy", np.stack(chunks[: len(states)]))
    versions = {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__}
    versions |= {"cv2": cv2.__version__, "machine": platform.machine(), "libc": " ".join(platform.libc_ver())}
    (out / "versions.json").write_text(json.dumps(versions | {"threads": torch.get_num_threads()}))
    (out / "maps").write_text(Path("/proc/self/maps").read_text())
    print("done", flush=True)


def backbone(engine: str, module: str, inputs: str) -> None:
    torch.backends.quantized.engine = engine
    torch.set_num_threads(1)
    print("load", flush=True)
    part, found = torch.jit.load(module).eval(), []
    with np.load(inputs) as seen, torch.inference_mode(), torch.jit.optimized_execution(False):
        for i, state in enumerate(torch.from_numpy(seen["state"])):
            print("predict", flush=True)
            found.append(part(state[None], torch.from_numpy(seen[f"frame_{i:04d}"])))
    np.save("backbone.npy", torch.cat(found).numpy())


if __name__ == "__main__":
    try:
        if sys.argv[1] == "--backbone":
            backbone(*sys.argv[2:])
        else:
            main(*sys.argv[1:])
    except RoverError as e:
        sys.exit(f"error: {e}")
