"""A hidden folder in which one process makes what will then take its place beside it.

    with alone_in(folder.with_name(f".{folder.name}.new")) as new:
        ...                                                     # fill it
        new.rename(folder)

Two commands with the same --name would each remove what the other had made, and the later would win.
"""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rover_lib.onboard.errors import RoverError


@contextmanager
def alone_in(folder: Path) -> Iterator[Path]:
    """That folder, empty, and this process's until the block ends; then it goes, with all that is left in it.

    What was left by a process that was killed goes first. Raises RoverError while another process is in it.
    """
    held = _taken(folder)
    try:
        for left in folder.iterdir():
            _remove(left)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def _taken(folder: Path) -> int:
    """The folder's descriptor, which holds its lock. Made if it is not there."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(held)
            raise RoverError(
                f"{folder}: another process is at work in it", remedy="wait for it, or give another name"
            ) from None
        except OSError:  # a network's file system that cannot lock a folder
            pass
        try:
            if folder.stat().st_ino == os.fstat(held).st_ino:
                return held
        except FileNotFoundError:
            pass
        os.close(held)  # who was in it has just ended, and has removed it


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
