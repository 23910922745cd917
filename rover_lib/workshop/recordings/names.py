"""Read what the numbers and the cameras of somebody's dataset or policy are called.

Names of actions are the car's own, other people's words for the same, or another robot's.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording.episode import CHANNELS
from rover_lib.workshop.untrusted import quote, quote_all

STATE, ACTION = "observation.state", "action"
Named = tuple[tuple[str, ...], tuple[int, ...]]  # names and their columns: a car's [steering, throttle], or as they lie
OTHER_WORDS = {  # how they begin; of a name with words for both, as angular_velocity, the first counts
    "steering": "steer|ang|turn|yaw|rudder|rot|theta|wheel|wz",
    "throttle": "throttl|gas|speed|lin|accel|forward|vel|drive|pedal|motor|vx",
}
CAMERA = "observation.images."  # what LeRobot puts before a camera's name


def flat_names(names: Any, depth: int = 4) -> tuple[str, ...]:
    """Return the names in a list, in lists of lists, under words, or with each one's number; () if there are none."""
    if isinstance(names, Mapping) and sorted(map(repr, names.values())) == sorted(map(repr, range(len(names)))):
        return tuple(sorted(names, key=names.__getitem__))  # {"throttle": 0, "steering": 1}
    if isinstance(names, Mapping) and names and all(str(key).isdecimal() for key in names):
        names = [names[key] for key in sorted(names, key=int)]  # {"0": "throttle", "1": "steering"}
    parts = list(names.values()) if isinstance(names, Mapping) else names
    if not isinstance(parts, (list, tuple)) or not depth:
        return ()
    if all(isinstance(part, str) for part in parts):
        return () if isinstance(names, Mapping) else tuple(parts)
    flat = [flat_names(part, depth - 1) for part in parts]  # {"motors": [...]}, [["throttle", "steering"]]
    return tuple(chain.from_iterable(flat)) if all(flat) else ()


def read_as_car(names: Sequence[str]) -> tuple[str, ...] | None:
    """Return a car's names in the order of `names`, if their words mean steering and throttle, once each; else None."""
    read = []
    for name in names:
        words = [word.lower() for word in re.findall("[A-Z]?[a-z]+|[A-Z]+", name)]
        read += [channel for channel in CHANNELS if any(re.match(OTHER_WORDS[channel], word) for word in words)][:1]
    return tuple(read) if sorted(read) == sorted(CHANNELS) and len(names) == len(read) else None


def name_states(root: Path, features: Mapping[str, Any], said: tuple[str, ...]) -> Named:
    """Name a dataset's states: by the user's names of the actions if they have none, or the same as the actions."""
    own = _names(features[STATE])
    size = features[STATE]["shape"][0]
    if own and own != _names(features[ACTION]):
        said = (read_as_car(own) or own) if said else own
    elif said and size != len(said):  # such numbers are not actions, and their names matter nowhere
        said = tuple(f"state_{i}" for i in range(size))
    return name_numbers(root, features, STATE, said)


def name_numbers(root: Path, features: Mapping[str, Any], key: str, said: tuple[str, ...]) -> Named:
    """Return a dataset's names of its states or actions, or those `said` by the user, as `Named` has them.

    Raises EpisodeError if the two contradict each other, and asks by it whether other words mean steering and throttle.
    """
    (size,) = features[key]["shape"]
    own = _names(features[key])
    if meant := read_as_car(own):
        place = f"{root}: the names of '{key}' are {quote_all(own)}"
        flag = f"pass --action-names {','.join(meant)}"
        if said and said not in (meant, own):
            raise EpisodeError(f"{place}, and --action-names says {quote_all(said)}", remedy=f"{flag}, or nothing")
        if meant != own and not said:
            remedy = f"if they are, {flag}, else --action-names {','.join(own)}"
            raise EpisodeError(f"{place}: are they steering and throttle?", remedy=remedy)
    names = said or own
    if not names:
        # The other numbers' order, if they have one.
        examples: list[Sequence[str]] = [_names(features.get(ACTION if key == STATE else STATE, {}))]
        if len(examples[0]) != size:
            # Of a car both orders: the user must not just copy one.
            examples = [CHANNELS, CHANNELS[::-1]] if size == 2 else [[f"joint_{i}" for i in range(1, size + 1)]]
        remedy = f"name them in the order of the numbers: --action-names {', or '.join(map(','.join, examples))}"
        actual = quote(features[key].get("names"))
        raise EpisodeError(f"{root}: '{key}' does not name its {size} numbers", found=actual, remedy=remedy)
    if len(names) != size or len(set(names)) != size:
        problem = f"{root}: '{key}' has {size} numbers in meta/info.json, their names are {quote_all(names)}"
        typed = said not in ((), own)
        remedy = "name each once: --action-names with commas between" if typed else "correct its shape and names there"
        raise EpisodeError(problem, remedy=remedy)
    if set(names) == set(CHANNELS):
        return CHANNELS, tuple(names.index(name) for name in CHANNELS)
    return names, tuple(range(size))


def _names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of a feature's numbers; () if there are none."""
    names = feature.get("names")
    names = flat_names([name.strip() for name in names.split(",")] if isinstance(names, str) else names)
    bare = tuple(name.removesuffix(".vel") for name in names)  # as our plugin's are in LeRobot 0.6
    return bare if set(bare) == set(CHANNELS) else names


def camera_names(keys: Iterable[str]) -> dict[str, str]:
    """Map a policy's name of each camera, the key without its prefix, to the key of its LeRobot feature.

    All keep their whole key if two would have the same name, as observation.image and observation.images.image.
    """
    keys = list(keys)
    # Only one prefix is removed: in a policy that we wrote, a camera may itself be called observation.image.
    names = {key.removeprefix(CAMERA if key.startswith(CAMERA) else "observation."): key for key in keys}
    return names if len(names) == len(keys) else {key: key for key in keys}
