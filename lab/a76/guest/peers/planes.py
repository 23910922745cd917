"""How a frame reaches an engine that wants floats, on the workstation and in the emulated Pi."""

import numpy as np


def planes(frame_rgb: np.ndarray) -> np.ndarray:
    """(height, width, 3) uint8 RGB -> (1, 3, height, width) float32, 0..255: normalisation is in the graph.

    In the graph, this took ExecuTorch and ONNX Runtime ten times as many instructions as it takes numpy.
    """
    return np.ascontiguousarray(frame_rgb.transpose(2, 0, 1)[None], dtype=np.float32)
