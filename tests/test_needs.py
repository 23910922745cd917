"""How the tests deal with a busy machine: a test in real time is repeated while the machine is late, never skipped."""

import subprocess
import sys
import threading
import time

import needs
import pytest


def test_a_test_is_repeated_while_the_machine_is_late():
    attempts = []

    @needs.real_time
    def late_twice():
        attempts.append(1)
        if len(attempts) < 3:
            needs.keep_sending(lambda: time.sleep(0.2), seconds=1)

    late_twice()
    assert len(attempts) == 3


@pytest.mark.slow
def test_it_fails_in_the_end_and_says_why():
    attempts = []

    @needs.real_time
    def always_late():
        attempts.append(1)
        needs.keep_sending(lambda: time.sleep(0.2), seconds=1)

    with pytest.raises(needs.Late) as failure:
        always_late()
    assert len(attempts) == needs.ATTEMPTS
    assert "this machine was too busy in 5 attempts" in failure.value.__notes__[0]


def test_one_at_a_time(tmp_path, monkeypatch):
    """Among all workers and test runs on this machine. Here a separate process stands for another test run."""
    monkeypatch.setattr(needs.tempfile, "gettempdir", lambda: str(tmp_path))
    program = f"""
import sys, tempfile
sys.path[:0] = {sys.path!r}
tempfile.gettempdir = lambda: {str(tmp_path)!r}
import needs
needs.real_time(lambda: (print("in", flush=True), sys.stdin.readline()))()
"""
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"in\n"
        began = threading.Event()
        mine = threading.Thread(target=needs.real_time(began.set))
        mine.start()
        assert not began.wait(0.2)
        other.stdin.close()
        assert began.wait(20)
        mine.join()


def test_a_heartbeat_knows_that_nobody_had_a_turn():
    with needs.Heartbeat() as heartbeat:
        time.sleep(0.1)
        begin = time.monotonic()
        sum(range(20_000_000))  # runs in C, without letting other threads have the interpreter
        took = time.monotonic() - begin
        time.sleep(0.1)
    assert heartbeat.late_s > 0.5 * took
