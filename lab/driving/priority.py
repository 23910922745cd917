"""A priority for what stands in for hardware: a real Arduino and a real cable do not wait for this machine."""

import contextlib
import gc
import os
import sys
from collections.abc import Iterator

from rover_lib.onboard.watch import SWITCH_S, schedule

PRIORITY = 3  # of real time, before rover drive


def boost(thread: int) -> None:
    """Gives a thread or a process, by its id, that priority, if this user may."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(PRIORITY))


@contextlib.contextmanager
def boosted_priority() -> Iterator[None]:
    """Inside, all threads of this program have it: one that waits for the interpreter waits for all who may hold it."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()  # in a large program, as pytest's, looking through all would keep the others waiting
    with contextlib.suppress(OSError):
        schedule(os.SCHED_RR | os.SCHED_RESET_ON_FORK, PRIORITY)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            schedule(os.SCHED_OTHER, 0)
        gc.unfreeze()
        sys.setswitchinterval(before)
