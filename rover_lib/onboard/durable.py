"""Files and folders that survive a kill and a power cut: made beside their place, synced, renamed, the rename synced.

After a rename alone, a power cut leaves a new name without its content. One process at a time works in a folder; what
a killed one left is removed by the next.
"""

import ctypes
import fcntl
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rover_lib.onboard.errors import RoverError

ASKED = ".asked"  # a file in a folder that is being filled, if that can be resumed: all that decides its content
GOES = ".goes"  # a file in a complete folder: names of the old files without a successor, one per line

_libc = ctypes.CDLL(None, use_errno=True)
_UMASK = os.umask(0o077)
os.umask(_UMASK)


def sync(path: Path) -> None:
    """Write a file's content, or a folder's list of names, to the disk. Raises OSError."""
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def sync_disk(path: Path) -> None:
    """Write all files of the file system that `path` is on to the disk: one wait, however many. Raises OSError."""
    file = os.open(path, os.O_RDONLY)
    try:
        if _libc.syncfs(file):
            error = ctypes.get_errno()
            raise OSError(error, os.strerror(error), str(path))
    finally:
        os.close(file)


def move_durably(new: Path, place: Path) -> None:
    """Rename a complete folder to its place on the same disk, content first. Raises OSError."""
    sync_disk(new)
    new.rename(place)
    sync(place.parent)


def lock_folder(folder: Path, wait: bool = False) -> int | None:
    """Lock a folder until the returned file is closed; None if it is gone, or, unless `wait`, another has the lock."""
    try:
        file = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        os.close(file)
        return None
    except OSError:
        pass  # a network's file system may have no such locks
    if _is_at(file, folder):
        return file
    os.close(file)  # it was removed or renamed meanwhile
    return None


def _is_at(file: int, folder: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), folder.lstat())
    except OSError:
        return False


@contextmanager
def build_folder(
    folder: Path, replaced: Callable[[Path], Iterable[Path]] = lambda _: (), asked: str = "", wait: bool = False
) -> Iterator[Path]:
    """Yield a hidden folder `.<name>.new` beside `folder`; its content moves into `folder` if the block ends well.

    It begins empty, nobody else can open it, and it is removed in any case. But if `asked` is given, all that decides
    the content, ASKED is in it, and while that is there the content stays, also after an error or a kill: who asks the
    same finds it again, less unfinished files. After a kill while the content moves, the next call moves the rest.

    replaced: returns the files of `folder` to remove then, in addition to those with a successor; all others stay.
    wait: while another process makes something for that folder; else RoverError is raised.
    """
    new = folder.with_name(f".{folder.name}.new")
    lock = _make_locked(new, wait)
    try:
        if (new / GOES).exists():
            _move_in(new, folder)
        _clear(new, asked)
        yield new
        (new / ASKED).unlink(missing_ok=True)
        if not folder.exists():
            new.chmod(0o777 & ~_UMASK)
            move_durably(new, folder)
            return
        goes = {path.name for path in replaced(folder)} - {path.name for path in new.iterdir()}
        part = new / f"{GOES}.part"
        part.write_text("\n".join(goes))
        sync_disk(new)
        part.rename(new / GOES)
        _move_in(new, folder)
    finally:
        if _is_at(lock, new) and not (new / ASKED).exists() and not (new / GOES).exists():
            shutil.rmtree(new, ignore_errors=True)
        os.close(lock)


def _make_locked(new: Path, wait: bool) -> int:
    try:
        new.parent.mkdir(parents=True, exist_ok=True)
        while True:
            new.mkdir(0o700, exist_ok=True)  # so that no other user can hold the lock
            if (lock := lock_folder(new, wait)) is not None:
                return lock
            if not wait and new.exists():
                raise RoverError(f"{new}: another process is at work in it", remedy="wait, or give another name")
    except OSError as error:  # of a hidden folder that nobody knows: its place is what the user named
        raise OSError(error.errno, error.strerror, str(new.parent)) from error


def _clear(new: Path, asked: str) -> None:
    """Empty a folder, except for the finished files of a process that asked the same."""
    note = new / ASKED
    same = asked != "" and note.is_file() and note.read_text() == asked
    for path in new.iterdir():
        if not same or (path.name.startswith(".") and path != note):
            _remove(path)
    if asked:
        note.write_text(asked)


def _move_in(new: Path, folder: Path) -> None:
    """Move complete content into its folder. Safe to begin again if it was cut off halfway."""
    sync(new)
    for name in (new / GOES).read_text().splitlines():
        _remove(folder / name)
    for path in new.iterdir():
        if path.name != GOES:
            if path.is_dir() or (folder / path.name).is_dir():
                _remove(folder / path.name)
            path.rename(folder / path.name)
    sync(folder)
    (new / GOES).unlink()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
