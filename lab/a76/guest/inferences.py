"""Load a policy and predict inside the emulated Pi, and tell the plugin what to count. All guest scripts share this.

Loading is section 0 of the plugin's counts; the first `counted` inferences are sections 1, 2, ... Each line on stdout
says what begins.
"""

import ctypes
import json
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

GETPPID, MARK = 173, 0xC0FFEE  # as in count.c; without the plugin this system call has no effect
libc = ctypes.CDLL(None)

# frame, state -> (chunk, A) float32. frame: (h, w, 3) uint8 BGR. state: (S,).
Predict = Callable[[Any, np.ndarray], np.ndarray]


def mark(starts: bool, section: int) -> None:
    """Tell the plugin that a section starts here, or that it ends here."""
    libc.syscall(GETPPID, ctypes.c_ulong(MARK), ctypes.c_ulong(starts), ctypes.c_ulong(section))


def loaded(load: Callable[[], Any]) -> Any:
    """Call `load`, count that as section 0, and return its result."""
    print("load", flush=True)
    mark(True, 0)
    result = load()
    mark(False, 0)
    return result


def predict_all(predict: Predict, observations: str, folder: str, counted: int) -> None:
    """Predict each observation, and leave `chunks.npy` (n, chunk, A) float32 in the folder.

    observations: an npz of `state` (n, S) float32 and `frame_0000`... (h, w, 3) uint8 BGR. They are predicted in that
    order, and again from the first if there are fewer than `counted`. Reading a frame is not counted.
    """
    chunks = []
    with np.load(observations) as seen:
        states = seen["state"]
        for i in range(max(len(states), counted)):
            state, frame = states[i % len(states)], seen[f"frame_{i % len(states):04d}"]
            print("predict", flush=True)
            if i < counted:
                mark(True, i + 1)
                chunk = predict(frame, state)
                mark(False, i + 1)
            else:
                chunk = predict(frame, state)
            chunks.append(chunk)
    np.save(Path(folder) / "chunks.npy", np.stack(chunks[: len(states)]))


def leave(folder: str, threads: int, **versions: str) -> None:
    """Leave `maps` (which files are loaded where) and `versions.json` in the folder.

    threads: how many did the work.
    """
    import cv2  # not above: networks that are no policies do without it, and it takes seconds to emulate

    versions |= {"python": platform.python_version(), "numpy": np.__version__, "cv2": cv2.__version__}
    versions |= {"machine": platform.machine(), "libc": " ".join(platform.libc_ver())}
    (Path(folder) / "versions.json").write_text(json.dumps(versions | {"threads": threads}))
    (Path(folder) / "maps").write_text(Path("/proc/self/maps").read_text())
    print("done", flush=True)
