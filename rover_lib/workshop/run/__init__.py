"""A run: from a checkpoint and recordings to artifacts, reports and a verdict, in one folder."""

import re
from pathlib import Path

from rover_lib.onboard.errors import RoverError


def run_folder(runs_dir: Path | str, name: str, error: type[RoverError]) -> Path:
    """The absolute path of the run of that name, which need not be there yet.

    Where that is a link, the folder that it leads to: what is made beside a run must be on the same disk.
    Raises `error` for a name that would lead elsewhere, or that a folder hidden or without a name would have, and for a
    file of that name.
    """
    if not re.fullmatch(r"\w[\w.-]*", name):
        remedy = "use letters, digits, _, - and ."
        raise error("a run's name must be a plain folder name", found=repr(name), remedy=remedy)
    folder = (Path(runs_dir) / name).resolve()
    if folder.exists() and not folder.is_dir():
        raise error(f"{folder}: is a file, and not a run's folder", remedy="give another --name")
    return folder
