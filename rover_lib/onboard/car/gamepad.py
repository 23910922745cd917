"""A gamepad on this machine as the human's transmitter, for an Arduino without a receiver (car.yml: `human: gamepad`).

The sticks are read by a ServoLink, which sends them to the Arduino in answer to each of its statuses; the Arduino
decides. The human counts only while L1 is held, from a press that was seen; only while the gamepad sends something all
the time, as motion sensors do (without them a still hand is as silent as an empty battery); and only once the kernel
has told where both sticks are. PyPI's evdev is compiled where it is installed, and a rover has no compiler.
"""

import contextlib
import fcntl
import logging
import math
import os
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rover_lib.onboard.errors import CarError

EVENT = struct.Struct("llHHi")  # struct input_event: seconds, microseconds, type, code, value
SYN, KEY, ABS, DROPPED, BTN_L1 = 0x00, 0x01, 0x03, 3, 0x136
AXES = STEERING, THROTTLE = 0x00, 0x04  # ABS_X, the left stick; ABS_RY, the right one
SENSORS = 1 << 6  # INPUT_PROP_ACCELEROMETER
EVIOCSCLOCKID, EVIOCGABS = 0x400445A0, 0x80184540
DEAD = 0.1  # of a stick's way, to either side of its middle
ALIVE_S = 0.1  # with nothing from the gamepad for longer, or with older events, the human has let go
OPEN_S = 1.0  # for its first events

_log = logging.getLogger(__name__)

ReadStick = Callable[[int, int], tuple[int, int, int]]  # of a file descriptor and an axis: its value, least and most


def read_stick(fd: int, axis: int) -> tuple[int, int, int]:
    """Return an axis's present value and the ends of its range, from the kernel. Raises OSError."""
    value, low, high, *_ = struct.unpack("6i", fcntl.ioctl(fd, EVIOCGABS + axis, bytes(24)))
    if low >= high:
        raise OSError(22, f"its axis {axis} goes from {low} to {high}")
    return value, low, high


def deflection(value: int, low: int, high: int) -> float:
    """Return how far a stick is from its middle, in [-1, 1]; 0 near it. low, high: the ends of its range."""
    x = max(-1.0, min(1.0, (2 * value - low - high) / (high - low)))
    if abs(x) < DEAD:
        return 0.0
    return math.copysign((abs(x) - DEAD) / (1 - DEAD), x)


class Gamepad:
    """An open gamepad. One thread at a time may read it.

    pad, motion: file descriptors of its sticks and of its motion sensors, non-blocking, with times of CLOCK_MONOTONIC.
    identity: tells it from others. read: asks the kernel for a stick of `pad`, at the opening and after lost events.
    """

    def __init__(self, name: str, pad: int, motion: int, identity: str = "", read: ReadStick = read_stick):
        self.name = name
        self.identity = identity
        self._pad = pad
        self._motion = motion
        self._read_stick = read
        self._values: dict[int, float] = {}  # of each stick that is known
        self._ranges: dict[int, tuple[int, int]] = {}
        self._held = False
        self._lost = False  # the kernel dropped events: what it sends up to the next report is a part only
        self._heard_s = float("-inf")
        self._open = {pad, motion}
        self.gone = ""  # why it can be read no more
        self._ask()

    def close(self) -> None:
        """Close both devices; again, it does nothing."""
        self.gone = self.gone or "it was closed"
        while self._open:
            with contextlib.suppress(OSError):
                os.close(self._open.pop())

    def sticks(self, now_s: float | None = None) -> tuple[float, float] | None:
        """Return (steering, throttle) as they are now, each in [-1, 1], right and forward positive.

        None while the human has let go: L1 is up, the gamepad is gone or silent, after which L1 must be pressed again,
        or it is not known where a stick is. Never waits, raises nothing.
        """
        if now_s is None:
            now_s = time.monotonic()
        if self.gone:  # others may have the numbers of its files by now
            return None
        try:
            self._take_all(self._motion, now_s)
            self._take_all(self._pad, now_s)
        except OSError as error:
            _log.warning("the gamepad %s is gone (%s): the car is nobody's", self.name, error.strerror)
            self.gone = str(error.strerror)
        if self.gone or now_s - self._heard_s > ALIVE_S:
            self._held = False
        if not self._held or len(self._values) < len(AXES):
            return None
        return self._values[STEERING], -self._values[THROTTLE]

    @property
    def silent_s(self) -> float:
        """Seconds since its newest event; infinity before the first."""
        return time.monotonic() - self._heard_s

    def _ask(self) -> None:
        for axis in AXES:
            value, low, high = self._read_stick(self._pad, axis)
            self._ranges[axis] = low, high
            self._values[axis] = deflection(value, *self._ranges[axis])

    def _take_all(self, fd: int, now_s: float) -> None:
        while True:
            try:
                data = os.read(fd, 64 * EVENT.size)
            except BlockingIOError:
                return
            if not data:
                raise OSError(19, "no such device")
            for seconds, us, kind, code, value in EVENT.iter_unpack(data):  # the kernel gives whole ones
                at_s = seconds + us / 1e6
                self._heard_s = max(self._heard_s, min(at_s, now_s))
                if fd == self._pad:
                    self._take(kind, code, value, young=now_s - at_s <= ALIVE_S)

    def _take(self, kind: int, code: int, value: int, *, young: bool) -> None:
        """Take an event of the sticks. young: it has not waited, so that a press of L1 is one of now."""
        if kind == SYN and code == DROPPED:
            self._lost = True
            self._held = False
            self._values.clear()
        elif self._lost:
            if kind == SYN:
                self._lost = False
                self._ask()
        elif kind == ABS and code in AXES:
            self._values[code] = deflection(value, *self._ranges[code])
        elif kind == KEY and code == BTN_L1 and value != 2:  # 2: the kernel repeats it
            self._held = value == 1 and young


@dataclass(frozen=True)
class GamepadDevice:
    """A gamepad that the kernel knows: the devices of its sticks and of its motion sensors, if it has any.

    identity: its own address, or where it is plugged in.
    """

    name: str
    pad: Path
    motion: Path | None
    identity: str = ""

    def __str__(self) -> str:
        return f"{self.name} ({self.pad.name}{'' if self.motion else ', without motion sensors: cannot be used'})"

    def open(self) -> Gamepad:
        """Open it. Raises CarError."""
        fds: list[int] = []
        try:
            for path in (self.pad, self.motion or self.pad):
                fds.append(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC))
                fcntl.ioctl(fds[-1], EVIOCSCLOCKID, struct.pack("i", time.CLOCK_MONOTONIC))
            return Gamepad(self.name, fds[0], fds[1], self.identity)
        except OSError as error:
            for fd in fds:
                os.close(fd)
            remedy = "is this user in group input? sudo usermod -aG input $USER, and log in again"
            raise CarError(f"the gamepad {self} cannot be read ({error.strerror})", remedy=remedy) from error


def list_gamepads(dev: Path = Path("/dev/input"), sys: Path = Path("/sys/class/input")) -> list[GamepadDevice]:
    """Return all devices that have L1 and both sticks, with the motion sensors of the same gamepad."""

    def text(node: Path, name: str) -> str:
        with contextlib.suppress(OSError):
            return (node / "device" / name).read_text().strip()
        return ""

    def bits(node: Path, name: str) -> int:
        words = reversed(text(node, name).split())
        return sum(int(word, 16) << 8 * struct.calcsize("l") * i for i, word in enumerate(words))

    nodes = sorted(sys.glob("event*"), key=lambda node: int(node.name[5:]))
    whole = {node: (node / "device" / "device").resolve() for node in nodes}
    motion = {whole[node]: dev / node.name for node in nodes if bits(node, "properties") & SENSORS}
    both_axes = 1 << STEERING | 1 << THROTTLE
    gamepads = []
    for node in nodes:
        axes = bits(node, "capabilities/abs")
        keys = bits(node, "capabilities/key")
        if axes & both_axes == both_axes and keys >> BTN_L1 & 1:
            name = ascii(text(node, "name"))[1:-1][:60]
            identity = f"{name} {text(node, 'uniq') or text(node, 'phys')}"
            gamepads.append(GamepadDevice(name, dev / node.name, motion.get(whole[node]), identity))
    return gamepads


def open_gamepad(
    list_them: Callable[[], list[GamepadDevice]] | None = None, *, again: Gamepad | None = None
) -> Gamepad:
    """Open the only gamepad that can be used, and wait up to OPEN_S for its first event.

    again: one that is gone; only the same one is opened, and nothing is waited for. Raises CarError.
    """
    gamepads = (list_them or list_gamepads)()
    usable = [pad for pad in gamepads if pad.motion and (not again or pad.identity == again.identity)]
    if len(usable) != 1:
        needed = f"{again.name} again" if again else "one DualShock 4, DualSense or Switch Pro Controller"
        listed = ", ".join(map(str, gamepads)) or "none in /dev/input"
        raise CarError("not one usable gamepad is connected", found=listed, remedy=f"connect {needed}")
    gamepad = usable[0].open()
    end_s = time.monotonic() + OPEN_S
    while not again and gamepad.silent_s > ALIVE_S:
        if time.monotonic() > end_s:
            gamepad.close()
            raise CarError(f"the gamepad {usable[0]} sends nothing", remedy="switch it on, or plug it in again")
        time.sleep(0.02)
        gamepad.sticks()
    return gamepad
