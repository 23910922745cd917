"""Find which picture of a video each frame shows, and whether it is torn."""

from pathlib import Path

import numpy as np

from rover_lib.workshop.untrusted import scan_video


def match_pictures(
    path: Path, times_s: np.ndarray, rate_hz: float, tolerance_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Match the frames of a video by their times, (n,) seconds: the nearest picture, where none is there.

    Frames after the last picture, of a video that was cut, keep their times. Raises what PyAV raises.
    Returns when the frames' pictures are shown, how far that is from `times_s`, and whether they are torn, (n,) each.
    """
    pictures_s, torn_s = scan_video(path)
    edges_s = np.array([*pictures_s, np.inf])
    after = np.searchsorted(edges_s, times_s).clip(1, len(pictures_s))
    before_s = edges_s[after - 1]
    after_s = edges_s[after]
    nearest_s = np.where(times_s - before_s < after_s - times_s, before_s, after_s)
    within = times_s < pictures_s[-1] + 0.5 / rate_hz
    off_s = np.where(within, np.abs(nearest_s - times_s), 0.0)
    return np.where(off_s > tolerance_s, nearest_s, times_s), off_s, within & np.isin(nearest_s, list(torn_s))
