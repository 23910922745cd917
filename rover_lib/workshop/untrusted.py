"""What a file from anywhere holds, put in a sentence: short, on one line, and without a walk through all of it."""

from collections.abc import Iterable

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
