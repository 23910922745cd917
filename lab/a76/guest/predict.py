"""Runs inside the emulated Pi: one artifact through rover_lib.onboard alone, as a Pi would run it.

    predict.py ARTIFACT OBSERVATIONS FOLDER COUNTED
    predict.py --backbone ENGINE MODULE INPUTS

What it reads, counts, prints and leaves in FOLDER is told in inferences.py; preparing a frame is counted too.

The second form runs a TorchScript part of a policy, for its bits and not for a count: INPUTS is an npz of `state`
(n, S) and prepared frames, as the part takes them; leaves `backbone.npy` (n, ...) of what it gave, in its folder.
"""

import sys

import numpy as np
import torch
from inferences import leave, loaded, predict_all

from rover_lib.onboard import load_policy
from rover_lib.onboard.errors import RoverError


def main(artifact: str, observations: str, folder: str, counted: str) -> None:
    policy = loaded(lambda: load_policy(artifact, threads=1))
    predict_all(policy.predict_chunk, observations, folder, int(counted))
    leave(folder, torch.get_num_threads(), torch=torch.__version__)


def backbone(engine: str, module: str, inputs: str) -> None:
    torch.backends.quantized.engine = engine
    torch.set_num_threads(1)
    print("load", flush=True)
    part, given = torch.jit.load(module).eval(), []
    with np.load(inputs) as seen, torch.inference_mode(), torch.jit.optimized_execution(False):
        for i, state in enumerate(torch.from_numpy(seen["state"])):
            print("predict", flush=True)
            given.append(part(state[None], torch.from_numpy(seen[f"frame_{i:04d}"])))
    np.save("backbone.npy", torch.cat(given).numpy())


if __name__ == "__main__":
    try:
        if sys.argv[1] == "--backbone":
            backbone(*sys.argv[2:])
        else:
            main(*sys.argv[1:])
    except RoverError as e:
        sys.exit(f"error: {e}")
