"""Run another program to its end; if it fails, the error contains the last lines that it printed."""

import subprocess
from pathlib import Path
from typing import Any

from rover_lib.onboard.errors import RoverError

LAST_LINES = 3


def run(*command: object, error: type[RoverError] = RoverError, remedy: str = "", **options: Any) -> str:
    """Run a command to its end and return its standard output.

    error: the type to raise, with `remedy`, if the command cannot be started or fails; the sentence has its name and
    the last lines that it printed. options: of subprocess.run, such as cwd, env and input.
    """
    words = [str(part) for part in command]
    name = Path(words[0]).name
    try:
        done = subprocess.run(words, capture_output=True, text=True, **options)
    except FileNotFoundError:
        raise error(f"{name} is not here", remedy=remedy or "install it") from None
    if done.returncode:
        last = last_words(done.stderr or done.stdout)
        raise error(f"{name} failed (exit status {done.returncode}): {last}", remedy=remedy)
    return done.stdout


def last_words(text: str) -> str:
    """The last lines that a program printed, joined to one line."""
    return " | ".join(text.strip().splitlines()[-LAST_LINES:]) or "it printed nothing"
