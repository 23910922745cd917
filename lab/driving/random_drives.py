"""Drive randomly in virtual time, and check each drive against the invariants: `python -m lab random OUTPUT`.

A plain generator makes a story from each seed, and the seed names it. Hypothesis was tried too, but it varies only a
few stories of its own: they visited 34 of the firmware's states in 150 drives, ours 49 in 300.
"""

import logging
import re
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from lab.driving.invariants import RESTING_US, Run, broken
from lab.driving.stories import Story, drive_story, random_story, shortest
from lab.driving.virtual import Event, Seen, library
from rover_lib.onboard.car import servo_link
from rover_lib.onboard.stage import write_stage


@dataclass
class Tally:
    """What a number of drives visited. driven: in how many of them the host moved the car.

    firmware: the firmware's states, each with its reason, what is missing, the result of the last command and which
    signals are there. loop: the phases of the loop, each with the firmware's state and its reason. ends: the sentences
    with which drives ended, without their numbers.
    """

    drives: int = 0
    driven: int = 0
    firmware: set[tuple] = field(default_factory=set)
    loop: set[tuple] = field(default_factory=set)
    ends: set[str] = field(default_factory=set)

    def add(self, seen: Seen) -> None:
        run = Run(seen)
        self.drives += 1
        self.driven += bool((run.autonomous & (run.throttle > RESTING_US)).any())
        self.ends |= {re.sub(r"[\d.]+", "N", text) for _, _, text in seen.drives if text}
        self.firmware |= {_firmware_state(event) for _, event in seen.pins}
        changes = [(ms, 0, name) for ms, name in seen.phases]
        changes += [(ms, 1, "".join(map(str, _firmware_state(event)[:2]))) for ms, event in seen.pins]
        now = ["off", ""]
        for _, which, value in sorted(changes, key=lambda change: change[:2]):
            now[which] = value
            self.loop.add(tuple(now))

    def merge(self, other: "Tally") -> None:
        self.drives += other.drives
        self.driven += other.driven
        for name in ("firmware", "loop", "ends"):
            getattr(self, name).update(getattr(other, name))

    @property
    def summary(self) -> dict[str, int]:
        """The counts for JSON: drives, driven, and different states and ends."""
        states = {"firmware_states": len(self.firmware), "loop_states": len(self.loop), "ends": len(self.ends)}
        return {"drives": self.drives, "driven": self.driven, **states}


def _firmware_state(event: Event | None) -> tuple:
    if event is None:
        return ("floating",)
    letters = (c.decode() for c in (event.state, event.reason, event.missing, event.result))
    return (*letters, *event.signals)


@dataclass(frozen=True)
class Failure:
    """A seed whose story breaks an invariant, the sentence about it, and a short story that breaks the same one."""

    seed: int
    sentence: str
    story: Story

    def __str__(self) -> str:
        return f"seed {self.seed}: {self.sentence}\n    {self.story}"


def random_drives(seeds: Sequence[int], jobs: int = 1) -> tuple[Tally, list[Failure]]:
    """Drive the story of each seed. Returns what the drives visited, and those that break an invariant.

    jobs: how many processes drive at a time. Raises RoverError if there is no gcc.
    """
    library()  # in this process, where its errors are seen
    if jobs == 1:
        return _drive_seeds(seeds)
    tally, failures = Tally(), []
    with ProcessPoolExecutor(jobs) as pool:
        for part, more in pool.map(_drive_seeds, [seeds[job::jobs] for job in range(jobs)]):
            tally.merge(part)
            failures += more
    return tally, sorted(failures, key=lambda failure: failure.seed)


def _drive_seeds(seeds: Sequence[int]) -> tuple[Tally, list[Failure]]:
    logging.getLogger(servo_link.__name__).setLevel(logging.ERROR)  # it would warn of what is broken here on purpose
    tally, failures = Tally(), []
    for seed in seeds:
        story = random_story(seed)
        seen = drive_story(story)
        tally.add(seen)
        if sentence := next(broken(seen), None):
            failures.append(Failure(seed, sentence, shortest(story, partial(_breaks, sentence.partition(":")[0]))))
    return tally, failures


def find_broken(seeds: Sequence[int]) -> str:
    """Drive the story of each seed until one breaks an invariant, and return what it says; "" if none does."""
    logging.getLogger(servo_link.__name__).setLevel(logging.CRITICAL)
    found = ((seed, next(broken(drive_story(random_story(seed))), None)) for seed in seeds)
    return next((f"seed {seed}: {sentence}" for seed, sentence in found if sentence), "")


def _breaks(invariant: str, story: Story) -> bool:
    return any(sentence.startswith(invariant) for sentence in broken(drive_story(story)))


def write_random_drives(path: Path | str, first: int, tally: Tally, failures: Sequence[Failure]) -> dict[str, Any]:
    """Write the stage `random`, and return it."""
    metrics = tally.summary | {"broken": [str(failure) for failure in failures]}
    return write_stage(path, "random", params={"first_seed": first}, metrics=metrics)
