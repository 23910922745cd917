"""What a signal's handler may do to the thread that it interrupts, at each line of what that is doing."""

import sys
import threading
import time

import pytest

from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.signal_event import SignalEvent


def interrupted(work, handler):
    """Repeat the work, interrupted by the handler at another line each time; return how many there are.

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


def test_a_handler_may_come_at_any_line():
    event, log = SignalEvent(), FlightLog(None, header={}, max_bytes=1 << 20, keep=0)

    def work():
        event.clear()
        event.wait(0.002)
        event.set()
        log.event("one")

    assert interrupted(work, lambda: (event.set(), log.event("another"))) > 10


@pytest.mark.parametrize("timeout", [None, 5.0])
def test_it_wakes_whoever_waits(timeout):
    event = SignalEvent()
    assert not event.wait(0.02)
    threading.Timer(0.02, event.set).start()
    start = time.monotonic()
    assert event.wait(timeout) and event.is_set() and time.monotonic() - start < 2
    event.clear()
    assert not event.is_set() and not event.wait(0)
