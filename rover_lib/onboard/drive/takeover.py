"""Record a drive as an episode: the policy's commands and, after a takeover, what the human does.

After the takeover the human has the car: this module only reads and records the Arduino's statuses, and sends nothing.
Each control has a column `driver`, one of recording.DRIVERS. A human's pulses are those of the receiver; if the pins
differ from it (the throttle is blocked, or the signal was lost), the driver is "nobody".
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rover_lib.onboard.car.protocol import State, Telemetry
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.recording.episode import HUMAN, NOBODY, POLICY
from rover_lib.onboard.recording.recorder import SILENT_S, Recorder

LET_GO_S = 2.0  # after both sticks have been at rest for this time, the human has let go
MOST_S = 300.0  # or a transmitter that was put down with a stick off its rest would fill the disk
# As in the firmware (vehicle.h): within these, a stick has not moved, or the throttle is at rest.
STEERING_REST_US, THROTTLE_REST_US = 48, 32
IGNORED = "i"  # the Arduino's result for a command that came while the host was not driving


@dataclass(frozen=True)
class Takeover:
    """The recording of a human. controls: how many, by who drove. ended: why. fault: whether a fault ended it."""

    seconds: float
    controls: dict[str, int]
    ended: str
    fault: bool = False

    def __str__(self) -> str:
        drove = ", ".join(f"{count} of {driver}" for driver, count in self.controls.items() if count)
        return f"the human's driving was recorded for {self.seconds:.1f} s ({drove or 'no control'}): {self.ended}"


def driver_by(telemetry: Telemetry) -> str:
    """Return who drives by a status, one of DRIVERS. A human drives if the pins' pulses are the receiver's."""
    if telemetry.state is State.AUTONOMOUS:
        return POLICY
    pins = telemetry.steering_us, telemetry.throttle_us
    follows = _sticks_near(telemetry, pins, (ARDUINO_STEP_US, ARDUINO_STEP_US))
    return HUMAN if telemetry.state is State.MANUAL and follows else NOBODY


class TakeoverRecorder:
    """Hands controls to a recorder, and says of each who drove. For the loop's thread. mode: of the artifact."""

    def __init__(self, recorder: Recorder, mode: str):
        self.recorder = recorder
        self._mode = mode
        self._waiting: tuple[tuple, dict[str, Any]] | None = None  # the newest command, perhaps not taken
        self._last_s = float("-inf")  # time of the newest control that was handed over

    def command(self, *row: Any, **columns: Any) -> None:
        """Note that a command was sent, with the arguments of Recorder.control(). Never waits, never raises."""
        self.flush()
        self._waiting = row, columns

    def flush(self) -> None:
        """Record the newest command, because the Arduino took it."""
        if self._waiting:
            row, columns = self._waiting
            self._waiting = None
            self._last_s = row[0]
            self.recorder.control(*row, mode=self._mode, driver=POLICY, **columns)

    def human(
        self,
        link: ServoLink,
        armed: Telemetry,
        *,
        rate_hz: float,
        stop: threading.Event,
        over: Callable[[], str | None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> Takeover:
        """Record the Arduino's newest status at each tick of rate_hz until the human lets go.

        armed: the status with which the car was armed, when both sticks were at rest. stop: ends the recording. over:
        called at each tick; may return another reason to end it. clock: of the link and the recorder. Sends nothing,
        and raises nothing if the link fails.
        """
        start_s = heard_s = signal_s = clock()
        rest_s: float | None = None  # since when both sticks have been at rest
        counts = dict.fromkeys((HUMAN, NOBODY), 0)
        boot = None
        tick = 0
        neutral = link.calibration.neutral()
        rest_us = armed.receiver_steering_us or neutral.steering_us, neutral.throttle_us
        first = link.turned  # the status that ended the policy's turn
        if self._waiting and first and (first.result == IGNORED or first.host_s <= self._waiting[0][0]):
            self._waiting = None  # the Arduino did not take the newest command
        self.flush()

        def ended(why: str, fault: bool = False) -> Takeover:
            return Takeover(clock() - start_s, counts, why, fault)

        while True:
            try:
                newest = link.latest()
            except RoverError as error:
                return ended(str(error), fault=True)
            for telemetry in (first, newest):
                if telemetry is None or telemetry.host_s <= self._last_s or telemetry.state is State.AUTONOMOUS:
                    continue
                if boot not in (None, telemetry.boot):
                    return ended("the Arduino was reset", fault=True)
                boot = telemetry.boot
                heard_s = max(heard_s, telemetry.host_s)
                driver = driver_by(telemetry)
                counts[driver] += 1
                self._last_s = telemetry.host_s
                self.recorder.control(telemetry.host_s, telemetry.uptime_ms, *telemetry.receiver, driver=driver)
                if None not in telemetry.receiver[:2]:
                    signal_s = heard_s
                if not _sticks_near(telemetry, rest_us, (STEERING_REST_US, THROTTLE_REST_US)):
                    rest_s = None
                elif rest_s is None:
                    rest_s = telemetry.host_s
            now_s = clock()
            first = None
            reasons = {
                "nothing more can be recorded": self.recorder.failure is not None,
                "told to stop": stop.is_set(),
                f"the sticks have been at rest for {LET_GO_S:g} s": rest_s is not None and heard_s - rest_s >= LET_GO_S,
                f"the transmitter has had no signal for {SILENT_S:g} s": now_s - signal_s > SILENT_S,
                f"after {MOST_S:g} s": now_s - start_s >= MOST_S,
            }
            if why := over() or next((why for why, holds in reasons.items() if holds), None):
                return ended(why)
            tick = max(tick + 1, int((now_s - start_s) * rate_hz))
            stop.wait(max(0.0, start_s + tick / rate_hz - clock()))


def _sticks_near(telemetry: Telemetry, at_us: tuple[int, int], bands_us: tuple[float, float]) -> bool:
    near = zip(telemetry.receiver[:2], at_us, bands_us, strict=True)
    return all(us is not None and abs(us - middle_us) <= band_us for us, middle_us, band_us in near)
