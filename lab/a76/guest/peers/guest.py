"""Run another engine inside the emulated Pi, on its own form of the policy, in one thread and without torch.

    guest.py ARTIFACT OBSERVATIONS FOLDER COUNTED ENGINE HEIGHT WIDTH

ENGINE is onnxruntime (ARTIFACT is an .onnx) or executorch (a .pte). Both take `state` (1, S) float32 and `frame`
(1, 3, HEIGHT, WIDTH) float32 (see planes.py) and give (1, chunk, A) float32. The rest is as in ../inferences.py: a
camera's BGR frame goes in, actions come out, and everything in between is counted.
"""

import ctypes
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np
from inferences import leave, loaded, predict_all
from planes import planes

from rover_lib.onboard.policy.preprocess import prepare_frame

Run = Callable[[np.ndarray, np.ndarray], np.ndarray]  # state (1, S), planes -> (chunk, A), all float32


def onnxruntime(artifact: str) -> Run:
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = ort.InferenceSession(artifact, options, providers=["CPUExecutionProvider"])
    return lambda state, frame: session.run(None, {"state": state, "frame": frame})[0][0]


def executorch(artifact: str) -> Run:
    import executorch  # only to find its folder: the runtime is C++ (see executorch.cpp), without a pool of threads

    library = ctypes.CDLL(str(Path(next(iter(executorch.__path__))).parent / "policy.so"))
    library.policy_load.restype = ctypes.c_void_p
    error = ctypes.c_int()
    policy = ctypes.c_void_p(library.policy_load(artifact.encode(), ctypes.byref(error)))
    if error.value:
        sys.exit(f"error: {artifact}: ExecuTorch does not load it (its error {error.value:#x})")
    chunk = np.empty([library.policy_output_size(policy, i) for i in range(3)], np.float32)

    def predict(state: np.ndarray, frame: np.ndarray) -> np.ndarray:
        given, seen, out = (ctypes.c_void_p(array.ctypes.data) for array in (state, frame, chunk))
        if failed := library.policy_run(policy, given, state.shape[1], seen, *frame.shape[2:], out):
            sys.exit(f"error: ExecuTorch does not run {artifact} (its error {failed:#x})")
        return chunk[0].copy()

    return predict


def main(artifact: str, observations: str, folder: str, counted: str, engine: str, height: str, width: str) -> None:
    run = loaded(lambda: {"onnxruntime": onnxruntime, "executorch": executorch}[engine](artifact))
    size = int(height), int(width)

    def predict(frame: np.ndarray, state: np.ndarray) -> np.ndarray:
        return run(state[None], planes(prepare_frame(frame, *size)))

    predict_all(predict, observations, folder, int(counted))
    leave(folder, 1, **{engine: version(engine)})


if __name__ == "__main__":
    main(*sys.argv[1:])
