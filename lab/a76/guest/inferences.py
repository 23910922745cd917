"""What everything that runs inside the emulated Pi does alike: it loads, predicts, tells the plugin what to count.

Loading is section 0 of the plugin's counts, the first `counted` inferences are sections 1, 2, ... Each line on stdout
says what begins.
"""

import ctypes
import json
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

GETPPID, MARK = 173, 0xC0FFEE  # as in count.c; without the plugin it is a system call that does nothing
libc = ctypes.CDLL(None)

# frame (h, w, 3) uint8 BGR, or one by each camera's name; state (S,) -> (chunk, A) float32
Predict = Callable[[Any, np.ndarray], np.ndarray]


def mark(starts: bool, section: int) -> None:
    """Count from here on, or up to here."""
    libc.syscall(GETPPID, ctypes.c_ulong(MARK), ctypes.c_ulong(starts), ctypes.c_ulong(section))


def loaded(load: Callable[[], Any]) -> Any:
    """What `load` returns, counted."""
    print("load", flush=True)
    mark(True, 0)
    result = load()
    mark(False, 0)
    return result


def predict_all(predict: Predict, observations: str, folder: str, counted: int) -> None:
    """Predict each observation, and leave `chunks.npy` (n, chunk, A) float32 in the folder.

    observations: an npz of `state` (n, S) float32 and `frame_0000`... (h, w, 3) uint8 BGR, or `frame_0000.<camera>`...
    where there are several cameras; they are predicted in that order, and again from the first if there are fewer than
    `counted`. A frame is read outside of what is counted.
    """
    chunks = []
    with np.load(observations) as seen:
        states = seen["state"]
        for i in range(max(len(states), counted)):
            state, frame = states[i % len(states)], frame_of(seen, i % len(states))
            print("predict", flush=True)
            if i < counted:
                mark(True, i + 1)
                chunk = predict(frame, state)
                mark(False, i + 1)
            else:
                chunk = predict(frame, state)
            chunks.append(chunk)
    np.save(Path(folder) / "chunks.npy", np.stack(chunks[: len(states)]))


def frame_of(seen: Any, number: int) -> Any:
    """A frame of an npz; of several cameras a dict by their names."""
    name = f"frame_{number:04d}"
    if name in seen:
        return seen[name]
    return {key.removeprefix(f"{name}."): seen[key] for key in seen if key.startswith(f"{name}.")}


def leave(folder: str, threads: int, **versions: str) -> None:
    """Leave `maps` (where what is loaded) and `versions.json` in the folder. threads: that did the work."""
    versions |= {"python": platform.python_version(), "numpy": np.__version__, "cv2": cv2.__version__}
    versions |= {"machine": platform.machine(), "libc": " ".join(platform.libc_ver())}
    (Path(folder) / "versions.json").write_text(json.dumps(versions | {"threads": threads}))
    (Path(folder) / "maps").write_text(Path("/proc/self/maps").read_text())
    print("done", flush=True)
