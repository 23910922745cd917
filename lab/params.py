"""Read the laboratory's gates and limits from lab/params.yml. A user's settings are in rover_lib.onboard.params."""

from pathlib import Path
from typing import Any

from rover_lib.onboard.params import read_params


def lab_params() -> dict[str, Any]:
    """Return the content of lab/params.yml."""
    return read_params(Path(__file__).with_name("params.yml"))
