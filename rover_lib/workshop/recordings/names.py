"""What the names of actions mean: the car's own names, other people's words for the same, or another robot's."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.recording.episode import CHANNELS
from rover_lib.workshop.untrusted import quote_all

OTHER_WORDS = {
    "steering": {"steering", "steer", "angle", "angular", "turn", "yaw", "rudder"},
    "throttle": {"throttle", "gas", "speed", "linear", "accelerator", "acceleration", "forward"},
}


def flat_names(names: Any) -> tuple[str, ...]:
    """Return the names in a list, in a list of a list, or in either under one word; () if there are none."""
    if isinstance(names, Mapping) and len(names) == 1:
        return flat_names(next(iter(names.values())))  # {"motors": [...]}
    if not isinstance(names, (list, tuple)) or not names:
        return ()
    if len(names) == 1 and isinstance(names[0], (list, tuple)):
        return flat_names(names[0])
    return tuple(names) if all(isinstance(name, str) for name in names) else ()


def read_as_car(names: Sequence[str]) -> tuple[str, ...] | None:
    """Return a car's names in the order of `names`, if their words mean steering and throttle, once each; else None."""
    read = []
    for name in names:
        words = set(re.findall("[a-z]+", name.lower()))
        read += [channel for channel, known in OTHER_WORDS.items() if words & known]
    return tuple(read) if sorted(read) == sorted(CHANNELS) and len(names) == len(read) else None


def settle_names(
    where: str, own: tuple[str, ...], said: tuple[str, ...], option: str, error: type[RoverError]
) -> tuple[str, ...]:
    """Return the names of some numbers, in their order: the file's `own`, or those `said` by the user's `option`.

    Raises `error` if the two deny each other, and asks by it whether other words mean steering and throttle.
    """
    meant = read_as_car(own)
    say = f"{option} {','.join(meant or own)}"
    if said and meant and meant != said:
        raise error(
            f"{where} are {quote_all(own)}, and {option} says {quote_all(said)}", remedy=f"say {say}, or nothing"
        )
    if meant and meant != own and not said:
        raise error(f"{where} are {quote_all(own)}: are they steering and throttle?", remedy=f"if they are, say {say}")
    return said or own
