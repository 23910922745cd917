"""Compare what an emulated Arduino's servo pins did with what another machine, with another clock, commanded."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from balloon_world.simulated_arduino import PinEvent
from lab.arduino.emulator import EmulatedArduino
from lab.driving.pins import NEUTRAL_US, PERIOD_US, STEP_US, STOPPED_THROTTLE_US
from rover_lib.onboard.drive.flight_log import Flight
from rover_lib.onboard.errors import RoverError

# A command holds from the next pulse that begins after it has come, which may need a second sending (loop.RESEND_S),
# until the first pulse of the next command. So a pulse belongs to one of the commands of the last 33 + 18 + 21 ms, and
# some more for the serial line.
HELD_S = 0.1
# How well one clock is known from the other over ssh: 5 ms by the digits that are read, and half of the reading's time.
ERROR_S = 0.02
READ_S = 0.2  # the time between readings of the pins


class Pins:
    """Records everything that an Arduino's pins do from now on; a context manager."""

    def __init__(self, board: EmulatedArduino):
        self._board = board
        self._events: list[PinEvent] = []
        self._done = threading.Event()
        self._failure: RoverError | None = None
        self._thread = threading.Thread(target=self._run, name="pins", daemon=True)

    def __enter__(self) -> "Pins":
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._done.set()
        self._thread.join()

    def since(self, at_s: float) -> list[PinEvent]:
        """Return what has happened since then. Raises ArduinoError if the Arduino has ended."""
        if self._failure:
            raise self._failure
        return [e for e in self._events[:] if e.monotonic_s >= at_s]

    def _run(self) -> None:
        while not self._done.wait(READ_S):
            try:
                self._events += self._board.pulses()
            except RoverError as error:
                self._failure = error
                return


def compare(
    flight: Flight, events: Sequence[PinEvent], host_s: Callable[[np.ndarray], np.ndarray], slow: float
) -> dict[str, Any]:
    """Compare each pulse of a drive with the commands that it may stem from, and each command with its pulses.

    host_s: converts the rover's monotonic seconds to the host's, which the events have. slow: how many seconds of the
    host are one of the rover's and the Arduino's.
    Returns commands, pulses, worst_us, unseen and distinct. worst_us: the largest distance of a pulse from the range of
    its commands (within it, the pulse is on the way from one to another), and of a command from the nearest of its
    pulses; None if there is nothing to compare, or if any has no counterpart. unseen: how many commands have no pulse
    in their time. distinct: how many different values were commanded, by pin: a servo that stands still proves little.
    """
    sent_s = host_s(flight.ticks["t_s"] + float(flight.header["start_monotonic_s"]))
    held_s, error_s = HELD_S * slow, ERROR_S * slow
    result: dict[str, Any] = {"commands": len(sent_s), "pulses": 0, "worst_us": None, "unseen": 0, "distinct": {}}
    worst: list[float] = []
    for pin in PERIOD_US:
        commanded = flight.ticks[f"{pin}_us"]
        pulses = [e for e in events if e.pin == pin and e.kind == "pulse"]
        rose_s, us = np.array([e.monotonic_s for e in pulses]), np.array([e.pulse_us for e in pulses])
        result["distinct"][pin] = len(np.unique(commanded))
        if not len(sent_s) or not len(pulses):
            return result
        # Only from the first command to the last: before and after, the pins are in neutral.
        driven = np.flatnonzero((rose_s > sent_s[0] + held_s) & (rose_s < sent_s[-1]))
        for i in driven:
            choice = commanded[(sent_s > rose_s[i] - held_s) & (sent_s <= rose_s[i] + error_s)]
            # The firmware limits how fast a pulse changes, so it may also lie between two commands.
            off = max(choice.min() - us[i], us[i] - choice.max(), 0.0) if len(choice) else np.inf
            worst.append(float(off))
        result["pulses"] += len(driven)
        for at_s, wanted in zip(sent_s[:-3], commanded[:-3], strict=True):
            caused = us[(rose_s > at_s - error_s) & (rose_s <= at_s + held_s)]
            result["unseen"] += not len(caused)
            worst.append(float(np.abs(caused - wanted).min()) if len(caused) else np.inf)
    result["worst_us"] = round(max(worst), 2) if worst and np.isfinite(max(worst)) else None
    return result


def moving(events: Sequence[PinEvent]) -> list[float]:
    """Return when (monotonic seconds) the pulses that move the car began."""
    return [e.monotonic_s for e in events if e.pin == "throttle" and e.pulse_us > STOPPED_THROTTLE_US]


def stopped(events: Sequence[PinEvent], at_s: float, slow: float = 1.0) -> dict[str, Any]:
    """Return how the pins went to neutral after something happened at `at_s` (host's clock), in the Arduino's ms.

    drove: whether the car was moving in the second before. after_ms: from at_s until the throttle was off.
    after_line_ms: the same from the last whole line of the rover, for which the firmware promises 150. steering_us: at
    the end. These are None if it did not happen. neutral: whether the throttle is off and the steering centred.
    """
    lines = [e.monotonic_s for e in events if e.kind == "line"]
    throttle = [e for e in events if e.pin == "throttle" and e.kind == "pulse"]
    steering = [e for e in events if e.pin == "steering" and e.kind == "pulse"]
    moving = [i for i, e in enumerate(throttle) if e.pulse_us > STOPPED_THROTTLE_US]
    before = [e for e in throttle if e.monotonic_s <= at_s]
    recent = [e for e in before if e.monotonic_s > at_s - slow] or before[-1:]  # if only changes are told
    drove = any(e.pulse_us > STOPPED_THROTTLE_US for e in recent)
    off = throttle[moving[-1] + 1].monotonic_s if moving and moving[-1] + 1 < len(throttle) else None
    last_line = max((s for s in lines if off is None or s < off), default=None)
    centred = bool(steering) and abs(steering[-1].pulse_us - NEUTRAL_US["steering"]) <= STEP_US
    return {
        "drove": drove,
        "after_ms": None if off is None else round((off - at_s) / slow * 1e3, 1),
        "after_line_ms": None if off is None or last_line is None else round((off - last_line) / slow * 1e3, 1),
        "steering_us": round(steering[-1].pulse_us, 1) if steering else None,
        "neutral": off is not None and centred,
    }
