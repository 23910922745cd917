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


def flat_names(names: Any, depth: int = 4) -> tuple[str, ...]:
    """Return the names in a list, in lists of lists, under words, or with each one's number; () if there are none."""
    if isinstance(names, Mapping) and sorted(map(repr, names.values())) == sorted(map(repr, range(len(names)))):
        return tuple(sorted(names, key=names.__getitem__))  # {"throttle": 0, "steering": 1}
    parts = list(names.values()) if isinstance(names, Mapping) else names
    if not isinstance(parts, (list, tuple)) or not depth:
        return ()
    if all(isinstance(part, str) for part in parts):
        return () if isinstance(names, Mapping) else tuple(parts)
    flat = [flat_names(part, depth - 1) for part in parts]  # {"motors": [...]}, [["throttle", "steering"]]
    return tuple(name for part in flat for name in part) if all(flat) else ()


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
