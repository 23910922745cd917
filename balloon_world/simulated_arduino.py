"""Stand in for the rover's Arduino, in Python: offer a serial port to a ServoLink, and tell what the servo pins do."""

import contextlib
import os
import pty
import re
import select
import struct
import termios
import threading
import time
import tty
import zlib
from collections import deque
from typing import Any, NamedTuple

from rover_lib.onboard.car.car import DEFAULT_NUMBERS, this_car
from rover_lib.onboard.car.servo_link import FIRMWARE_VERSION, PROTOCOL_VERSION

BOOT_S = 0.2  # how long the boot loader runs; a real board's takes 1 to 2 s
_NEUTRAL = this_car().pwm.neutral()
REST_US = (float(_NEUTRAL.steering_us), float(_NEUTRAL.throttle_us))  # a transmitter whose sticks nobody touches


class PinEvent(NamedTuple):
    """Something that happened on the servo pins, or that explains what they do.

    kind: 'pulse'; 'cut': a reset ended a pulse; 'line': a whole line of the host has arrived; 'reset': from now on the
    pins float; 'open': somebody opened the port; 'stall': this machine had no time for the Arduino, for pulse_us;
    'lost': events were not read in time, and pulse_us is their number. pin: 'steering', 'throttle' or ''.
    monotonic_s: time.monotonic() when the pin rose, or when the event happened. period_us: the time since the pin rose
    before that, 0 for the first pulse after a reset; from a StandIn always the nominal period.
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


_NUMBER = r"(0|[1-9][0-9]{0,9})"
_COMMAND = re.compile(rf">([ACDLN]) {_NUMBER} {_NUMBER}((?: {_NUMBER})*)", re.ASCII)
_NUMBERS = {"A": 3, "C": 9, "D": 3, "N": 0, "L": 1}  # how many numbers follow boot and sequence
_STATUS_S = 0.02
_TIMEOUT_S = 0.150
LATE_MS = 150
CAP_US = DEFAULT_NUMBERS[6] + DEFAULT_NUMBERS[8]
_SEQUENCE_WINDOW = 65535
_LINE_MAX = 96


class StandIn:
    """A stand-in for the Arduino, for machines without simavr. It speaks protocol 4 of firmware/README.md on a pty.

    It is not the firmware and proves nothing about it. Like the firmware, it resets when its port is opened, unless DTR
    was left up; it starts in manual, with a transmitter at rest; it drives only when armed, within the ranges and the
    throttle's cap; it rejects commands that are old, late or meant for another start; and 150 ms after the last command
    it goes to neutral until it is armed again. Unlike with the firmware, no human can take over, but one has always
    just wiggled the stick when the host wants to arm; there is no watchdog and no limit to how fast a pulse may change;
    a line may take any time to arrive; and a pulse starts as soon as its command comes.
    """

    def __init__(self, boot_s: float = BOOT_S):
        self._boot_s = boot_s
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        attributes = termios.tcgetattr(slave)
        attributes[2] |= termios.HUPCL  # as on a serial port
        termios.tcsetattr(slave, termios.TCSANOW, attributes)
        self.port = os.ttyname(slave)
        os.close(slave)  # so that POLLHUP tells whether somebody has the port open
        os.set_blocking(self._master, False)
        self._events: deque[PinEvent] = deque(maxlen=10_000)
        self._pins: tuple[int, ...] = ()
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
        """Return what changed on the pins since the last call; at most 10,000 events are kept."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def close(self) -> None:
        """Unplug the Arduino."""
        if not self._closing.is_set():
            self._closing.set()
            self._thread.join()
            os.close(self._master)

    def _reset(self) -> None:
        self._boot = (self._boot + 1) % 65536
        self._sequence = 0
        self._cap_us = self._lowered_us = 65535
        self._take_car(DEFAULT_NUMBERS)
        self._result, self._state, self._reason = "-", "M", "r"
        self._bad = self._old = self._out_of_range = 0
        self._line: bytes | None = None  # what has arrived since the last '>'; None if no line has begun
        self._started = time.monotonic()
        self._commanded = self._status_due = 0.0
        self._pins = ()
        self._event("reset")
        self._set_pins(*self._neutral)

    def _run(self) -> None:
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        is_open = dtr = False
        while not self._closing.is_set():
            due = min(self._status_due, self._commanded + _TIMEOUT_S) if self._state == "A" else self._status_due
            wait_s = min(max(due - time.monotonic(), 0.0), _STATUS_S)
            events = dict(poller.poll(wait_s * 1000)).get(self._master, 0)
            was_open, is_open = is_open, not events & select.POLLHUP
            if not is_open:
                if was_open:  # tcgetattr of the master gives the settings of the other end
                    dtr = not termios.tcgetattr(self._master)[2] & termios.HUPCL
                self._check_timeout()
                time.sleep(0.005)
                continue
            if not was_open:
                self._event("open")
            if not was_open and not dtr:
                self._reset()
                self._closing.wait(self._boot_s)
                self._read()  # the boot loader swallows what came meanwhile
                self._started = time.monotonic()
                self._send("")  # ends a line that the reset cut
                self._hello("e")
            self._check_timeout()
            for byte in self._read():
                self._take(byte)
            if time.monotonic() >= self._status_due:
                self._status()

    def _read(self) -> bytes:
        try:
            return os.read(self._master, 4096)
        except OSError:  # nothing there, or just closed
            return b""

    def _send(self, body: str) -> None:
        line = f"{body}*{zlib.crc32(body.encode()):08X}\n" if body else "\n"
        with contextlib.suppress(OSError):  # what nobody reads is lost, as on a wire
            os.write(self._master, line.encode())

    def _hello(self, reset: str = "-") -> None:
        self._send(f"<H {PROTOCOL_VERSION} {FIRMWARE_VERSION} {self._boot} {self._sequence} {reset} {self._car_id}")

    @property
    def _uptime_ms(self) -> int:
        return int((time.monotonic() - self._started) * 1000) % (1 << 32)

    def _status(self) -> None:
        self._status_due = time.monotonic() + _STATUS_S
        receiver = " ".join(f"{us} {period_us}" for us, period_us in zip(self._neutral, self._periods_us, strict=True))
        self._send(
            f"<S {self._boot} {self._uptime_ms} {self._sequence} {self._result} {self._state} {self._reason} - "
            f"{self._pins[0]} {self._pins[1]} {self._neutral[1] + self._cap_us} {receiver} "
            f"{self._bad} {self._old} {self._out_of_range} 0"
        )

    def _take(self, byte: int) -> None:
        if byte == ord(">"):
            self._bad += bool(self._line)
            self._line = b">"
        elif byte == ord("\n"):
            line, self._line = self._line, None
            if line is not None:
                self._command(line)
        elif self._line is not None:
            self._line += bytes([byte])
            if len(self._line) > _LINE_MAX:
                self._bad += 1
                self._line = None

    def _command(self, line: bytes) -> None:
        body, _, crc = line.rpartition(b"*")
        command = _COMMAND.fullmatch(body.decode("ascii", "replace"))
        numbers = [int(number) for number in command[4].split()] if command else []
        whole = crc == b"%08X" % zlib.crc32(body)
        if whole and body == b">Q":
            self._hello()
            return
        if not whole or not command or len(numbers) != _NUMBERS[command[1]]:
            self._bad += 1
            return
        kind, boot, sequence = command[1], int(command[2]), int(command[3])
        if boot != self._boot or not 1 <= (sequence - self._sequence) % (1 << 32) <= _SEQUENCE_WINDOW:
            self._old += 1
            self._result = "o"
        elif kind in "AD" and (self._uptime_ms - numbers[0]) % (1 << 32) > LATE_MS:
            self._old += 1
            self._result = "l"
        else:
            self._sequence = sequence
            self._result = self._obey(kind, numbers)
        self._status()

    def _obey(self, kind: str, numbers: list[int]) -> str:
        armed = self._state == "A"
        if kind == "C":
            return "i" if armed else self._told(numbers)
        if kind == "A" and numbers[2] != self._car_id:
            return "c"
        pulses = {"D": numbers[1:], "L": [self._neutral[0], *numbers]}.get(kind, self._neutral)
        if not all(low <= us <= high for us, (low, high) in zip(pulses, self._ranges, strict=True)):
            self._out_of_range += 1
            return "r"
        if (kind in "DN" and not armed) or (kind == "L" and armed):
            return "i"
        if kind == "N":
            self._enter("S", "n")
        elif kind == "L":
            self._lowered_us = self._cap_us = min(self._cap_us, abs(numbers[0] - self._neutral[1]))
        elif kind == "D":
            self._commanded = time.monotonic()
            low, high = self._neutral[1] - self._cap_us, self._neutral[1] + self._cap_us
            self._set_pins(pulses[0], min(max(pulses[1], low), high))
        elif not armed:  # arming again while armed does not renew the deadline
            self._commanded = time.monotonic()
            self._enter("A", "a")
        return "k"

    def _told(self, numbers: list[int]) -> str:
        self._take_car(tuple(numbers))
        self._pins = ()
        self._set_pins(*self._neutral)
        return "k"

    def _take_car(self, numbers: tuple[int, ...]) -> None:
        """Use that car's neutral, ranges, periods and cap from now on.

        They are not checked here, unlike in the firmware: the host refuses a car with numbers that it does not allow.
        """
        self._car_id = zlib.crc32(struct.pack("<9H", *numbers))
        self._periods_us = numbers[0], numbers[4]
        self._neutral = numbers[2], numbers[6]
        self._ranges = [(numbers[1], numbers[3]), (numbers[5], numbers[7])]
        self._cap_us = min(numbers[8], self._lowered_us)

    def _check_timeout(self) -> None:
        if self._state == "A" and time.monotonic() - self._commanded >= _TIMEOUT_S:
            self._enter("S", "t")

    def _enter(self, state: str, reason: str) -> None:
        self._state, self._reason = state, reason
        self._set_pins(*self._neutral)

    def _set_pins(self, *pulses: int) -> None:
        for i, pin in enumerate(("steering", "throttle")):
            if not self._pins or pulses[i] != self._pins[i]:
                self._event("pulse", pin, pulses[i], self._periods_us[i])
        self._pins = pulses

    def _event(self, kind: str, pin: str = "", *measured: Any) -> None:
        pulse_us, period_us = measured or (0.0, 0.0)
        self._events.append(PinEvent(time.monotonic(), kind, pin, float(pulse_us), float(period_us)))
