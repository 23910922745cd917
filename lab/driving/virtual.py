"""Simulate a world in virtual time around the real sketch: the serial line, the human with transmitter and receiver.

Time is in whole milliseconds and passes only in `World.advance`. The sketch is compiled as a library for this machine
(board.c). The host in this world is in virtual_host.py.
"""

import ctypes
import functools
import heapq
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lab.arduino.emulator import CC, FIRMWARE, compile_c
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.protocol import Telemetry, parse
from rover_lib.workshop.cache import cache_folder, key_of

BOARD = Path(__file__).with_name("board.c")
BYTES_PER_MS = 11.52
FRAME_MS = 33.3
WATCHDOG_MS = 60
BOOT_MS = 300  # how long the boot loader runs
LATENCY_MS = 90  # how long a plan takes
STEERING, THROTTLE = range(2)
LIVE, LOST, HELD, PRESET = "live", "lost", "held", "preset"  # what the receiver sends
GONE, SILENT, STUCK, DROPPING = "pulled out", "out of reach", "its L1 held since before", "its events dropped"


class Event(ctypes.Structure):
    """What the pins do from a millisecond on, and why. The fields are those of board.c."""

    _fields_ = (
        ("at_ms", ctypes.c_uint32),
        ("steering_us", ctypes.c_uint16),
        ("throttle_us", ctypes.c_uint16),
        *((name, ctypes.c_char) for name in ("state", "reason", "result", "missing")),
        ("signals", ctypes.c_bool * 2),
    )


@functools.cache
def library(human: str = "receiver") -> Path:
    """Get the sketch for that human as a library, from the cache or compiled now. Raises RoverError without gcc."""
    rover = FIRMWARE / "rover"
    sources = [BOARD, *sorted(p for p in rover.iterdir() if p.is_file())]
    key = key_of({"names": [source.name for source in sources], "human": human}, *sources)

    def make(folder: Path) -> None:
        gamepad = ["-DHUMAN_GAMEPAD"] * (human == "gamepad")
        compiled = ("-x", "c", BOARD, rover / "protocol.c", rover / "vehicle.c")
        compile_c(*CC, *gamepad, "-shared", "-fPIC", "-I", rover, "-o", folder / "board.so", *compiled)

    return cache_folder("board", key, make) / "board.so"


class Board:
    """The sketch from one start to the next, one at a time. numbers: of the car in its EEPROM."""

    def __init__(self, clock_ms: int, boot: int, cause: str, numbers: Sequence[int], human: str):
        self.c = ctypes.CDLL(str(library(human)))
        self._text = ctypes.create_string_buffer(1024)
        self._events = (Event * 65536)()
        self._zero_ms = clock_ms
        car = (ctypes.c_uint16 * 9)(*numbers)
        self.c.board_start(ctypes.c_uint32(clock_ms), boot, ctypes.c_char(cause.encode()), car)

    def transmit(
        self, channel: int, pulse_us: int, one_in: int = 1, misread_in: int = 0, misread_us: int = 0, period_us: int = 0
    ) -> None:
        """Set the receiver's pulses from now on, where 0 stands for none. board.c explains the other arguments."""
        self.c.board_transmit(channel, pulse_us, one_in, misread_in, misread_us, period_us)

    def run(self, ms: int) -> tuple[int, bytes]:
        """Let up to `ms` milliseconds pass. Returns how many did, and what the sketch sent in the last of them."""
        passed = self.c.board_run(ms)
        length = self.c.board_said(self._text)
        return passed, self._text.raw[:length]

    def events(self) -> list[tuple[int, Event]]:
        """Return the events since the last call, each with its time in milliseconds since this start."""
        count = self.c.board_events(self._events)
        return [((e.at_ms - self._zero_ms) % 2**32, Event.from_buffer_copy(e)) for e in self._events[:count]]


class Wire:
    """One direction of the serial line, which carries whole lines in order. You may set its latency and faults.

    change: returns what comes out for a line that goes in.
    """

    def __init__(self, world: "World", arrive: Callable[[bytes], None]):
        self._world, self._arrive = world, arrive
        self.latency_ms = 1
        self.lost_pct = self.garbled_pct = 0
        self.change: Callable[[bytes], bytes] | None = None
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
        out = self.change(line) if self.change else line
        world.at(self._last_ms, functools.partial(self._arrive, out))


@dataclass(eq=False)
class Hand:
    """The human's hand on the transmitter, and what the receiver makes of it. A gamepad's is LIVE while L1 is held."""

    sticks: list[int]  # as pulses: steering, throttle; us
    sent: list[int]  # pulses of a receiver that holds or sends presets
    receiver: str = LIVE
    pad: str = ""  # a gamepad's fault: GONE, SILENT, STUCK or DROPPING
    throttle_wire: bool = True
    steering_wire: bool = True
    one_in: int = 1
    misread_in: int = 0

    def pulses(self) -> tuple[int, int]:
        """Return the pulses on the receiver's pins (steering, throttle; us), where 0 stands for none."""
        steering, throttle = {LIVE: self.sticks, LOST: (0, 0)}.get(self.receiver, self.sent)
        return steering if self.steering_wire else 0, throttle if self.throttle_wire else 0


@dataclass(eq=False)
class Lens:
    """What the camera shows. frozen_ms: since when it shows the same. late_ms: how old the pictures are that come.

    stands_ms: since when the car stands at a wall, so that only the pictures' noise changes. film: what it shows
    instead, in turn: pictures (h, w, 3) uint8 BGR.
    """

    film: Sequence[np.ndarray] = ()
    frozen_ms: int | None = None
    stands_ms: int | None = None
    black: bool = False
    silent: bool = False
    late_ms: int = 0


@dataclass(eq=False)
class Mind:
    """How the policy answers. throttle: None: it goes and brakes in turn, as usual. does: '', raise, nan or wild."""

    throttle: float | None = None
    latency_ms: int = LATENCY_MS
    does: str = ""


class Killed(BaseException):
    """The process was killed by SIGKILL: none of its code runs any more."""


class Asked(NamedTuple):
    """A drive command as the host wrote it.

    content_ms: when the scene behind the plan was really to be seen. planned: whether a plan asked for it, and not a
    host that went mad.
    """

    at_ms: int
    throttle_us: int
    content_ms: int
    planned: bool
    sequence: int
    steering_us: int


class Planned(NamedTuple):
    """A plan as it arrived. All of its actions are the same: steering, throttle. bad: nobody may drive by it."""

    at_ms: int
    steering: float
    throttle: float
    bad: bool


@dataclass
class Seen:
    """What really happened, for the invariants. All times are in milliseconds; what lasts is noted when it begins."""

    gamepad: bool  # whether the human has one
    pins: list[tuple[int, Event | None]] = field(default_factory=list)  # with the board's reasons; None: they float
    hands: list[tuple[int, Hand]] = field(default_factory=list)  # what human and receiver do
    commands: list[Asked] = field(default_factory=list)
    asked: list[int] = field(default_factory=list)  # when an operator asked to arm the car
    starts: list[int] = field(default_factory=list)  # of the sketch
    hung: list[tuple[int, int]] = field(default_factory=list)  # from when to when the sketch's loop hung
    drives: list[tuple[int, int, str | None]] = field(default_factory=list)  # begin, end, last sentence; None: killed
    errors: list[tuple[int, BaseException | None]] = field(default_factory=list)  # that ended a process; None: as asked
    log: list[tuple[int, str]] = field(default_factory=list)  # the flight log's events
    paused_ms: int = 0  # for how long the host's process was stopped in all
    pauses: list[tuple[int, int]] = field(default_factory=list)  # from when to when
    kills: list[int] = field(default_factory=list)  # of the host's process: the firmware stops the car
    asked_most_ms: int = 2000  # how old a request may become
    plans: list[Planned] = field(default_factory=list)  # as they arrived
    frames: list[tuple[int, bool]] = field(default_factory=list)  # when each came, and whether it was black
    heard: list[tuple[int, int]] = field(default_factory=list)  # statuses as the host read them, with their command
    stops: list[tuple[int, int]] = field(default_factory=list)  # when a drive was to end; since when it drove, or 0
    sick: list[tuple[int, bool]] = field(default_factory=list)  # whether lines or orders are spoilt
    stands: list[tuple[int, bool]] = field(default_factory=list)  # whether the car stands at a wall
    low: list[tuple[int, bool]] = field(default_factory=list)  # whether the host's supply is too low
    end_ms: int = 0


class World:
    """The whole world. Its methods and attributes are what may break.

    clock_ms: the Arduino's when it is switched on. rest_us: the pulses of sticks at rest.
    """

    def __init__(self, clock_ms: int = 0, car: Car | None = None):
        self.car = car or Car()
        self.rest_us = self.car.numbers[2], self.car.numbers[6]
        self.now_ms = 0
        self.rng = random.Random(0)
        self.seen = Seen(self.car.human == "gamepad")
        self.hand = Hand(list(self.rest_us), list(self.rest_us))
        self.lens, self.mind = Lens(), Mind()
        self.board: Board | None = None
        self.port: Any = None  # the host's end of the line, while it is open: hear(data) and unplug()
        self.mad_us = 0
        self.alive = True  # whether the host's process is
        self.paused_until_ms = 0
        self.suspended_ms = 0  # for how long the host's machine has been suspended in all
        self.failing: BaseException | None = None  # to be raised when the host waits next
        self.unplugged = self.stuck = False
        self.content_ms, self.planned = 0, True  # see Asked: of the newest order, whose command may be sent again
        self.written: list[bytes] = []
        self._boot = 0
        self._due: list[tuple[int, int, Callable[[], object]]] = []
        self._count = 0
        self._started_ms = self._hung_ms = 0
        self.view_stop = self.operator_gone = False
        self.throttled: str | None = "0x0"  # what the host's firmware says of its supply and heat
        self.down, self.up = Wire(self, self._arrive_down), Wire(self, self._arrive_up)
        self._power(clock_ms, "p")

    def throttle_us(self, default_us: int) -> int:
        """Return this car's throttle pulse that is as far from rest as that one is from the default car's."""
        return self.rest_us[1] + default_us - 120

    # ---- time

    def clock(self) -> float:
        """Return the time in seconds, in place of time.monotonic(): it stands still while the host is suspended."""
        return (self.now_ms - self.suspended_ms) / 1e3

    def boottime(self) -> float:
        """Return the time in seconds, in place of host.boottime()."""
        return self.now_ms / 1e3

    def at(self, at_ms: int, what: Callable[[], object]) -> None:
        """Do something at a time; it must not let time pass itself."""
        self._count += 1
        heapq.heappush(self._due, (max(at_ms, self.now_ms), self._count, what))

    def advance(self, until_ms: int) -> None:
        while True:
            while self._due and self._due[0][0] <= self.now_ms:
                heapq.heappop(self._due)[2]()
            if self.now_ms >= until_ms:
                return
            ms, output = min(until_ms, self._due[0][0] if self._due else until_ms) - self.now_ms, b""
            if self.board and not self._hung_ms:
                ms, output = self.board.run(ms)
            self.now_ms += ms
            for line in output.splitlines(keepends=True):
                self.up.send(line)

    def sleep(self, seconds: float) -> None:
        """Let the host sleep. It does not wake up while its process is stopped."""
        self.advance(self.now_ms + math.ceil(seconds * 1e3 - 1e-6))
        while self.paused_until_ms > self.now_ms:
            self.advance(self.paused_until_ms)
        if self.failing:
            error, self.failing = self.failing, None
            raise error

    def suspend(self, ms: int) -> None:
        """Suspend the host's machine for a while."""
        self.suspended_ms += self.pause(ms)

    def pause(self, ms: int) -> int:
        """Stop the host's process for a while; return by how much longer it stands still."""
        until_ms = self.now_ms + ms
        longer_ms = max(0, until_ms - max(self.paused_until_ms, self.now_ms))
        self.seen.paused_ms += longer_ms
        self.seen.pauses.append((self.now_ms, until_ms))
        self.paused_until_ms = max(self.paused_until_ms, until_ms)
        return longer_ms

    # ---- the board

    def reset(self, cause: str = "e") -> None:
        """Reset the board, by its button or its watchdog. The pins float until the boot loader has ended."""
        self._stop_board()
        self.seen.pins.append((self.now_ms, None))
        before = self._boot

        def start() -> None:
            if self._boot == before and not self.board:
                self._power(0, cause)

        self.at(self.now_ms + BOOT_MS, start)

    def hang(self) -> None:
        """Hang the sketch's loop. Its pins go on until the watchdog resets the board."""
        if self.board and not self._hung_ms:
            self._hung_ms = self.now_ms
            board = self.board
            self.at(self.now_ms + WATCHDOG_MS, lambda: self.reset("w") if self.board is board else None)

    def _power(self, clock_ms: int, cause: str) -> None:
        self._boot += 1
        self._started_ms, self._hung_ms = self.now_ms, 0
        self.board = Board(clock_ms, self._boot, cause, self.car.numbers, self.car.human)
        self.seen.starts.append(self.now_ms)
        self.handle()

    def _stop_board(self) -> None:
        if self._hung_ms:
            self.seen.hung.append((self._hung_ms, self.now_ms))
            self._hung_ms = 0
        if self.board:
            self.seen.pins += [(self._started_ms + ms, event) for ms, event in self.board.events()]
            self.board = None

    def handle(self) -> None:
        """Pass on to the receiver's pins what the hand does now."""
        hand = replace(self.hand, sticks=list(self.hand.sticks), sent=list(self.hand.sent))
        self.seen.hands.append((self.now_ms, hand))
        wires = (self.down, self.up)
        sick = any(w.latency_ms > 1 or w.lost_pct or w.garbled_pct or w.change for w in wires)
        sick |= bool(self.lens.late_ms or self.mind.latency_ms > LATENCY_MS)  # then the throttle fades
        self.seen.sick.append((self.now_ms, bool(sick or self.stuck or self.unplugged or self.mad_us)))
        self.seen.stands.append((self.now_ms, self.lens.stands_ms is not None))
        self.seen.low.append((self.now_ms, self.throttled != "0x0"))
        if self.board:
            steering_us, throttle_us = hand.pulses()
            self.board.transmit(STEERING, steering_us)
            self.board.transmit(THROTTLE, throttle_us, hand.one_in, hand.misread_in, self.rest_us[1])

    def close(self) -> None:
        """End the world, and complete `seen`."""
        self.seen.end_ms = self.now_ms
        self._stop_board()

    # ---- the line

    def _arrive_down(self, line: bytes) -> None:
        if self.board and not self._hung_ms:
            self.board.c.board_give(line, len(line))

    def _arrive_up(self, line: bytes) -> None:
        if self.unplugged or not self.port:
            return
        if self.paused_until_ms > self.now_ms:  # the thread that reads wakes up a little later than the host's loop
            return self.at(self.paused_until_ms + 1, functools.partial(self._arrive_up, line))
        for part in line.splitlines():
            if isinstance(status := parse(part, 0.0), Telemetry):
                self.seen.heard.append((self.now_ms, status.sequence))
        self.port.hear(line)

    def write(self, line: bytes) -> None:
        """Write a line from the host. Raises what a port raises: OSError if unplugged, BlockingIOError if stuck."""
        if not self.alive:
            return
        if self.unplugged:
            raise OSError("unplugged")
        if self.stuck:
            raise BlockingIOError
        self.written.append(line)
        if line.startswith(b">D"):
            _, sequence, _, steering_us, throttle_us = map(int, line[3:].split(b"*")[0].split())
            command = Asked(self.now_ms, throttle_us, self.content_ms, self.planned, sequence, steering_us)
            self.seen.commands.append(command)
        self.down.send(line)
