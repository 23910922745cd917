"""The control loop: it sends a command at each absolute deadline, and every fault ends in a stopped car.

Whatever ends the loop, the next command is neutral. If that does not get through, the Arduino stops the car by itself
150 ms after the last command.
"""

import logging
import threading
import time
from array import array
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from rover_lib.onboard.car.car import this_car
from rover_lib.onboard.car.protocol import State, Telemetry
from rover_lib.onboard.car.servo_link import LATE_S, LinkError, ServoLink
from rover_lib.onboard.drive.flight_log import ARMED, FlightLog, Tick, figures
from rover_lib.onboard.drive.pilot import Order, Pilot
from rover_lib.onboard.errors import DriveFault, ParamsError, RoverError, sentence_of

RATES_HZ = (10.0, 100.0)
KEEP_S = 0.034  # longest time between commands, even if ticks are rarer: to the Arduino, 100 ms without one is a pause
RESEND_S = 0.018  # time to be acknowledged: 3 ms for the command, 7 for a status already on the wire, 7 for its own
SPARE_S = 0.004  # nothing is sent again so shortly before a deadline
READ_S = 0.005  # time for the thread that reads the port, after a pause of the whole process
# The Arduino notices only pauses of 100 ms. Within half a second, shorter ones together may take no longer than this.
LATE_MOST_S = 0.15
LATE_WITHIN_S = 0.5

Arm = Callable[[], Telemetry | None]  # arms the car and returns the status that says so; None: no motor is driven


@dataclass(frozen=True)
class Until:
    """When a drive ends as asked: after `ticks` or `max_seconds`, when `stop` is set or `over` returns a reason."""

    ticks: int | None = None
    max_seconds: float | None = None
    stop: threading.Event = field(default_factory=threading.Event)
    over: Callable[[], str | None] = lambda: None


@dataclass(frozen=True)
class Hooks:
    """Functions that the caller adds to the loop.

    arm: called once all is ready; it may first wait for a human. None: the link's arm(), at once. warnings: called once
    a second, for sentences to log. record: called with each command, with the arguments of Recorder.control(). show:
    called with each tick once its command has been sent.
    """

    arm: Arm | None = None
    warnings: Callable[[], Iterable[str]] = lambda: ()
    record: Callable[..., None] | None = None
    show: Callable[[Tick], None] | None = None


@dataclass
class Report:
    """The outcome of a drive, and its state while it lasts.

    late_ms (how long after its deadline a command was sent), plan_age_ms and latency_ms have one value per tick; the
    last two have none where no plan is followed.
    """

    ticks: int = 0
    missed: int = 0
    resent: int = 0
    seconds: float = 0.0
    ended: str = ""
    status: str = "getting ready"  # one line for people
    machine: str = ""  # what there is to say of supply and heat
    world: dict[str, Any] = field(default_factory=dict)  # figures of a simulated car, added to the summary
    late_ms: array = field(default_factory=lambda: array("f"), repr=False)
    plan_age_ms: array = field(default_factory=lambda: array("f"), repr=False)
    latency_ms: array = field(default_factory=lambda: array("f"), repr=False)

    def clear(self) -> None:
        """Make it as new, for another drive: whoever shows this report then follows that one."""
        vars(self).update(vars(Report()))

    def summary(self) -> dict[str, Any]:
        """Return the summary, for JSON: ticks, missed, jitter_p50_ms, jitter_p99_ms, jitter_max_ms, ..."""
        return {
            "ticks": self.ticks,
            "missed": self.missed,
            **figures(self.late_ms, self.plan_age_ms, self.latency_ms),
            "resent": self.resent,
            "seconds": round(self.seconds, 3),
            "ended": self.ended,
            **self.world,
        }


def drive(
    pilot: Pilot,
    link: ServoLink | None,
    log: FlightLog,
    *,
    rate_hz: float,
    until: Until | None = None,
    hooks: Hooks | None = None,
    report: Report | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Report:
    """Arm the car, then send the pilot's order at each deadline until the drive ends.

    Args:
        pilot: gives the order of each tick.
        link: to the Arduino; None: no motor is driven.
        log: takes each tick and event.
        rate_hz: commands per second, within RATES_HZ.
        until: what ends the drive; None: the pilot has no more orders.
        hooks: what else is called at each tick.
        report: filled during the drive.
        clock: in seconds.
        sleep: waits for that many seconds.

    Returns:
        The report.

    Raises:
        RoverError: the drive cannot begin.
        DriveFault: a fault or the human stopped the car; neutral is sent before that.
    """
    if not RATES_HZ[0] <= rate_hz <= RATES_HZ[1]:
        raise ParamsError(f"a car is driven at {RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz", found=f"{rate_hz:g}")
    report = report or Report()
    until = until or Until()
    loop = _Loop(pilot, link, log, 1 / rate_hz, until, hooks or Hooks(), report, clock, sleep)
    pilot.ready(until.stop)
    if until.stop.is_set():
        report.ended = "stopped before it began"
        return report
    try:
        loop.arm()
        report.ended = loop.run()
    except BaseException as error:
        stopped = loop.neutral()  # before anything else, which may take long
        report.ended = sentence_of(error)
        log.event(report.ended, level=logging.ERROR)
        if isinstance(error, RoverError) and not isinstance(error, DriveFault) and loop.armed:
            raise DriveFault(error.what, found=error.found, remedy=error.remedy) from error
        raise
    else:
        stopped = loop.neutral()
        log.event(f"ended: {report.ended}")
    finally:
        log.event(stopped)
        if loop.start_s:
            report.seconds = clock() - loop.start_s
    return report


@dataclass
class _Loop:
    pilot: Pilot
    link: ServoLink | None
    log: FlightLog
    period_s: float
    until: Until
    hooks: Hooks
    report: Report
    clock: Callable[[], float]
    sleep: Callable[[float], None]

    armed: bool = False
    start_s: float = 0.0
    boot: int = 0  # number of the Arduino's start at which it was armed
    sequence: int = 0  # number of the newest command
    sent_s: float = 0.0
    late: deque[tuple[float, float]] = field(default_factory=deque)  # missed deadlines: when it was seen, seconds late
    last: Order | None = None
    port_stuck: bool = False  # the port did not take the last command

    def arm(self) -> None:
        telemetry = None
        if self.hooks.arm:
            telemetry = self.hooks.arm()
        elif self.link:
            telemetry = self.link.arm()
        if telemetry:
            self.boot = telemetry.boot
        self.armed = True
        self.log.event(ARMED if self.link else "dry run: no motor is driven")

    def neutral(self) -> str:
        """Stop the car and return a sentence about how that went."""
        if not self.link:
            return "neutral: no motor was driven"
        try:
            return f"neutral: {self.link.neutral().why}"
        except Exception as error:  # of any kind: it must not hide what stopped the car before it
            return f"neutral was not answered, the Arduino stops by itself: {sentence_of(error)}"

    def run(self) -> str:
        report = self.report
        until = self.until
        self.start_s = start = self.clock()
        n = seconds = 0
        while True:
            deadline = start + n * self.period_s
            self._wait(deadline)
            if until.stop.is_set():
                return "told to stop"
            if why := until.over():
                return why
            now = self.clock()
            late_s = now - deadline
            if (behind := int(late_s / self.period_s)) > 0:
                report.missed += behind
                n += behind
                self.log.event(f"missed {behind} ticks: the machine had no time for the loop")
                deadline += behind * self.period_s
            telemetry = self._telemetry()
            if behind and self.link:
                self._check_time(now, late_s)
            order = self.pilot.order(now)
            if order is None:
                return "done"
            self._send(order)
            self.pilot.sent(self.sent_s, order)
            self._note(order, telemetry, deadline, now)
            n += 1
            report.ticks += 1
            if until.ticks is not None and report.ticks >= until.ticks:
                return f"{until.ticks} ticks"
            if until.max_seconds is not None and now - start >= until.max_seconds:
                return f"{until.max_seconds:g} s"
            if now - start >= seconds:
                seconds += 1
                for warning in self.hooks.warnings():
                    self.log.event(warning)
                report.status = self._status(order, telemetry)

    def _status(self, order: Order, telemetry: Telemetry | None) -> str:
        who = telemetry.why if telemetry else "dry run"
        plan = "" if order.age_s is None else f", plan {order.age_s * 1e3:.0f} ms old"
        late = f"late {max(self.report.late_ms[-100:]):.1f} ms at most, {self.report.missed} missed"
        machine = f"; {self.report.machine}" if self.report.machine else ""
        return f"{who}: steering {order.steering:+.2f}, throttle {order.throttle:.3f}{plan}; {late}{machine}"

    def _wait(self, deadline: float) -> None:
        """Wait for the deadline; meanwhile send the last command again if it is not acknowledged or is KEEP_S old."""
        link = self.link
        last = self.last
        while link and last and (again := max(self.sent_s + RESEND_S, self.clock())) < deadline - SPARE_S:
            self.sleep(max(0.0, again - self.clock()))
            try:
                telemetry = link.latest()
                if telemetry and telemetry.accepts(self.sequence):
                    if (again := self.sent_s + KEEP_S) >= deadline - SPARE_S:
                        break
                    self.sleep(max(0.0, again - self.clock()))
                else:
                    self.report.resent += 1
                self._put(link, last)
            except LinkError:  # the next tick raises what it means
                break
        if (rest_s := deadline - self.clock()) > 0:
            self.sleep(rest_s)

    def _telemetry(self) -> Telemetry | None:
        """Return the Arduino's newest status, if it lets the host drive. Raises DriveFault, LinkError."""
        if not self.link:
            return None
        telemetry = self.link.latest()
        if self.link.unacknowledged_s(self.clock()) > LATE_S:
            self.sleep(READ_S)
            telemetry = self.link.latest()
        if telemetry is None:
            raise DriveFault("the Arduino sends no status")
        if telemetry.boot != self.boot:
            hello = self.link.hello
            why = hello.reset if hello and hello.boot == telemetry.boot else "unknown reason"
            raise DriveFault(f"the Arduino was reset ({why}); it is in manual now")
        if telemetry.state is State.MANUAL:
            raise DriveFault("the human took over with the transmitter", kind="taken over")
        if telemetry.state is not State.AUTONOMOUS:
            raise DriveFault(f"the Arduino stopped the car: {telemetry.why}")
        if (age_s := self.link.unacknowledged_s(self.clock())) > LATE_S:
            problem = f"the Arduino has not answered for {age_s * 1e3:.0f} ms, the link is behind"
            raise DriveFault(problem, remedy="what is between this machine and the Arduino?")
        return telemetry

    def _check_time(self, now: float, late_s: float) -> None:
        self.late.append((now, late_s))
        while self.late[0][0] < now - LATE_WITHIN_S:
            self.late.popleft()
        late_s = sum(seconds for _, seconds in self.late)
        if late_s > LATE_MOST_S:
            problem = (
                f"the loop had no time for its ticks in {late_s * 1e3:.0f} of the last {LATE_WITHIN_S * 1e3:.0f} ms"
            )
            raise DriveFault(problem, remedy="is this machine too busy?")

    def _send(self, order: Order) -> None:
        self.last = order
        if not self.link:
            self.sent_s = self.clock()
            return
        try:
            self._put(self.link, order)
            self.port_stuck = False
        except LinkError as error:
            self.link.latest()  # raises if the port is gone
            if not self.port_stuck:  # perhaps for a moment only; if not, the Arduino stops the car
                self.log.event(f"a command was not sent: {error}")
            self.port_stuck = True

    def _put(self, link: ServoLink, order: Order) -> None:
        self.sequence = link.send(order.steering_us, order.throttle_us)
        self.sent_s = self.clock()

    def _note(self, order: Order, telemetry: Telemetry | None, deadline: float, now: float) -> None:
        late_ms = (max(self.sent_s, now) - deadline) * 1e3
        plan_age_ms = None if order.age_s is None else order.age_s * 1e3
        latency_ms = None if order.latency_s is None else order.latency_s * 1e3
        self.report.late_ms.append(late_ms)
        if plan_age_ms is not None and latency_ms is not None:
            self.report.plan_age_ms.append(plan_age_ms)
            self.report.latency_ms.append(latency_ms)
        tick = Tick(
            t_s=now - self.log.start_s,
            late_ms=late_ms,
            state=telemetry.state.value if telemetry else "",
            reason=telemetry.reason if telemetry else "",
            steering=order.steering,
            throttle=order.throttle,
            steering_us=order.steering_us,
            throttle_us=order.throttle_us,
            pins_steering_us=telemetry.steering_us if telemetry else None,
            pins_throttle_us=telemetry.throttle_us if telemetry else None,
            plan=order.plan,
            plan_age_ms=plan_age_ms,
            latency_ms=latency_ms,
            fade=order.fade,
            frame=order.frame,
            strange=order.strange,
        )
        self.log.tick(tick)
        if self.hooks.record:
            calibration = self.link.calibration if self.link else this_car().pwm
            self.hooks.record(
                self.sent_s,
                telemetry.uptime_ms if telemetry else round((now - self.start_s) * 1e3),
                order.steering_us,
                order.throttle_us,
                round(calibration.steering.period_us),
                round(calibration.throttle.period_us),
                plan_age_ms=None if plan_age_ms is None else round(plan_age_ms, 1),
            )
        if self.hooks.show:
            self.hooks.show(tick)
