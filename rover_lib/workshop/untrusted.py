"""What a file from anywhere holds, put in a sentence: short, on one line, and without a walk through all of it."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rover_lib.onboard.stage import read_plain

JSON_BYTES = 60_000_000  # an hour and a half of driving
MOST_VALUES = 2_000_000  # lists and objects: each takes 70 bytes and more, and in the file three
LONGEST = 60  # characters of one value
LARGEST = 10**20  # Python refuses to print an integer of thousands of digits


def read_json(path: Path, most_bytes: int = JSON_BYTES) -> Any:
    """Return what a JSON file holds. Raises OSError if it cannot be read or is larger, else as `parse_json`."""
    return parse_json(read_plain(path, most_bytes))


def parse_json(data: bytes) -> Any:
    """Return what JSON says. Raises ValueError for anything else, and for what would take many times its size."""
    if (count := data.count(b"[") + data.count(b"{")) > MOST_VALUES:
        raise ValueError(f"{count} lists and objects in it, at most {MOST_VALUES} are read")
    try:
        return json.loads(data)
    except RecursionError:  # brackets nested too deep
        raise ValueError("nested too deep") from None


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
