"""A progress bar for people."""

import sys
from collections.abc import Callable
from typing import Any


def progress() -> Callable[..., Any]:
    """A progress bar where someone watches; plain silence in a log."""
    from functools import partial

    from tqdm import tqdm

    return partial(tqdm, disable=not sys.stderr.isatty(), leave=False)
