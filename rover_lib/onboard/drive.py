"""The control loop: a command at each absolute deadline, and a stopped car at the end of every fault.

    with Camera(0) as camera, PolicyProcess(artifact) as policy, ServoLink(port) as link:
        commanded = Commanded()
        with Planner(camera, policy.predict, commanded, policy.rate_hz) as planner:
            pilot = PolicyPilot(camera, planner, commanded, settings, policy.rate_hz)
            report = drive(pilot, link, rate_hz=30, log=log)

Nothing is driven by on an exception: whatever ends the loop, neutral is the first that is sent after it, and the
Arduino stops by itself 150 ms after the last command should that not get through.
"""

import contextlib
import gc
import logging
import os
import signal
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import numpy as np

from rover_lib.onboard.camera import Camera
from rover_lib.onboard.errors import ParamsError, PolicyError, RoverError
from rover_lib.onboard.inference import Planner, PolicyProcess, PolicyThread, late
from rover_lib.onboard.plan import Commanded, Follower, Settings
from rover_lib.onboard.pwm import PwmCalibration
from rover_lib.onboard.recorder import Recorder
from rover_lib.onboard.recording import Controls
from rover_lib.onboard.servo_link import SEQUENCES, LinkError, ServoLink, State, Telemetry
from rover_lib.onboard.telemetry import FlightLog, Tick

RATES_HZ = (10.0, 100.0)
FIRST_PLAN_S = 10.0
RESEND_S = 0.018  # a command takes 3 ms on the wire, a status that is under way 7, its own 7
SPARE_S = 0.004  # before a deadline nothing is sent again
SWITCH_S = 0.0005  # other threads give the interpreter back to the loop after at most so long, not Python's 5 ms
PRIORITY = 1  # the lowest of real time
MOVING = 0.004  # throttle above which a car moves, and no two pictures are the same
SLACK_S = 0.002  # a control of this much later is of the same tick: recordings have the ticks' rate, or close to it
HOLE_S = 0.3  # a recording without a measured pulse for so long does not go on driving
HUNG_S = 3.0  # without a tick; the Arduino has stopped the car long before
LATE_FRAME_S = 0.2  # six frames of a camera
LATE_COMMAND_MS = 5.0
OFTEN = 5  # commands of a second that were sent again
IDLE = 0.05  # of the processors' time; with less, somebody waits
CLOCK_SET_S = 1.0
TAIL_BYTES = 1 << 16
SETTLED_S = 60.0  # memory is watched from here on
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class DriveFault(RoverError):
    """What stopped the car."""


class TakenOver(RoverError):
    """The human moved a stick."""


@dataclass(frozen=True)
class Order:
    """What to send at a tick, and where it comes from. latency_s, age_s and frame: of the plan, if there is one."""

    steering: float
    throttle: float
    steering_us: int
    throttle_us: int
    plan: int = 0
    age_s: float | None = None
    latency_s: float | None = None
    fade: float = 1.0
    frame: int = 0


class Pilot(Protocol):
    """Who says what to do at a tick."""

    def ready(self, stop: threading.Event) -> None:
        """Waits until there is something to drive by. Raises RoverError if that does not come."""

    def order(self, now_s: float) -> Order | None:
        """For this tick; None when there is nothing more to do. Raises RoverError for what must stop the car."""

    def sent(self, at_s: float, order: Order) -> None:
        """It went out at that time."""


class PolicyPilot:
    """Drives by plans, and watches the camera behind them. rate_hz: of the plans' steps."""

    def __init__(
        self,
        camera: Camera,
        planner: Planner,
        commanded: Commanded,
        settings: Settings,
        rate_hz: float,
        *,
        calibration: PwmCalibration | None = None,
    ):
        self._camera, self._planner, self._commanded, self._settings = camera, planner, commanded, settings
        self._calibration = calibration or PwmCalibration()
        self._follower = Follower(settings, rate_hz)
        self._moving_s: float | None = None  # since when the car has been driving
        self._black_s: float | None = None  # since when the picture has been black
        self._frame_age_s = self._asking_s = 0.0  # the most, since troubles()

    def ready(self, stop: threading.Event) -> None:
        end = time.monotonic() + FIRST_PLAN_S
        while self._planner.wait(0.1) is None and not stop.is_set():
            if time.monotonic() > end:
                raise PolicyError(f"no plan within {FIRST_PLAN_S:g} s; does 'rover benchmark' run on this artifact?")

    def order(self, now_s: float) -> Order | None:
        frame = self._camera.latest()
        if frame:
            self._watch(frame.captured_s, frame.repeats, frame.mean, now_s)
            self._frame_age_s = max(self._frame_age_s, now_s - frame.captured_s)
        self._asking_s = max(self._asking_s, self._planner.asking_s)
        plan = self._planner.newest()
        if plan is not None and plan is not self._follower.plan:
            self._follower.add(plan, now_s)
        command = self._follower.command(now_s)
        if command is None:
            asking_s = self._planner.asking_s
            why = f"the policy has not answered for {asking_s:.1f} s" if asking_s > 0.1 else "no new frame came"
            raise DriveFault(f"the newest plan is too old to drive by ({self._follower.stop_s():g} s): {why}")
        pulses = self._calibration.pulses(command.steering, command.throttle)
        return Order(
            command.steering,
            command.throttle,
            pulses.steering_us,
            pulses.throttle_us,
            command.plan.number,
            command.age_s,
            command.plan.latency_s,
            command.fade,
            frame.number if frame else 0,
        )

    def sent(self, at_s: float, order: Order) -> None:
        self._commanded.add(at_s, order.steering, order.throttle)
        if order.throttle <= MOVING:
            self._moving_s = None
        elif self._moving_s is None:
            self._moving_s = at_s

    def troubles(self) -> Iterator[str]:
        """For drive's `watch`: of camera and policy, since it was asked last."""
        age_s, asking_s, plan = self._frame_age_s, self._asking_s, self._follower.plan
        self._frame_age_s = self._asking_s = 0.0
        if age_s > LATE_FRAME_S:
            yield f"no new frame for {age_s:.2f} s"
        if plan and asking_s > LATE_FRAME_S + 1.5 * plan.latency_s:
            yield f"the policy took {asking_s:.2f} s or more, for the plan before {plan.latency_s:.2f} s"

    def _watch(self, captured_s: float, repeats: int, mean: float, now_s: float) -> None:
        many, period_s = self._settings.frozen_frames, 1 / self._camera.wanted_hz
        moving_s = now_s - self._moving_s if self._moving_s is not None else 0.0
        if many and repeats + 1 >= many and moving_s > repeats * period_s:
            raise DriveFault(f"the camera is frozen: {repeats + 1} frames were the same while the car was driving")
        if mean >= self._settings.black_level or not self._settings.black_frames:
            self._black_s = None
            return
        self._black_s = captured_s if self._black_s is None else self._black_s
        if captured_s - self._black_s >= (self._settings.black_frames - 1.5) * period_s:
            raise DriveFault(f"the camera's picture is black (mean {mean:.1f} of 255); is there a cap on the lens?")


class ReplayPilot:
    """Sends a recording's pulses at the times at which they were recorded; no policy, no camera.

    throttle_limit: of the throttle, in [0, 1]. What is outside the range that the Arduino takes is clipped to it.
    """

    def __init__(self, controls: Controls, *, throttle_limit: float = 1.0, calibration: PwmCalibration | None = None):
        c = calibration or PwmCalibration()
        self._calibration = c
        self._times = np.asarray(controls.times_s)
        steering = (c.steering.pulse_us(c.steering.low), c.steering.pulse_us(c.steering.high))
        throttle = (c.throttle.neutral_us, c.throttle.pulse_us(min(c.throttle.high, throttle_limit)))
        self._steering = np.clip(controls.steering_us, *steering)
        self._throttle = np.clip(controls.throttle_us, *throttle)
        self._start_s: float | None = None

    def ready(self, stop: threading.Event) -> None:
        pass

    def order(self, now_s: float) -> Order | None:
        if self._start_s is None:
            self._start_s = now_s
        i = int(np.searchsorted(self._times, now_s - self._start_s + SLACK_S, side="right")) - 1
        if i >= len(self._times) - 1 and now_s - self._start_s > self._times[-1] + 1 / RATES_HZ[0]:
            return None
        steering_us, throttle_us = int(self._steering[max(i, 0)]), int(self._throttle[max(i, 0)])
        if now_s - self._start_s - self._times[max(i, 0)] > HOLE_S:  # nobody knows what the human did meanwhile
            throttle_us = self._calibration.throttle.neutral_us
        actions = self._calibration.actions_from_pulses(steering_us, throttle_us)
        return Order(actions.steering or 0.0, actions.throttle or 0.0, steering_us, throttle_us)

    def sent(self, at_s: float, order: Order) -> None:
        pass


@dataclass
class Report:
    """What a drive was. Times of ticks in milliseconds; jitter: how late a command went out after its deadline."""

    ticks: int = 0
    missed: int = 0
    resent: int = 0
    seconds: float = 0.0
    ended: str = ""
    status: str = "getting ready"  # a line for people
    memory_mb: float | None = None  # resident, of the loop's process and its children, at the end
    memory_growth_mb: float | None = None  # since the first minute
    late_ms: array = field(default_factory=lambda: array("f"), repr=False)
    plan_age_ms: array = field(default_factory=lambda: array("f"), repr=False)
    latency_ms: array = field(default_factory=lambda: array("f"), repr=False)

    def summary(self) -> dict[str, Any]:
        """For JSON: ticks, missed, jitter_p50_ms, jitter_p99_ms, jitter_max_ms, plan_age_p95_ms, ..."""

        def at(values: array, pct: float) -> float | None:
            return round(float(np.percentile(values, pct)), 3) if len(values) else None

        return {
            "ticks": self.ticks,
            "missed": self.missed,
            "jitter_p50_ms": at(self.late_ms, 50),
            "jitter_p99_ms": at(self.late_ms, 99),
            "jitter_max_ms": at(self.late_ms, 100),
            "plan_age_p95_ms": at(self.plan_age_ms, 95),
            "latency_p50_ms": at(self.latency_ms, 50),
            "latency_p95_ms": at(self.latency_ms, 95),
            "resent": self.resent,
            "seconds": round(self.seconds, 3),
            "memory_mb": self.memory_mb,
            "memory_growth_mb": self.memory_growth_mb,
            "ended": self.ended,
        }


def drive(
    pilot: Pilot,
    link: ServoLink | None,
    *,
    rate_hz: float,
    log: FlightLog,
    recorder: Recorder | None = None,
    mode: str = "",
    ticks: int | None = None,
    max_seconds: float | None = None,
    stop: threading.Event | None = None,
    watch: Callable[[], Iterable[str]] = lambda: (),
    children: Iterable[int] = (),
    report: Report | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Report:
    """Arms the car, then sends the pilot's order at each deadline until one of the ends is reached.

    link: None drives no motor. recorder: takes each command too. mode: who drives, for it. stop: ends it, as ticks and
    max_seconds do. watch: called once a second; what it says goes to the log. children: processes whose memory counts.
    report: is filled as it goes, so that it is there after a fault too.
    Raises RoverError if it cannot be begun, DriveFault with what stopped the car, TakenOver when the human did;
    whatever it is, the car was told neutral before.
    """
    if not RATES_HZ[0] <= rate_hz <= RATES_HZ[1]:
        raise ParamsError(f"a car is driven at {RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz, found {rate_hz:g}")
    report = report if report is not None else Report()
    stop = stop or threading.Event()
    pilot.ready(stop)
    loop = _Loop(pilot, link, 1 / rate_hz, log, recorder, mode, report, clock, sleep, (os.getpid(), *children))
    if stop.is_set():
        report.ended = "stopped before it began"
        return report
    try:
        loop.arm()
        report.ended = loop.run(stop, ticks, max_seconds, watch)
    except BaseException as error:
        said = loop.neutral()  # first of all, and before anything that may take long
        report.ended = f"{error}" if isinstance(error, RoverError) else f"{type(error).__name__}: {error}"
        log.event(report.ended, level=logging.ERROR)
        if isinstance(error, RoverError) and not isinstance(error, (DriveFault, TakenOver)) and loop.armed:
            raise DriveFault(report.ended) from error
        raise
    else:
        said = loop.neutral()
        log.event(f"ended: {report.ended}")
    finally:
        log.event(said)
        report.seconds = clock() - loop.start_s if loop.start_s else 0.0
    return report


@dataclass
class _Loop:
    pilot: Pilot
    link: ServoLink | None
    period_s: float
    log: FlightLog
    recorder: Recorder | None
    mode: str
    report: Report
    clock: Callable[[], float]
    sleep: Callable[[float], None]
    pids: tuple[int, ...]
    armed: bool = False
    start_s: float = 0.0
    boot: int = 0
    sequence: int = 0  # of the newest command
    sent_s: float = 0.0
    last: Order | None = None
    troubled: bool = False  # the port did not take the last command

    def arm(self) -> None:
        if self.link:
            self.boot = self.link.arm().boot
        self.armed = True
        self.log.event("armed" if self.link else "dry run: no motor is driven")

    def neutral(self) -> str:
        """Stops the car; what there is to say about it."""
        if not self.link:
            return "neutral: no motor was driven"
        try:
            return f"neutral: {self.link.neutral().why}"
        except LinkError as error:
            return f"neutral was not answered, the Arduino stops by itself: {error}"

    def run(
        self,
        stop: threading.Event,
        ticks: int | None,
        max_seconds: float | None,
        watch: Callable[[], Iterable[str]],
    ) -> str:
        report, n = self.report, 0
        self.start_s = start = self.clock()
        seconds, first_mb = 0, None
        while True:
            deadline = start + n * self.period_s
            self._wait(deadline)
            if stop.is_set():
                return "told to stop"
            now = self.clock()
            if (behind := int((now - deadline) / self.period_s)) > 0:
                report.missed += behind
                n += behind
                self.log.event(f"missed {behind} ticks: the machine had no time for the loop")
                deadline += behind * self.period_s
            telemetry = self._look()
            order = self.pilot.order(now)
            if order is None:
                return "done"
            self._send(order)
            self.pilot.sent(self.sent_s, order)
            self._note(order, telemetry, deadline, now)
            n += 1
            report.ticks += 1
            if ticks is not None and report.ticks >= ticks:
                return f"{ticks} ticks"
            if max_seconds is not None and now - start >= max_seconds:
                return f"{max_seconds:g} s"
            if now - start >= seconds:
                seconds += 1
                for said in watch():
                    self.log.event(said)
                report.memory_mb = memory_mb(self.pids)
                report.status = self._status(order, telemetry)
                if first_mb is None and now - start >= SETTLED_S:
                    first_mb = report.memory_mb
                if first_mb and report.memory_mb:
                    report.memory_growth_mb = round(report.memory_mb - first_mb, 2)

    def _status(self, order: Order, telemetry: Telemetry | None) -> str:
        who = telemetry.why if telemetry else "dry run"
        plan = "" if order.age_s is None else f", plan {order.age_s * 1e3:.0f} ms old, took {order.latency_s * 1e3:.0f}"
        late = f"late {max(self.report.late_ms[-100:]):.1f} ms at most, {self.report.missed} missed"
        return f"{who}: steering {order.steering:+.2f}, throttle {order.throttle:.3f}{plan}; {late}"

    def _wait(self, deadline: float) -> None:
        """Until the deadline; a command that the Arduino has not acknowledged meanwhile is sent again."""
        while self.link and self.last and (again := max(self.sent_s + RESEND_S, self.clock())) < deadline - SPARE_S:
            self.sleep(max(0.0, again - self.clock()))
            with contextlib.suppress(LinkError):  # the next tick looks at it
                telemetry = self.link.latest()
                if telemetry and (telemetry.sequence - self.sequence) % SEQUENCES < SEQUENCES // 2:
                    break
                self._put(self.last)
                self.report.resent += 1
                continue
            break
        if (left := deadline - self.clock()) > 0:
            self.sleep(left)

    def _look(self) -> Telemetry | None:
        """Whether the Arduino still lets us drive."""
        if not self.link:
            return None
        telemetry = self.link.latest()
        if telemetry.boot != self.boot:
            hello = self.link.hello
            why = hello.reset if hello and hello.boot == telemetry.boot else "unknown reason"
            raise DriveFault(f"the Arduino was reset ({why}); it is in manual now")
        if telemetry.state is State.MANUAL:
            raise TakenOver("the human took over with the transmitter")
        if telemetry.state is not State.AUTONOMOUS:
            raise DriveFault(f"the Arduino stopped the car: {telemetry.why}")
        return telemetry

    def _send(self, order: Order) -> None:
        self.last = order
        if not self.link:
            self.sent_s = self.clock()
            return
        try:
            self._put(order)
            self.troubled = False
        except LinkError as error:
            self.link.latest()  # raises if the port is gone
            if not self.troubled:  # it is only stuck, perhaps for a moment; the Arduino knows when to stop
                self.log.event(f"a command was not sent: {error}")
            self.troubled = True

    def _put(self, order: Order) -> None:
        self.sequence = self.link.send(order.steering_us, order.throttle_us)
        self.sent_s = self.clock()

    def _note(self, order: Order, telemetry: Telemetry | None, deadline: float, now: float) -> None:
        late_ms = (max(self.sent_s, now) - deadline) * 1e3
        self.report.late_ms.append(late_ms)
        if order.age_s is not None:
            self.report.plan_age_ms.append(order.age_s * 1e3)
            self.report.latency_ms.append(order.latency_s * 1e3)
        self.log.tick(
            Tick(
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
                plan_age_ms=None if order.age_s is None else order.age_s * 1e3,
                latency_ms=None if order.latency_s is None else order.latency_s * 1e3,
                fade=order.fade,
                frame=order.frame,
            )
        )
        if self.recorder:
            calibration = self.link.calibration if self.link else PwmCalibration()
            self.recorder.control(
                self.sent_s,
                telemetry.uptime_ms if telemetry else round((now - self.start_s) * 1e3),
                order.steering_us,
                order.throttle_us,
                round(calibration.steering.period_us),
                round(calibration.throttle.period_us),
                mode=self.mode,
                plan_age_ms=None if order.age_s is None else round(order.age_s * 1e3, 1),
            )


@contextlib.contextmanager
def going_first(log: FlightLog) -> Iterator[None]:
    """Inside, this process goes before all that is not as urgent, if its user may ask for that.

    All its threads, which sleep most of the time: one that was made to wait while it holds the interpreter would keep
    the loop waiting too. With four busy processes on two cores the loop's lateness at p99 was 0.7 ms so, 4 to 9 with
    the loop's thread alone at that priority, and 14 to 19 without (measured on an x86-64 workstation).
    """
    gc.collect()
    gc.freeze()  # what is here now need not be looked through again while driving
    before, said = sys.getswitchinterval(), "the loop runs at real-time priority"
    sys.setswitchinterval(SWITCH_S)
    try:
        _schedule(os.SCHED_RR | os.SCHED_RESET_ON_FORK, PRIORITY)
    except (OSError, AttributeError):  # AttributeError: no Linux
        said = "the loop runs at ordinary priority: this user may not ask for real time"
    log.event(said)
    try:
        yield
    finally:
        with contextlib.suppress(OSError, AttributeError):
            _schedule(os.SCHED_OTHER, 0)
        sys.setswitchinterval(before)
        gc.unfreeze()


def _schedule(policy: int, priority: int) -> None:
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has just ended
            os.sched_setscheduler(int(thread.name), policy, os.sched_param(priority))


@contextlib.contextmanager
def ended_by_signals(stop: threading.Event, log: FlightLog) -> Iterator[None]:
    """SIGTERM, SIGINT and SIGHUP set `stop` inside; a second one does what it did before. For the main thread."""

    def on_signal(number: int, frame: FrameType | None) -> None:
        log.event(f"{signal.Signals(number).name}: stopping")
        stop.set()
        signal.signal(number, before[number])

    before = {number: signal.signal(number, on_signal) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def ended_if_hung(report: Report, log: FlightLog) -> Iterator[None]:
    """Inside, this process ends (exit code 3) when its loop has begun, has not ended, and ticks no more.

    Nobody else would end it, and camera, port and memory would stay taken. Counted in turns of its own, so that a
    process that was stopped as a whole has its time to go on.
    """

    def look() -> None:
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
    threading.Thread(target=look, name="hung?", daemon=True).start()
    try:
        yield
    finally:
        done.set()


def unended(log: Path | str) -> str | None:
    """A sentence if the last drive in a flight log was armed, and never came to its end; to be asked before a new one.

    A process that is killed, or has no power any more, cannot say so itself.
    """
    try:
        with Path(log).open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL_BYTES))
            lines = file.read().splitlines()
    except OSError:
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


class Troubles:
    """For drive's `watch`: what was out of the ordinary since it was asked last, a sentence for each.

    link: None drives no motor.
    """

    def __init__(self, report: Report, link: ServoLink | None):
        self._report, self._link = report, link
        self._ticks = 0
        self._counted: tuple[int, ...] | None = None
        self._spent = _processors()
        self._clock_s = time.time() - time.monotonic()

    def __call__(self) -> Iterator[str]:
        late_ms, self._ticks = max(self._report.late_ms[self._ticks :], default=0.0), len(self._report.late_ms)
        if late_ms > LATE_COMMAND_MS:
            yield f"commands were up to {late_ms:.1f} ms late"
        with contextlib.suppress(LinkError):  # the next tick looks at it
            if self._link and (telemetry := self._link.latest()):
                yield from self._of_the_link(telemetry)
        spent, before = _processors(), self._spent
        self._spent = spent
        if spent and before and spent[1] > before[1]:
            idle = (spent[0] - before[0]) / (spent[1] - before[1])
            if idle < IDLE:
                yield f"this machine is busy: its processors were idle for {idle:.0%} of the time"
        clock_s, before_s = time.time() - time.monotonic(), self._clock_s
        self._clock_s = clock_s
        if abs(clock_s - before_s) > CLOCK_SET_S:
            yield f"the system's clock was set by {clock_s - before_s:+.0f} s; nothing that drives goes by it"

    def _of_the_link(self, t: Telemetry) -> Iterator[str]:
        counted = (self._report.resent, self._link.garbled, t.bad_lines, t.old_commands, t.out_of_range, t.lost_bytes)
        before, self._counted = self._counted or counted, counted
        again, garbled, bad, old, beyond, lost = (now - then for now, then in zip(counted, before, strict=True))
        if again > OFTEN or garbled or bad or old or beyond or lost:
            yield (
                f"the link: {again} commands were sent again, {garbled} lines came garbled; the Arduino had {bad} "
                f"garbled, {old} old and {beyond} out of range, and lost {lost} bytes"
            )


def _processors() -> tuple[int, int] | None:
    """Of all processors' time, in the kernel's ticks: idle, and all; None where it does not say."""
    try:
        with open("/proc/stat") as file:  # noqa: PTH123  # faster, once a second while driving
            spent = [int(value) for value in file.readline().split()[1:9]]
        return spent[3] + spent[4], sum(spent)
    except (OSError, ValueError, IndexError):
        return None


def artifact_watch(path: Path | str) -> Callable[[], Iterable[str]]:
    """For drive's `watch`: says once when the file that was loaded is another one, or gone."""

    def look() -> tuple[int, ...] | None:
        try:
            s = os.stat(path)  # noqa: PTH116  # its fields are what is compared
        except OSError:
            return None
        return s.st_ino, s.st_size, s.st_mtime_ns

    last = look()

    def watch() -> Iterator[str]:
        nonlocal last
        if (found := look()) != last:
            last = found
            yield f"{path}: {'changed' if found else 'gone'} on disk; the policy that was loaded goes on driving"

    return watch


def default_log() -> Path:
    """Where a drive's flight log goes: systemd's state folder of the service, or the user's."""
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(os.environ.get("STATE_DIRECTORY") or Path(home) / "rover") / "flight.log"


def memory_mb(pids: Iterable[int]) -> float | None:
    """Resident memory of processes together; None where /proc does not say."""
    try:
        pages = sum(int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in pids)
    except (OSError, ValueError, IndexError):
        return None
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 2)


def drive_artifact(
    artifact: Path | str,
    camera: Camera,
    link: ServoLink | None,
    *,
    settings: Settings,
    rate_hz: float,
    log: FlightLog,
    record: Path | None = None,
    threads: int | None = None,
    in_thread: bool = False,
    latency_s: float = 0.0,
    stop: threading.Event | None = None,
    **ends: Any,
) -> Report:
    """Drives an artifact by an open camera, in this process's main thread; everything else as `drive`.

    record: folder in which an episode is written. in_thread: the policy runs in a thread of this process, for
    comparison; not for driving, since one that hangs cannot be ended. latency_s: a plan takes at least so long, for
    comparison. ends: ticks, max_seconds, report.
    """
    stop = stop or threading.Event()
    commanded = Commanded()
    with contextlib.ExitStack() as stack:
        policy = stack.enter_context((PolicyThread if in_thread else PolicyProcess)(artifact, threads=threads))
        predict = late(policy.predict, latency_s) if latency_s else policy.predict
        planner = stack.enter_context(Planner(camera, predict, commanded, policy.rate_hz))
        mode = policy.manifest["mode"]
        recorder = None
        if record:
            port = link.port if link else ""
            recorder = Recorder(
                record, camera, label=f"driven by {mode}", rate_hz=rate_hz, arduino_port=port, source="rover drive"
            )
            stack.callback(lambda: log.event(f"recorded: {recorder.path or recorder.failure}"))
            stack.enter_context(recorder)  # notes in the episode what ended the drive
        report = ends.setdefault("report", Report())
        pilot = PolicyPilot(camera, planner, commanded, settings, policy.rate_hz)
        looks = (artifact_watch(artifact), pilot.troubles, Troubles(report, link))
        stack.enter_context(going_first(log))
        return drive(
            pilot,
            link,
            rate_hz=rate_hz,
            log=log,
            recorder=recorder,
            mode=mode,
            stop=stop,
            watch=lambda: (said for look in looks for said in look()),
            children=policy.pids,
            **ends,
        )
