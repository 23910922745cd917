"""What goes into the episode of a drive: the policy's commands and, after a takeover, what the human does.

    recorder = TakeoverRecorder(Recorder(...), mode="static")
    hooks = Hooks(record=recorder.command)
    ...                                              # the loop raises TakenOver: it has ended, and armed nothing
    takeover = recorder.human(link, armed, rate_hz=30, stop=stop)

From the takeover on the car is the human's: here statuses of the Arduino are read and written down, until they let go,
and nothing is sent to it. Each control has a column `driver`, one of recording.DRIVERS. A human's pulses are those of
the receiver, as the Arduino measures them; where its pins do something else (a throttle that waits until it was at
rest, a signal that was lost), nobody drives.

Who drove is known to a tick: the Arduino says in its first status after the takeover whether it still took the
policy's last command, and a command that it did not take is not written.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.pwm import ARDUINO_STEP_US
from rover_lib.onboard.recorder import SILENT_S, Recorder
from rover_lib.onboard.recording import HUMAN, NOBODY, POLICY
from rover_lib.onboard.servo_link import ServoLink, State, Telemetry

LET_GO_S = 2.0  # with both sticks at rest for this time, the human has let go
MOST_S = 300.0  # a transmitter that was put down with a stick held would fill the disk
# As the firmware has them (vehicle.h): so far from rest a stick has not moved, or is the throttle at rest.
STEERING_REST_US, THROTTLE_REST_US = 48, 32
IGNORED = "i"  # the Arduino's word for a command that was not for who drives now


@dataclass(frozen=True)
class Takeover:
    """What a human did with the car. controls: how many, by who drove. ended: why. fault: whether by one."""

    seconds: float
    controls: dict[str, int]
    ended: str
    fault: bool = False

    def __str__(self) -> str:
        drove = ", ".join(f"{count} of {driver}" for driver, count in self.controls.items() if count)
        return f"the human's driving was recorded for {self.seconds:.1f} s ({drove or 'no control'}): {self.ended}"


def driver_by(telemetry: Telemetry) -> str:
    """Who drives by a status of the Arduino, one of DRIVERS: a human where its pins do what the receiver says."""
    if telemetry.state is State.AUTONOMOUS:
        return POLICY
    pins = telemetry.steering_us, telemetry.throttle_us
    receiver = telemetry.receiver_steering_us, telemetry.receiver_throttle_us
    follows = all(
        us is not None and abs(pin_us - us) <= ARDUINO_STEP_US for pin_us, us in zip(pins, receiver, strict=True)
    )
    return HUMAN if telemetry.state is State.MANUAL and follows else NOBODY


class TakeoverRecorder:
    """A recorder's controls, with who drove at each; for the loop's thread alone. mode: of the artifact that drives."""

    def __init__(self, recorder: Recorder, mode: str):
        self.recorder = recorder
        self._mode = mode
        self._waiting: tuple[tuple, dict[str, Any]] | None = None  # the newest command: was it taken?
        self._last_s = float("-inf")  # of the newest control that was handed over

    def command(self, *row: Any, **columns: Any) -> None:
        """For the loop's hooks: a command went out, as Recorder.control(). Waits for nothing, raises nothing."""
        self.flush()
        self._waiting = row, columns

    def flush(self) -> None:
        """The newest command was taken: it goes into the episode."""
        if self._waiting:
            row, columns = self._waiting
            self._waiting, self._last_s = None, row[0]
            self.recorder.control(*row, mode=self._mode, driver=POLICY, **columns)

    def human(
        self,
        link: ServoLink,
        armed: Telemetry | None,
        *,
        rate_hz: float,
        stop: threading.Event,
        over: Callable[[], str | None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> Takeover:
        """Writes the Arduino's newest status at each tick of rate_hz until the human lets go, and says how that was.

        armed: the status with which the car was armed, whose sticks were at rest; None: rest is neutral. stop: ends it.
        over: called at each tick, may give another reason to end it. clock: the link's and the recorder's.
        It ends as well after MOST_S, where the receiver has no signal or the link no status, the Arduino was reset, or
        the recorder takes no more. Sends nothing, and raises nothing of a link that fails.
        """
        start_s = heard_s = signal_s = clock()
        rest_s: float | None = None  # since when both sticks have been there
        counts, boot, tick = dict.fromkeys((HUMAN, NOBODY), 0), None, 0
        neutral = link.calibration.neutral()
        held_us = armed.receiver_steering_us if armed else None
        rest_us = neutral.steering_us if held_us is None else held_us, neutral.throttle_us
        first = link.turned
        if self._waiting and first and (first.result == IGNORED or first.host_s <= self._waiting[0][0]):
            self._waiting = None
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
                boot, heard_s = telemetry.boot, max(heard_s, telemetry.host_s)
                driver = driver_by(telemetry)
                counts[driver] += 1
                self._write(telemetry, driver)
                if None not in (telemetry.receiver_steering_us, telemetry.receiver_throttle_us):
                    signal_s = heard_s
                if not _at_rest(telemetry, rest_us):
                    rest_s = None
                elif rest_s is None:
                    rest_s = telemetry.host_s
            now_s, first = clock(), None
            if self.recorder.failure is not None:
                return ended("nothing more can be recorded")
            if stop.is_set():
                return ended("told to stop")
            if why := over():
                return ended(why)
            if newest and newest.state is State.AUTONOMOUS:
                return ended("another program has armed the car")
            if rest_s is not None and heard_s - rest_s >= LET_GO_S:
                return ended(f"the sticks have been at rest for {LET_GO_S:g} s")
            if now_s - signal_s > SILENT_S:
                return ended(f"the transmitter has had no signal for {SILENT_S:g} s")
            if now_s - start_s >= MOST_S:
                return ended(f"after {MOST_S:g} s")
            tick = max(tick + 1, int((now_s - start_s) * rate_hz))
            stop.wait(max(0.0, start_s + tick / rate_hz - clock()))

    def _write(self, telemetry: Telemetry, driver: str) -> None:
        self._last_s = telemetry.host_s
        self.recorder.control(
            telemetry.host_s,
            telemetry.uptime_ms,
            telemetry.receiver_steering_us,
            telemetry.receiver_throttle_us,
            telemetry.receiver_steering_period_us,
            telemetry.receiver_throttle_period_us,
            driver=driver,
        )


def _at_rest(telemetry: Telemetry, rest_us: tuple[int, int]) -> bool:
    sticks_us = telemetry.receiver_steering_us, telemetry.receiver_throttle_us
    bands_us = STEERING_REST_US, THROTTLE_REST_US
    return all(
        us is not None and abs(us - at_us) <= band_us
        for us, at_us, band_us in zip(sticks_us, rest_us, bands_us, strict=True)
    )
