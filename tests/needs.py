"""What a test needs of the machine: packages, without which it is skipped with the reason; and to be in time.

Debian packages cannot come with pip; .ci/run installs them, so that none of these tests skips there.
"""

import contextlib
import fcntl
import functools
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from lab.a76 import core
from lab.arduino import emulator
from lab.debian import missing_packages

QEMU_MISSING = missing_packages(core.NEEDS)
qemu = pytest.mark.skipif(bool(QEMU_MISSING), reason=f"needs the Debian packages {' '.join(QEMU_MISSING)}")

# The firmware's own source is compiled for this machine.
gcc = pytest.mark.skipif(not shutil.which("gcc"), reason="needs the Debian packages gcc libc6-dev")

SIMAVR_MISSING = emulator.missing_packages()
simavr = pytest.mark.skipif(bool(SIMAVR_MISSING), reason=f"needs the Debian packages {' '.join(SIMAVR_MISSING)}")

ATTEMPTS = 5
BEAT_S = 0.02
LATE_S = 0.06  # with a command every 20 ms, half of the 150 ms after which an Arduino stops


def until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    """Waits until something holds, which has to come."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.002)


def ended(pid: int) -> bool:
    """Whether a process is no more, or only waits for its parent to notice."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


class Late(AssertionError):
    """This machine did not let a test do something in time."""


def keep_sending(
    send: Callable[[], object], seconds: float = 20.0, condition: Callable[[], object] | None = None
) -> None:
    """Sends every 20 ms for that long, or until something holds, which has to come. For a test in real time.

    Raises Late where it could not: 150 ms after the last command the Arduino stops, as it must, and what the test would
    judge is no longer what it has sent.
    """
    last = time.monotonic()
    end = last + seconds
    while not (condition and condition()):
        if last >= end:
            assert not condition, "it did not happen"
            return
        send()
        time.sleep(BEAT_S)
        if (now := time.monotonic()) - last > 0.12:
            raise Late(f"{now - last:.2f} s between two commands")
        last = now


class Heartbeat:
    """How late a thread that wakes up every 20 ms comes; late_s: at its worst."""

    def __init__(self) -> None:
        self.late_s = 0.0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def __enter__(self) -> "Heartbeat":
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._done.set()
        self._thread.join()

    def _run(self) -> None:
        before = time.monotonic()
        while not self._done.wait(BEAT_S):
            now = time.monotonic()
            self.late_s = max(self.late_s, now - before - BEAT_S)
            before = now


@contextlib.contextmanager
def in_turn():
    """Inside, no other test in real time runs on this machine, of this suite or of another.

    What runs at real-time priority keeps a processor for up to 100 ms from what else does, and an Arduino that waits as
    long stops its car.
    """
    with (Path(tempfile.gettempdir()) / f"rover-real-time-{os.getuid()}.lock").open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(turn, fcntl.LOCK_UN)  # a forked child may hold the file open


@contextlib.contextmanager
def boosted_priority():
    """Inside, this thread goes before ordinary ones, if this user may.

    What it starts does not, unless it asks for that: a program that loads torch would keep every car of this machine
    waiting.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.0005)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        sys.setswitchinterval(before)


def real_time(test: Callable[..., None]) -> Callable[..., None]:
    """A test in real time: repeated if it failed while this machine was measurably late, and only then.

    A sender that is late is a test of nothing: the Arduino rightly stops. After ATTEMPTS it fails, and says so.
    """

    @functools.wraps(test)
    def repeated(*args: object, **fixtures: object) -> None:
        for attempt in range(1, ATTEMPTS + 1):
            with in_turn(), boosted_priority(), Heartbeat() as heartbeat:
                try:
                    return test(*args, **fixtures)
                except Exception as error:
                    if heartbeat.late_s < LATE_S and not isinstance(error, Late):
                        raise
                    if attempt == ATTEMPTS:
                        late_ms = heartbeat.late_s * 1e3
                        error.add_note(
                            f"this machine was too busy in {ATTEMPTS} attempts, {late_ms:.0f} ms late in this"
                        )
                        raise
            print(f"attempt {attempt} was spoilt: a thread woke up {heartbeat.late_s * 1e3:.0f} ms late")

    return repeated
