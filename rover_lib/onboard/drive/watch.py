"""What surrounds the control loop: its priority, signals that end it, an exit if it hangs, and warnings.

The loop itself knows none of these. It calls HealthWatch once a second, and logs the sentences that it gets.
"""

import contextlib
import gc
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType

from rover_lib.onboard.car.servo_link import LinkError, ServoLink, Telemetry
from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.signal_event import SignalEvent, signals
from rover_lib.onboard.stage import open_plain

SWITCH_S = 0.0005  # after this, other threads give the interpreter back to the loop; Python's default is 5 ms
PRIORITY = 2  # real-time; above that of the balloon world's stand-in for a car
HUNG_S = 3.0  # without a tick; the Arduino has stopped the car long before that
LATE_COMMAND_MS = 5.0
OFTEN = 5  # commands that were sent again within a second
IDLE = 0.05  # of the processors' time; if less is idle, some process has to wait
CLOCK_SET_S = 1.0  # a smaller step of the system's clock is ignored
TAIL_BYTES = 1 << 16  # of a flight log, read for the end of its last drive


@contextlib.contextmanager
def real_time(priority: int) -> Iterator[bool]:
    """Give all threads of this process a real-time priority inside the context. Yields False if the user may not.

    All threads get it, because one that waits for the processor while it holds the interpreter makes the others wait.
    With four busy processes on two cores, the loop's lateness at p99 was 0.7 ms; it was 4 to 9 ms with only the loop's
    thread at that priority, and 14 to 19 ms without (measured on an x86-64 workstation).
    """
    gc.collect()
    gc.freeze()  # so that garbage collection skips all objects that exist now
    before, granted = sys.getswitchinterval(), True
    sys.setswitchinterval(SWITCH_S)
    try:
        _schedule(os.SCHED_RR | os.SCHED_RESET_ON_FORK, priority)
    except (OSError, AttributeError):  # AttributeError: this is not Linux
        granted = False
    try:
        yield granted
    finally:
        with contextlib.suppress(OSError, AttributeError):
            _schedule(os.SCHED_OTHER, 0)
        sys.setswitchinterval(before)
        gc.unfreeze()


def _schedule(policy: int, priority: int) -> None:
    """Put all present threads of this process under a policy of the kernel's scheduler. Raises OSError."""
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has just ended
            os.sched_setscheduler(int(thread.name), policy, os.sched_param(priority))


@contextlib.contextmanager
def boost_priority(log: FlightLog) -> Iterator[None]:
    """Inside the context, let this process go before less urgent ones, if its user may ask for that."""
    with real_time(PRIORITY) as granted:
        log.event("the loop runs at real-time priority" if granted else "this user may not ask for real time")
        yield


@contextlib.contextmanager
def stop_on_signals(stop: SignalEvent | threading.Event, log: FlightLog) -> Iterator[None]:
    """Inside the context, each of SIGNALS sets `stop`; the second time, the same signal does what it did before.

    Only the main thread may use this.
    """

    def on_signal(number: int, frame: FrameType | None) -> None:
        log.event(f"{signal.Signals(number).name}: stopping")
        stop.set()
        signal.signal(number, before[number])

    with signals(on_signal) as before:
        yield


@contextlib.contextmanager
def exit_if_hung(report: Report, log: FlightLog) -> Iterator[None]:
    """Inside the context, end this process (exit code 3) if its loop has begun, has not ended, and no longer ticks.

    Nobody else would end it, and camera, port and memory would stay in use. The watching thread counts its own turns
    instead of reading a clock, so that a process that was stopped as a whole gets the time to go on.
    """

    def watch() -> None:
        ticks, turns = 0, 0
        while not done.wait(HUNG_S / 6):
            turns = turns + 1 if ticks == report.ticks and not report.ended else 0
            ticks = report.ticks
            if ticks and turns >= 6:
                text = f"the loop has not ticked for {HUNG_S:g} s; the Arduino has stopped the car, this program ends"
                log.event(text, level=logging.ERROR)
                log.close()
                os._exit(3)

    done = threading.Event()
    threading.Thread(target=watch, name="hung?", daemon=True).start()
    try:
        yield
    finally:
        done.set()


def find_unfinished_drive(log: Path | str) -> str | None:
    """Return a sentence if the last drive in a flight log was armed but has no end. Call this before a new drive.

    A process that was killed, or lost its power, could not log its own end.
    """
    try:
        with open_plain(log, RoverError(f"{log}: not a regular file")) as file:  # opening a FIFO would wait
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL_BYTES))
            lines = file.read().splitlines()
    except (OSError, RoverError):
        return None
    for line in reversed(lines):  # back to where the last drive began
        if b'"event":"neutral' in line or b'"kind":"header"' in line:
            return None
        if line.startswith(b"[") or b'"event":"armed' in line:  # a tick, or its beginning
            return f"{log}: the drive before this one has no end: killed, or without power or disk"
    return None


class HealthWatch:
    """A source of warnings, for loop.Hooks: a sentence for each thing that was unusual since the last call.

    link: None if no motor is driven. pids: processes whose memory is noted in the report.
    """

    def __init__(self, report: Report, link: ServoLink | None, pids: Iterable[int] = ()):
        self._report, self._link, self._pids = report, link, tuple(pids)
        self._ticks = 0
        self._counted: tuple[int, ...] | None = None
        self._spent, self._busy = _spent(), False
        self._clock_s = time.time() - time.monotonic()

    def __call__(self) -> Iterator[str]:
        self._report.memory_mb = memory_mb(self._pids)
        late_ms, self._ticks = max(self._report.late_ms[self._ticks :], default=0.0), len(self._report.late_ms)
        if late_ms > LATE_COMMAND_MS:
            yield f"commands were up to {late_ms:.1f} ms late"
        with contextlib.suppress(LinkError):  # the next tick handles it
            if self._link and (telemetry := self._link.latest()):
                yield from self._of_the_link(self._link.garbled, telemetry)
        before, self._spent = self._spent, _spent()
        idle, total = (now - then for now, then in zip(self._spent, before, strict=True))
        was_busy, self._busy = self._busy, idle < IDLE * total
        if self._busy and not was_busy:  # what goes on is not said again
            yield f"this machine is busy: its processors were idle for {idle / total:.0%} of the time"
        before_s, self._clock_s = self._clock_s, time.time() - time.monotonic()
        if abs(self._clock_s - before_s) > CLOCK_SET_S:
            yield f"the system's clock was set by {self._clock_s - before_s:+.0f} s; nothing that drives goes by it"

    def _of_the_link(self, garbled_lines: int, t: Telemetry) -> Iterator[str]:
        counted = (self._report.resent, garbled_lines, t.bad_lines, t.old_commands, t.out_of_range, t.lost_bytes)
        before, self._counted = self._counted or counted, counted
        # An Arduino that was reset counts from 0 again.
        news = (now - then if now >= then else now for now, then in zip(counted, before, strict=True))
        again, garbled, bad, old, beyond, lost = news
        if again > OFTEN or garbled or bad or old or beyond or lost:
            yield (
                f"the link: {again} commands were sent again, {garbled} lines came garbled; the Arduino had {bad} "
                f"garbled, {old} old and {beyond} out of range, and lost {lost} bytes"
            )


def _spent() -> tuple[int, int]:
    """Return the processors' time in the kernel's ticks, idle and in total; zeros if the kernel reports none."""
    try:
        spent = [int(value) for value in Path("/proc/stat").read_text().partition("\n")[0].split()[1:9]]
        return spent[3] + spent[4], sum(spent)
    except (OSError, ValueError, IndexError):
        return 0, 0


def memory_mb(pids: Iterable[int]) -> float | None:
    """Return the resident memory of processes together, in MB; None if /proc does not tell."""
    try:
        pages = sum(int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in pids)
    except (OSError, ValueError, IndexError):
        return None
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 2)
