"""A hidden folder in which one process makes what will then take its place beside it.

    with made_beside(folder, files_of_a_run) as new:
        ...                                                     # fill it

Two commands with the same --name would each remove what the other had made, and the later would win.
"""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rover_lib.onboard.errors import RoverError

ADDED = ".added"  # in the folder of what was replaced: the names that replaced nothing, a line each


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


@contextmanager
def made_beside(folder: Path, replaced: Callable[[Path], Iterable[Path]] = lambda _: ()) -> Iterator[Path]:
    """`.<name>.new` beside a folder, empty: what is in it when the block ends well takes its place there.

    All of it does, or nothing; the hidden folder goes in any case.

    replaced: what of the folder goes then, beside all that has a successor; the rest stays. Until the new is whole it
    lies in `.<name>.old`, from where the next one puts it back if this process was killed meanwhile.
    Raises RoverError while another process makes something for that folder.
    """
    old = folder.with_name(f".{folder.name}.old")
    with alone_in(folder.with_name(f".{folder.name}.new")) as new:
        if old.exists():  # the last one was killed while it took its place
            _put_back(old, folder)
        yield new
        if folder.exists():
            _take_place(new, folder, old, replaced(folder))
        else:
            new.rename(folder)


def _take_place(new: Path, folder: Path, old: Path, replaced: Iterable[Path]) -> None:
    made = {path.name for path in new.iterdir()}
    goes = {path.name for path in replaced if path.exists()} | {name for name in made if (folder / name).exists()}
    old.mkdir()
    try:
        (new / ADDED).write_text("\n".join(sorted(made - goes)))
        (new / ADDED).rename(old / ADDED)
        for name in goes:
            (folder / name).rename(old / name)
        for name in made:
            (new / name).rename(folder / name)
        old.rename(new / "replaced")  # done at once: a kill while it is removed must not leave a part to be put back
    except BaseException:
        if old.exists():
            _put_back(old, folder)
        raise


def _put_back(old: Path, folder: Path) -> None:
    """Move what was being replaced back into its folder, over what of its successor is there. May be killed, too."""
    added = old / ADDED
    if added.exists():
        for name in added.read_text().splitlines():
            _remove(folder / name)
        added.unlink()
    for path in old.iterdir():
        _remove(folder / path.name)
        path.rename(folder / path.name)
    old.rmdir()


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
