"""Run one artifact inside the emulated Pi, with rover_lib.onboard alone, as a Pi would run it.

    predict.py ARTIFACT OBSERVATIONS FOLDER COUNTED [ENGINE PART INPUTS BITS]

inferences.py explains what it reads, counts, prints and leaves in FOLDER. Preparing a frame is counted too.

With the last four it then runs PART, a TorchScript part of the policy, to get its bits, not to count. INPUTS is an npz
of `state` (n, S) and prepared frames `frame_0000.<camera>`..., in the order in which the part takes them. It writes the
part's outputs to BITS, an npy (n, ...).
"""

import sys
from importlib.metadata import version

import numpy as np
from inferences import frame_of, leave, loaded, predict_all

from rover_lib.onboard import load_policy
from rover_lib.onboard.artifact.engines import PACKAGES
from rover_lib.onboard.errors import RoverError


def main(artifact: str, observations: str, folder: str, counted: str, *part: str) -> None:
    policy = loaded(lambda: load_policy(artifact, threads=1))
    predict_all(policy.predict_chunk, observations, folder, int(counted))
    package = PACKAGES[policy.manifest["engine"]]
    leave(folder, policy.threads, **{package: version(package)})
    if part:
        leave_bits(*part)


def leave_bits(engine: str, module: str, inputs: str, bits: str) -> None:
    import torch  # imported only here, so that an artifact of the other engine does not pay for it

    torch.backends.quantized.engine = engine
    torch.set_num_threads(1)
    part, given = torch.jit.load(module).eval(), []
    with np.load(inputs) as seen, torch.inference_mode(), torch.jit.optimized_execution(False):
        for i, state in enumerate(torch.from_numpy(seen["state"])):
            print("bits", flush=True)
            given.append(part(state[None], *map(torch.from_numpy, frame_of(seen, i).values())))
    np.save(bits, torch.cat(given).numpy())


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except RoverError as e:
        sys.exit(f"error: {e}")
