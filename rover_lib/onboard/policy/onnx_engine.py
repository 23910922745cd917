"""Run artifacts in ONNX Runtime, on a rover without torch."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnxruntime

from rover_lib.onboard.artifact.archive import ONNX, refused
from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.car.host import usable_cores
from rover_lib.onboard.policy.load import Engine

onnxruntime.disable_telemetry_events()  # nobody has agreed to it
ERRORS_ONLY = 3  # log level; ONNX Runtime warns of what a machine without a graphics card lacks


def session_of(model: bytes, threads: int, path: Path | str = "the model") -> onnxruntime.InferenceSession:
    """Make a session for one of our models, on the processor. path: the model's, for errors. Raises ArtifactError."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = ERRORS_ONLY
    # A thread that waits for work by spinning takes the control loop's turn, and warms the processor for nothing.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Else kernels for x86 without VNNI clip sums of two products to 16 bits.
    options.add_session_config_entry("session.x64quantprecision", "1")
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as e:  # ONNX Runtime raises a dozen types
        why = " ".join(str(e).split())[:200]
        raise refused(path, f"ONNX Runtime cannot load it ({why})") from None
    # The session keeps the model's bytes (68 MB) beside its packed weights, only to be made again with other providers.
    session._model_bytes = None
    return session


class OnnxEngine(Engine):
    """The model of an ONNX artifact. Make it with `load`."""

    def __init__(self, path: Path, model: bytes, threads: int):
        self._session = session_of(model, threads, path)
        self.threads = threads
        self.names = [i.name for i in self._session.get_inputs()]

    def run(self, state: np.ndarray, frames_rgb: Sequence[np.ndarray]) -> list[np.ndarray]:
        inputs = dict(zip(self.names, (state[None], *frames_rgb), strict=True))
        try:
            return self._session.run(None, inputs)
        except Exception as e:  # ONNX Runtime raises a dozen types, none of them a RuntimeError
            raise RuntimeError(str(e)) from None


def load(artifact: Artifact, threads: int | None) -> OnnxEngine:
    """Load an artifact. Raises ArtifactError if ONNX Runtime refuses it, or its inputs are not the manifest's."""
    path = artifact.path
    manifest = artifact.manifest
    engine = OnnxEngine(path, artifact.record(ONNX), threads or usable_cores())
    names = ["state", *(f"frame_{c['name']}" for c in manifest["cameras"])]
    if engine.names != names:
        raise refused(path, f"its model takes {engine.names}, its manifest says {names}"[:300])
    return engine
