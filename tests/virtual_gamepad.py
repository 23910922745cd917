"""A gamepad made of two FIFOs that speak struct input_event, where the kernel has no uinput."""

import contextlib
import os
import threading
import time
from pathlib import Path

from lab.driving.cable import boost
from rover_lib.onboard.car.gamepad import ABS, BTN_L1, EVENT, KEY, STEERING, SYN, THROTTLE, Gamepad, Stick

FULL = 32767
EVERY_S = 0.004  # between two reports of its motion sensors
WIGGLE = (0.6, -0.6, 0.0)  # of the steering stick; then it must rest for a second


class VirtualGamepad:
    """Sends the events of its motion sensors from the start on, and the others when told; a context manager."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._pad = self._motion = -1
        self._over, self._writing = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._move, daemon=True)
        self.plug()

    def __enter__(self) -> "VirtualGamepad":
        return self

    def __exit__(self, *exc: object) -> None:
        self.unplug()

    def plug(self) -> None:
        """Plug it in anew, with what nobody has read forgotten."""
        self.unplug()
        for name in ("pad", "motion"):
            (self.folder / name).unlink(missing_ok=True)
            os.mkfifo(self.folder / name)
        # A FIFO that is open for both never blocks, and has its end when this closes it.
        self._pad, self._motion = (os.open(self.folder / name, os.O_RDWR | os.O_NONBLOCK) for name in ("pad", "motion"))
        self._over.clear()
        self._thread = threading.Thread(target=self._move, daemon=True)
        self._thread.start()

    def freeze(self) -> None:
        """Send nothing more, as when its radio is out of reach."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def unplug(self) -> None:
        """Let its readers come to an end."""
        self.freeze()
        with self._writing:
            for fd in {self._pad, self._motion} - {-1}:
                os.close(fd)
            self._pad = self._motion = -1

    def hold(self, held: bool) -> None:
        """Press the dead-man button, or let go of it."""
        self.send(KEY, BTN_L1, int(held))

    def move(self, steering: float, throttle: float) -> None:
        """Move both sticks there, each in [-1, 1], right and forward positive."""
        self.send(ABS, STEERING, round(steering * FULL))
        self.send(ABS, THROTTLE, round(-throttle * FULL))

    def wiggle(self, side_s: float = 0.15) -> None:
        """Make the gesture before arming, and wait until it counts. side_s: how long the stick stays at each side."""
        for steering in WIGGLE:
            self.move(steering, 0)
            time.sleep(side_s)
        time.sleep(1.1)

    def send(self, kind: int, code: int, value: int, age_s: float = 0.0) -> None:
        """Send an event that is that old."""
        with self._writing:
            self._write(self._pad, (kind, code, value), age_s)

    def _write(self, fd: int, event: tuple[int, int, int], age_s: float = 0.0) -> None:
        at_s = time.monotonic() - age_s
        if not self._over.is_set():
            with contextlib.suppress(BlockingIOError):  # nobody reads
                os.write(fd, EVENT.pack(int(at_s), int(at_s % 1 * 1e6), *event) + EVENT.pack(int(at_s), 0, SYN, 0, 0))

    def _move(self) -> None:
        boost(threading.get_native_id())
        value = 0
        while not self._over.wait(EVERY_S):
            value += 1
            self._write(self._motion, (ABS, 0, value))


def open_virtual(folder: Path) -> Gamepad:
    """Open it as open_gamepad() opens a real one."""
    pad, motion = (os.open(folder / name, os.O_RDONLY | os.O_NONBLOCK) for name in ("pad", "motion"))
    return Gamepad("virtual", pad, motion, {axis: Stick(-FULL, FULL) for axis in (STEERING, THROTTLE)})
