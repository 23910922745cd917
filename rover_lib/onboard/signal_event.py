"""Signals that end a program: who handles them, and an event that a handler may set."""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

# All that ask a program to end. A script's & starts a drive with SIGINT and SIGQUIT ignored; they must still end it.
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
POLL_S = 0.01


class SignalEvent(threading.Event):
    """A flag that the handler of a signal may set at any moment: it has no lock, which the handler could wait for."""

    def __init__(self) -> None:
        self._is_set = False

    def is_set(self) -> bool:
        return self._is_set

    def set(self) -> None:
        self._is_set = True

    def clear(self) -> None:
        self._is_set = False

    def wait(self, timeout: float | None = None) -> bool:
        end_s = time.monotonic() + (float("inf") if timeout is None else timeout)
        while not self._is_set and (left_s := end_s - time.monotonic()) > 0:
            time.sleep(min(POLL_S, left_s))
        return self._is_set


@contextlib.contextmanager
def signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[dict[int, Any]]:
    """Send SIGNALS to `handler` inside the context, and to their former handlers afterwards. Yields the former ones."""
    before: dict[int, Any] = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield before
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
