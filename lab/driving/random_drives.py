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
        drives = list(pool.map(_drive, seeds, chunksize=20))
    return {
        "drives": len(seeds),
        "driven": sum(moved for moved, _ in drives),
        "broken": [text for _, text in drives if text],
    }


def _drive(seed: int) -> tuple[bool, str]:
    """Return whether the host moved the car, and what was broken, with the story."""
    # The link would warn of what is broken here on purpose.
    logging.getLogger(servo_link.__name__).setLevel(logging.CRITICAL)
    story = random_story(seed)
    seen = drive_story(story)
    run = Run(seen)
    moved = bool((run.autonomous & (run.throttle > RESTING_US)).any())
    sentence = next(broken(seen), "")
    return moved, sentence and f"seed {seed}: {sentence}\n    {story}"
