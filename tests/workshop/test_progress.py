"""Bars where nobody watches: a line now and then."""

import io

from rover_lib.workshop import progress


def test_a_log_gets_a_line_now_and_then(monkeypatch):
    now = iter(range(0, 1000, 8))  # eight seconds an item
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    log = io.StringIO()
    assert list(progress.lines(log, range(9), desc="calibrating", total=9)) == list(range(9))
    assert log.getvalue().splitlines()[0] == "rover: calibrating: 2 of 9" and len(log.getvalue().splitlines()) == 3
