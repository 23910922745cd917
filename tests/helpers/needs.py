"""What tests need from the machine: Debian packages, and enough time.

A test whose packages are missing is skipped, and the reason names them. pip cannot install Debian packages; .ci/run
does, so that none of these tests is skipped there.
"""

import contextlib
import fcntl
import functools
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from lab.a76 import core
from lab.arduino import emulator
from lab.debian import missing_packages
from rover_lib.onboard.drive import watch

QEMU_MISSING = missing_packages(core.NEEDS)
qemu = pytest.mark.skipif(bool(QEMU_MISSING), reason=f"needs the Debian packages {' '.join(QEMU_MISSING)}")

# Some tests compile the firmware's source for this machine.
gcc = pytest.mark.skipif(not shutil.which("gcc"), reason="needs the Debian packages gcc libc6-dev")

SIMAVR_MISSING = missing_packages(emulator.NEEDS)
simavr = pytest.mark.skipif(bool(SIMAVR_MISSING), reason=f"needs the Debian packages {' '.join(SIMAVR_MISSING)}")

ATTEMPTS = 5
BEAT_S = 0.02
PRIORITY = 1  # of a test in real time, if this user may; programs that it starts have ordinary priority
LATE_S = 0.03  # a command waits for two or three threads in turn: so late each, they use up the 100 ms it has


def until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    """Wait until the condition holds. Fails if it does not within `seconds`."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.002)


def ended(pid: int) -> bool:
    """Whether a process has ended. A zombie, which only waits for its parent to notice, has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


class Late(AssertionError):
    """This machine was too busy for a test to do something in time."""


def keep_sending(
    send: Callable[[], object], seconds: float = 20.0, condition: Callable[[], object] | None = None
) -> None:
    """For a test in real time: send every 20 ms for `seconds`, or until the condition holds.

    Fails if there is a condition and it does not hold by then. Raises Late if more than 120 ms passed between two
    commands: after 150 ms the Arduino stops, as it must, and the test would no longer judge what it sent.
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
    """Wakes up every 20 ms in a thread of its own. late_s: the largest delay so far."""

    def __enter__(self) -> "Heartbeat":
        self.late_s, self._done = 0.0, threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
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
    """While inside, no other test in real time runs on this machine: it could keep a processor for 100 ms."""
    with (Path(tempfile.gettempdir()) / f"rover-real-time-{os.getuid()}.lock").open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(turn, fcntl.LOCK_UN)  # explicitly, because a forked child may still hold the file open


def real_time(test: Callable[..., None]) -> Callable[..., None]:
    """Decorate a test in real time: repeat it if it failed while this machine was measurably late, and only then.

    A late sender tests nothing, because the Arduino rightly stops. After ATTEMPTS failures the test fails and says why.
    """

    @functools.wraps(test)
    def repeated(*args: object, **fixtures: object) -> None:
        for attempt in range(1, ATTEMPTS + 1):
            with in_turn(), watch.real_time(PRIORITY), Heartbeat() as heartbeat:
                try:
                    return test(*args, **fixtures)
                except Exception as error:
                    if heartbeat.late_s < LATE_S and not isinstance(error, Late):
                        raise
                    if attempt == ATTEMPTS:
                        error.add_note(f"this machine was too busy, {heartbeat.late_s:.3f} s late")
                        raise

    return repeated
