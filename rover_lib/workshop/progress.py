"""Progress bars for long work: the type of a bar, a silent one, and bars that appear only if somebody watches."""

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TextIO, TypeVar

LINES_S = 20.0  # seconds of silence in a log
LOG_VARIABLE = "ROVER_PROGRESS_LOG"  # the file into which the run's messages go, if that is no terminal
TTY_VARIABLE = "ROVER_PROGRESS_TTY"  # the terminal where a run was started: the notebooks draw their bars there

T = TypeVar("T")
Progress = Callable[..., Iterable]  # called like tqdm.tqdm(iterable, desc=, total=)


def silent(items: Iterable[T], **_: object) -> Iterable[T]:
    """Show no bar: the default of every function that takes a `progress`."""
    return items


def terminal_bar() -> Progress:
    """A bar if the output is a terminal; a line now and then if it goes to a log."""
    from tqdm import tqdm

    return partial(tqdm, leave=False) if sys.stderr.isatty() else partial(lines, sys.stderr)


def lines(stream: TextIO, items: Iterable[T], *, desc: str = "", total: int | None = None, **_: object) -> Iterator[T]:
    """Yield the items, and write a line to the stream each LINES_S."""
    told_s = time.monotonic()
    for count, item in enumerate(items):
        if time.monotonic() - told_s > LINES_S:
            told_s = time.monotonic()
            print(f"rover: {desc or 'at work'}: {count}{f' of {total}' if total else ''}", file=stream, flush=True)
        yield item


def notebook_bar() -> Progress:
    """A bar in the terminal where `rover run` was started, lines in its log, or a bar in JupyterLab; else none."""
    from tqdm import tqdm
    from tqdm.auto import tqdm as widget

    if name := os.environ.get(LOG_VARIABLE):
        with suppress(OSError):
            return partial(lines, Path(name).open("a"))
    if name := os.environ.get(TTY_VARIABLE):
        with suppress(OSError):  # open as long as the kernel lives
            return partial(tqdm, file=Path(name).open("w"), leave=False)
    if "JPY_SESSION_NAME" in os.environ:
        return partial(widget, leave=False)  # else each step leaves red text below the cell
    return silent
