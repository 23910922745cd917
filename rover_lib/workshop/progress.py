"""Progress of what takes long: one type, one way to show nothing, and bars where somebody watches."""

import os
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TypeVar

TTY_VARIABLE = "ROVER_PROGRESS_TTY"  # the terminal of who started a run: the notebooks' bars are drawn there

T = TypeVar("T")
Progress = Callable[..., Iterable]  # called like tqdm.tqdm(iterable, desc=, total=)


def silent(items: Iterable[T], **_: object) -> Iterable[T]:
    """No bar: the default of every function that takes a `progress`."""
    return items


def terminal() -> Progress:
    """A bar where someone watches; nothing in a log."""
    from tqdm import tqdm

    return partial(tqdm, disable=not sys.stderr.isatty(), leave=False)


def watched() -> Progress:
    """A notebook's bar where someone watches; bars in a stored output are noise.

    That is the terminal from which `rover run` was started, or a JupyterLab session.
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
