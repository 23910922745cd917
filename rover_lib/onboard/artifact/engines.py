"""The engines that run artifacts, by the name in an artifact's manifest. Only `load` imports one.

An engine's module has load(artifact, threads) -> Engine, which raises ArtifactError if it cannot run the open Artifact
here. threads: None lets the engine choose.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

TORCH, ONNXRUNTIME = "qnnpack", "onnxruntime"
PACKAGES = {TORCH: "torch", ONNXRUNTIME: "onnxruntime"}  # the package each engine needs
MODULES = {
    TORCH: "rover_lib.onboard.policy.torch_engine",
    ONNXRUNTIME: "rover_lib.onboard.policy.onnx_engine",
}


class Engine(Protocol):
    """An artifact's graph in one engine. threads: how many compute."""

    threads: int

    def run(self, state: np.ndarray, frames_rgb: Sequence[np.ndarray]) -> list[np.ndarray]:
        """(S,) float32 and one (height, width, 3) uint8 per camera in. Raises RuntimeError.

        Returns (1, chunk, A), and (1, D) if the artifact gives an embedding.
        """

    def give_back(self) -> bool:
        """Free the memory that only loading needed, after a first run; return whether to check predictions again."""
        return False
