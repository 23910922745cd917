"""What a signal's handler may do to the thread that it interrupts, at each line of what that is doing."""

import sys
import threading

from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.signal_event import SignalEvent


def interrupted(work, handler):
    """Repeat the work, interrupted by the handler at another line each time; return how many there are."""
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
    event, log = SignalEvent(), FlightLog("unused.log", header={}, max_bytes=1 << 20, keep=0)

    def work():
        event.clear()
        event.wait(0.002)
        event.set()
        log.event("one")

    assert interrupted(work, lambda: (event.set(), log.event("another"))) > 10
