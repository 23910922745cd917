"""Give what replaces hardware a high priority, as a real Arduino and a real cable do not wait for this machine."""

import contextlib
import os

from rover_lib.onboard.drive.watch import real_time

PRIORITY = 3  # of real-time scheduling, above that of rover drive


def boost(thread: int) -> None:
    """Give a thread or a process, by its id, that priority, if this user may."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(PRIORITY))


def boost_priority() -> contextlib.AbstractContextManager[bool]:
    """Give all threads of this program that priority inside the context, if this user may."""
    return real_time(PRIORITY)
