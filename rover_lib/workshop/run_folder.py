"""Where a run lies: in a folder of its own, below the folder of runs."""

import re
from pathlib import Path

from rover_lib.onboard.errors import RoverError


def run_folder(runs_dir: Path | str, name: str, error: type[RoverError]) -> Path:
    """The absolute path of the run of that name, which need not be there yet.

    Raises `error` for a name that would lead elsewhere, or that a folder hidden or without a name would have.
    """
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise error("a run's name must be a plain folder name", found=repr(name), remedy="use letters, digits and _")
    return Path(runs_dir).resolve() / name
