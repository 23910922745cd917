"""What stands around the control loop: its priority, its signals, its end when it hangs, and warnings.

The loop knows none of these. A source of warnings is called once a second, and gives sentences for the log.
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
from typing import Any

from rover_lib.onboard.loop import Report
from rover_lib.onboard.servo_link import LinkError, ServoLink, Telemetry
from rover_lib.onboard.signal_event import SignalEvent
from rover_lib.onboard.stage import open_plain
from rover_lib.onboard.telemetry import FlightLog, LogError

SWITCH_S = 0.0005  # at the latest, other threads give the interpreter back to the loop; not Python's 5 ms
PRIORITY = 2  # of real time: above what stands in for a car in the balloon world
HUNG_S = 3.0  # without a tick; the Arduino has stopped the car long before
LATE_COMMAND_MS = 5.0
OFTEN = 5  # commands of a second that were sent again
IDLE = 0.05  # of the processors' time; with less, somebody waits
STOLEN = 0.03  # of the same
REPEAT_AFTER = 3  # seconds after which a warning that still holds is repeated
CLOCK_SET_S = 1.0
SETTLED_S = 60.0  # memory is watched for growth from here on
TAIL_BYTES = 1 << 16
# All that ask a program to end. A script's & starts it with SIGINT and SIGQUIT ignored; such a drive must still end.
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)


@contextlib.contextmanager
def real_time(priority: int) -> Iterator[bool]:
    """Inside, all threads of this process have a real-time priority; gives whether this user may ask for that.

    All of them, because one that waits for its turn while it holds the interpreter keeps the others waiting too.
    """
    gc.collect()
    gc.freeze()  # what is here now need not be looked through again meanwhile
    before, granted = sys.getswitchinterval(), True
    sys.setswitchinterval(SWITCH_S)
    try:
        schedule(os.SCHED_RR | os.SCHED_RESET_ON_FORK, priority)
    except (OSError, AttributeError):  # AttributeError: no Linux
        granted = False
    try:
        yield granted
    finally:
        with contextlib.suppress(OSError, AttributeError):
            schedule(os.SCHED_OTHER, 0)
        sys.setswitchinterval(before)
        gc.unfreeze()


@contextlib.contextmanager
def boosted_priority(log: FlightLog) -> Iterator[None]:
    """Inside, this process goes before all that is not as urgent, if its user may ask for that.

    With four busy processes on two cores the loop's lateness at p99 was 0.7 ms so, 4 to 9 with the loop's thread alone
    at that priority, and 14 to 19 without (measured on an x86-64 workstation).
    """
    with real_time(PRIORITY) as granted:
        if granted:
            log.event("the loop runs at real-time priority")
        else:
            log.event("the loop runs at ordinary priority: this user may not ask for real time")
        yield


def schedule(policy: int, priority: int) -> None:
    """Puts all threads that this process has now under a policy of the kernel's scheduler. OSError: not allowed."""
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has just ended
            os.sched_setscheduler(int(thread.name), policy, os.sched_param(priority))


@contextlib.contextmanager
def stopped_by_signals(stop: SignalEvent, log: FlightLog) -> Iterator[None]:
    """SIGNALS set `stop` inside; a second one does what it did before. For the main thread."""

    def on_signal(number: int, frame: FrameType | None) -> None:
        log.event(f"{signal.Signals(number).name}: stopping")
        stop.set()
        signal.signal(number, before[number])

    with signals(on_signal) as before:
        yield


@contextlib.contextmanager
def signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[dict[int, Any]]:
    """SIGNALS go to `handler` inside, and where they went before afterwards; gives the latter."""
    before: dict[int, Any] = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield before
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextlib.contextmanager
def exit_if_hung(report: Report, log: FlightLog) -> Iterator[None]:
    """Inside, this process ends (exit code 3) when its loop has begun, has not ended, and ticks no more.

    Nobody else would end it, and camera, port and memory would stay taken. Counted in turns of its own, so that a
    process that was stopped as a whole has its time to go on.
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


def unfinished_drive(log: Path | str) -> str | None:
    """A sentence if the last drive in a flight log was armed, and never came to its end; to be asked before a new one.

    A process that is killed, or has no power any more, cannot say so itself.
    """
    try:
        with open_plain(log, LogError(f"{log}: no plain file")) as file:  # a FIFO would be waited for
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL_BYTES))
            lines = file.read().splitlines()
    except (OSError, LogError):
        return None
    ticks = False
    for line in reversed(lines):
        if b'"event":"neutral' in line:
            return None
        if b'"event":"armed' in line:
            ticks = True
        elif b'"kind":"header"' not in line:
            ticks |= line[:1].isdigit()
            continue
        break
    return f"{log}: the drive before this one has no end: killed, or without power or disk" if ticks else None


class HealthWatch:
    """What was out of the ordinary since it was asked last, a sentence for each: `warnings` of loop.Hooks.

    link: None drives no motor.
    """

    def __init__(self, report: Report, link: ServoLink | None):
        self._report, self._link = report, link
        self._ticks = 0
        self._counted: tuple[int, ...] | None = None
        self._spent = _processors()
        self._busy = 0  # seconds in a row in which the machine was
        self._clock_s = time.time() - time.monotonic()

    def __call__(self) -> Iterator[str]:
        late_ms, self._ticks = max(self._report.late_ms[self._ticks :], default=0.0), len(self._report.late_ms)
        if late_ms > LATE_COMMAND_MS:
            yield f"commands were up to {late_ms:.1f} ms late"
        with contextlib.suppress(LinkError):  # the next tick looks at it
            if self._link and (telemetry := self._link.latest()):
                yield from self._of_the_link(self._link.garbled, telemetry)
        spent, before = _processors(), self._spent
        self._spent = spent
        if spent and before and spent[1] > before[1]:
            idle, _, stolen = ((now - then) / (spent[1] - before[1]) for now, then in zip(spent, before, strict=True))
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
        again, garbled, bad, old, beyond, lost = (now - then for now, then in zip(counted, before, strict=True))
        if again > OFTEN or garbled or bad or old or beyond or lost:
            yield (
                f"the link: {again} commands were sent again, {garbled} lines came garbled; the Arduino had {bad} "
                f"garbled, {old} old and {beyond} out of range, and lost {lost} bytes"
            )


def _processors() -> tuple[int, int, int] | None:
    """Of all processors' time, in the kernel's ticks: idle, all, and taken by a host; None where it does not say."""
    try:
        with open("/proc/stat") as file:  # noqa: PTH123  # faster, once a second while driving
            spent = [int(value) for value in file.readline().split()[1:9]]
        return spent[3] + spent[4], sum(spent), spent[7]
    except (OSError, ValueError, IndexError):
        return None


def artifact_changes(path: Path | str) -> Callable[[], Iterable[str]]:
    """A source of warnings: says once when the file that was loaded is another one, or gone."""

    def signature() -> tuple[int, ...] | None:
        try:
            s = os.stat(path)  # noqa: PTH116  # its fields are what is compared
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
    """A source of no warnings, which keeps the report's memory up to date. pids: of the processes that count."""

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
    """Resident memory of processes together; None where /proc does not say."""
    try:
        pages = sum(int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in pids)
    except (OSError, ValueError, IndexError):
        return None
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 2)
