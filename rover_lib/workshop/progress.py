"""Progress bars for long work: the type of a bar, a silent one, and bars that appear only if somebody watches."""

import os
import sys
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

RARELY: dict[str, Any] = {"delay": 20.0, "mininterval": 20.0}  # seconds: how a bar moves in a log

Progress = Callable[..., Iterable]  # called like tqdm.tqdm(iterable, desc=, total=)


def silent(items: Iterable, **_: object) -> Iterable:
    """Show no bar: the default of every function that takes a `progress`."""
    return items


def terminal_bar() -> Progress:
    """A bar if the output is a terminal; one that moves now and then if it goes to a log."""
    from tqdm import tqdm

    return partial(tqdm, leave=False) if sys.stderr.isatty() else partial(tqdm, leave=False, **RARELY)


def notebook_bar() -> Progress:
    """A bar in JupyterLab; else none, as `rover run` shows one of the cells."""
    from tqdm.auto import tqdm as widget

    if "JPY_SESSION_NAME" in os.environ:
        return partial(widget, leave=False)  # else each step leaves red text below the cell
    return silent
