"""Progress bars for long work: the type of a bar, a silent one, and bars that appear only if somebody watches."""

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from functools import partial
from html import escape
from typing import Any

RARELY: dict[str, Any] = {"delay": 20.0, "mininterval": 20.0}  # seconds: how a bar moves in a log

EVERY_S = 0.2  # between two changes of a notebook's bar

Progress = Callable[..., Iterable]  # called like tqdm.tqdm(iterable, desc=, total=)


def silent(items: Iterable, **_: object) -> Iterable:
    """Show no bar: the default of every function that takes a `progress`."""
    return items


def terminal_bar() -> Progress:
    """A bar if the output is a terminal; one that moves now and then if it goes to a log."""
    from tqdm import tqdm

    return partial(tqdm, leave=False, **({} if sys.stderr.isatty() else RARELY))


def in_jupyterlab() -> bool:
    """Whether a kernel of JupyterLab runs this. `rover run`, papermill and nbval show none of a cell's widgets."""
    return "JPY_SESSION_NAME" in os.environ


def notebook_bar() -> Progress:
    """A bar in JupyterLab; else none, as `rover run` shows one of the cells."""
    return _shown_bar if in_jupyterlab() else silent


def _shown_bar(items: Iterable, desc: str = "", total: int | None = None) -> Iterator:
    """Show a bar while somebody takes the items, and nothing afterwards.

    Not tqdm's: a widget stays in a saved notebook, which cannot show it once its kernel has ended.
    """
    from IPython.display import HTML, display

    if total is None and isinstance(items, Sized):
        total = len(items)
    shown = display(HTML(escape(desc)), display_id=True)
    last_s = 0.0
    try:
        for done, item in enumerate(items):
            if (now_s := time.monotonic()) - last_s > EVERY_S:
                last_s = now_s
                bar = f"<progress></progress> {escape(desc)} {done}"
                if total is not None:
                    bar = f'<progress value="{done}" max="{total}"></progress> {escape(desc)} {done} of {total}'
                shown.update(HTML(bar))
            yield item
    finally:
        shown.update(HTML(""))
