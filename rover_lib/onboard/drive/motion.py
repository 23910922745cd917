"""Notice a car that stands although its throttle is on, by pictures that stay as they were: for pilot.py."""

import cv2
import numpy as np

from rover_lib.onboard.car.camera import Frame
from rover_lib.onboard.errors import DriveFault

DRIVEN = 0.02  # throttle above which a car must move; the least of the recordings is 0.027
EVERY_S = 0.1  # between two pictures that are looked at; each takes 0.2 ms
GAP_S = 0.25  # at most this is counted for a picture: nobody knows what the car did in a longer gap
ROWS = 90  # of a picture that are looked at
CELLS = 32, 30  # across and down
# How far two pictures' cells differ (root mean square, of a mean of 100) if the car has moved between them. Those of a
# standing car differ by up to 3, of a driving one by more than this at least every 0.7 s (results/lab/stuck.json).
MOVED = 3.5


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
        self._judged_s, passed_s = frame.captured_s, min(passed_s, GAP_S)
        self._off_s = 0.0 if abs(throttle) > DRIVEN else self._off_s + passed_s
        if self._off_s > self.stuck_s:  # a car that brakes for a moment may still be stuck, one that waits is not
            self._before = None
            return
        cells = cells_of(frame.image)
        if self._before is None or np.sqrt(np.mean((cells - self._before) ** 2)) > MOVED:
            self._before, self.still_s = cells, 0.0
        elif not self._off_s:
            self.still_s += passed_s
        if self.still_s >= self.stuck_s:
            what = f"the throttle has been on for {self.still_s:.1f} s, and the picture does not move"
            raise DriveFault(what, remedy="is the car stuck? (drive.stuck_s in params.yml)")


def cells_of(image: np.ndarray) -> np.ndarray:
    """Return a picture's grey cells, (30, 32) float32 with a mean of 100, so that dimmer light is no motion.

    image: (h, w, 3) uint8 BGR.
    """
    rows = np.ascontiguousarray(image[:: max(1, len(image) // ROWS)])
    cells = cv2.cvtColor(cv2.resize(rows, CELLS, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY).astype(np.float32)
    return cells * (100 / max(float(cells.mean()), 1.0))
