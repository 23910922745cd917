"""Stand in for the rover's Arduino, in Python: offer a serial port to a ServoLink, and tell what the servo pins do."""

import contextlib
import os
import pty
import select
import struct
import termios
import threading
import time
import tty
import zlib
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from rover_lib.onboard.car.car import DEFAULT_NUMBERS, this_car
from rover_lib.onboard.car.protocol import PROTOCOL_VERSION, frame
from rover_lib.onboard.car.servo_link import FIRMWARE_VERSION

BOOT_S = 0.2  # how long the boot loader runs; a real board's takes 1 to 2 s
_NEUTRAL = this_car().pwm.neutral()
REST_US = (float(_NEUTRAL.steering_us), float(_NEUTRAL.throttle_us))  # a transmitter whose sticks nobody touches
STATUS_S = 0.02
TIMEOUT_S = 0.150


class PinEvent(NamedTuple):
    """Something that happened on the servo pins, or that explains what they do.

    kind: 'pulse'; 'cut': a reset ended a pulse; 'line': a whole line of the host has arrived; 'reset': from now on the
    pins float; 'open': somebody opened the port; 'stall': this machine had no time for the Arduino, for pulse_us;
    'lost': pulse_us events were not read in time. pin: 'steering', 'throttle' or ''. monotonic_s: time.monotonic() when
    the pin rose, or when the event happened. period_us: since the pin rose before; from a StandIn the nominal one.
    """

    monotonic_s: float
    kind: str
    pin: str
    pulse_us: float
    period_us: float

    @property
    def end_s(self) -> float:
        """When the pin fell (time.monotonic()); from then on the servo knows the pulse's length."""
        return self.monotonic_s + self.pulse_us * 1e-6 if self.pin else self.monotonic_s


class StandIn:
    """A stand-in for the Arduino, for machines without simavr. It speaks protocol 4 of firmware/README.md on a pty.

    It is not the firmware and proves nothing about it. Like the firmware, it resets when its port is opened, unless DTR
    was left up; it starts in manual, with a transmitter at rest; it drives only when armed and within the throttle's
    cap; and 150 ms after the last command it goes to neutral until it is armed again. It checks no CRC, range or age of
    a command. No human takes over, but one has always just wiggled the stick when the host wants to arm.
    """

    def __init__(self) -> None:
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        attributes = termios.tcgetattr(slave)
        attributes[2] |= termios.HUPCL  # as on a serial port
        termios.tcsetattr(slave, termios.TCSANOW, attributes)
        self.port = os.ttyname(slave)
        os.close(slave)  # so that POLLHUP tells whether somebody has the port open
        os.set_blocking(self._master, False)
        self._events: deque[PinEvent] = deque(maxlen=10_000)
        self._boot = 0
        self._reset()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stand-in Arduino", daemon=True)
        self._thread.start()

    def __enter__(self) -> "StandIn":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def pulses(self) -> list[PinEvent]:
        """Return the 10,000 newest events on the pins since the last call."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def close(self) -> None:
        """Unplug the Arduino."""
        if not self._closing.is_set():
            self._closing.set()
            self._thread.join()
            os.close(self._master)

    def _reset(self) -> None:
        self._boot += 1
        self._sequence = 0
        self._lowered_us = self._cap_us = 65535
        self._result = "-"
        self._state = "M"
        self._reason = "r"
        self._rest = b""  # of a line that has not ended
        self._started = time.monotonic()
        self._commanded = self._status_due = 0.0
        self._events.append(PinEvent(time.monotonic(), "reset", "", 0.0, 0.0))
        self._take_car(DEFAULT_NUMBERS)

    def _run(self) -> None:
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        is_open = dtr = False
        while not self._closing.is_set():
            wait_s = min(max(self._status_due - time.monotonic(), 0.0), STATUS_S)
            events = dict(poller.poll(wait_s * 1000)).get(self._master, 0)
            was_open = is_open
            is_open = not events & select.POLLHUP
            if self._state == "A" and time.monotonic() - self._commanded >= TIMEOUT_S:
                self._enter("S", "t")
            if not is_open:
                if was_open:  # tcgetattr of the master gives the settings of the other end
                    dtr = not termios.tcgetattr(self._master)[2] & termios.HUPCL
                time.sleep(0.005)
                continue
            if not was_open and not dtr:
                self._start()
            *lines, self._rest = (self._rest + self._read()).split(b"\n")
            for line in lines:
                with contextlib.suppress(ValueError):  # of a damaged line
                    self._command(line[line.rfind(b">") :].partition(b"*")[0].decode())
            if time.monotonic() >= self._status_due:
                self._status()

    def _start(self) -> None:
        """Reset, and say hello when the boot loader has ended, which swallows what comes meanwhile."""
        self._reset()
        self._closing.wait(BOOT_S)
        self._read()
        self._started = time.monotonic()
        os.write(self._master, b"\n")  # ends a line that the reset cut
        self._hello("e")

    def _read(self) -> bytes:
        try:
            return os.read(self._master, 4096)
        except OSError:  # nothing there, or just closed
            return b""

    def _say(self, *words: object) -> None:
        with contextlib.suppress(OSError):  # what nobody reads is lost, as on a wire
            os.write(self._master, frame(" ".join(map(str, words))))

    def _hello(self, reset: str = "-") -> None:
        self._say("<H", PROTOCOL_VERSION, FIRMWARE_VERSION, self._boot, self._sequence, reset, self._car_id)

    def _status(self) -> None:
        self._status_due = time.monotonic() + STATUS_S
        uptime_ms = int((time.monotonic() - self._started) * 1000)
        why = self._result, self._state, self._reason, "-"
        pulses = *self._pins, self._neutral[1] + self._cap_us
        receiver = self._neutral[0], self._periods_us[0], self._neutral[1], self._periods_us[1]
        self._say("<S", self._boot, uptime_ms, self._sequence, *why, *pulses, *receiver, 0, 0, 0, 0)

    def _command(self, body: str) -> None:
        if body == ">Q":
            return self._hello()
        kind = body[1:2]
        boot, sequence, *numbers = map(int, body[2:].split())
        if boot != self._boot or sequence <= self._sequence:
            self._result = "o"
        else:
            self._sequence = sequence
            self._result = self._obey(kind, numbers)
        self._status()

    def _obey(self, kind: str, numbers: Sequence[int]) -> str:
        armed = self._state == "A"
        if (kind in "DN" and not armed) or (kind in "CL" and armed):
            return "i"
        if kind == "C":
            self._take_car(numbers)
        elif kind == "N":
            self._enter("S", "n")
        elif kind == "L":
            self._lowered_us = self._cap_us = min(self._cap_us, abs(numbers[0] - self._neutral[1]))
        elif kind == "D":
            self._commanded = time.monotonic()
            _, steering_us, throttle_us = numbers
            low_us = self._neutral[1] - self._cap_us
            high_us = self._neutral[1] + self._cap_us
            self._set_pins(steering_us, min(max(throttle_us, low_us), high_us))
        elif not armed:  # arming again while armed does not renew the deadline
            self._commanded = time.monotonic()
            self._enter("A", "a")
        return "k"

    def _take_car(self, numbers: Sequence[int]) -> None:
        """Use that car's neutral, periods and cap from now on."""
        self._car_id = zlib.crc32(struct.pack("<9H", *numbers))
        self._periods_us = numbers[0], numbers[4]
        self._neutral = numbers[2], numbers[6]
        self._cap_us = min(numbers[8], self._lowered_us)
        self._pins: tuple[int, ...] = ()
        self._set_pins(*self._neutral)

    def _enter(self, state: str, reason: str) -> None:
        self._state = state
        self._reason = reason
        self._set_pins(*self._neutral)

    def _set_pins(self, *pulses: int) -> None:
        for i, pin in enumerate(("steering", "throttle")):
            if not self._pins or pulses[i] != self._pins[i]:
                event = PinEvent(time.monotonic(), "pulse", pin, float(pulses[i]), float(self._periods_us[i]))
                self._events.append(event)
        self._pins = pulses
