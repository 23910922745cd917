"""Numbers for results/, of which there are many."""

from typing import Any


def shorten(value: Any, digits: int = 4) -> Any:
    """Round each number in it to this many digits: nobody reads more."""
    if isinstance(value, dict):
        return {key: shorten(each, digits) for key, each in value.items()}
    if isinstance(value, list):
        return [shorten(each, digits) for each in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value
