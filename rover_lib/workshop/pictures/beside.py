"""Compare what the drives' pictures have in common, to find those that are upside down, or whose colours are swapped.

Each drive is described by where its pictures have which brightness, texture and colours. Turned over, the description
of a drive that is upside down is like the others'. Where the drives of one place have nothing in common, or what they
have would be the same the other way round, nothing is found.
"""

from collections.abc import Sequence

import numpy as np

LEAST_DRIVES = 3
BINS, THIRDS, ROWS = 12, 3, 12  # of hues; parts of a picture's height
SATURATED = 60.0  # grey levels from grey; a white balance makes less of grey
COLOURED = 0.01  # how far, in shares of the picture, the hues of a drive must be from their swapped ones
MOST_OF = 0.9  # the share of the drives that must be alike, once they are turned
UNLIKE = 0.3  # how much nearer the right description must be, by cosine
# Of a drive whose colours are swapped: its cosine to the others' mean once it is turned, and how much less it was.
# By UNLIKE alone, one of eight draws of 3 to 20 of the demo's drives had a drive too many: floors and walls differ.
TURNED_LEAST, TURNED_NEARER = 0.5, 0.4


def find_swapped(drives: Sequence[np.ndarray]) -> np.ndarray:
    """Return which drives have red and blue swapped beside the others, (n,) bool.

    drives: some pictures of each, (k, h, w, 3) float32 BGR.
    """
    hues = np.array([_hues(pictures) for pictures in drives])
    swapped = hues[..., [(BINS * 2 // 3 - 1 - k) % BINS for k in range(BINS)]]  # 240 degrees minus the hue
    coloured = np.linalg.norm((hues - swapped).reshape(len(hues), -1), axis=1) > COLOURED
    if coloured.sum() < LEAST_DRIVES or coloured.mean() < MOST_OF:
        return np.zeros(len(drives), bool)
    side, right, wrong = _turned(hues, swapped)
    odd = side & coloured & ((_nearer(right, wrong) > UNLIKE)[coloured].mean() >= MOST_OF)
    for i in np.flatnonzero(odd):
        others = np.delete(right, i, axis=0).mean(0)
        once_turned, before = _cosine(np.stack([right[i], wrong[i]]), others)
        odd[i] = once_turned > TURNED_LEAST and once_turned - before > TURNED_NEARER
    return odd


def find_upside_down(drives: Sequence[np.ndarray]) -> np.ndarray:
    """Return which drives are upside down beside the others, (n,) bool; drives as of `find_swapped`."""
    rows = np.array([_rows(pictures) for pictures in drives])
    rows -= rows.mean(2, keepdims=True)
    rows /= np.sqrt((rows**2).mean((0, 2), keepdims=True)) + 1e-6
    side, *descriptions = _turned(rows, rows[:, :, ::-1])
    # Walls may be darker than the floor or brighter: what is told by brightness alone is not sure.
    by_texture, *textures = _turned(rows[:, 1:4], rows[:, 1:4, ::-1])
    if (side == by_texture).mean() < MOST_OF:
        return np.zeros(len(drives), bool)
    return side & by_texture & (np.minimum(_nearer(*descriptions), _nearer(*textures)) > UNLIKE)


def _turned(features: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which drives are nearer to the others when they are turned, the fewer ones, (n,) bool.

    And the drives' descriptions, (n, values), the right way round and the wrong way round.
    features, turned: (n, ...) descriptions of the drives, as they are and turned.
    """
    features, turned = (values.reshape(len(values), -1) for values in (features, turned))
    apart = features - turned  # what a turn changes, and only that
    apart = apart / np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-9)
    common = np.linalg.eigh(apart.T @ apart)[1][:, -1]
    signs = apart @ common
    differ = signs * np.sign(signs.sum()) < 0
    right = np.where(differ[:, None], turned, features)
    wrong = np.where(differ[:, None], features, turned)
    return differ, right, wrong


def _nearer(right: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """Return how much nearer, (n,), each right description is to their mean than the wrong one."""
    usual = right.mean(0)
    return _cosine(right, usual) - _cosine(wrong, usual)


def _cosine(vectors: np.ndarray, one: np.ndarray) -> np.ndarray:
    return (vectors @ one) / np.maximum(np.linalg.norm(vectors, axis=1) * np.linalg.norm(one), 1e-9)


def _hues(pictures: np.ndarray) -> np.ndarray:
    """Return which share of a picture has each saturated hue, (THIRDS, BINS), from top to bottom."""
    blue, green, red = np.moveaxis(pictures, -1, 0)
    x = red - (green + blue) / 2
    y = np.sqrt(3) / 2 * (green - blue)
    hue = (np.degrees(np.arctan2(y, x)) % 360 // (360 / BINS)).astype(int) % BINS
    saturated = np.hypot(x, y) > SATURATED
    parts = zip(np.array_split(hue, THIRDS, 1), np.array_split(saturated, THIRDS, 1), strict=True)
    return np.array([np.bincount(h[s], minlength=BINS) / h.size for h, s in parts])


def _rows(pictures: np.ndarray) -> np.ndarray:
    """Return (6, ROWS): brightness, its spread and edges across and down, red and blue beside green, by height."""
    grey = pictures.mean(-1)
    across = np.abs(np.diff(grey, axis=2)).mean((0, 2))
    down = np.abs(np.diff(grey, axis=1, append=grey[:, -1:]))
    colours = [(pictures[..., a] - pictures[..., b]).mean((0, 2)) for a, b in ((2, 1), (1, 0))]
    profile = np.array([grey.mean((0, 2)), grey.std(2).mean(0), across, down.mean((0, 2)), *colours])
    return profile.reshape(len(profile), ROWS, -1).mean(2)
