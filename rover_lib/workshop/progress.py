"""Progress bars for long work: the type of a bar, a silent one, and bars that appear only if somebody watches."""

import os
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TypeVar

TTY_VARIABLE = "ROVER_PROGRESS_TTY"  # the terminal where a run was started: the notebooks draw their bars there

T = TypeVar("T")
Progress = Callable[..., Iterable]  # called like tqdm.tqdm(iterable, desc=, total=)


def silent(items: Iterable[T], **_: object) -> Iterable[T]:
    """Show no bar. This is the default of every function that takes a `progress`."""
    return items


def terminal_bar() -> Progress:
    """A bar if the output is a terminal; nothing if it goes to a log."""
    from tqdm import tqdm

    return partial(tqdm, disable=not sys.stderr.isatty(), leave=False)


def notebook_bar() -> Progress:
    """A notebook's bar if somebody watches; in stored outputs, bars would only be noise.

    Somebody watches in the terminal where `rover run` was started, or in a JupyterLab session.
    """
    from tqdm import tqdm

    if name := os.environ.get(TTY_VARIABLE):
        try:
            stream = Path(name).open("w")  # noqa: SIM115, open as long as the kernel lives
        except OSError:
            return silent
        return partial(tqdm, file=stream, leave=False)
    if "JPY_SESSION_NAME" in os.environ:
        return partial(tqdm, leave=False)
    return silent
