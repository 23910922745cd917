"""Build a folder's new content in a hidden folder beside it, one process at a time, and swap it in when complete.

    with build_beside(folder, files_of_a_run) as new:
        ...                                                     # fill it

Without this, two commands with the same --name would remove each other's files.
"""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rover_lib.onboard.errors import RoverError

ADDED = ".added"  # a file in the folder of replaced files: names of the new files that replaced nothing, one per line
ASKED = ".asked"  # a file in a folder that is being filled, if that can be gone on with: all that decides its content


@contextmanager
def lock_folder(folder: Path, asked: str = "") -> Iterator[Path]:
    """An empty folder that only this process uses until the block ends; then it is removed with all its content.

    asked: all that decides what is made. If it is given, ASKED is in the folder, and while it is there the content
    stays, also after an error or a kill. What an ended process left that was asked the same is then found again, less
    its unfinished files; anything else goes first. Raises RoverError while another process uses the folder.
    """
    held, note = _lock(folder), folder / ASKED
    try:
        same = asked and _text(note) == asked
        for left in folder.iterdir():
            if not same or (left.name.startswith(".") and left != note):
                _remove(left)
        if asked:
            note.write_text(asked)
        yield folder
    finally:
        if not asked or _text(note) != asked:
            shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


@contextmanager
def build_beside(
    folder: Path, replaced: Callable[[Path], Iterable[Path]] = lambda _: (), asked: str = ""
) -> Iterator[Path]:
    """Give a folder `.<name>.new` beside `folder`; its content moves into `folder` if the block ends well.

    Either all of it moves or nothing. The hidden folder begins empty and is removed in any case, except for what
    `lock_folder` keeps if it is given `asked`.

    replaced: returns the files of `folder` to remove then, in addition to those with a successor; all others stay.
    Until the new content is complete, the old files lie in `.<name>.old`. If this process is killed meanwhile, the next
    call puts them back. Raises RoverError while another process makes something for that folder.
    """
    old = folder.with_name(f".{folder.name}.old")
    with lock_folder(folder.with_name(f".{folder.name}.new"), asked) as new:
        if old.exists():  # the last process was killed during the swap
            _put_back(old, folder)
        yield new
        (new / ASKED).unlink(missing_ok=True)
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
        old.rename(new / "replaced")  # in one step: if we are killed while removing it, no part must be put back
    except BaseException:
        if old.exists():
            _put_back(old, folder)
        raise


def _put_back(old: Path, folder: Path) -> None:
    """Move the replaced files back into their folder, over any new ones there. Safe if it is killed halfway, too."""
    added = old / ADDED
    if added.exists():
        for name in added.read_text().splitlines():
            _remove(folder / name)
        added.unlink()
    for path in old.iterdir():
        _remove(folder / path.name)
        path.rename(folder / path.name)
    old.rmdir()


def _lock(folder: Path) -> int:
    """Lock the folder, which is made if needed; return the descriptor that holds the lock."""
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:  # of a hidden folder that nobody knows: its place is what the user named
            raise OSError(error.errno, error.strerror, str(folder.parent)) from error
        held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(held)
            raise RoverError(
                f"{folder}: another process is at work in it", remedy="wait for it, or give another name"
            ) from None
        except OSError:  # a network file system that cannot lock a folder
            pass
        try:
            if folder.stat().st_ino == os.fstat(held).st_ino:
                return held
        except FileNotFoundError:
            pass
        os.close(held)  # the process that used it has just ended and removed it


def _text(path: Path) -> str:
    return path.read_text() if path.is_file() else ""


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
