"""The laboratory's gates and limits: params.yml beside this file. What a user sets is rover_lib.onboard.params'."""

from pathlib import Path
from typing import Any

from rover_lib.onboard.params import read_params


def lab_params() -> dict[str, Any]:
    """The content of lab/params.yml."""
    return read_params(Path(__file__).with_name("params.yml"))
