"""Drive randomly in virtual time, and check each drive against the invariants: `python -m lab random OUTPUT`.

A plain generator makes a story from each seed, and the seed names it. Hypothesis was tried too, but it varies only a
few stories of its own: they visited 34 of the firmware's states in 150 drives, ours 49 in 300.
"""

import logging
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

from lab.driving.invariants import RESTING_US, Run, broken
from lab.driving.stories import Story, drive_story, random_story, shortest
from lab.driving.virtual import Event, Seen, library
from rover_lib.onboard.car import servo_link


def random_drives(seeds: Sequence[int], jobs: int = 1) -> dict[str, Any]:
    """Drive the story of each seed; return the metrics of stage `random`.

    driven: in how many drives the host moved the car. firmware_states: how many they visited, each with its reason,
    what is missing, the result of the last command and which signals are there. broken: a text for each drive that
    breaks an invariant, with its seed and a short story that breaks the same one. jobs: how many processes drive at a
    time. Raises RoverError if there is no gcc.
    """
    library()  # in this process, where its errors are seen
    parts = [seeds[job::jobs] for job in range(jobs)]
    if jobs == 1:
        done = [_drive_seeds(seeds)]
    else:
        with ProcessPoolExecutor(jobs) as pool:
            done = list(pool.map(_drive_seeds, parts))
    return {
        "drives": len(seeds),
        "driven": sum(driven for driven, _, _ in done),
        "firmware_states": len(set().union(*(states for _, states, _ in done))),
        "broken": [f"seed {seed}: {text}" for seed, text in sorted(f for _, _, broke in done for f in broke)],
    }


def _drive_seeds(seeds: Sequence[int]) -> tuple[int, set[tuple], list[tuple[int, str]]]:
    logging.getLogger(servo_link.__name__).setLevel(logging.ERROR)  # it would warn of what is broken here on purpose
    driven, states, broke = 0, set(), []
    for seed in seeds:
        story = random_story(seed)
        seen = drive_story(story)
        driven += _moved(seen)
        states |= {_firmware_state(event) for _, event in seen.pins}
        if sentence := next(broken(seen), None):
            short = shortest(story, partial(_breaks, sentence.partition(":")[0]))
            broke.append((seed, f"{sentence}\n    {short}"))
    return driven, states, broke


def _moved(seen: Seen) -> bool:
    run = Run(seen)
    return bool((run.autonomous & (run.throttle > RESTING_US)).any())


def _firmware_state(event: Event | None) -> tuple:
    if event is None:
        return ("floating",)
    return event.state, event.reason, event.missing, event.result, *event.signals


def find_broken(seeds: Sequence[int]) -> str:
    """Drive the story of each seed until one breaks an invariant, and return what it says; "" if none does."""
    logging.getLogger(servo_link.__name__).setLevel(logging.CRITICAL)
    found = ((seed, next(broken(drive_story(random_story(seed))), None)) for seed in seeds)
    return next((f"seed {seed}: {sentence}" for seed, sentence in found if sentence), "")


def _breaks(invariant: str, story: Story) -> bool:
    return any(sentence.startswith(invariant) for sentence in broken(drive_story(story)))
