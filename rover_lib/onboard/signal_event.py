"""Signals that end a program: who handles them, and an event that a handler may set."""

import contextlib
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

# All that ask a program to end. A script's & starts a drive with SIGINT and SIGQUIT ignored; they must still end it.
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)


class SignalEvent(threading.Event):
    """A threading.Event that the handler of a signal may set, whatever the interrupted thread is doing.

    Python's own Event takes a lock in wait() and set() that a thread cannot take twice: if a handler interrupted a
    thread that holds the lock, it would wait for itself, and Ctrl-C would hang the program. This one takes no lock
    except inside SimpleQueue, whose put() may interrupt itself.
    """

    def __init__(self) -> None:
        self._is_set = False
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()  # not empty while the event is set

    def is_set(self) -> bool:
        return self._is_set

    def set(self) -> None:
        self._is_set = True
        self._wake.put(None)

    def clear(self) -> None:
        self._is_set = False
        while not self._wake.empty():
            self._take(0.0)

    def wait(self, timeout: float | None = None) -> bool:
        end_s = None if timeout is None else time.monotonic() + timeout
        while not self._is_set:
            left_s = None if end_s is None else end_s - time.monotonic()
            if left_s is not None and left_s <= 0:
                break
            if self._take(left_s) and self._is_set:
                self._wake.put(None)  # for other threads that wait
        return self._is_set

    def _take(self, timeout: float | None) -> bool:
        try:
            self._wake.get(timeout=timeout)
        except queue.Empty:
            return False
        return True


@contextlib.contextmanager
def signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[dict[int, Any]]:
    """Send SIGNALS to `handler` inside the context, and to their former handlers afterwards. Yields the former ones."""
    before: dict[int, Any] = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield before
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
