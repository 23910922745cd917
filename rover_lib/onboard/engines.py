"""The engines that run artifacts, by the name in an artifact's manifest. Only `load` imports one.

An engine is a module with

    load(path, manifest, threads) -> Engine

that raises ArtifactError if it cannot run the artifact here. threads: None leaves the engine's own choice.
"""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

TORCH, ONNXRUNTIME, HAILO = "qnnpack", "onnxruntime", "hailo"
PACKAGES = {TORCH: "torch", ONNXRUNTIME: "onnxruntime", HAILO: "hailo_platform"}  # what has to be installed for it
MODULES = {
    TORCH: "rover_lib.onboard.torch_engine",
    ONNXRUNTIME: "rover_lib.onboard.onnx_engine",
    HAILO: "rover_lib.onboard.hailo_engine",
}
# Engines whose process cannot be held to computing and reading files, and why
UNCONFINED = {HAILO: "HailoRT talks to the chip through its driver"}


class Engine(Protocol):
    """An artifact's graph in one engine."""

    def run(self, state: np.ndarray, frames_rgb: Sequence[np.ndarray]) -> np.ndarray:
        """(S,) float32 and one (height, width, 3) uint8 per camera in, (1, chunk, A) out. Raises RuntimeError."""

    def give_back(self) -> bool:
        """Drops what only loading needed, once it has run; whether predictions must be proven again after that."""

    @property
    def threads(self) -> int:
        """How many threads compute."""

    def set_threads(self, threads: int) -> None:
        """Compute with that many threads from now on; torch's are those of the whole process."""


class SessionEngine(ABC):
    """What engines share whose threads are those of a session of ONNX Runtime, and which hold nothing to give back."""

    _threads: int

    @abstractmethod
    def _make_session(self, threads: int) -> None:
        """Make the session with that many threads. Raises ArtifactError, and leaves the one that is there then."""

    def give_back(self) -> bool:
        """As Engine: nothing is held that could be."""
        return False

    @property
    def threads(self) -> int:
        """As Engine, of what runs on the processor."""
        return self._threads

    def set_threads(self, threads: int) -> None:
        """As Engine: a session has its threads for life, so it is made anew. Raises ArtifactError."""
        self._make_session(threads)
        self._threads = threads


def module_of(name: str) -> Any:
    """The engine's module, imported now, which takes seconds: by who limits what may be opened or allocated later.

    Raises KeyError for an engine that is not known, ImportError for one that is not installed.
    """
    return importlib.import_module(MODULES[name])
