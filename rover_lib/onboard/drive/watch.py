"""What surrounds the control loop: its priority, signals that end it, an exit if it hangs, and sources of warnings.

The loop itself knows none of these. It calls each source of warnings once a second, and logs the sentences it gets.
"""

import contextlib
import gc
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType

from rover_lib.onboard.car.servo_link import LinkError, ServoLink, Telemetry
from rover_lib.onboard.drive.flight_log import FlightLog, LogError
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.signal_event import SignalEvent, signals
from rover_lib.onboard.stage import open_plain

SWITCH_S = 0.0005  # after this, other threads give the interpreter back to the loop; Python's default is 5 ms
PRIORITY = 2  # real-time; above that of the balloon world's stand-in for a car
HUNG_S = 3.0  # without a tick; the Arduino has stopped the car long before that
LATE_COMMAND_MS = 5.0
OFTEN = 5  # commands that were sent again within a second
IDLE = 0.05  # of the processors' time; if less is idle, some process has to wait
STOLEN = 0.03  # of the processors' time, taken by the host of a virtual machine
REPEAT_AFTER = 3  # seconds after which the warning of a busy machine is repeated
CLOCK_SET_S = 1.0  # a smaller step of the system's clock is ignored
SETTLED_S = 60.0  # from then on, the growth of memory is measured
TAIL_BYTES = 1 << 16  # of a flight log, read for the end of its last drive


@contextlib.contextmanager
def real_time(priority: int) -> Iterator[bool]:
    """Give all threads of this process a real-time priority inside the context. Yields False if the user may not.

    All threads get it, because one that waits for the processor while it holds the interpreter makes the others wait.
    """
    gc.collect()
    gc.freeze()  # so that garbage collection skips all objects that exist now
    before, granted = sys.getswitchinterval(), True
    sys.setswitchinterval(SWITCH_S)
    try:
        schedule(os.SCHED_RR | os.SCHED_RESET_ON_FORK, priority)
    except (OSError, AttributeError):  # AttributeError: this is not Linux
        granted = False
    try:
        yield granted
    finally:
        with contextlib.suppress(OSError, AttributeError):
            schedule(os.SCHED_OTHER, 0)
        sys.setswitchinterval(before)
        gc.unfreeze()


@contextlib.contextmanager
def boost_priority(log: FlightLog) -> Iterator[None]:
    """Inside the context, let this process go before less urgent ones, if its user may ask for that.

    With four busy processes on two cores, the loop's lateness at p99 was 0.7 ms; it was 4 to 9 ms with only the loop's
    thread at that priority, and 14 to 19 ms without (measured on an x86-64 workstation).
    """
    with real_time(PRIORITY) as granted:
        if granted:
            log.event("the loop runs at real-time priority")
        else:
            log.event("the loop runs at ordinary priority: this user may not ask for real time")
        yield


def schedule(policy: int, priority: int) -> None:
    """Put all present threads of this process under a policy of the kernel's scheduler.

    Raises OSError if that is not allowed.
    """
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has just ended
            os.sched_setscheduler(int(thread.name), policy, os.sched_param(priority))


@contextlib.contextmanager
def stop_on_signals(stop: SignalEvent, log: FlightLog) -> Iterator[None]:
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
        with open_plain(log, LogError(f"{log}: no plain file")) as file:  # opening a FIFO would wait
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL_BYTES))
            lines = file.read().splitlines()
    except (OSError, LogError):
        return None
    drove = False
    for line in reversed(lines):  # back to where the last drive began
        if b'"event":"neutral' in line:
            return None
        if b'"event":"armed' in line:
            drove = True
            break
        if b'"kind":"header"' in line:
            break
        drove |= line[:1].isdigit()  # a tick; events are JSON
    return f"{log}: the drive before this one has no end: killed, or without power or disk" if drove else None


class HealthWatch:
    """A source of warnings, for loop.Hooks: a sentence for each thing that was unusual since the last call.

    link: None if no motor is driven.
    """

    def __init__(self, report: Report, link: ServoLink | None):
        self._report, self._link = report, link
        self._ticks = 0
        self._counted: tuple[int, ...] | None = None
        self._spent = _processors()
        self._busy = 0  # in how many seconds in a row the machine was busy
        self._clock_s = time.time() - time.monotonic()

    def __call__(self) -> Iterator[str]:
        late_ms, self._ticks = max(self._report.late_ms[self._ticks :], default=0.0), len(self._report.late_ms)
        if late_ms > LATE_COMMAND_MS:
            yield f"commands were up to {late_ms:.1f} ms late"
        with contextlib.suppress(LinkError):  # the next tick handles it
            if self._link and (telemetry := self._link.latest()):
                yield from self._of_the_link(self._link.garbled, telemetry)
        spent, before = _processors(), self._spent
        self._spent = spent
        if spent and before and spent[1] > before[1]:
            total = spent[1] - before[1]
            idle, stolen = (spent[0] - before[0]) / total, (spent[2] - before[2]) / total
            if idle < IDLE and self._busy % REPEAT_AFTER == 0:
                yield f"this machine is busy: its processors were idle for {idle:.0%} of the time"
            self._busy = self._busy + 1 if idle < IDLE else 0
            if stolen > STOLEN:
                yield f"this virtual machine was without its processors for {stolen:.0%} of the time"
        clock_s, before_s = time.time() - time.monotonic(), self._clock_s
        self._clock_s = clock_s
        if abs(clock_s - before_s) > CLOCK_SET_S:
            yield f"the system's clock was set by {clock_s - before_s:+.0f} s; nothing that drives goes by it"

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


def _processors() -> tuple[int, int, int] | None:
    """Return the processors' time in the kernel's ticks: idle, total, and taken by the host of a virtual machine.

    Returns None if the kernel does not tell.
    """
    try:
        with open("/proc/stat") as file:  # noqa: PTH123  # faster than Path; this runs once a second while driving
            spent = [int(value) for value in file.readline().split()[1:9]]
        return spent[3] + spent[4], sum(spent), spent[7]
    except (OSError, ValueError, IndexError):
        return None


def artifact_changes(path: Path | str) -> Callable[[], Iterable[str]]:
    """Return a source of warnings that says once when the loaded file has changed or is gone."""

    def signature() -> tuple[int, ...] | None:
        try:
            s = os.stat(path)  # noqa: PTH116  # only some of its fields are compared
        except OSError:
            return None
        return s.st_ino, s.st_size, s.st_mtime_ns

    last = signature()

    def watch() -> Iterator[str]:
        nonlocal last
        if (now := signature()) != last:
            last = now
            yield f"{path}: {'changed' if now else 'gone'} on disk; the policy that was loaded goes on driving"

    return watch


class MemoryWatch:
    """A source that gives no warnings, but keeps the report's memory up to date. pids: the processes that count."""

    def __init__(self, report: Report, pids: Iterable[int], clock: Callable[[], float] = time.monotonic):
        self._report, self._pids, self._clock = report, tuple(pids), clock
        self._start_s: float | None = None
        self._first_mb: float | None = None  # after the first minute

    def __call__(self) -> Iterable[str]:
        report, now = self._report, self._clock()
        self._start_s = now if self._start_s is None else self._start_s
        report.memory_mb = memory_mb(self._pids)
        if self._first_mb is None and now - self._start_s >= SETTLED_S:
            self._first_mb = report.memory_mb
        if self._first_mb and report.memory_mb:
            report.memory_growth_mb = round(report.memory_mb - self._first_mb, 2)
        return ()


def memory_mb(pids: Iterable[int]) -> float | None:
    """Return the resident memory of processes together, in MB; None if /proc does not tell."""
    try:
        pages = sum(int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in pids)
    except (OSError, ValueError, IndexError):
        return None
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 2)
