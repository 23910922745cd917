"""Notice a car that stands although its throttle is on, by pictures that stay as they were: for pilot.py."""

import cv2
import numpy as np

from rover_lib.onboard.car.camera import Frame
from rover_lib.onboard.errors import DriveFault

DRIVEN = 0.02  # throttle above which a car must move; the least of the recordings is 0.027
EVERY_S = 0.1  # between two pictures that are looked at; each takes 0.7 ms
GAP_S = 0.25  # at most this is counted for a picture: nobody knows what the car did in a longer gap
BLOCKS = 80, 60  # across and down: a JPEG's, of 8 pixels, in a picture of 640x480
ACROSS, DOWN = 2, 3  # blocks of a half in a cell
# How far two pictures differ, of a mean of 100, if the car has moved between them. Those of a standing car differ by up
# to 2 in the dark and under lamps that flicker by a fifth, those of a driving one by more than 3 within half a second
# (results/lab/stuck.json).
MOVED = 2.5


class Motion:
    """Judges whether a car moves that is told to. stuck_s: how long it may stand; 0: for ever."""

    def __init__(self, stuck_s: float):
        self.stuck_s = stuck_s
        self.still_s = 0.0  # for how long the throttle has been on since the last motion
        self._off_s = self._judged_s = 0.0
        self._before: np.ndarray | None = None  # the cells at the last motion

    def watch(self, frame: Frame, throttle: float) -> None:
        """Take note of the newest picture, and of the throttle that is in force. Raises DriveFault for a stuck car."""
        passed_s = frame.captured_s - self._judged_s
        if not self.stuck_s or passed_s < EVERY_S:
            return
        self._judged_s = frame.captured_s
        passed_s = min(passed_s, GAP_S)
        self._off_s = 0.0 if abs(throttle) > DRIVEN else self._off_s + passed_s
        if self._off_s > self.stuck_s:  # a car that brakes for a moment may still be stuck, one that waits is not
            self._before = None
            return
        cells = cells_of(frame.image)
        if self._before is None or difference(cells, self._before) > MOVED:
            self._before = cells
            self.still_s = 0.0
        elif not self._off_s:
            self.still_s += passed_s
        if self.still_s >= self.stuck_s:
            problem = f"the throttle has been on for {self.still_s:.1f} s, and the picture does not move"
            raise DriveFault(problem, remedy="is the car stuck? (drive.stuck_s in params.yml)")


def cells_of(image: np.ndarray) -> np.ndarray:
    """Return a picture's grey cells twice, (2, 20, 20) float32: by its even and by its odd columns of blocks.

    Their mean is 100, so that dimmer light is no motion. image: (h, w, 3) uint8 BGR.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    blocks = cv2.resize(grey, BLOCKS, interpolation=cv2.INTER_AREA)
    rows = BLOCKS[1] // DOWN
    columns = BLOCKS[0] // (2 * ACROSS)
    cells = blocks.reshape(rows, DOWN, columns, ACROSS, 2).mean((1, 3)).transpose(2, 0, 1)
    return cells * (100 / max(float(cells.mean()), 1.0))


def difference(now: np.ndarray, before: np.ndarray) -> float:
    """Return how far two pictures' cells differ, but for noise and for lamps that flicker.

    A camera that reads row after row shows such a lamp as bands: so each row may be brighter or darker as a whole.
    Motion is in both halves, noise in each another: it drops out of their product.
    """
    gain = (now * before).sum(2, keepdims=True) / np.maximum((now * now).sum(2, keepdims=True), 1e-3)
    first, second = gain * now - before
    return float(np.sqrt(max(np.mean(first * second), 0.0)))
