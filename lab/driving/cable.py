"""Simulate a serial cable. This program passes on what it carries, so that it can be cut, stuck and garbled."""

import contextlib
import os
import pty
import random
import re
import select
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable

from lab.driving.pins import Command
from lab.driving.priority import boost
from rover_lib.onboard.car.servo_link import Telemetry, frame, parse

Change = Callable[[bytes], bytes]


def whole_lines(change: Change) -> Change:
    """Turn a change of whole lines into a change of a stream of bytes."""
    pending = b""

    def pass_on(data: bytes) -> bytes:
        nonlocal pending
        *lines, pending = (pending + data).split(b"\n")
        return b"".join(change(line + b"\n") for line in lines)

    return pass_on


def flipping(rng: random.Random, share: float) -> Change:
    """Return a change that flips a bit in that share of the bytes."""
    return lambda data: bytes(b ^ (1 << rng.randrange(8)) if rng.random() < share else b for b in data)


def dropping(rng: random.Random, share: float) -> Change:
    """Return a change that drops that share of the lines."""
    return whole_lines(lambda line: b"" if rng.random() < share else line)


def lagging(share: float) -> Change:
    """Return a change whose delay grows by that share of the passing time. Bytes come out only when more come in."""
    start_s, waiting = time.monotonic(), deque[tuple[float, bytes]]()

    def lag(data: bytes) -> bytes:
        now_s, ready = time.monotonic(), b""
        waiting.append((now_s, data))
        while waiting and waiting[0][0] + share * (waiting[0][0] - start_s) <= now_s:
            ready += waiting.popleft()[1]
        return ready

    return lag


_DRIVE = re.compile(rb">D \d+ \d+ \d+ (\d+) (\d+)\*[0-9A-F]{8}")


class Cable:
    """The cable between a host and an Arduino. port: the host's end; opening it opens the Arduino's.

    to_arduino, to_host: changes of what passes, which you may set. commands: the drive commands that the host wrote,
    before any change; lines: all lines that it wrote. not_ours: lines that another program writes to the port; they are
    not counted among these. status: the Arduino's newest since the host opened the port, before any change.
    """

    def __init__(self, arduino_port: str):
        self._arduino_port = arduino_port
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        _set_hang_up(slave, True)  # as on a serial port
        self.port = os.ttyname(slave)
        os.close(slave)  # so that POLLHUP tells whether somebody has the port open
        os.set_blocking(self._master, False)
        self.to_arduino: Change | None = None
        self.to_host: Change | None = None
        self.commands: list[Command] = []
        self.lines: list[bytes] = []
        self.not_ours: set[bytes] = set()
        self._injected: deque[bytes] = deque()
        self.status: Telemetry | None = None
        self._pending = self._coming = b""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cable", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Close both ends."""
        self._closing.set()
        self._thread.join()

    def stick(self) -> None:
        """Let the port take no more bytes, so that whoever writes has to wait."""
        port = os.open(self.port, os.O_RDWR | os.O_NOCTTY)
        termios.tcflow(port, termios.TCOOFF)
        os.close(port)

    def inject(self, data: bytes) -> None:
        """Send bytes to the Arduino as if they came from the host."""
        self._injected.append(data)

    def _run(self) -> None:
        boost(threading.get_native_id())
        poller, arduino = select.poll(), -1
        poller.register(self._master, select.POLLIN)
        while not self._closing.is_set():
            events = dict(poller.poll(20))
            if events.get(self._master, 0) & select.POLLHUP:  # nobody has it open
                if arduino >= 0:
                    poller.unregister(arduino)
                    # Pass on the setting that the host left. It decides whether the next opening is an edge of DTR,
                    # which resets the Arduino.
                    _set_hang_up(arduino, bool(termios.tcgetattr(self._master)[2] & termios.HUPCL))
                    os.close(arduino)
                    arduino, self.status = -1, None
                self._closing.wait(0.005)
                continue
            if arduino < 0:
                arduino = os.open(self._arduino_port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                poller.register(arduino, select.POLLIN)
                self._pending = self._coming = b""
            if data := _read(self._master):
                self._note(data)
                _write(arduino, self.to_arduino(data) if self.to_arduino else data)
            while self._injected:
                _write(arduino, self._injected.popleft())
            if data := _read(arduino):
                self._hear(data)
                _write(self._master, self.to_host(data) if self.to_host else data)
        for fd in (self._master, arduino):
            if fd >= 0:
                os.close(fd)

    def _hear(self, data: bytes) -> None:
        *lines, self._coming = (self._coming + data).split(b"\n")
        for line in lines:
            if isinstance(message := parse(line, 0.0), Telemetry):
                self.status = message

    def _note(self, data: bytes) -> None:
        now = time.monotonic()
        *lines, self._pending = (self._pending + data).split(b"\n")
        for line in lines:
            line = line[max(0, line.rfind(b">")) :]
            if line in self.not_ours:
                continue
            self.lines.append(line + b"\n")
            drive = _DRIVE.fullmatch(line)
            if drive and frame(line.split(b"*")[0].decode()) == line + b"\n":
                self.commands.append(Command(now, int(drive[1]), int(drive[2])))


def _set_hang_up(fd: int, on: bool) -> None:
    attributes = termios.tcgetattr(fd)
    attributes[2] = attributes[2] | termios.HUPCL if on else attributes[2] & ~termios.HUPCL
    termios.tcsetattr(fd, termios.TCSANOW, attributes)


def _read(fd: int) -> bytes:
    with contextlib.suppress(OSError):  # nothing there, or the other end is gone
        return os.read(fd, 4096)
    return b""


def _write(fd: int, data: bytes) -> None:
    with contextlib.suppress(OSError):  # bytes that nobody takes are lost, as on a wire
        os.write(fd, data)
