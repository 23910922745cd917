"""Soften recorded plans: a share of each is what a line through the backbone's features says of it.

    softened = soften(maps, chunks, share, judging, judge)

What a driver does half a second later is noise in part, which a transformer learns by heart within some hundred steps.
A ridge regression on features that are averaged over the picture cannot.
"""

from collections.abc import Callable

import numpy as np

from rover_learn.backbone import FEATURES
from rover_learn.training import RowFile, blocks_of

RIDGES = (1.0, 10.0, 100.0, 1000.0, 10_000.0)
AT_ONCE = 256  # maps


def soften(
    maps: RowFile,
    chunks: np.ndarray,
    share: float,
    judging: RowFile,
    judge: Callable[[np.ndarray], float],
) -> np.ndarray:
    """Return plans to learn from, (n, C, A) float32: `share` of the line's, the rest recorded.

    maps: (n, 512, h, w), features of what was recorded with chunks, (n, C, A). judging: features of other recordings;
    judge: the error of plans on these, (m, C, A), by which one of RIDGES is chosen.
    """
    features = _averaged(maps)
    centre = features.mean(axis=0)
    features -= centre
    plans = chunks.reshape(len(chunks), -1).astype(np.float64)
    usual = plans.mean(axis=0)
    seen = _averaged(judging) - centre
    squares = features.T @ features
    products = features.T @ (plans - usual)
    best_error = np.inf
    best_weights = np.zeros_like(products)
    for ridge in RIDGES:
        weights = np.linalg.solve(squares + ridge * np.eye(FEATURES), products)
        planned = (seen @ weights + usual).reshape(-1, *chunks.shape[1:])
        error = judge(planned)
        if error < best_error:
            best_error = error
            best_weights = weights
    line = (features @ best_weights + usual).reshape(chunks.shape)
    return ((1 - share) * chunks + share * line).astype(np.float32)


def _averaged(maps: RowFile) -> np.ndarray:
    """Return features averaged over the picture, (n, 512) float64."""
    blocks = blocks_of(len(maps), AT_ONCE)
    return np.concatenate([maps[rows].mean(axis=(2, 3), dtype=np.float64) for rows in blocks])
