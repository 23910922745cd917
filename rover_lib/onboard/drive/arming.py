"""Arm the car: wait for what a human must do, prepare the drive, and ask the Arduino for the car last of all.

    with Arming(options, settings, link, log, planner, camera, pilot, mode="static") as arming:
        telemetry = arm_when_asked(arming.arm, link, stop, log.event, terminal=True)

A service, a terminal and a script differ only in who asks; what is done then is the same, in one place.
"""

import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.car.car import this_car
from rover_lib.onboard.car.host import boottime
from rover_lib.onboard.car.servo_link import ServoLink, Telemetry
from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.drive.inference import Planner
from rover_lib.onboard.drive.loop import Arm
from rover_lib.onboard.drive.opening import DriveOptions
from rover_lib.onboard.drive.pilot import PolicyPilot
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.drive.service import CHECK_S, Service, check_age
from rover_lib.onboard.drive.takeover import TakeoverRecorder
from rover_lib.onboard.drive.watch import boost_priority
from rover_lib.onboard.errors import RoverError, sentence_of
from rover_lib.onboard.recording.episode import About
from rover_lib.onboard.recording.recorder import Recorder, room_for

WAIT_S = 30.0  # for a human, from the command that asks for the car; the Arduino refuses an arming after 31
TAKEN_OVER = "the human drives, and is recorded until the sticks are let go"


def arm_when_asked(
    attempt: Arm,
    link: ServoLink | None,
    stop: threading.Event,
    notify: Callable[[str], None],
    checks: Sequence[Callable[[], object]] = (),
    *,
    service: Service | None = None,
    said: str = "",
    terminal: bool = False,
    clock: Callable[[], float] = boottime,
) -> Telemetry | None:
    """Arm the car by `attempt` for whoever asks for it, and return what it returned.

    With a service, its operator asks, said: how the previous drive ended. In a terminal, the command itself asked, and
    the car waits for what is missing. Otherwise, and without a link, it is armed at once. Raises as wait_for_human(),
    arm_when_ready() and attempt() do.
    """
    if link and service:
        return service.wait_for_human(attempt, checks, partial(what_is_missing, link), said=said)
    if link and terminal:
        return arm_when_ready(attempt, link, stop, notify, checks, clock)
    return attempt()


def arm_when_ready(
    arm: Arm,
    link: ServoLink,
    stop: threading.Event,
    notify: Callable[[str], None],
    checks: Sequence[Callable[[], object]] = (),
    clock: Callable[[], float] = boottime,
) -> Telemetry | None:
    """Arm for a human who has just asked for it: say what is missing, wait for it for WAIT_S at most, and then arm.

    checks: called while waiting; each raises if its device fails. Raises RoverError when told to stop or if
    something is missing for too long, what a check raises, and what arm() raises.
    """
    link.request()
    told, asked_s = "", clock()
    while missing := what_is_missing(link):
        check_age(clock() - asked_s, WAIT_S)
        if missing != told:
            notify(f"before the car can drive: {missing}")
            told = missing
        for check in checks:
            check()
        if stop.wait(CHECK_S):
            raise RoverError("told to stop before a human armed the car", kind="not armed")
    check_age(clock() - asked_s, WAIT_S)
    return arm()


def what_is_missing(link: ServoLink) -> str:
    """Return what a human must do before the Arduino can be armed, "" if nothing. Raises LinkError as latest() does."""
    telemetry = link.latest()
    return link.remedy(telemetry.missing) if telemetry and telemetry.missing != "-" else ""


def arm_by_plan(
    link: ServoLink | None,
    planner: Planner,
    pilot: PolicyPilot,
    settings: Settings,
    notify: Callable[[str], None],
    still_wanted: Callable[[], object] = lambda: None,
    prepare: Callable[[], object] = lambda: None,
) -> Telemetry | None:
    """Arm the car if the newest plan is fresh and the camera sees. Return the status that confirms it.

    prepare: called after the request was noted and before the plan is renewed. Raises PolicyError without a fresh plan,
    CameraError for a camera that shows nothing, what prepare() raises, and as arm_capped() does.
    """
    if link:
        link.request(keep=True)
    prepare()
    planner.renew(settings.fade_s)
    pilot.check_sight()
    return arm_capped(link, settings.throttle_limit, notify, still_wanted) if link else None


def arm_capped(
    link: ServoLink,
    limit: float,
    notify: Callable[[str], None],
    still_wanted: Callable[[], object] = lambda: None,
) -> Telemetry:
    """Arm a car, after the Arduino was told to limit the host's throttle to `limit`.

    limit: the largest throttle that this drive may ask for, in [0, 1]; `notify` is told if the Arduino allows less.
    still_wanted: raises if nobody wants the car armed any more. Raises what still_wanted raises, and LinkError as
    lower_cap() and arm() do.
    """
    channel = link.calibration.throttle
    directions = (limit, -limit) if channel.low < 0 else (limit,)
    farthest_us = max(map(channel.pulse_us, directions), key=lambda us: abs(us - channel.neutral_us))
    cap_us = link.lower_cap(farthest_us).cap_us
    span_us = abs(channel.pulse_us(limit) - channel.neutral_us)
    if cap_us - channel.neutral_us < span_us:
        cap = limit * (cap_us - channel.neutral_us) / span_us
        notify(
            f"the Arduino gives at most throttle {cap:.2f} ({cap_us} us), and this drive may ask for {limit:.2f}: what "
            "is above is cut. A cap that another drive has lowered is back after a reset of the Arduino"
        )
    still_wanted()
    return link.arm()


class Arming:
    """Prepares a drive and arms the car; a context manager, whose end finishes the episode and lowers the priority.

    mode: of the artifact that drives. still_wanted: see arm_capped(). If arming is refused, what it began is undone.
    """

    def __init__(
        self,
        options: DriveOptions,
        settings: Settings,
        link: ServoLink | None,
        log: FlightLog,
        planner: Planner,
        camera: Camera,
        pilot: PolicyPilot,
        *,
        mode: str,
        still_wanted: Callable[[], object] = lambda: None,
    ):
        self._options, self._settings, self._link, self._log = options, settings, link, log
        self._planner, self._camera, self._pilot, self._mode = planner, camera, pilot, mode
        self._still_wanted = still_wanted
        self._room: int | None = None
        if options.record and options.record_mb:
            self._room = room_for(options.record, options.record_mb)  # now, because it may take a while
        self._recorder: TakeoverRecorder | None = None
        self._armed: Telemetry | None = None
        self._driving, self._recording = ExitStack(), ExitStack()

    def __enter__(self) -> "Arming":
        return self

    def __exit__(self, *exc: Any) -> None:
        if self._recorder:
            self._recorder.flush()
        try:
            self._driving.__exit__(*exc)
        finally:
            try:
                self._recording.__exit__(*exc)
            finally:
                if self._recorder and (outcome := self._recorder.recorder.path or self._recorder.recorder.failure):
                    self._log.event(f"recorded: {outcome}")

    def arm(self) -> Telemetry | None:
        """Arm the car, for the loop's hooks. Raises RoverError if that is refused; it may then be called again."""
        with ExitStack() as recording, ExitStack() as driving:

            def prepare() -> None:
                driving.enter_context(self._planner.without_rest())
                if folder := self._options.record:
                    self._recorder = TakeoverRecorder(recording.enter_context(self._recorder_in(folder)), self._mode)
                driving.enter_context(boost_priority(self._log))

            self._armed = arm_by_plan(
                self._link, self._planner, self._pilot, self._settings, self._log.event, self._still_wanted, prepare
            )
            self._driving, self._recording = driving.pop_all(), recording.pop_all()
        return self._armed

    def record(self, *row: Any, **columns: Any) -> None:
        """Write a command into the episode, for the loop's hooks."""
        if self._recorder:
            self._recorder.command(*row, **columns)

    def record_human(self, link: ServoLink, stop: threading.Event, over: Callable[[], str | None]) -> None:
        """After a takeover in a recorded drive, record the human until TakeoverRecorder.human() ends.

        Raises nothing: the human has the car, and opening the port again might take it away from them.
        """
        if not self._recorder:
            return
        self._driving.close()  # the host no longer drives: ordinary priority, and one plan per second
        recorder = self._recorder.recorder
        self._log.event(TAKEN_OVER)
        try:
            takeover = self._recorder.human(link, self._armed, rate_hz=self._options.hz, stop=stop, over=over)
            recorder.note(takeover=vars(takeover))
            self._log.event(str(takeover))
            recorder.close(takeover.ended if takeover.fault else None)
        except Exception as error:
            self._log.event(f"the human is not recorded: {sentence_of(error)}", level=logging.ERROR)

    def _recorder_in(self, folder: Path) -> Recorder:
        port, car = (self._link.port, self._link.car) if self._link else ("", this_car())
        about = About(f"driven by {self._mode}", arduino_port=port, source="rover drive", car=car)
        return Recorder(folder, self._camera, about, rate_hz=self._options.hz, most_bytes=self._room)
