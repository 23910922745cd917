"""Prepare a frame for an engine that wants floats, on the workstation and in the emulated Pi."""

import numpy as np


def planes(frame_rgb: np.ndarray) -> np.ndarray:
    """Turn (height, width, 3) uint8 RGB into (1, 3, height, width) float32, 0 to 255. Normalisation is in the graph.

    As a part of the graph, this took ExecuTorch and ONNX Runtime ten times as many instructions as it takes numpy.
    """
    return np.ascontiguousarray(frame_rgb.transpose(2, 0, 1)[None], dtype=np.float32)
