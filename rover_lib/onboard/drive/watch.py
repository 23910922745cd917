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
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from rover_lib.onboard.car.host import UNDER_VOLTAGE, throttled_means
from rover_lib.onboard.car.protocol import Telemetry
from rover_lib.onboard.car.servo_link import LinkError, ServoLink
from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.errors import DriveFault
from rover_lib.onboard.signal_event import SignalEvent, signals

SWITCH_S = 0.0005  # after this, other threads give the interpreter back to the loop; Python's default is 5 ms
PRIORITY = 2  # real-time; above that of the balloon world's stand-in for a car
HUNG_S = 3.0  # without a tick; the Arduino has stopped the car long before that
LATE_COMMAND_MS = 5.0
OLD_S = 10.0  # a reading of supply and heat is no longer news; a command that hangs is given up after 5
NOT_REPORTED = "this machine does not report its supply and heat: low voltage would not be seen"
OFTEN = 5  # commands that were sent again within a second


@contextlib.contextmanager
def real_time(priority: int) -> Iterator[bool]:
    """Give all threads of this process a real-time priority inside the context. Yields False if the user may not.

    All of them: one that waits for the processor while it holds the interpreter makes the loop wait. Beside four busy
    processes on two cores, it was 0.7 ms late at p99, with its own thread alone at that priority 4 to 9 ms (measured on
    an x86-64 workstation).
    """
    gc.collect()
    gc.freeze()  # so that garbage collection skips all objects that exist now
    before = sys.getswitchinterval()
    granted = True
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
    """Inside the context, a signal sets `stop`; the second time, it does what it did before. For the main thread."""

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()  # before anything that might wait
        log.event(f"{signal.Signals(number).name}: stopping")
        signal.signal(number, before[number])

    with signals(on_signal) as before:
        yield


@contextlib.contextmanager
def exit_if_hung(report: Report, log: FlightLog) -> Iterator[None]:
    """Inside the context, end this process (exit code 3) if its loop has begun, has not ended, and no longer ticks.

    Otherwise camera, port and memory would stay in use. Turns are counted instead of time, so that a process that was
    stopped as a whole gets the time to go on.
    """

    def watch() -> None:
        ticks = 0
        turns = 0
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


@dataclass
class HealthWatch:
    """A source of warnings, for loop.Hooks: a sentence for each thing that was unusual since the last call.

    log: one of its threads reads the supply and the heat, for the loop must not wait for that. undervoltage_s: after
    this time a supply that is too low raises DriveFault; 0: never. low_s: since when it has been too low. warning: the
    last one of supply and heat. counts: of the link, at the last call.
    """

    report: Report
    link: ServoLink | None
    log: FlightLog
    undervoltage_s: float
    clock: Callable[[], float] = time.monotonic
    ticks: int = 0
    counts: tuple[int, ...] | None = None
    low_s: float | None = None
    warning: str | None = None

    def __call__(self) -> Iterator[str]:
        yield from self._of_the_supply()
        late_ms = max(self.report.late_ms[self.ticks :], default=0.0)
        self.ticks = len(self.report.late_ms)
        if late_ms > LATE_COMMAND_MS:
            yield f"commands were up to {late_ms:.1f} ms late"
        with contextlib.suppress(LinkError):  # the next tick handles it
            if self.link and (telemetry := self.link.latest()):
                yield from self._of_the_link(self.link.garbled, telemetry)

    def _of_the_supply(self) -> Iterator[str]:
        if not (machine := self.log.machine):  # it has not been read yet
            return
        old = self.clock() - self.log.start_s - machine["t_s"] > OLD_S
        now = throttled_means(None if old else machine["throttled"], since_the_start=False)
        slow = "; plans take longer" if set(now or ()) - {UNDER_VOLTAGE} else ""
        self.report.machine = ", ".join(now or ()) + slow
        warning = NOT_REPORTED if now is None else self.report.machine
        if warning and warning != self.warning:
            yield warning
        self.warning = warning
        if now is None:
            return  # unknown: neither low nor good again
        if UNDER_VOLTAGE not in now:
            self.low_s = None
            return
        if self.low_s is None:
            self.low_s = self.clock()
        if self.undervoltage_s and (low_s := self.clock() - self.low_s) >= self.undervoltage_s:
            raise DriveFault(f"{UNDER_VOLTAGE} for {low_s:.0f} s", remedy="charge the battery")

    def _of_the_link(self, garbled: int, t: Telemetry) -> Iterator[str]:
        counts = (self.report.resent, garbled, t.bad_lines, t.old_commands, t.out_of_range, t.lost_bytes)
        before = self.counts or counts
        self.counts = counts
        # An Arduino that was reset counts from 0 again.
        news = (now - then if now >= then else now for now, then in zip(counts, before, strict=True))
        again, garbled, bad, old, beyond, lost = news
        if again > OFTEN or garbled or bad or old or beyond or lost:
            yield (
                f"the link: {again} commands were sent again, {garbled} lines came garbled; the Arduino had {bad} "
                f"garbled, {old} old and {beyond} out of range, and lost {lost} bytes"
            )
