"""A cache outside the tree, by the hash of what made its content: recordings, checkpoints, the emulated Pi."""

import hashlib
import inspect
import json
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from rover_lib.onboard.durable import build_folder


def cache_root() -> Path:
    """Where what is expensive to make is kept: $ROVER_CACHE, or rover/ in the user's cache."""
    return Path(os.environ.get("ROVER_CACHE") or Path.home() / ".cache" / "rover")


def key_of(params: dict[str, Any], *sources: ModuleType | Path) -> str:
    """Hash, 16 hex digits, of what makes a thing: its parameters and the modules or files involved."""
    digest = hashlib.sha256(json.dumps(params, sort_keys=True).encode())
    for source in sources:
        digest.update((source if isinstance(source, Path) else Path(inspect.getfile(source))).read_bytes())
    return digest.hexdigest()[:16]


def cache_folder(kind: str, key: str, make: Callable[[Path], None]) -> Path:
    """The folder <cache>/<kind>-<key>, made whole by `make(temporary folder)`, by one process, if it is not there."""
    folder = cache_root() / f"{kind}-{key}"
    if not folder.is_dir():
        with build_folder(folder, wait=True) as new:
            if not folder.is_dir():  # another process may have made it meanwhile
                make(new)
    return folder
