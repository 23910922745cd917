"""Arm the car and drive, once or repeatedly, with all that a drive has opened.

`rover drive` and the laboratory's random drives arm and drive by this code; only what is opened differs.
"""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.car.host import boottime
from rover_lib.onboard.car.protocol import Telemetry
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.drive.feed import TAKEN, WAITING, Feed
from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.drive.inference import Planner
from rover_lib.onboard.drive.loop import Arm, Hooks, Report, Until, drive
from rover_lib.onboard.drive.pilot import PolicyPilot
from rover_lib.onboard.drive.plan import Commanded, Settings
from rover_lib.onboard.drive.service import CHECK_S, Service, check_age
from rover_lib.onboard.drive.takeover import TakeoverRecorder
from rover_lib.onboard.drive.watch import HealthWatch, boost_priority
from rover_lib.onboard.errors import DriveFault, RoverError, sentence_of
from rover_lib.onboard.recording.episode import About
from rover_lib.onboard.recording.recorder import Recorder, room_for

WAIT_S = 30.0  # for a human, from the command that asks for the car; the Arduino refuses an arming after 31
TAKEN_OVER = "the human drives, and is recorded until the sticks are let go"


@dataclass(frozen=True)
class DriveOptions:
    """The options of `rover drive`, whose help explains them. None: as there.

    latency_ms: make each plan take at least this long, for comparisons. asked_s: when the car was asked for, by
    boottime().
    """

    artifact: Path
    camera: str = "0"
    port: str = ""
    hz: float = 30.0
    dry_run: bool = False
    record: Path | None = None
    record_mb: float | None = None
    max_seconds: float | None = None
    ticks: int | None = None
    throttle_limit: float | None = None
    threads: int | None = None
    log_file: Path | None = None
    service: bool = False
    latency_ms: float = 0.0
    view: Path | None = None
    asked_s: float = field(default_factory=boottime)


@dataclass
class Session:
    """All that a drive has opened.

    link: None: no motor is driven. rate_hz, mode: of the policy. service: None: there is one drive. terminal: whether
    somebody sees what is missing, and is waited for. boost: gives priority while the car drives.
    """

    options: DriveOptions
    settings: Settings
    report: Report
    log: FlightLog
    feed: Feed
    link: ServoLink | None
    camera: Camera
    planner: Planner
    commanded: Commanded
    rate_hz: float
    mode: str
    service: Service | None = None
    terminal: bool = False
    boost: Callable[[FlightLog], AbstractContextManager] = boost_priority
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    now: Callable[[], float] = boottime

    def drive(self, stop: threading.Event, said: str = "") -> None:
        """Arm the car when somebody asks for it, and drive once. said: how the previous drive ended.

        Raises as loop.drive() does, but for a service no DriveFault.
        """
        options = self.options
        pilot = self.make_pilot()
        health = HealthWatch(self.report, self.link, self.log, self.settings.undervoltage_s, self.clock)
        with Arming(self, pilot) as arming:
            self.report.clear()
            arm = partial(self._arm, arming, stop, said)
            show = partial(self.feed.tick, self.report, self.camera, pilot)
            record = arming.record if options.record else None
            hooks = Hooks(arm, lambda: [*pilot.warnings(), *health()], record, show)
            until = Until(options.ticks, options.max_seconds, stop, self.over)
            try:
                drive(pilot, self.link, self.log, rate_hz=options.hz, until=until, hooks=hooks, report=self.report,
                      clock=self.clock, sleep=self.sleep)  # fmt: skip
            except DriveFault as error:
                if error.kind == "taken over":
                    arming.record_human(stop, self._human_over)
                if not self.service:
                    raise
            finally:
                self.feed.ended(self.report, self.camera, self.link)

    @property
    def car(self) -> Car:
        return self.link.car if self.link else this_car()

    def make_pilot(self) -> PolicyPilot:
        pwm = self.car.pwm
        return PolicyPilot(self.camera, self.planner, self.commanded, self.settings, self.rate_hz, calibration=pwm)

    def make_recorder(self, folder: Path, room: int | None) -> AbstractContextManager[Recorder]:
        port = self.link.port if self.link else ""
        facts = About(f"driven by {self.mode}", arduino_port=port, source="rover drive", car=self.car)
        return Recorder(folder, self.camera, facts, rate_hz=self.options.hz, most_bytes=room)

    def attempt(self, arming: "Arming") -> Telemetry | None:
        return arming.arm()

    def over(self) -> str | None:
        """Why this drive must end, by its operator or the view; None if it may go on."""
        if self.service and (reason := self.service.over()):
            return reason
        return self.feed.over()

    def check_wanted(self) -> None:
        """Raise RoverError if whoever asked for the car did so too long ago, or is gone."""
        if self.service:
            self.service.check_request()
        else:
            check_age(self.now() - self.options.asked_s, WAIT_S)

    def _arm(self, arming: "Arming", stop: threading.Event, said: str) -> Telemetry | None:
        """Arm the car for whoever asks for it: a service's operator, or the command itself."""
        attempt = partial(self.attempt, arming)
        if not (self.link and (self.service or self.terminal)):
            return attempt()
        show = partial(self._show_waiting, said)
        checks: list[Callable[[], object]] = [self.camera.latest, self.planner.newest, self.link.latest, show]
        if self.service:
            return self.service.wait_for_human(attempt, checks, partial(what_is_missing, self.link), said=said)
        return arm_when_ready(attempt, self.link, stop, self.log.event, checks, self.check_wanted)

    def _show_waiting(self, said: str) -> None:
        request = self.feed.over()  # a waiting service ignores a stop from the view: it is disarmed anyway
        self.feed.show(WAITING, said, self.report, self.camera, self.link)
        if request and not self.service:
            raise RoverError(request, kind="not armed")

    def _human_over(self) -> str | None:
        if self.service:
            self.service.alive()
        self.report.status = TAKEN_OVER
        self.feed.show(TAKEN, TAKEN_OVER, self.report, self.camera, self.link)
        return self.feed.over()


class Arming(AbstractContextManager["Arming"]):
    """Prepares a drive and arms the car; a context manager, whose end finishes the episode and lowers the priority."""

    def __init__(self, session: Session, pilot: PolicyPilot):
        self._session = session
        self._pilot = pilot
        options = session.options
        self._room: int | None = None
        if options.record and options.record_mb:
            self._room = room_for(options.record, options.record_mb)  # now, because it may take a while
        self._recorder: TakeoverRecorder | None = None
        self._armed: Telemetry | None = None
        self._driving, self._opened = ExitStack(), ExitStack()  # the second contains the first

    def __exit__(self, *exc: Any) -> None:
        if self._recorder:
            self._recorder.flush()
        try:
            self._opened.__exit__(*exc)
        finally:
            if self._recorder and (outcome := self._recorder.recorder.path or self._recorder.recorder.failure):
                self._session.log.event(f"recorded: {outcome}")

    def arm(self) -> Telemetry | None:
        """Arm the car if the newest plan is fresh and the camera sees. Return the status that confirms it.

        If it raises RoverError, what it began is undone, and it may be called again.
        """
        session = self._session
        with ExitStack() as opened:
            if session.link:
                session.link.request(keep=True)
            if folder := session.options.record:
                recorder = opened.enter_context(session.make_recorder(folder, self._room))
                self._recorder = TakeoverRecorder(recorder, session.mode)
            driving = opened.enter_context(ExitStack())
            driving.enter_context(session.planner.without_rest())
            driving.enter_context(session.boost(session.log))
            session.planner.renew(session.settings.fade_s)
            self._pilot.check()
            if session.link:
                limit = session.settings.throttle_limit
                self._armed = arm_capped(session.link, limit, session.log.event, session.check_wanted)
            self._driving = driving
            self._opened = opened.pop_all()
        return self._armed

    def record(self, *row: Any, **columns: Any) -> None:
        if self._recorder:
            self._recorder.command(*row, **columns)

    def record_human(self, stop: threading.Event, over: Callable[[], str | None]) -> None:
        """After a takeover in a recorded drive, record the human. Raises nothing."""
        session = self._session
        if not (self._recorder and session.link and self._armed):
            return
        self._driving.close()  # the host no longer drives: ordinary priority, and one plan per second
        recorder = self._recorder.recorder
        log = session.log
        log.event(TAKEN_OVER)
        try:
            rate_hz = session.options.hz
            takeover = self._recorder.human(
                session.link, self._armed, rate_hz=rate_hz, stop=stop, over=over, clock=session.clock
            )
            recorder.note(takeover=vars(takeover))
            log.event(str(takeover))
            recorder.close(takeover.ended if takeover.fault else None)
        except Exception as error:
            log.event(f"the human is not recorded: {sentence_of(error)}", level=logging.ERROR)


def arm_when_ready(
    arm: Arm,
    link: ServoLink,
    stop: threading.Event,
    notify: Callable[[str], None],
    checks: Sequence[Callable[[], object]] = (),
    still_wanted: Callable[[], object] | None = None,
) -> Telemetry | None:
    """Arm for a human in a terminal: say what is missing, wait for it, and then arm.

    checks: called while waiting; each raises if its device fails. still_wanted: raises if the human asked too long ago;
    None: they ask now. Raises RoverError when told to stop.
    """
    asked_s = boottime()
    still_wanted = still_wanted or (lambda: check_age(boottime() - asked_s, WAIT_S))
    link.request()
    message = ""
    while missing := what_is_missing(link):
        still_wanted()
        if missing != message:
            notify(f"before the car can drive: {missing}")
            message = missing
        for check in checks:
            check()
        if stop.wait(CHECK_S):
            raise RoverError("told to stop before a human armed the car", kind="not armed")
    still_wanted()
    return arm()


def what_is_missing(link: ServoLink) -> str:
    """Return what a human must do before the Arduino can be armed, "" if nothing. Raises LinkError."""
    telemetry = link.latest()
    if not telemetry or telemetry.missing == "-":
        return ""
    return link.remedy(telemetry.missing)


def arm_capped(
    link: ServoLink, limit: float, notify: Callable[[str], None], still_wanted: Callable[[], object] = lambda: None
) -> Telemetry:
    """Arm a car, after the Arduino was told to limit the host's throttle to `limit`, in [0, 1].

    notify: told if the Arduino allows less. Raises what still_wanted raises, and LinkError.
    """
    channel = link.calibration.throttle
    directions = (limit, -limit) if channel.low < 0 else (limit,)
    farthest_us = max(map(channel.pulse_us, directions), key=lambda us: abs(us - channel.neutral_us))
    cap_us = link.lower_cap(farthest_us).cap_us
    span_us = abs(channel.pulse_us(limit) - channel.neutral_us)
    if cap_us - channel.neutral_us < span_us:
        cap = limit * (cap_us - channel.neutral_us) / span_us
        problem = f"the Arduino gives at most throttle {cap:.2f} ({cap_us} us), this drive may ask for {limit:.2f}"
        notify(f"{problem}: what is above is cut; a reset of the Arduino raises a lowered cap")
    still_wanted()
    return link.arm()
