"""Drive randomly in virtual time, and check each drive against the invariants: `python -m lab random OUTPUT`.

A plain generator makes a story from each seed, and the seed names it.
"""

import logging
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from lab.driving.invariants import RESTING_US, Run, broken
from lab.driving.stories import drive_story, random_story
from lab.driving.virtual import library
from rover_lib.onboard.car import servo_link


def random_drives(seeds: Sequence[int], jobs: int = 1) -> dict[str, Any]:
    """Drive the story of each seed; return the metrics of stage `random`.

    driven: in how many drives the host moved the car. broken: a text for each drive that breaks an invariant, with its
    seed and story. jobs: how many processes drive at a time. Raises RoverError if there is no gcc.
    """
    library()  # in this process, where its errors are seen
    with ProcessPoolExecutor(jobs) as pool:
        done = list(pool.map(_drive_seeds, [seeds[job::jobs] for job in range(jobs)]))
    return {
        "drives": len(seeds),
        "driven": sum(driven for driven, _ in done),
        "broken": [f"seed {seed}: {text}" for seed, text in sorted(f for _, broke in done for f in broke)],
    }


def _drive_seeds(seeds: Sequence[int]) -> tuple[int, list[tuple[int, str]]]:
    # The link would warn of what is broken here on purpose.
    logging.getLogger(servo_link.__name__).setLevel(logging.CRITICAL)
    driven, broke = 0, []
    for seed in seeds:
        story = random_story(seed)
        seen = drive_story(story)
        run = Run(seen)
        driven += bool((run.autonomous & (run.throttle > RESTING_US)).any())
        broke += [(seed, f"{sentence}\n    {story}") for sentence in list(broken(seen))[:1]]
    return driven, broke
