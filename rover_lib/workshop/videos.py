"""Find which picture of a video each frame shows, and whether it is torn."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rover_lib.workshop.untrusted import scan_video


class Matched(NamedTuple):
    """times_s: when the frames' pictures are shown. off_s: how far that is from where they were looked for.

    torn: (n,) bool, whether they are damaged.
    """

    times_s: np.ndarray
    off_s: np.ndarray
    torn: np.ndarray


def match_pictures(path: Path, wanted_s: np.ndarray, rate_hz: float, tolerance_s: float) -> Matched:
    """Match the frames of a video by their times, (n,) seconds: the nearest picture, where none is there.

    Frames after the last picture, of a video that was cut, keep their times. Raises what PyAV raises.
    """
    frames, torn = scan_video(path)
    there_s = np.array([*frames, np.inf])
    after = np.searchsorted(there_s, wanted_s).clip(1, len(frames))
    before_s = there_s[after - 1]
    after_s = there_s[after]
    nearest_s = np.where(wanted_s - before_s < after_s - wanted_s, before_s, after_s)
    off_s = np.where(wanted_s < frames[-1] + 0.5 / rate_hz, np.abs(nearest_s - wanted_s), 0.0)
    is_torn = np.isin(nearest_s, list(torn)) & (wanted_s < frames[-1] + 0.5 / rate_hz)
    return Matched(np.where(off_s > tolerance_s, nearest_s, wanted_s), off_s, is_torn)
