"""What a test needs of the machine: it is skipped, with the reason, where that is not there."""

import time
from collections.abc import Callable

import pytest

from rover_lib.playground import arduino
from rover_lib.workshop import arm

QEMU_MISSING = arm.missing_packages()
qemu = pytest.mark.skipif(bool(QEMU_MISSING), reason=f"needs the Debian packages {' '.join(QEMU_MISSING)}")

SIMAVR_MISSING = arduino.missing_packages()
simavr = pytest.mark.skipif(bool(SIMAVR_MISSING), reason=f"needs the Debian packages {' '.join(SIMAVR_MISSING)}")


def until(condition: Callable[[], object], seconds: float = 5.0) -> None:
    """Waits until something holds, which has to come."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.002)


def keep_sending(send: Callable[[], object], seconds: float) -> None:
    """Sends every 20 ms; the test is skipped where the machine was too busy for that, since the Arduino stops then."""
    last = time.monotonic()
    end = last + seconds
    while last < end:
        send()
        time.sleep(0.02)
        if (now := time.monotonic()) - last > 0.1:
            pytest.skip(f"this machine was too busy to send in time: {now - last:.2f} s between two commands")
        last = now
