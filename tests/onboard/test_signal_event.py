"""What a signal's handler may do to the thread that it interrupts, at each line of what that is doing."""

import sys
import threading
import time

import pytest

from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.signal_event import SignalEvent


def interrupted(work, handler):
    """Does the work again and again, interrupted by the handler at another line each time; how many there are.

    The handler is called as Python calls one of a signal: between two steps of the thread that works. Fails where that
    thread never comes to its end.
    """
    at = 0
    while True:
        at, lines = at + 1, 0

        def trace(frame, kind, _, at=at):
            nonlocal lines
            if kind == "line":
                lines += 1
                if lines == at:
                    handler()
            return trace

        def run():
            sys.settrace(trace)
            work()
            sys.settrace(None)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        thread.join(10)
        assert not thread.is_alive(), f"a handler at line {at} of it waits for what its own thread has"
        if lines < at:
            return at


@pytest.mark.parametrize("work", ["wait", "set", "clear"])
def test_it_is_set_at_any_line(work):
    event = SignalEvent()

    def do():
        event.clear()
        getattr(event, work)(*[0.002] * (work == "wait"))

    assert interrupted(do, event.set) > 5


def test_what_happened_is_noted_at_any_line():
    log = FlightLog(None, header={}, max_bytes=1 << 20, keep=0)
    assert interrupted(lambda: log.event("one"), lambda: log.event("another")) > 5


def test_it_is_an_event():
    event = SignalEvent()
    begin = time.monotonic()
    assert not event.wait(0.02)
    assert time.monotonic() - begin >= 0.02
    waited = []
    threads = [threading.Thread(target=lambda: waited.append(event.wait())) for _ in range(3)]
    for thread in threads:
        thread.start()
    event.set()
    for thread in threads:
        thread.join(10)
    assert waited == [True] * 3
    assert event.is_set()
    assert event.wait(0)
    event.clear()
    assert not event.is_set()
    assert not event.wait(0)
