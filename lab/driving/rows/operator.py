"""Signals by which the operator, or the system, ends a drive from outside."""

import signal
from typing import Any

from lab.driving.bench import DrivingBench
from lab.driving.pins import STOPPED
from lab.driving.row import FaultKind

FAULTS = FaultKind("operator")


def _by_signal(name: str, number: int, message: str, **more: Any) -> None:
    FAULTS.add(name, STOPPED, message, "a signal from outside", **more)(lambda bench: bench.signal(number))


_by_signal("SIGTERM", signal.SIGTERM, "SIGTERM: stopping", exit_code=0)
_by_signal("SIGINT", signal.SIGINT, "SIGINT: stopping", exit_code=0)
_by_signal("SIGHUP", signal.SIGHUP, "SIGHUP: stopping", exit_code=0)
_by_signal("SIGQUIT", signal.SIGQUIT, "SIGQUIT: stopping", exit_code=0)
_by_signal("SIGKILL", signal.SIGKILL, "the drive before this one", exit_code=-signal.SIGKILL, told_later=True)
_by_signal("SIGUSR1", signal.SIGUSR1, "the drive before this one", exit_code=-signal.SIGUSR1, told_later=True)


@FAULTS.add("SIGTERM and then SIGINT", STOPPED, "SIGTERM: stopping", "two signals from outside", exit_code=0)
def _two_signals(bench: DrivingBench) -> None:
    bench.signal(signal.SIGTERM)
    bench.signal(signal.SIGINT)
