"""A world in virtual time around the real sketch: the serial line, the human with transmitter and receiver, and time.

Time is whole milliseconds and passes in `World.advance` only. The sketch is a library of this machine (board.c). What
the host is in this world is in virtual_host.py.
"""

import ctypes
import functools
import heapq
import math
import random
from _ctypes import dlclose
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, Protocol

from lab.arduino.emulator import CC, FIRMWARE, compile_c
from rover_lib.workshop.cache import cached_folder, key_of

BOARD = Path(__file__).with_name("board.c")
LIBRARY = "board.so"
BYTES_PER_MS = 11.52
FRAME_MS = 33.3
WATCHDOG_MS = 60
BOOT_MS = 300  # of a boot loader
LATENCY_MS = 90  # of a plan
STEERING, THROTTLE = range(2)
STICKS_US = (1456, 120)  # at rest
LIVE, LOST, HELD, PRESET = "live", "lost", "held", "preset"  # what the receiver sends


class Event(ctypes.Structure):
    """As in board.c: what the pins do, and why, from a millisecond on."""

    _fields_ = (
        ("at_ms", ctypes.c_uint32),
        ("steering_us", ctypes.c_uint16),
        ("throttle_us", ctypes.c_uint16),
        *((name, ctypes.c_char) for name in ("state", "reason", "result", "missing")),
        ("signals", ctypes.c_bool * 2),
    )


@functools.cache
def library() -> Path:
    """The sketch for this machine, from the cache or compiled now. Raises ArduinoError where there is no gcc."""
    sources = [BOARD, *sorted(p for p in (FIRMWARE / "rover").iterdir() if p.is_file())]
    key = key_of({"names": [source.name for source in sources]}, *sources)
    return cached_folder("board", key, functools.partial(compile_sketch, FIRMWARE)) / LIBRARY


def compile_sketch(firmware: Path, folder: Path) -> None:
    """Makes LIBRARY in a folder. firmware: where the sketch is."""
    rover = firmware / "rover"
    sources = ("-x", "c", BOARD, rover / "protocol.c", rover / "vehicle.c")
    compile_c(*CC, "-shared", "-fPIC", "-I", rover, "-o", folder / LIBRARY, *sources)


class Board:
    """The sketch from one start to the next. Raises ArduinoError where there is no gcc."""

    def __init__(self, clock_ms: int, boot: int, cause: str):
        self._c = ctypes.CDLL(str(library()))
        self._text = ctypes.create_string_buffer(1024)
        self._events = (Event * 4096)()
        self._zero_ms = clock_ms
        self._c.board_start(ctypes.c_uint32(clock_ms), boot, ctypes.c_char(cause.encode()))

    def transmit(self, channel: int, pulse_us: int, one_in: int = 1, misread_in: int = 0) -> None:
        """The receiver's pulses from now on; 0: none. See board.c for the rest."""
        self._c.board_transmit(channel, pulse_us, one_in, misread_in)

    def give(self, data: bytes) -> None:
        self._c.board_give(data, len(data))

    def run(self, ms: int) -> tuple[int, bytes]:
        """Lets up to `ms` milliseconds pass; gives how many did, and what it said in the last of them."""
        passed = self._c.board_run(ms)
        length = self._c.board_said(self._text)
        return passed, self._text.raw[:length]

    def events(self) -> list[tuple[int, Event]]:
        """Since the last call, with the milliseconds since this start."""
        count = self._c.board_events(self._events)
        return [((e.at_ms - self._zero_ms) % 2**32, Event.from_buffer_copy(e)) for e in self._events[:count]]

    def close(self) -> None:
        dlclose(self._c._handle)


class Wire:
    """One direction of the serial line: whole lines, in order. Each of its faults may be set."""

    def __init__(self, world: "World", arrive: Callable[[bytes], None]):
        self._world, self._arrive = world, arrive
        self.latency_ms = 1
        self.lost_pct = self.garbled_pct = 0
        self._busy_ms = 0.0
        self._last_ms = 0

    def send(self, line: bytes) -> None:
        world = self._world
        self._busy_ms = max(self._busy_ms, world.now_ms) + len(line) / BYTES_PER_MS
        self._last_ms = max(self._last_ms, math.ceil(self._busy_ms) + self.latency_ms)
        if world.rng.random() * 100 < self.lost_pct:
            return
        if world.rng.random() * 100 < self.garbled_pct:
            bad = bytearray(line)
            bad[world.rng.randrange(len(bad))] ^= 1 << world.rng.randrange(8)
            line = bytes(bad)
        world.at(self._last_ms, lambda: self._arrive(line))


@dataclass(eq=False)
class Hand:
    """The human's, on the transmitter, and what the receiver makes of it."""

    sticks: list[int] = field(default_factory=lambda: list(STICKS_US))
    receiver: str = LIVE
    sent: list[int] = field(default_factory=lambda: list(STICKS_US))  # by a receiver that holds or presets
    throttle_wire: bool = True
    one_in: int = 1
    misread_in: int = 0

    def pulses(self) -> tuple[int, int]:
        """On the receiver's pins, 0 is none."""
        steering, throttle = {LIVE: self.sticks, LOST: (0, 0)}.get(self.receiver, self.sent)
        return steering, throttle if self.throttle_wire else 0


@dataclass(eq=False)
class Lens:
    """What the camera shows. frozen_ms: since when the same. late_ms: how old pictures are that come."""

    frozen_ms: int | None = None
    black: bool = False
    silent: bool = False
    late_ms: int = 0


@dataclass(eq=False)
class Mind:
    """How the policy answers. throttle: None: as usual, it goes and it brakes. does: raise, nan, wild."""

    throttle: float | None = None
    latency_ms: int = LATENCY_MS
    does: str = ""


class Killed(BaseException):
    """SIGKILL: nothing of the process runs any more."""


class Asked(NamedTuple):
    """A drive's line as the host wrote it. content_ms: when what the plan's picture shows was really to be seen.

    planned: a plan asked for it, and not a host that went mad.
    """

    at_ms: int
    throttle_us: int
    content_ms: int
    planned: bool


@dataclass
class Seen:
    """What really happened, for the invariants; times in milliseconds.

    pins: with the board's own words for it, None while they float. hands: what the human and the receiver do, from then
    on. commands: a drive's lines as the host wrote them. asked: an operator asked for the car to be armed. wiggled: a
    gesture was complete. starts: of the sketch. hung: it did nothing, from and to. phases: of what drives. drives:
    begin, end and last words, None if it was killed. paused_ms: the process that drives was stopped, in all.
    """

    pins: list[tuple[int, Event | None]] = field(default_factory=list)
    hands: list[tuple[int, Hand]] = field(default_factory=list)
    commands: list[Asked] = field(default_factory=list)
    asked: list[int] = field(default_factory=list)
    wiggled: list[int] = field(default_factory=list)
    starts: list[int] = field(default_factory=list)
    hung: list[tuple[int, int]] = field(default_factory=list)
    phases: list[tuple[int, str]] = field(default_factory=list)
    drives: list[tuple[int, int, str | None]] = field(default_factory=list)
    log: list[tuple[int, str]] = field(default_factory=list)
    paused_ms: int = 0
    end_ms: int = 0


class Port(Protocol):
    """The host's end of the serial line."""

    def hear(self, data: bytes) -> None:
        """Bytes came."""

    def unplug(self) -> None:
        """The device is gone."""


class World:
    """All of it. What may break are its methods; rng: of lines that are lost or garbled."""

    def __init__(self, clock_ms: int = 0):
        self.now_ms = 0
        self.rng = random.Random(0)
        self.seen = Seen()
        self.hand, self.lens, self.mind = Hand(), Lens(), Mind()
        self.board: Board | None = None
        self.port: Port | None = None  # while somebody has it open
        self.mad_us = 0
        self.alive = True  # the process that drives
        self.paused_until_ms = 0
        self.failing: BaseException | None = None  # raised where the host waits next
        self.unplugged = self.stuck = False
        self.content_ms = 0  # of the picture behind the newest order
        self.written: list[bytes] = []
        self._unread: list[bytes] = []
        self._boot = 0
        self._due: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0
        self._started_ms = self._hung_ms = 0
        self.down, self.up = Wire(self, self._arrive_down), Wire(self, self._arrive_up)
        self._power(clock_ms, "p")

    # ---- time

    def clock(self) -> float:
        """Seconds, as time.monotonic()."""
        return self.now_ms / 1e3

    def at(self, at_ms: int, what: Callable[[], None]) -> None:
        """To be done then; it must not let time pass."""
        self._count += 1
        heapq.heappush(self._due, (max(at_ms, self.now_ms), self._count, what))

    def advance(self, until_ms: int) -> None:
        while True:
            while self._due and self._due[0][0] <= self.now_ms:
                heapq.heappop(self._due)[2]()
            if self.now_ms >= until_ms:
                return
            ms = min(until_ms, self._due[0][0] if self._due else until_ms) - self.now_ms
            if not self.board or self._hung_ms:
                self.now_ms += ms
                continue
            ms, said = self.board.run(ms)
            self.now_ms += ms
            for line in said.splitlines(keepends=True):
                self.up.send(line)

    def sleep(self, seconds: float) -> None:
        """The host's: while its process is stopped it does not come back."""
        self.advance(self.now_ms + math.ceil(seconds * 1e3 - 1e-6))
        while self.paused_until_ms > self.now_ms:
            self.advance(self.paused_until_ms)
        if self.failing:
            error, self.failing = self.failing, None
            raise error

    def phase(self, name: str) -> None:
        """What drives is at something else from now on."""
        self.seen.phases.append((self.now_ms, name))

    def pause(self, ms: int) -> None:
        """The process that drives is stopped for a while."""
        until_ms = self.now_ms + ms
        self.seen.paused_ms += max(0, until_ms - max(self.paused_until_ms, self.now_ms))
        self.paused_until_ms = max(self.paused_until_ms, until_ms)

    # ---- the board

    def reset(self, cause: str = "e") -> None:
        """The reset button, or the watchdog: the pins float until the boot loader is over."""
        self._stop_board()
        self.seen.pins.append((self.now_ms, None))
        before = self._boot

        def start() -> None:
            if self._boot == before and not self.board:
                self._power(0, cause)

        self.at(self.now_ms + BOOT_MS, start)

    def hang(self) -> None:
        """The sketch's loop does not come back; its pins go on until the watchdog has had enough."""
        if self.board and not self._hung_ms:
            self._hung_ms = self.now_ms
            board = self.board
            self.at(self.now_ms + WATCHDOG_MS, lambda: self.reset("w") if self.board is board else None)

    def _power(self, clock_ms: int, cause: str) -> None:
        self._boot += 1
        self._started_ms, self._hung_ms = self.now_ms, 0
        self.board = Board(clock_ms, self._boot, cause)
        self.seen.starts.append(self.now_ms)
        self.handle()

    def _stop_board(self) -> None:
        if self._hung_ms:
            self.seen.hung.append((self._hung_ms, self.now_ms))
            self._hung_ms = 0
        if self.board:
            self.seen.pins += [(self._started_ms + ms, event) for ms, event in self.board.events()]
            self.board.close()
            self.board = None

    def handle(self) -> None:
        """The hand did something: the receiver's pins show it."""
        hand = replace(self.hand, sticks=list(self.hand.sticks), sent=list(self.hand.sent))
        self.seen.hands.append((self.now_ms, hand))
        if self.board:
            steering_us, throttle_us = hand.pulses()
            self.board.transmit(STEERING, steering_us)
            self.board.transmit(THROTTLE, throttle_us, hand.one_in, hand.misread_in)

    def close(self) -> None:
        """The end: all that was seen is in `seen`."""
        self.seen.end_ms = self.now_ms
        self._stop_board()

    # ---- the line

    def _arrive_down(self, line: bytes) -> None:
        if self.board and not self._hung_ms:
            self.board.give(line)

    def _arrive_up(self, line: bytes) -> None:
        if self.unplugged or not self.port:
            return
        if self.paused_until_ms > self.now_ms:
            if not self._unread:  # the thread that reads wakes up a little later than the loop
                self.at(self.paused_until_ms + 1, self._read_all)
            self._unread.append(line)
        else:
            self.port.hear(line)

    def _read_all(self) -> None:
        lines, self._unread = self._unread, []
        if self.paused_until_ms > self.now_ms:  # stopped again
            self._unread = lines
            self.at(self.paused_until_ms + 1, self._read_all)
        elif self.port:
            self.port.hear(b"".join(lines))

    def write(self, line: bytes) -> None:
        """The host's; raises what the port does."""
        if not self.alive:
            return
        if self.unplugged:
            raise OSError("unplugged")
        if self.stuck:
            raise BlockingIOError
        self.written.append(line)
        if line.startswith(b">D"):
            throttle_us = int(line.split(b"*")[0].split()[-1])
            self.seen.commands.append(Asked(self.now_ms, throttle_us, self.content_ms, not self.mad_us))
        self.down.send(line)
