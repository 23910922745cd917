"""What a file from anywhere holds, put in a sentence: short, on one line, and without a walk through all of it."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any, TypeVar

from rover_lib.onboard.errors import RoverError

T = TypeVar("T")

LONGEST = 60  # characters of one value
LARGEST = 10**20  # Python refuses to print an integer of thousands of digits


def quote(value: object) -> str:
    """A value for a sentence.

    Of what holds other values only the type and length: the whole could be endless, or hold itself.
    """
    if isinstance(value, bool | float | None):
        return repr(value)
    if isinstance(value, int):
        return repr(value) if abs(value) < LARGEST else f"an integer of {value.bit_length()} bits"
    if isinstance(value, str | bytes):
        text = repr(value[:LONGEST])
        return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."
    length = f" of {len(value)}" if isinstance(value, dict | list | tuple | set) else ""
    return f"a {type(value).__name__}{length}"


def quote_all(values: Iterable[object], most: int = 6) -> str:
    """The first values, separated by commas, names without quotes, and how many more there are."""
    values = list(values)
    names = [v if isinstance(v, str) and v.isprintable() and len(v) <= LONGEST else quote(v) for v in values[:most]]
    return ", ".join(names) + (f" and {len(values) - most} more" if len(values) > most else "")


def numbers(kind: type[T], values: Mapping[str, Any], where: str, error: type[RoverError]) -> T:
    """A dataclass of numbers, made of what a user has written in a file. where: that an error names.

    Raises `error` for a name that the dataclass does not have, or that is missing, and for what is no number.
    """
    wanted = {field.name: field.type for field in fields(kind)}  # type: ignore[arg-type]
    if unknown := sorted(set(values) - set(wanted)):
        raise error(f"{where}: there is no {unknown[0]!r}", remedy=f"known are {', '.join(wanted)}")
    if missing := sorted(set(wanted) - set(values)):
        raise error(f"{where}: {missing[0]} is missing")
    for name, value in values.items():
        whole = wanted[name] is int
        if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
            what, like = ("a whole number", "10") if whole else ("a number", "1.0e-3; 1e-3 is text in YAML")
            raise error(f"{where}: {name} must be {what}", found=quote(value), remedy=f"write it like {like}")
    return kind(**values)
