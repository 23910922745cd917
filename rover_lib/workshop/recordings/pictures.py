"""Whether the pictures of recordings are there and whole: each is decoded once, and again only after it has changed."""

import hashlib
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from rover_lib.onboard.car.picture import MOST_BYTES, check_jpeg
from rover_lib.onboard.errors import CameraError
from rover_lib.onboard.stage import read_plain
from rover_lib.workshop.cache import cache_root
from rover_lib.workshop.recordings.controls import Faults
from rover_lib.workshop.untrusted import quote, read_json


class Pictures:
    """The pictures below the root of `faults`. keep() leaves in the cache which of them are whole."""

    def __init__(self, faults: Faults):
        self._faults = faults
        name = hashlib.sha256(bytes(faults.root.resolve())).hexdigest()[:16]
        self._known: dict[str, Sequence[int]] = {}
        self._whole: dict[str, Sequence[int]] = {}
        self._file: Path | None = None
        with suppress(OSError, ValueError, TypeError, RuntimeError):  # JSON of another kind; a user without a home
            self._file = cache_root() / f"pictures-{name}.json"
            self._known = dict(read_json(self._file))

    def size_of(self, home: Path, picture: Path, name: str, listing: Path) -> tuple[int, int] | None:
        """Return a picture's (height, width); None, and a fault, unless it is there, whole and in its folder.

        home: that folder, resolved. name: the picture's in `listing`, the file that lists it.
        """
        try:
            if name.startswith(os.sep) or not os.path.realpath(picture).startswith(f"{home}{os.sep}"):
                self._faults.add(listing, "path_leaves_folder", f"{quote(name)} is outside of the episode")
                return None
            there = picture.stat()
            # The time of the last change of any kind: a copy may bring along the time of its content.
            key = f"{home.name}/{name} {there.st_size} {there.st_mtime_ns} {there.st_ctime_ns}"
            self._whole[key] = self._known.get(key) or check_jpeg(read_plain(picture, MOST_BYTES))
            height, width = self._whole[key]
            return height, width
        except CameraError as e:
            self._faults.add(picture, "broken_jpeg", str(e))
        except (OSError, ValueError, RuntimeError):  # not there, unreadable, a long name, a zero byte, a loop of links
            self._faults.add(listing, "frame_missing", f"{quote(name)} is listed but cannot be read")
        return None

    def keep(self) -> None:
        """Write the cache, if it has changed and there is room for it."""
        if self._file and self._whole.keys() != self._known.keys():
            with suppress(OSError):
                self._file.parent.mkdir(parents=True, exist_ok=True)
                self._file.write_text(json.dumps(self._whole))  # half a file is no JSON, and is not used
