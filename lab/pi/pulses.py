"""Record what an emulated Arduino's servo pins do."""

import threading
from collections.abc import Sequence
from typing import Any

from balloon_world.simulated_arduino import PinEvent
from lab.arduino.emulator import EmulatedArduino
from lab.driving.pins import NEUTRAL_US, STEP_US, STOPPED_THROTTLE_US
from rover_lib.onboard.errors import RoverError

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
