"""Run one artifact inside the emulated Pi, with rover_lib.onboard alone, as a Pi would run it.

    predict.py ARTIFACT OBSERVATIONS FOLDER COUNTED
    predict.py --backbone ENGINE MODULE INPUTS

inferences.py explains what it reads, counts, prints and leaves in FOLDER. Preparing a frame is counted too.

The second form runs a TorchScript part of a policy to get its bits, not to count. INPUTS is an npz of `state` (n, S)
and prepared frames `frame_0000.<camera>`..., in the order in which the part takes them. It leaves the part's outputs as
`backbone.npy` (n, ...) in the current folder.
"""

import sys
from importlib.metadata import version

import numpy as np
from inferences import frame_of, leave, loaded, predict_all

from rover_lib.onboard import load_policy
from rover_lib.onboard.artifact.engines import PACKAGES
from rover_lib.onboard.errors import RoverError


def main(artifact: str, observations: str, folder: str, counted: str) -> None:
    policy = loaded(lambda: load_policy(artifact, threads=1))
    predict_all(policy.predict_chunk, observations, folder, int(counted))
    package = PACKAGES[policy.manifest["engine"]]
    leave(folder, policy.threads, **{package: version(package)})


def backbone(engine: str, module: str, inputs: str) -> None:
    import torch  # imported only here, so that an artifact of the other engine does not pay for it

    torch.backends.quantized.engine = engine
    torch.set_num_threads(1)
    print("load", flush=True)
    part, given = torch.jit.load(module).eval(), []
    with np.load(inputs) as seen, torch.inference_mode(), torch.jit.optimized_execution(False):
        for i, state in enumerate(torch.from_numpy(seen["state"])):
            print("predict", flush=True)
            given.append(part(state[None], *map(torch.from_numpy, frame_of(seen, i).values())))
    np.save("backbone.npy", torch.cat(given).numpy())


if __name__ == "__main__":
    try:
        if sys.argv[1] == "--backbone":
            backbone(*sys.argv[2:])
        else:
            main(*sys.argv[1:])
    except RoverError as e:
        sys.exit(f"error: {e}")
