"""The engines that run artifacts, by the name in an artifact's manifest. Only `load` imports one.

An engine's module has load(artifact, threads) -> Engine, which raises ArtifactError if it cannot run the open Artifact
here. threads: None lets the engine choose.
"""

import importlib
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

TORCH, ONNXRUNTIME, HAILO = "qnnpack", "onnxruntime", "hailo"
PACKAGES = {TORCH: "torch", ONNXRUNTIME: "onnxruntime", HAILO: "hailo_platform"}  # the package each engine needs
MODULES = {
    TORCH: "rover_lib.onboard.policy.torch_engine",
    ONNXRUNTIME: "rover_lib.onboard.policy.onnx_engine",
    HAILO: "rover_lib.onboard.policy.hailo_engine",
}
# Engines whose process cannot be confined (see confine.py), and why
UNCONFINED = {HAILO: "HailoRT talks to the chip through its driver"}


class Engine(Protocol):
    """An artifact's graph in one engine."""

    def run(self, state: np.ndarray, frames_rgb: Sequence[np.ndarray]) -> np.ndarray:
        """(S,) float32 and one (height, width, 3) uint8 per camera in, (1, chunk, A) out. Raises RuntimeError."""

    def give_back(self) -> bool:
        """Free the memory that only loading needed, after a first run; return whether to check predictions again."""

    @property
    def threads(self) -> int:
        """How many threads compute."""

    def set_threads(self, threads: int) -> None:
        """Compute with that many threads from now on. XNNPACK's pool keeps the number of its first plan."""


class SessionEngine:
    """Base of the engines that compute in a session of ONNX Runtime. They have no memory to give back."""

    threads = 0

    def _make_session(self, threads: int) -> None:
        """Make the session with that many threads. Raises ArtifactError, and then keeps the present session."""
        raise NotImplementedError

    def give_back(self) -> bool:
        return False

    def set_threads(self, threads: int) -> None:
        self._make_session(threads)
        self.threads = threads


def module_of(name: str) -> Any:
    """Import an engine's module, which takes seconds. Raises KeyError or ImportError."""
    return importlib.import_module(MODULES[name])
