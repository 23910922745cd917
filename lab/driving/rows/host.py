"""Faults of the process that drives, and of the machine that it runs on."""

import contextlib
import os
import re
import signal
import subprocess
import sys

from lab.driving.bench import DrivingBench
from lab.driving.pins import CONTINUES, STOPPED
from lab.driving.row import FaultKind

FAULTS = FaultKind("host")


@FAULTS.add(
    "loop thread killed",
    STOPPED,
    "the loop has not ticked",
    "the loop's thread leaves by exit(2), in the process",
    start="end the loop's thread",
)
def _kill_loop(bench: DrivingBench) -> None:
    bench.signal(signal.SIGUSR2)


@FAULTS.add(
    "exception in the loop",
    STOPPED,
    "raised in the loop",
    "raised by a signal's handler, wherever the loop is",
    start="raise in the loop",
)
def _raise_in_loop(bench: DrivingBench) -> None:
    bench.signal(signal.SIGUSR2)


@FAULTS.add(
    "host process stopped", STOPPED, "no valid command for 150 ms|said nothing for", "SIGSTOP, after 1 s SIGCONT"
)
def _pause_process(bench: DrivingBench) -> None:
    _pause(bench, 1.0)


def _pause(bench: DrivingBench, seconds: float) -> None:
    bench.signal(signal.SIGSTOP)
    bench.wait(seconds)
    bench.signal(signal.SIGCONT)


@FAULTS.add(
    "host process stopped again and again",
    STOPPED,
    "the host paused again and again|had no time for its ticks",
    "SIGSTOP for 110 ms of every 150",
)
def _stutter(bench: DrivingBench) -> None:
    for _ in range(8):
        _pause(bench, 0.11)
        bench.wait(0.04)


@FAULTS.add(
    "CPU starved",
    CONTINUES,
    "this machine is busy",
    "4 busy processes of ordinary priority",
    watch_s=3.0,
    starves=True,
    limits="as 'inference hangs', when the policy gets so little that plans become too old",
)
def _starve(bench: DrivingBench) -> None:
    for _ in range(4):
        busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
        bench.undo.callback(busy.wait)
        bench.undo.callback(busy.kill)  # added last, so it is called before wait
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, busy.pid, 0)


@FAULTS.add(
    "disk full while logging",
    CONTINUES,
    "the flight log cannot be written",
    "",
    start="disk",
    watch_s=2.0,
    limits="none: it drives without a log, and says so once",
)
def _fill_disk(bench: DrivingBench) -> None:
    bench.fill_disk()


def _by_clock(hours: int) -> None:
    @FAULTS.add(
        f"clock stepped by {hours:+d} h",
        CONTINUES,
        re.escape(f"the system's clock was set by {hours * 3600:+d} s"),
        "a library under rover drive shifts the system's time; the machine's is left alone",
        start="clock",
        watch_s=1.6,
        limits="none: what drives asks the monotonic clock only",
    )
    def _step_clock(bench: DrivingBench) -> None:
        bench.step_clock(3600 * hours)


_by_clock(+1)
_by_clock(-1)


@FAULTS.add(
    "exception in the logger",
    CONTINUES,
    "raised in the logger",
    "each line of the flight log raises while it is made",
    start="raise in the logger",
    watch_s=2.0,
    limits="none: it drives without a log, and says so once",
)
def _fail_logger(bench: DrivingBench) -> None:
    bench.signal(signal.SIGUSR2)


@FAULTS.add(
    "host process stopped for 100 ms",
    CONTINUES,
    "missed 2 ticks|missed 3 ticks",
    "SIGSTOP, then SIGCONT",
    paused_s=0.1,
    limits="as 'host process stopped', after 150 ms; as 'again and again', after 45 ms of the half second behind it",
)
def _pause_process_shortly(bench: DrivingBench) -> None:
    _pause(bench, 0.1)
