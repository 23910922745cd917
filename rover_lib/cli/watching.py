"""Show the FILE of `rover view`: let an artifact drive through the balloon world, or show a recorded drive again."""

import os
import webbrowser
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from rover_lib.onboard.cli import open_view
from rover_lib.onboard.kinds import check_kind, kinds_of


def open_browser(url: str) -> None:
    """Open a browser if there is a screen; without one, a browser would take over the terminal."""
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(url)


def watch(file: Path, drive: int, options: dict[str, Any]) -> None:
    """Do what `rover view FILE` asks for, until the view is ended.

    drive: which drive of a flight log to show.
    Raises KindError for a file that is neither an artifact nor a drive.
    """
    kinds = kinds_of(file)
    if {"flight log", "recordings"} & set(kinds):
        from rover_lib.workshop.drive_log.replay import load_replay

        return open_view(**options, opened=open_browser, shown=load_replay(file, drive))
    check_kind(file, "artifact")
    (simulated,) = entry_points(group="rover.cars", name="world")
    open_view(**options, opened=open_browser, shown=simulated.load().shown(file))
