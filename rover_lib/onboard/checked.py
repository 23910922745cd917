"""Whether a value from a file, a cable or a caller is a number, a whole one, and within limits: decided here."""

import math
from typing import TypeGuard


def is_number(value: object, least: float = -math.inf, most: float = math.inf) -> TypeGuard[float]:
    """Whether it is a finite int or float from `least` to `most`. A bool is none, nor is what no float can hold."""
    try:
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        return number and least <= value <= most  # type: ignore[operator]
    except OverflowError:
        return False


def is_whole(value: object, least: float = -math.inf, most: float = math.inf) -> TypeGuard[int]:
    """Whether it is an int from `least` to `most`, and no bool."""
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most
