"""Build a folder's new content in a hidden folder beside it, one process at a time, and move it in when complete.

    with build_beside(folder, files_of_a_run) as new:
        ...                                                     # fill it

Without this, two commands with the same --name would remove each other's files.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import Timeout

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import private_lock

ASKED = ".asked"  # a file in a folder that is being filled, if that can be resumed: all that decides its content
GOES = ".goes"  # a file in a complete folder: names of the old files without a successor, one per line


@contextmanager
def lock_folder(folder: Path, asked: str = "") -> Iterator[Path]:
    """An empty folder that only this process uses until the block ends; then it is removed with all its content.

    asked: all that decides what is made. If it is given, ASKED is in the folder, and while it is there the content
    stays, also after an error or a kill. What an ended process left that was asked the same is then found again, less
    its unfinished files; anything else goes first. Raises RoverError while another process uses the folder.
    """
    with _locked(folder), _filled(folder, asked):
        yield folder


@contextmanager
def build_beside(
    folder: Path, replaced: Callable[[Path], Iterable[Path]] = lambda _: (), asked: str = ""
) -> Iterator[Path]:
    """Give a folder `.<name>.new` beside `folder`; its content moves into `folder` if the block ends well.

    The hidden folder begins empty and is removed in any case, except for what `lock_folder` keeps if it is given
    `asked`. If this process is killed while the content moves, the next call for that folder moves the rest.

    replaced: returns the files of `folder` to remove then, in addition to those with a successor; all others stay.
    Raises RoverError while another process makes something for that folder.
    """
    new = folder.with_name(f".{folder.name}.new")
    with _locked(new):
        if (new / GOES).exists():
            _move_in(new, folder)
        with _filled(new, asked):
            yield new
            (new / ASKED).unlink(missing_ok=True)
            if not folder.exists():
                new.rename(folder)
                return
            goes = {path.name for path in replaced(folder)} - {path.name for path in new.iterdir()}
            (new / f"{GOES}.part").write_text("\n".join(goes))
            (new / f"{GOES}.part").rename(new / GOES)
            _move_in(new, folder)


def _move_in(new: Path, folder: Path) -> None:
    """Move complete content into its folder. Safe to begin again if it was killed halfway."""
    for name in (new / GOES).read_text().splitlines():
        _remove(folder / name)
    for path in new.iterdir():
        if path.name != GOES:
            if path.is_dir() or (folder / path.name).is_dir():
                _remove(folder / path.name)
            path.rename(folder / path.name)
    (new / GOES).unlink()


@contextmanager
def _filled(folder: Path, asked: str) -> Iterator[None]:
    note = folder / ASKED
    if not asked or _text(note) != asked:
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(exist_ok=True)
    for left in folder.iterdir():
        if left.name.startswith(".") and left != note:  # an unfinished file
            _remove(left)
    if asked:
        note.write_text(asked)
    try:
        yield
    finally:
        if (not asked or _text(note) != asked) and not (folder / GOES).exists():
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = private_lock(f"{folder}.lock")
        lock.acquire()
    except Timeout:
        remedy = "wait for it, or give another name"
        raise RoverError(f"{folder}: another process is at work in it", remedy=remedy) from None
    except OSError as error:  # of a hidden file that nobody knows: its place is what the user named
        raise OSError(error.errno, error.strerror, str(folder.parent)) from error
    try:
        yield
    finally:
        Path(lock.lock_file).unlink(missing_ok=True)  # filelock sees that a file it has locked is gone, and tries again
        lock.release()


def _text(path: Path) -> str:
    return path.read_text() if path.is_file() else ""


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
