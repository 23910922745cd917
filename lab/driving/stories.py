"""Tell stories of what may happen in a drive: any faults, at any moment and in any order, even before it and after it.

    seen = drive_story(random_story(seed=7))

To add a new kind of fault, write a function here that changes something in the world (virtual.py). From then on every
random drive may have it. stories.yml has the faults of docs/safety.md (rows.py), and what once broke an invariant.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from lab.driving.virtual import DROPPING, GONE, HELD, LIVE, LOST, PRESET, SILENT, STUCK, Killed, Seen, World
from lab.driving.virtual_host import PLAN, Process
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.protocol import frame

WIGGLE_MS, START_MS, ASK_MS, STOP_MS, END_MS = 100, 1500, 2100, 4800, 5400
GAMEPAD_MS = 2000  # how much later with a gamepad the gesture is, the request and the stop
LONGER_MS = 32_000  # of a drive that takes longer than a gesture and a request last


@dataclass(frozen=True)
class Happening:
    """One of HAPPENINGS with its time, amount and duration."""

    at_ms: int
    what: str
    amount: int = 0
    for_ms: int = 0


@dataclass(frozen=True)
class Story:
    """What happens in a drive in addition to the usual: the human's gesture, an operator's start, a stop 3.3 s later.

    wiggled: whether the gesture comes. service: whether the drive is a service, which the operator also asks to arm.
    limited, heartbeat: see Process. terminal: whether the drive waits for the gesture. longer_ms: how much later it is
    stopped, and if `late`, begun. clock_ms: the Arduino's when it is switched on. steady: whether the policy never
    brakes. gamepad: whether the human has one, which counts only while a link is open: all comes later.
    """

    happenings: tuple[Happening, ...] = ()
    wiggled: bool = True
    service: bool = False
    clock_ms: int = 0
    terminal: bool = False
    limited: bool = False
    heartbeat: bool = False
    longer_ms: int = 0
    late: bool = False
    steady: bool = False
    gamepad: bool = False


# ---- what may happen


class Stage:
    """A world, and the process that drives in it while there is one."""

    def __init__(self, clock_ms: int, car: Car | None = None):
        self.world = World(clock_ms, car)
        self.process: Process | None = None
        self.start_due = False
        self._usual: dict[tuple[object, str], Any] = {}

    def during(self, happening: Happening, thing: object, **values: Any) -> None:
        """Set attributes of a thing while the happening lasts, then set them back to their usual values."""
        for name, value in values.items():
            self._usual.setdefault((thing, name), getattr(thing, name))
            setattr(thing, name, value)
        self.world.handle()

        def back() -> None:
            for name in values:
                setattr(thing, name, self._usual[thing, name])
            self.world.handle()

        self.world.at(self.world.now_ms + happening.for_ms, back)

    def again_and_again(self, happening: Happening, every_ms: int, what: Callable[[], object]) -> None:
        for ms in range(0, happening.for_ms, every_ms):
            self.world.at(self.world.now_ms + ms, what)

    def wiggle(self) -> None:
        """Let the human move the steering stick to both sides and let go."""
        self.steer(294)
        self.world.at(self.world.now_ms + 70, lambda: self.steer(-306))
        self.world.at(self.world.now_ms + 140, lambda: self.steer(0))

    def steer(self, steering_us: int, throttle_us: int | None = None) -> None:
        """Let the human hold the steering stick so far from rest, and the throttle stick there or where it is."""
        hand = self.world.hand
        hand.sticks = [self.world.rest_us[0] + steering_us, hand.sticks[1] if throttle_us is None else throttle_us]
        self.world.handle()


Happen = Callable[[Stage, Happening], object]
HAPPENINGS: dict[str, tuple[Happen, tuple[int, int], tuple[int, int]]] = {}  # with the ranges of amount and for_ms
TOLD: dict[str, Happen] = {}  # happenings of the fixed stories alone: no random drive has them
A_WHILE, LONG, ONCE = (20, 2500), (20, 4000), (0, 0)
AMOUNT, NOW = object(), object()  # of a value: the happening's amount, and the time at which it begins (ms)


def _may(what: str, amount: tuple[int, int] = ONCE, for_ms: tuple[int, int] = ONCE) -> Callable[[Happen], Happen]:
    def add(happen: Happen) -> Happen:
        HAPPENINGS[what] = happen, amount, for_ms
        return happen

    return add


def during(thing: str, **values: Any) -> Happen:
    """Return what sets attributes of the world's `thing` while it lasts; "" is the world itself."""

    def happen(stage: Stage, h: Happening) -> None:
        meant = {AMOUNT: h.amount, NOW: stage.world.now_ms}
        now = {name: meant.get(value, value) for name, value in values.items()}
        stage.during(h, getattr(stage.world, thing) if thing else stage.world, **now)

    return happen


_may("the camera is black", for_ms=LONG)(during("lens", black=True))
_may("the camera gives no more frames", for_ms=LONG)(during("lens", silent=True))
_may("the camera freezes", for_ms=LONG)(during("lens", frozen_ms=NOW))
_may("the car stands at a wall", for_ms=LONG)(during("lens", stands_ms=NOW))
_may("the supply is low", for_ms=(500, 8000))(during("", throttled="0x50005"))
_may("frames come late", (20, 3000), A_WHILE)(during("lens", late_ms=AMOUNT))


def _to_process(do: Callable[[Process], object]) -> Happen:
    def happen(stage: Stage, h: Happening) -> None:
        if stage.process:
            do(stage.process)

    return happen


_may("the camera is unplugged")(_to_process(lambda process: process.eyes.unplug()))


for _does in ("raise", "nan", "wild"):
    _may(f"the policy's answer: {_does}", for_ms=(20, 300))(during("mind", does=_does))
_may("the policy is slow", (90, 2000), A_WHILE)(during("mind", latency_ms=AMOUNT))
_may("the policy wants full throttle", for_ms=A_WHILE)(during("mind", throttle=1.0))
_may("the host goes mad", (120, 711), A_WHILE)(during("", mad_us=AMOUNT))


def _lag(stage: Stage, h: Happening, wire: str) -> None:
    for ms in range(0, h.for_ms, 10):
        later = Happening(h.at_ms + ms, h.what, 1 + ms * h.amount // 100, h.for_ms - ms)
        stage.world.at(stage.world.now_ms + ms, partial(during(wire, latency_ms=AMOUNT), stage, later))


WIRES = {"to the Arduino": "down", "from the Arduino": "up"}
for _what, _wire in WIRES.items():
    _may(f"{_what}: further and further behind", (1, 99), (200, 4000))(partial(_lag, wire=_wire))
for _fault, _most in (("latency_ms", 2500), ("lost_pct", 100), ("garbled_pct", 100)):
    for _what, _wire in WIRES.items():
        _may(f"{_what}: {_fault}", (1, _most), A_WHILE)(during(_wire, **{_fault: AMOUNT}))


@_may("the cable is unplugged", for_ms=A_WHILE)
def _unplug(stage: Stage, h: Happening) -> None:
    stage.during(h, stage.world, unplugged=True)
    if stage.world.port:
        stage.world.port.unplug()


_may("the port is stuck", for_ms=A_WHILE)(during("", stuck=True))


@_may("old lines come again", (1, 200), (20, 1000))
def _replay(stage: Stage, h: Happening) -> None:
    old = iter(stage.world.written[-h.amount :])
    stage.again_and_again(h, 10, lambda: stage.world.down.send(next(old, b"?\n")))


@_may("another program writes to the port", (0, 5), (20, 1000))
def _intrude(stage: Stage, h: Happening) -> None:
    lines = (b"AT+GCAP\r\n", b">D 1", frame(">D 0 7 2000 700"), frame(">A 0 8 0 0 0"), frame(">N 0 9"), frame(">Q"))
    stage.again_and_again(h, 10, lambda: stage.world.down.send(lines[h.amount]))


_may("the Arduino is reset")(lambda stage, h: stage.world.reset())
_may("the Arduino's loop hangs")(lambda stage, h: stage.world.hang())
_may("the transmitter is off", for_ms=A_WHILE)(during("hand", receiver=LOST))
_may("the receiver's throttle wire is off", for_ms=A_WHILE)(during("hand", throttle_wire=False))
_may("the receiver's steering wire is off", for_ms=A_WHILE)(during("hand", steering_wire=False))


@_may("the human steers to both sides, seconds apart", (3200, 6000))
def _steer_slowly(stage: Stage, h: Happening) -> None:
    for ms, amount in ((0, -300), (h.amount, 300)):
        move = Happening(h.at_ms, h.what, amount, 120)
        stage.world.at(stage.world.now_ms + ms, partial(_steer, stage, move))


@_may("the human drives by hand", (130, 400), (1000, 12_000))
def _by_hand(stage: Stage, h: Happening) -> None:
    """Around corners, with stops of a second in between."""
    world = stage.world
    for ms in range(0, h.for_ms, 1900):
        side = 300 if ms // 1900 % 2 else -300
        world.at(world.now_ms + ms, partial(stage.steer, side, world.throttle_us(h.amount)))
        world.at(world.now_ms + ms + 800, partial(stage.steer, 0, world.rest_us[1]))


@_may("the receiver sends presets", (60, 700), A_WHILE)
def _preset(stage: Stage, h: Happening) -> None:
    world, hand = stage.world, stage.world.hand
    stage.during(Happening(h.at_ms, h.what, for_ms=h.for_ms + 200), hand, receiver=LOST)

    def make_up() -> None:
        # Only after a loss: nobody can tell presets from a human if they follow the human's own pulses at once.
        if hand.receiver == LOST:
            stage.during(h, hand, receiver=PRESET, sent=[world.rest_us[0], world.throttle_us(h.amount)])

    world.at(world.now_ms + 200, make_up)


@_may("the receiver holds its last values", for_ms=LONG)
def _hold(stage: Stage, h: Happening) -> None:
    hand = stage.world.hand
    if hand.receiver == LIVE:
        stage.during(h, hand, receiver=HELD, sent=list(hand.sticks))


_may("throttle pulses are misread", (3, 10), A_WHILE)(during("hand", misread_in=AMOUNT))
_may("few throttle pulses come", (2, 99), A_WHILE)(during("hand", one_in=AMOUNT))


@_may("the human steers", (-400, 400), A_WHILE)
def _steer(stage: Stage, h: Happening) -> None:
    hand = stage.world.hand
    stage.during(h, hand, sticks=[stage.world.rest_us[0] + h.amount, hand.sticks[1]])


@_may("the human pulls the throttle", (120, 700), A_WHILE)
def _pull(stage: Stage, h: Happening) -> None:
    hand = stage.world.hand
    stage.during(h, hand, sticks=[hand.sticks[0], stage.world.throttle_us(h.amount)])


for _fault in (GONE, SILENT, DROPPING):
    _may(f"the gamepad: {_fault}", for_ms=A_WHILE)(during("hand", pad=_fault))
TOLD[f"the gamepad: {STUCK}"] = during("hand", pad=STUCK)
_may("the human wiggles the stick")(lambda stage, h: stage.wiggle())
_may("the process is stopped", for_ms=A_WHILE)(lambda stage, h: stage.world.pause(h.for_ms))
_may("the machine is suspended", for_ms=(200, 40_000))(lambda stage, h: stage.world.suspend(h.for_ms))


@_may("the process stutters for long", (75, 98), (900, 2500))
@_may("the process stutters", (20, 140), A_WHILE)
def _stutter(stage: Stage, h: Happening) -> None:
    stage.again_and_again(h, 150, lambda: stage.world.pause(h.amount))


@_may("the process pauses twice", (48, 90))
def _pause_twice(stage: Stage, h: Happening) -> None:
    world = stage.world
    world.pause(h.amount + 58)
    world.at(world.now_ms + h.amount + 58 + 150, lambda: world.pause(h.amount))


@_may("an exception in the loop")
def _raise(stage: Stage, h: Happening) -> None:
    stage.world.failing = RuntimeError("raised in the loop") if stage.process else None


@_may("the process is killed")
def _kill(stage: Stage, h: Happening) -> None:
    if stage.process:
        stage.world.alive, stage.world.failing = False, Killed()
        stage.world.seen.kills.append(stage.world.now_ms)


_may("the operator says stop")(_to_process(lambda process: process.stop("signal")))
_may("somebody stops it from the view")(_to_process(lambda process: process.stop("view")))
_may("the operator's connection is lost")(lambda stage, h: setattr(stage.world, "operator_gone", True))


@_may("the operator starts it")
def _start(stage: Stage, h: Happening) -> None:
    if stage.process:
        stage.process.ask()
    else:
        stage.start_due = True


@_may("the operator starts it, and the machine is suspended", for_ms=(2500, 20_000))
def _start_and_suspend(stage: Stage, h: Happening) -> None:
    _start(stage, h)
    stage.world.at(stage.world.now_ms + 5, lambda: stage.world.suspend(h.for_ms))


def read_stories(section: str) -> list[dict[str, Any]]:
    """Return a section of stories.yml, "rows", "pins" or "kept", with what `happens` as happenings."""
    rows = yaml.safe_load(Path(__file__).with_suffix(".yml").read_text())[section]
    return [row | {"happenings": tuple(Happening(*each) for each in row.pop("happens", ()))} for row in rows]


# Those to be kept, and how a drive ends in them: a regular expression.
KEPT: dict[str, tuple[Story, str]] = {}
for _row in read_stories("kept"):
    _name, _end = _row.pop("name"), _row.pop("end")
    KEPT[_name] = Story(**_row), _end


def random_story(seed: int) -> Story:
    """Make a story of up to eight happenings. The same seed gives the same story, as long as HAPPENINGS is the same."""
    rng = random.Random(seed)
    happenings = []
    longer_ms = LONGER_MS if rng.random() < 0.03 else 0
    for _ in range(rng.randint(0, 8)):
        name = rng.choice(list(HAPPENINGS))
        _, amount, (shortest, longest) = HAPPENINGS[name]
        for_ms = round(shortest * (longest / shortest) ** rng.random()) if shortest else 0
        happenings.append(Happening(rng.randint(0, STOP_MS + longer_ms), name, rng.randint(*amount), for_ms))
    in_order = tuple(sorted(happenings, key=lambda h: h.at_ms))
    path = rng.choice(["service", "service", "terminal", "at once"])
    limits = rng.random() < 0.2, rng.random() < 0.2
    clock_ms = rng.choice([0, 2**32 - 2000])
    wiggled, late, gamepad = rng.random() < 0.8, bool(longer_ms) and rng.random() < 0.5, rng.random() < 0.2
    terminal = path == "terminal" or (gamepad and path == "at once")
    return Story(in_order, wiggled, path == "service", clock_ms, terminal, *limits, longer_ms, late, gamepad=gamepad)


def drive_story(story: Story, car: Car | None = None) -> Seen:
    """Drive a story, in some hundredths of a second, and return what was seen. Raises RoverError without gcc."""
    stage = Stage(story.clock_ms, Car(human="gamepad") if story.gamepad else car)
    world = stage.world
    world.mind.throttle = PLAN[1] if story.steady else None
    later_ms = story.longer_ms * story.late
    pad_ms = GAMEPAD_MS * story.gamepad
    if story.wiggled:
        world.at(WIGGLE_MS + (later_ms + pad_ms if story.gamepad else 0), stage.wiggle)
    for h in story.happenings:
        happen = TOLD[h.what] if h.what in TOLD else HAPPENINGS[h.what][0]
        world.at(h.at_ms, partial(happen, stage, h))
    stop_ms = STOP_MS + story.longer_ms + pad_ms
    usual = {START_MS + later_ms: "the operator starts it", stop_ms: "the operator says stop"}
    if story.service:
        usual[ASK_MS + later_ms + pad_ms] = "the operator starts it"
    for ms, name in usual.items():
        world.at(ms, partial(HAPPENINGS[name][0], stage, Happening(ms, name)))
    while world.now_ms < stop_ms + END_MS - STOP_MS:
        world.advance(world.now_ms + 1)
        if stage.start_due and world.now_ms < stop_ms:
            stage.start_due = False
            stage.process = Process(world, story.service, story.terminal, story.limited, story.heartbeat)
            stage.process.run()
            stage.process = None
    world.close()
    return world.seen
