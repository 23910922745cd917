"""Numbers for results/, of which there are many."""

from typing import Any


def shorten(value: Any) -> Any:
    """The same with four digits of each number: nobody reads more."""
    if isinstance(value, dict):
        return {key: shorten(each) for key, each in value.items()}
    return float(f"{value:.4g}") if isinstance(value, float) else value
