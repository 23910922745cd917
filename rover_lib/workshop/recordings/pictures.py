"""Check the pictures that a recording lists, each once: what is whole is remembered until its file changes."""

import json
import os
import stat
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

from rover_lib.onboard.car.picture import MOST_BYTES, check_jpeg
from rover_lib.onboard.errors import CameraError, EpisodeError
from rover_lib.onboard.stage import read_plain
from rover_lib.workshop.cache import cache_root, key_of
from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.untrusted import quote, read_json

HOLE_INTERVALS = 2.5  # one dropped frame is bridged; two in a row are a hole in time
HOLE_S = 0.5  # always a hole in time, whatever the usual interval: no camera of a moving car is that slow
AT_ONCE = 64  # pictures that one thread checks before it gets the next ones
MOST_KNOWN = 30_000_000  # bytes of what is remembered of one folder, 100 for each picture
Checked = tuple[str, Sequence[int]] | Exception  # what is remembered of a picture and its (height, width)


def check_pictures(
    folder: Path, names: Sequence[str], listing: Path, faults: Faults, inside: str = "."
) -> list[tuple[Path, bool]]:
    """Return each listed picture's path, and whether it can be used: it is there, whole, and of the usual size.

    names: of the pictures in `folder`/`inside`, as in the file `listing`. None may be outside of `folder`. What cannot
    be used is a fault. Those that are whole are kept in the cache, and decoded again only after they have changed.
    """
    home = os.path.realpath(folder)
    cached = dict[str, Any]()
    whole = dict[str, Any]()
    cache = cache_root() / f"pictures-{key_of({'in': home})}.json"
    with suppress(OSError, ValueError):  # none yet, or half of one
        cached = dict(read_json(cache, MOST_KNOWN))
    parent_of = lru_cache(os.path.realpath)

    def check(name: str, path: Path) -> tuple[str, Sequence[int]]:
        there = path.lstat()
        # Only a link has to be followed: of all others, the folder decides.
        linked = stat.S_ISLNK(there.st_mode) or path.name == ".."
        real = os.path.realpath(path) if linked else f"{parent_of(path.parent)}{os.sep}"
        if not real.startswith(f"{home}{os.sep}"):
            raise EpisodeError(f"{quote(name)} is outside of the episode")
        there = path.stat() if linked else there
        # The time of any change: a copy may bring along the time of its content.
        key = f"{name} {there.st_size} {there.st_mtime_ns} {there.st_ctime_ns}"
        return key, cached.get(key) or check_jpeg(read_plain(path, MOST_BYTES))

    def check_some(first: int) -> list[Checked]:
        return [_caught(check, *entry) for entry in listed[first : first + AT_ONCE]]

    listed = [(name, folder / inside / name.replace("\\", "/")) for name in names]
    with ThreadPoolExecutor(min(16, os.cpu_count() or 1)) as pool:  # decoding releases the interpreter's lock
        checked = list(chain.from_iterable(pool.map(check_some, range(0, len(listed), AT_ONCE))))
    sizes = list(_sizes(listed, checked, listing, faults, whole))
    if whole.keys() - cached.keys():
        with suppress(OSError):
            cache.parent.mkdir(parents=True, exist_ok=True)
            cache.write_text(json.dumps(whole))
    counts = Counter(size for size in sizes if size)
    usual = max(counts, key=counts.__getitem__, default=(0, 0))
    for (_, path), size in zip(listed, sizes, strict=True):
        if size and size != usual:
            note = "{} pixels high, {} wide, and most here {} and {}: another camera's?".format(*size, *usual)
            faults.add(path, "another_size", note)
    return [(path, size == usual) for (_, path), size in zip(listed, sizes, strict=True)]


def _caught(check: Any, name: str, path: Path) -> Checked:
    try:
        return check(name, path)
    except (EpisodeError, CameraError, OSError, ValueError) as e:
        return e


def _sizes(
    listed: Sequence[tuple[str, Path]], checked: Sequence[Checked], listing: Path, faults: Faults, whole: dict[str, Any]
) -> Iterator[tuple[int, int] | None]:
    """Yield the (height, width) of each picture; None, and a fault, if it cannot be used. whole: gets the others."""
    for (name, path), result in zip(listed, checked, strict=True):
        if isinstance(result, EpisodeError):
            faults.add(listing, "path_leaves_folder", str(result))
        elif isinstance(result, CameraError):
            faults.add(path, "broken_jpeg", str(result))
        elif isinstance(result, Exception):  # not there, unreadable, a long name, a zero byte
            faults.add(listing, "frame_missing", f"{quote(name)} is listed but cannot be read")
        else:
            key, (height, width) = result
            whole[key] = height, width
            yield height, width
            continue
        yield None
