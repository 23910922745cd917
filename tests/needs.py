"""What a test needs of the machine: it is skipped, with the reason, where that is not there.

Debian packages cannot come with pip; .ci/run installs them, so that none of these tests skips there.
"""

import time
from collections.abc import Callable

import pytest

from lab.a76 import count as arm
from lab.arduino import emulator as arduino
from lab.debian import missing_packages

QEMU_MISSING = missing_packages(arm.NEEDS)
qemu = pytest.mark.skipif(bool(QEMU_MISSING), reason=f"needs the Debian packages {' '.join(QEMU_MISSING)}")

SIMAVR_MISSING = arduino.missing_packages()
simavr = pytest.mark.skipif(bool(SIMAVR_MISSING), reason=f"needs the Debian packages {' '.join(SIMAVR_MISSING)}")


def until(condition: Callable[[], object], seconds: float = 5.0) -> None:
    """Waits until something holds, which has to come."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.002)


def keep_sending(
    send: Callable[[], object], seconds: float = 10.0, condition: Callable[[], object] | None = None
) -> None:
    """Sends every 20 ms for so long, or until something holds, which has to come.

    The test is skipped where the machine was too busy for that: 150 ms after the last command the Arduino stops, as it
    must, and what the test would judge is no longer what it has sent.
    """
    last = time.monotonic()
    end = last + seconds
    while not (condition and condition()):
        if last >= end:
            assert not condition, "it did not happen"
            return
        send()
        time.sleep(0.02)
        if (now := time.monotonic()) - last > 0.12:
            pytest.skip(f"this machine was too busy to send in time: {now - last:.2f} s between two commands")
        last = now
