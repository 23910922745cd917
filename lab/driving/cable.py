"""Simulate a serial cable. This program passes on what it carries, so that it can be cut and stuck."""

import contextlib
import os
import pty
import re
import select
import termios
import threading
import time
import tty

from lab.driving.pins import Command

_DRIVE = re.compile(rb">D \d+ \d+ \d+ (\d+) (\d+)\*[0-9A-F]{8}")
PRIORITY = 3  # of real-time scheduling, above that of rover drive: hardware does not wait for this machine


def boost(thread: int) -> None:
    """Give a thread or a process, by its id, that priority, if this user may."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(PRIORITY))


class Cable:
    """The cable between a host and an Arduino. port: the host's end; opening it opens the Arduino's.

    commands: the drive commands that the host wrote.
    """

    def __init__(self, arduino_port: str):
        self._arduino_port = arduino_port
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        _set_hang_up(slave, True)  # as on a serial port
        self.port = os.ttyname(slave)
        os.close(slave)  # so that POLLHUP tells whether somebody has the port open
        os.set_blocking(self._master, False)
        self.commands: list[Command] = []
        self._pending = b""
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
                    arduino = -1
                self._closing.wait(0.005)
                continue
            if arduino < 0:
                arduino = os.open(self._arduino_port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                poller.register(arduino, select.POLLIN)
                self._pending = b""
            if data := _read(self._master):
                self._note(data)
                _write(arduino, data)
            _write(self._master, _read(arduino))
        for fd in (self._master, arduino):
            if fd >= 0:
                os.close(fd)

    def _note(self, data: bytes) -> None:
        now = time.monotonic()
        *lines, self._pending = (self._pending + data).split(b"\n")
        for line in lines:
            if drive := _DRIVE.fullmatch(line):
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
