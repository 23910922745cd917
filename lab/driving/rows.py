"""The faults that docs/safety.md names: what happens to a car at speed, and what must become of it, in virtual time.

    row = run_row(all_rows()["camera frozen"])        # as in results/lab/faults.json

The rows are in stories.yml; what happens in them alone, and how they are judged, is here. Some of them, and
what only a real process can have, are on the pins of an emulated Arduino too (on_pins.py).
"""

import functools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from balloon_world.simulated_arduino import PinEvent
from lab.driving.invariants import Run, broken
from lab.driving.pins import CONTINUES, DEFAULT, HUMAN, REFUSED, STOPPED, Command, Observation, judge, row_of
from lab.driving.stories import TOLD, Happening, Stage, Story, drive_story, read_stories
from lab.driving.virtual import Killed, Seen
from lab.driving.virtual_host import scenery
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import DriveFault, RoverError

AT_MS = 3000  # of a fault, when the car has been at speed for a while
END_MS, WIGGLE_MS, AGAIN_MS, STOP_MS = 5200, 5600, 7000, 8400  # the drive's end, and then another without the fault
WATCH_MS = 1000
EXIT_CODES = {STOPPED: 3, HUMAN: 4, CONTINUES: None, REFUSED: 1}
H = Happening


@dataclass(frozen=True)
class FaultRow:
    """One fault, and what is expected of the car.

    message: a regular expression for the line that tells of the fault. exit_code: of the drive, None if it goes on;
    "usual": that of EXIT_CODES. watch_ms: for how long the car is watched. until_limit: whether a car that `continues`
    is stopped by the plan's age. wiggled: whether a human made the gesture before. late: whether the drive is started
    3.6 s later. moved_us: the human's sticks, from rest, where `human` is expected.
    """

    name: str
    kind: str
    expected: str
    message: str
    happenings: tuple[Happening, ...] = ()
    exit_code: int | str | None = "usual"
    watch_ms: int = WATCH_MS
    until_limit: bool = False
    wiggled: bool = True
    late: bool = False
    moved_us: Sequence[int] = (0, 0)

    @property
    def wanted_code(self) -> int | str | None:
        """The exit code that is expected of the drive."""
        return EXIT_CODES[self.expected] if self.exit_code == "usual" else self.exit_code

    def story(self) -> Story:
        """The fault, and after it another drive, which nothing happens to."""
        happenings = list(self.happenings)
        if self.expected != REFUSED:
            happenings.append(H(END_MS, "the operator says stop"))
        happenings += [H(WIGGLE_MS, "the human wiggles the stick"), H(AGAIN_MS, "the operator starts it")]
        return Story(tuple(happenings), self.wiggled, longer_ms=STOP_MS - 4800, late=self.late, steady=True)


@functools.cache
def all_rows(section: str = "rows") -> dict[str, FaultRow]:
    """Read the faults of stories.yml, by their names: those in virtual time, or of section "pins"."""
    return {row["name"]: FaultRow(**row) for row in read_stories(section)}


# ---- what only these rows have


def _film(stage: Stage, h: Happening) -> None:
    stage.during(h, stage.world.lens, film=FILMS[h.what]())


def _flickering() -> list[np.ndarray]:
    film = [np.full_like(scenery()[0], 128) for _ in range(40)]
    for i, picture in enumerate(film):
        picture[50, 50] = 6 * i
    return film


FILMS: dict[str, Callable[[], Sequence[np.ndarray]]] = {
    "one pixel flickers": _flickering,
    "all but a strip is frozen": lambda: [np.vstack([scenery()[0][:-4], picture[-4:]]) for picture in scenery()],
    "camera sees grey": lambda: [*np.random.default_rng(0).integers(120, 137, (40, *scenery()[0].shape), np.uint8)],
    "camera changes its picture's size": lambda: [picture[::2, ::2] for picture in scenery()],
    "camera of another shape": lambda: [np.vstack([picture, picture[:24]]) for picture in scenery()],
}
TOLD |= dict.fromkeys(FILMS, _film)


def _flip(stage: Stage, h: Happening) -> None:
    def change(line: bytes) -> bytes:
        rng = stage.world.rng
        return bytes(b ^ (1 << rng.randrange(8)) if rng.random() < 0.01 else b for b in line)

    for wire in (stage.world.down, stage.world.up):
        stage.during(h, wire, change=change)


TOLD["a bit of 1 % of the bytes"] = _flip


# ---- judging


def run_row(fault: FaultRow, car: Car = DEFAULT) -> dict[str, Any]:
    """Drive a fault's story with a car; return the row of metrics.faults."""
    seen = drive_story(fault.story(), car)
    human_us = car.numbers[2] + fault.moved_us[0], car.numbers[6] + fault.moved_us[1]
    at_ms, end_ms, over_ms = AT_MS, AT_MS + fault.watch_ms, END_MS
    if fault.expected == REFUSED:
        at_ms, end_ms, over_ms = 0, AGAIN_MS, AGAIN_MS
    watched = _observe(seen, car, at_ms, end_ms)
    figures, wrong = judge(fault.expected, watched, car, human_us=human_us, until_limit=fault.until_limit)
    code = next((_exit_code(error) for ms, error in seen.errors if ms < over_ms), None)
    texts = [text for ms, text in seen.log if ms >= at_ms] + [words for _, ms, words in seen.drives if words]
    line = next((text for text in texts if re.search(fault.message, text)), None)
    run = Run(seen)
    recovered = bool((run.autonomous & (run.throttle != car.numbers[6]))[AGAIN_MS:].any())
    if car == DEFAULT:  # the invariants' numbers are this car's
        wrong += broken(seen)
    method = ", ".join(dict.fromkeys(h.what for h in fault.happenings)) or "nothing happens"
    return row_of(fault, (figures, wrong), code, line, recovered, f"in virtual time: {method}")


def _observe(seen: Seen, car: Car, at_ms: int, end_ms: int) -> Observation:
    """Return what a pin's timer makes of the pins, as an emulated Arduino's events, from shortly before at_ms."""
    run = Run(seen)
    events = []
    for pin, period_us in (("steering", car.numbers[0]), ("throttle", car.numbers[4])):
        widths = getattr(run, pin)
        for at_us in range(max(0, at_ms - 400) * 1000, end_ms * 1000, period_us):
            if us := int(widths[at_us // 1000]):
                events.append(PinEvent(at_us / 1e6, "pulse", pin, float(us), float(period_us)))
    commands = [Command(c.at_ms / 1e3, c.steering_us, c.throttle_us) for c in seen.commands]
    return Observation(sorted(events, key=lambda e: e.end_s), commands, at_ms / 1e3, end_ms / 1e3)


def _exit_code(error: BaseException | None) -> int:
    """Return the exit code of `rover drive` for what ended it, as rover_lib/onboard/cli.py has it."""
    if error is None:
        return 0
    if isinstance(error, Killed):
        return -9
    if isinstance(error, RoverError) and not isinstance(error, DriveFault):
        return 0 if error.kind == "not armed" else 1
    return 4 if getattr(error, "kind", "") == "taken over" else 3
