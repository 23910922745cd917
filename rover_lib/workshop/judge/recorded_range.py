"""One unit for every error of a policy: percent of the range that an action has in the recordings.

An action that never changes in the recordings is not judged: its errors are None, and it takes no part in a choice.
"""

from collections.abc import Iterable, Mapping

import numpy as np

Range = tuple[float, float]  # (least, most) recorded value of an action
FOLLOWS = 0.1  # of how far plans lie apart: what moves a plan by less than that is hardly followed
FLOOR_PCT = 1.0  # of the recorded range: nor is what moves it by less, however little the plans lie apart
# An action that a car can be driven with though it never changes. On average it is at most 11 % of its usual size away
# from its median in nine of 32 public tubs (tapped, or one of four values), and at least 16 % in the others.
HELD = "throttle"
HARDLY = 0.13
HELD_OFF = 0.2  # a held action's plans must be nearer to what was recorded than this share of its usual size


def pct_of_range(error: float, recorded: Range) -> float | None:
    """An error, in units of the action, in percent of its recorded range; None for an action that never changes."""
    low, high = recorded
    return 100 * error / (high - low) if high > low else None


def worst(errors: Mapping[str, float | None] | Iterable[float | None]) -> float | None:
    """The largest of the errors that are judged, None if none is."""
    values = errors.values() if isinstance(errors, Mapping) else errors
    return max((e for e in values if e is not None), default=None)


def constant_actions(action_range: Mapping[str, Range]) -> list[str]:
    """Names of the actions that never change in the recordings."""
    return [name for name, (low, high) in action_range.items() if not high > low]


def not_judged(action_range: Mapping[str, Range]) -> list[str]:
    """A warning for each action that never changes in the recordings."""
    return [f"{name} never changes in these recordings: not judged" for name in constant_actions(action_range)]


def usual_size(values: np.ndarray) -> float:
    """The mean size of recorded values (n,) of an action."""
    return float(np.abs(values).mean())


def hardly_varies(action: str, values: np.ndarray) -> bool:
    """Whether an action that may be held is nearly constant in its recorded values (n,)."""
    return action == HELD and float(np.abs(values - np.median(values)).mean()) <= HARDLY * usual_size(values)


def follows(moved_pct: float, apart_pct: float) -> bool:
    """Whether a plan follows what moved it by `moved_pct`, where the plans for both lie `apart_pct`."""
    return moved_pct > max(FOLLOWS * apart_pct, FLOOR_PCT)


def format_pct(value: float | None) -> str:
    """A share of the recorded range as people read it."""
    return "not judged" if value is None else f"{value:6.2f} %"
