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
import logging
import os
import threading
import time
from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.camera import Camera
from rover_lib.onboard.errors import DriveFault, ParamsError, RoverError, TakenOver, sentence_of
from rover_lib.onboard.inference import Planner, PolicyProcess, PolicyThread, late
from rover_lib.onboard.pilot import Order, Pilot, PolicyPilot
from rover_lib.onboard.plan import Commanded, Settings
from rover_lib.onboard.pwm import PwmCalibration
from rover_lib.onboard.recorder import Recorder, room_for
from rover_lib.onboard.servo_link import SEQUENCES, LinkError, ServoLink, State, Telemetry
from rover_lib.onboard.telemetry import FlightLog, Tick
from rover_lib.onboard.watch import Troubles, artifact_watch, going_first, memory_mb

RATES_HZ = (10.0, 100.0)
RESEND_S = 0.018  # a command takes 3 ms on the wire, a status that is under way 7, its own 7
SPARE_S = 0.004  # before a deadline nothing is sent again
SETTLED_S = 60.0  # memory is watched from here on
REST_S = 1.0  # between plans that nobody drives by

Arm = Callable[[], Telemetry | None]  # arms the car; None: there is none


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


def at_once(arm: Arm, looks: Iterable[Callable[[], object]] = ()) -> Telemetry | None:
    """Arms the car without waiting for anybody."""
    return arm()


def drive(
    pilot: Pilot,
    link: ServoLink | None,
    *,
    rate_hz: float,
    log: FlightLog,
    record: Callable[..., None] | None = None,
    mode: str = "",
    ticks: int | None = None,
    max_seconds: float | None = None,
    stop: threading.Event | None = None,
    wait: Callable[[Arm], Telemetry | None] = at_once,
    watch: Callable[[], Iterable[str]] = lambda: (),
    children: Iterable[int] = (),
    report: Report | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Report:
    """Arms the car, then sends the pilot's order at each deadline until one of the ends is reached.

    link: None drives no motor. record: takes each command too, as Recorder.control does. mode: who drives, for it.
    stop: ends it, as ticks and max_seconds do. wait: called once all is ready, with what arms the car, and returns what
    that does; a human may say when. watch: called once a second; what it says goes to the log. children: processes
    whose memory counts. report: is filled as it goes, so that it is there after a fault too.
    Raises RoverError if it cannot be begun, DriveFault with what stopped the car, TakenOver when the human did;
    whatever it is, the car was told neutral before.
    """
    if not RATES_HZ[0] <= rate_hz <= RATES_HZ[1]:
        raise ParamsError(f"a car is driven at {RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz, found {rate_hz:g}")
    report = report if report is not None else Report()
    stop = stop or threading.Event()
    pilot.ready(stop)
    loop = _Loop(pilot, link, 1 / rate_hz, log, record, mode, report, clock, sleep, (os.getpid(), *children))
    if stop.is_set():
        report.ended = "stopped before it began"
        return report
    try:
        loop.arm(wait)
        report.ended = loop.run(stop, ticks, max_seconds, watch)
    except BaseException as error:
        said = loop.neutral()  # first of all, and before anything that may take long
        report.ended = sentence_of(error)
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
    record: Callable[..., None] | None
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

    def arm(self, wait: Callable[[Arm], Telemetry | None]) -> None:
        telemetry = wait(self.link.arm if self.link else lambda: None)
        self.boot = telemetry.boot if telemetry else 0
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
        if self.record:
            calibration = self.link.calibration if self.link else PwmCalibration()
            self.record(
                self.sent_s,
                telemetry.uptime_ms if telemetry else round((now - self.start_s) * 1e3),
                order.steering_us,
                order.throttle_us,
                round(calibration.steering.period_us),
                round(calibration.throttle.period_us),
                mode=self.mode,
                plan_age_ms=None if order.age_s is None else round(order.age_s * 1e3, 1),
            )


def drive_artifact(
    artifact: Path | str,
    camera: Camera,
    link: ServoLink | None,
    *,
    settings: Settings,
    rate_hz: float,
    log: FlightLog,
    record: Path | None = None,
    record_mb: float | None = None,
    threads: int | None = None,
    in_thread: bool = False,
    latency_s: float = 0.0,
    stop: threading.Event | None = None,
    wait: Callable[[Arm, Iterable[Callable[[], object]]], Telemetry | None] = at_once,
    **ends: Any,
) -> Report:
    """Drives an artifact by an open camera, in this process's main thread; everything else as `drive`.

    record: folder in which an episode is written; record_mb: all in it together take at most so much, None: what the
    disk has. in_thread: the policy runs in a thread of this process, for comparison; not for driving, since one that
    hangs cannot be ended. latency_s: a plan takes at least so long, for comparison. wait: as drive's, and gets what
    must go on working meanwhile too: each raises if it does not. ends: ticks, max_seconds, report.
    """
    stop = stop or threading.Event()
    commanded = Commanded()
    with contextlib.ExitStack() as stack:
        policy = stack.enter_context((PolicyThread if in_thread else PolicyProcess)(artifact, threads=threads))
        predict = late(policy.predict, latency_s) if latency_s else policy.predict
        planner = stack.enter_context(Planner(camera, predict, commanded, policy.rate_hz, rest_s=REST_S))
        mode = policy.manifest["mode"]
        recorder: Recorder | None = None
        room = room_for(record, record_mb) if record and record_mb else None  # now: it may take a while
        report = ends.setdefault("report", Report())
        pilot = PolicyPilot(camera, planner, commanded, settings, policy.rate_hz)
        sayings = (artifact_watch(artifact), pilot.troubles, Troubles(report, link))
        looks = (camera.latest, planner.newest, *((link.latest,) if link else ()))

        def prepared(arm: Arm) -> Telemetry | None:
            """Arms with a fresh plan, at the loop's priority, recorded; where it is refused, all that is undone."""
            nonlocal recorder
            with contextlib.ExitStack() as needed:
                needed.enter_context(planner.hurrying())
                if record:
                    about = {"label": f"driven by {mode}", "arduino_port": link.port if link else ""}
                    recorder = needed.enter_context(
                        Recorder(record, camera, **about, rate_hz=rate_hz, source="rover drive", most_bytes=room)
                    )  # notes in the episode what ended the drive
                needed.enter_context(going_first(log))
                planner.renew(settings.fade_s)
                telemetry = arm()
                stack.push(needed.pop_all())
            return telemetry

        def recorded() -> None:
            if recorder and (what := recorder.path or recorder.failure):
                log.event(f"recorded: {what}")

        stack.callback(recorded)

        return drive(
            pilot,
            link,
            rate_hz=rate_hz,
            log=log,
            record=(lambda *row, **more: recorder.control(*row, **more)) if record else None,
            mode=mode,
            stop=stop,
            wait=lambda arm: wait(lambda: prepared(arm), looks),
            watch=lambda: (said for say in sayings for said in say()),
            children=policy.pids,
            **ends,
        )
