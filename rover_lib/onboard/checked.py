"""Whether a value from a file, a cable or a caller is a number, a whole one, and within limits: decided here."""

import math
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import Any, NamedTuple, TypeGuard


def is_number(value: object, least: float = -math.inf, most: float = math.inf) -> TypeGuard[float]:
    """Whether it is a finite number, also numpy's, from `least` to `most`. Rejects bools and overflow."""
    try:
        number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
        return number and least <= value <= most  # type: ignore[operator]
    except OverflowError:
        return False


def is_whole(value: object, least: float = -math.inf, most: float = math.inf) -> TypeGuard[int]:
    """Whether it is an int from `least` to `most`, and no bool."""
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


class Rule(NamedTuple):
    """What a value must be: a test of it, and the same in words."""

    holds: Callable[[Any], bool]
    words: str


def number(least: float, most: float) -> Rule:
    """The rule of a number from `least` to `most`."""
    return Rule(lambda value: is_number(value, least, most), f"a number from {least:g} to {most:g}")


def whole(least: int, most: int, unit: str = "") -> Rule:
    """The rule of a whole number from `least` to `most`."""
    return Rule(lambda value: is_whole(value, least, most), f"a whole number from {least} to {most}{unit}")


def one_of(known: Sequence[str]) -> Rule:
    """The rule of one of these texts."""
    return Rule(lambda value: value in known, f"one of {', '.join(known)}")


def of_type(*types: type) -> Rule:
    """The rule of a value of one of these types."""
    return Rule(lambda value: isinstance(value, types), " or ".join(t.__name__ for t in types))


def broken_rule(values: Mapping[str, Any], rules: Mapping[str, Rule]) -> tuple[str, str, str] | None:
    """Return the first name whose value breaks its rule, the rule in words, and the value; None if all hold.

    A name that is not among the values breaks its rule.
    """
    for name, rule in rules.items():
        if name not in values or not rule.holds(values[name]):
            return name, rule.words, repr(values[name])[:80] if name in values else "nothing"
    return None
