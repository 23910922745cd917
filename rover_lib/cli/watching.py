"""Show the FILE of `rover view`: let an artifact drive through the balloon world, or show a recorded drive again."""

import contextlib
import os
import sys
import threading
import webbrowser
from pathlib import Path
from typing import Any

import click

from rover_lib.onboard.car.host import default_view
from rover_lib.onboard.cli import open_view
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.kinds import check_kind, kinds_of
from rover_lib.workshop.child_process import Child
from rover_lib.workshop.drive_log.replay import load_replay


def open_browser(url: str) -> None:
    """Open a browser if there is a screen; without one, a browser would take over the terminal."""
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(url)


def watch(file: Path, drive: int, options: dict[str, Any]) -> None:
    """Do what `rover view FILE` asks for, until the view is ended.

    drive: which drive of a flight log to show. An artifact drives in a process of its own, which ends with the view.
    Raises KindError for a file that is neither an artifact nor a drive.
    """
    kinds = kinds_of(file)
    if {"flight log", "recordings"} & set(kinds):
        return open_view(**options, opened=open_browser, replay=load_replay(file, drive))
    check_kind(file, "artifact")
    place = options.setdefault("feed", None) or default_view()
    options["feed"] = place
    command = (sys.executable, "-m", "rover_lib.cli", "drive", file, "--world", "--view", place)
    with contextlib.ExitStack() as stack:

        def opened(url: str) -> None:
            child = Child("the drive", *command, error=RoverError)
            stack.callback(child.close)
            threading.Thread(target=_tell_end, args=(child,), daemon=True).start()
            click.echo("the car drives in some seconds; Ctrl-C ends both", err=True)
            open_browser(url)

        open_view(**options, opened=opened)


def _tell_end(child: Child) -> None:
    """Print a drive's last words once it has ended. The page stays open."""
    child.process.wait()
    with contextlib.suppress(ValueError):  # the stream is closed, because the view has ended too
        click.echo(f"the drive has ended: {child.last_words()}; Ctrl-C ends the view", err=True)
