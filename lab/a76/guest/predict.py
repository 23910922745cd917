"""Run one artifact inside the emulated Pi, with rover_lib.onboard alone, as a Pi would run it.

    predict.py ARTIFACT OBSERVATIONS FOLDER COUNTED

Loading is section 0 of the plugin's counts; the first COUNTED inferences, with the preparation of a frame, are sections
1, 2, ... and what tells the unfamiliar is the one after them. Each line on stdout says what begins.

OBSERVATIONS: an npz of `state` (n, S) float32 and `frame_0000`... (h, w, 3) uint8 BGR. FOLDER gets `chunks.npy`
(n, chunk, A) float32, `maps` (which files are loaded where) and `versions.json`.
"""

import ctypes
import json
import platform
import sys
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np

from rover_lib.onboard import load_policy
from rover_lib.onboard.artifact.manifest import PACKAGES
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.policy.load import Policy

GETPPID, MARK = 173, 0xC0FFEE  # as in count.c; without the plugin this system call has no effect
libc = ctypes.CDLL(None)


def mark(starts: bool, section: int) -> None:
    """Tell the plugin that a section starts here, or that it ends here."""
    libc.syscall(GETPPID, ctypes.c_ulong(MARK), ctypes.c_ulong(starts), ctypes.c_ulong(section))


def predict_all(policy: Policy, observations: str, counted: int) -> np.ndarray:
    """Predict the observations in order, and again from the first if there are fewer than `counted`.

    Reading a frame is not counted.
    """
    chunks = []
    with np.load(observations) as arrays:
        states = arrays["state"]
        for i in range(max(len(states), counted)):
            state, frame = states[i % len(states)], arrays[f"frame_{i % len(states):04d}"]
            print("predict", flush=True)
            if i < counted:
                mark(True, i + 1)
            chunks.append(policy.predict_chunk(frame, state))
            if i < counted:
                mark(False, i + 1)
    if policy.familiar:  # what telling the unfamiliar costs of each inference; its arrays are in the caches by now
        mark(True, counted + 1)
        policy.familiar.strange(policy.familiar.mean[None])
        mark(False, counted + 1)
    return np.stack(chunks[: len(states)])


def main(artifact: str, observations: str, folder: str, counted: str) -> None:
    print("load", flush=True)
    mark(True, 0)
    policy = load_policy(artifact, threads=1)
    mark(False, 0)
    np.save(Path(folder) / "chunks.npy", predict_all(policy, observations, int(counted)))
    package = PACKAGES[policy.manifest["engine"]]
    versions = {package: version(package), "numpy": np.__version__, "cv2": cv2.__version__, "threads": policy.threads}
    versions |= {"python": platform.python_version(), "machine": platform.machine()}
    versions |= {"libc": " ".join(platform.libc_ver())}
    (Path(folder) / "versions.json").write_text(json.dumps(versions))
    (Path(folder) / "maps").write_text(Path("/proc/self/maps").read_text())
    print("done", flush=True)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except RoverError as e:
        sys.exit(f"error: {e}")
