"""A whole drive: open all devices in order, run the control loop, and close everything in reverse order.

    report = Report()
    drive_car(DriveOptions(artifact=Path("policy_static.pt"), camera="0", port="/dev/ttyUSB0"), report)

The loop itself is in loop.py, and what the car does at a tick in pilot.py.
"""

import contextlib
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from rover_lib.onboard.artifact.manifest import Artifact, car_of, seen_size
from rover_lib.onboard.car.camera import Camera, check_shape, path_of, size_like
from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.car.host import boottime, default_log, default_view
from rover_lib.onboard.car.servo_link import ServoLink, Telemetry
from rover_lib.onboard.drive.feed import Feed
from rover_lib.onboard.drive.flight_log import FlightLog, log_limits
from rover_lib.onboard.drive.inference import Planner, PolicyProcess, delay
from rover_lib.onboard.drive.loop import Arm, Hooks, Report, Until, Warnings, drive
from rover_lib.onboard.drive.pilot import Pilot, PolicyPilot, ReplayPilot
from rover_lib.onboard.drive.plan import Commanded, Settings
from rover_lib.onboard.drive.service import CHECK_S, NotArmed, Service, check_age
from rover_lib.onboard.drive.takeover import TakeoverRecorder
from rover_lib.onboard.drive.watch import (
    HealthWatch,
    MemoryWatch,
    artifact_changes,
    boost_priority,
    exit_if_hung,
    find_unfinished_drive,
    stop_on_signals,
)
from rover_lib.onboard.errors import CameraError, DriveFault, ParamsError, TakenOver, sentence_of
from rover_lib.onboard.params import params
from rover_lib.onboard.recording.episode import About, Controls, read_car_of, read_controls
from rover_lib.onboard.recording.recorder import Recorder, room_for
from rover_lib.onboard.signal_event import SignalEvent
from rover_lib.onboard.status_line import StatusLine

WAIT_S = 30.0  # for a human, from the command that asks for the car; the Arduino refuses an arming after 31
REST_S = 1.0  # between plans while the car is not driving
TAKEN_OVER = "the human drives, and is recorded until the sticks are let go"


class OtherCar(Protocol):
    """A car to drive instead of the one at the options' camera and port, such as a simulated one."""

    camera: str
    port: str

    def summary(self) -> dict[str, Any]:
        """Return what happened to the car, for the drive's report."""


@dataclass(frozen=True)
class DriveOptions:
    """The options of `rover drive`. There is either an artifact or a replay.

    hz: commands per second. dry_run: no motor is driven. record: folder in which an episode is written. record_mb: how
    much all episodes in it may take together; None: limited by the disk. max_seconds, ticks: when to end.
    throttle_limit, blend_ticks, ensemble: replace the values of params.yml. threads: of the policy; None: all cores but
    one. log_file: None: the user's. replay: an episode whose pulses are sent. service: run as a systemd service,
    disarmed until a human arms it. film: the camera may be recorded pictures (a folder, a FIFO, an .mjpeg), which do
    not show where the car is. latency_ms: make each plan take at least this long, for comparisons. view: the socket of
    a view; None: the user's.
    """

    artifact: Path | None = None
    camera: str = "0"
    port: str = ""
    hz: float = 30.0
    dry_run: bool = False
    record: Path | None = None
    record_mb: float | None = None
    max_seconds: float | None = None
    ticks: int | None = None
    throttle_limit: float | None = None
    blend_ticks: int | None = None
    ensemble: float | None = None
    threads: int | None = None
    log_file: Path | None = None
    replay: Path | None = None
    service: bool = False
    film: bool = False
    latency_ms: float = 0.0
    view: Path | None = None


def check_no_film(camera: str) -> None:
    """Raise CameraError for pictures that do not come from a camera's device."""
    path = path_of(camera)
    if path.exists() and not path.is_char_device():
        raise CameraError(
            f"{camera}: recorded pictures know nothing of where the car is",
            remedy="give the camera's /dev/videoN, or --film if this is no real car",
        )


def drive_car(
    options: DriveOptions, report: Report, car: Callable[[], AbstractContextManager[OtherCar]] | None = None
) -> None:
    """Drive as the options say, in this process's main thread. Raises as loop.drive() does.

    report: filled during the drive, so that it is complete even after a fault. car: opens a car that is driven instead
    of the one at the options' camera and port. As a service, this drives each time that a human arms the car, until it
    is told to stop.
    """
    settings = Settings.of(
        params()["drive"],
        throttle_limit=options.throttle_limit,
        blend_ticks=options.blend_ticks,
        ensemble=options.ensemble,
    )
    this = this_car()
    controls = read_controls(options.replay) if options.replay else None
    if options.replay and not (recorded := read_car_of(options.replay)).drives_like(this):
        raise ParamsError(
            f"{options.replay}: its pulses are of another car",
            found=f"{recorded.name!r} there, and this car is {this.name!r}",
            remedy="replay one of this car's",
        )
    path = options.artifact.resolve() if options.artifact else None  # `current` may point to another one later
    with ExitStack() as stack:
        artifact = stack.enter_context(Artifact(path)) if path else None
        seen = seen_size(artifact.manifest) if artifact else (0, 0)  # read first: it may be missing, or no artifact
        if not (controls or car or options.dry_run or options.film):
            check_no_film(options.camera)
        log = stack.enter_context(_open_flight_log(options, settings, report))
        if path:
            most_m = settings.throttle_limit * params()["view"]["speed_mps"] * settings.blind_s
            log.event(f"one picture drives the car for {most_m:.1f} m at most, at throttle {settings.throttle_limit:g}")
        stop = SignalEvent()
        stack.enter_context(stop_on_signals(stop, log))
        stack.enter_context(exit_if_hung(report, log))
        if car:
            other = stack.enter_context(car())
            options = replace(options, camera=other.camera, port=other.port)
            stack.callback(lambda: report.world.update(other.summary()))
        service = None
        if options.service and artifact:
            service = stack.enter_context(Service(report, stop, log.event, model=artifact.content_hash))
        title = (options.artifact or options.replay or Path()).name
        feed = stack.enter_context(contextlib.closing(Feed(options.view or default_view(), log, title)))
        over = _first_of(*([service.over] if service else []), feed.over)
        until = Until(options.ticks, options.max_seconds, stop, over)
        link = None if options.dry_run else stack.enter_context(ServoLink(options.port, car=this))
        opened = _Opened(options, settings, report, log, feed, link, until)
        if controls:
            _replay(opened, controls)
        elif artifact:
            _drive_by(artifact, seen, opened, service)
        else:
            raise ParamsError("a drive needs an artifact or a replay")


@dataclass(frozen=True)
class _Opened:
    """All that every kind of drive has opened. link: None: no motor is driven."""

    options: DriveOptions
    settings: Settings
    report: Report
    log: FlightLog
    feed: Feed
    link: ServoLink | None
    until: Until

    def run(self, pilot: Pilot, hooks: Hooks) -> None:
        """Run the control loop for one drive. Raises as loop.drive() does."""
        rate_hz, report = self.options.hz, self.report
        drive(pilot, self.link, self.log, rate_hz=rate_hz, until=self.until, hooks=hooks, report=report)


def _replay(opened: _Opened, controls: Controls) -> None:
    """Send the pulses of a recording."""
    options, report, log, link = opened.options, opened.report, opened.log, opened.link
    limit = 1.0 if options.throttle_limit is None else options.throttle_limit
    pilot = ReplayPilot(controls, throttle_limit=limit, calibration=this_car().pwm)
    arm: Arm | None = None
    if link:
        arm = partial(arm_capped, link, limit, pilot.most_throttle, log.event)
        if sys.stdin.isatty():
            arm = partial(arm_when_ready, arm, link, opened.until.stop, log.event)
    warnings = _all_of(HealthWatch(report, link), MemoryWatch(report, [os.getpid()]))
    try:
        with boost_priority(log):
            opened.run(pilot, Hooks(arm, warnings, show=partial(opened.feed.tick, report, None, None)))
    finally:
        opened.feed.ended(report, None, link)


def _drive_by(artifact: Artifact, seen: tuple[int, int], opened: _Opened, service: Service | None) -> None:
    """Drive by an artifact's plans: once, or as a service each time that a human arms the car.

    seen: (width, height) of the pictures that the policy was made with.
    """
    options, report, log, link, feed = opened.options, opened.report, opened.log, opened.link, opened.feed
    this, stop = this_car(), opened.until.stop
    with ExitStack() as stack:
        camera = stack.enter_context(Camera(options.camera, size=size_like(*seen), held=options.film))
        if (frame := camera.latest()) and not path_of(options.camera).is_dir():  # a folder is of an episode, for a look
            check_shape(options.camera, frame.image, seen)
        policy = stack.enter_context(PolicyProcess(artifact, threads=options.threads))
        if policy.unconfined:
            log.event(f"the policy's process is not confined: {policy.unconfined}", level=logging.WARNING)
        predict = delay(policy.predict, options.latency_ms / 1e3) if options.latency_ms else policy.predict
        commanded = Commanded()
        planner = stack.enter_context(
            Planner(camera, predict, commanded, policy.rate_hz, rest_s=REST_S, limits=this.limits)
        )
        if sentence := another_car(policy.manifest, this):
            log.event(sentence, level=logging.WARNING)
        said = ""

        def show_waiting() -> None:
            asked = feed.over()  # a waiting service ignores a stop from the view: it is disarmed anyway
            feed.waiting(report, camera, link, said)
            if asked and not service:
                raise NotArmed(asked)

        def human_over() -> str | None:
            if service:
                service.alive()
            report.status = TAKEN_OVER
            feed.taken_over(report, camera, link, TAKEN_OVER)
            return feed.over()

        checks = [camera.latest, planner.newest, *([link.latest] if link else []), show_waiting]
        while True:
            pilot = PolicyPilot(camera, planner, commanded, opened.settings, policy.rate_hz, calibration=this.pwm)
            warnings = _all_of(
                artifact_changes(artifact.path),
                pilot.warnings,
                HealthWatch(report, link),
                MemoryWatch(report, [os.getpid(), *policy.pids]),
            )
            with _Arming(opened, planner, camera, policy.manifest["mode"], pilot) as attempt:
                report.clear()
                arm: Arm = attempt.arm
                if service and link:
                    attempt.still_wanted = service.check_request
                    arm = partial(
                        service.wait_for_human, attempt.arm, checks, partial(what_is_missing, link), said=said
                    )
                elif link and sys.stdin.isatty():
                    arm = partial(arm_when_ready, attempt.arm, link, stop, log.event, checks)
                show = partial(feed.tick, report, camera, pilot)
                record = attempt.record if options.record else None
                try:
                    opened.run(pilot, Hooks(_arm_then(arm, camera.begin), warnings, record, show))
                except (DriveFault, TakenOver) as error:
                    if link and isinstance(error, TakenOver):
                        attempt.record_human(link, stop, human_over)
                    if not service:
                        raise
                finally:
                    feed.ended(report, camera, link)
            if not service or stop.is_set():
                return
            said = report.ended


def another_car(manifest: dict[str, Any], this: Car) -> str:
    """Return a warning if an artifact was calibrated for another car than this one, else "". It may drive all the same.

    An artifact that names no car is for the car of the original recordings.
    """
    meant = car_of(manifest)
    if meant.drives_like(this):
        return ""
    return (
        f"this policy was calibrated for {meant.name!r}, and this car is {this.name!r}: it has not seen what this one "
        "does; see that the way is free"
    )


def _arm_then(arm: Arm, begin: Callable[[], object]) -> Arm:
    """Return a function that arms and then calls begin(): a film must start with the loop, not while arming waits."""

    def armed() -> Telemetry | None:
        telemetry = arm()
        begin()
        return telemetry

    return armed


def what_is_missing(link: ServoLink) -> str:
    """Return what a human must do before the Arduino can be armed, "" if nothing. Raises LinkError as latest() does."""
    telemetry = link.latest()
    return link.remedy(telemetry.missing) if telemetry and telemetry.missing != "-" else ""


def arm_capped(
    link: ServoLink,
    limit: float,
    most: float,
    notify: Callable[[str], None],
    still_wanted: Callable[[], object] = lambda: None,
) -> Telemetry:
    """Arm a car, after the Arduino was told to limit the host's throttle to `limit`.

    limit, most: throttles in [0, 1]. most: the largest that this drive may ask for; `notify` is told if the Arduino
    allows less. still_wanted: raises if nobody wants the car armed any more. Raises what still_wanted raises, and
    LinkError as lower_cap() and arm() do.
    """
    channel = link.calibration.throttle
    directions = (limit, -limit) if channel.low < 0 else (limit,)
    farthest_us = max(map(channel.pulse_us, directions), key=lambda us: abs(us - channel.neutral_us))
    cap_us = link.lower_cap(farthest_us).cap_us
    span_us = abs(channel.pulse_us(most) - channel.neutral_us)
    if cap_us - channel.neutral_us < span_us:
        cap = most * (cap_us - channel.neutral_us) / span_us
        notify(
            f"the Arduino gives at most throttle {cap:.2f} ({cap_us} us), and this drive may ask for {most:.2f}: what "
            "is above is cut. A cap that another drive has lowered is back after a reset of the Arduino"
        )
    still_wanted()
    return link.arm()


def arm_when_ready(
    arm: Arm,
    link: ServoLink,
    stop: threading.Event,
    notify: Callable[[str], None],
    checks: Sequence[Callable[[], object]] = (),
    clock: Callable[[], float] = boottime,
) -> Telemetry | None:
    """Arm for a human who has just asked for it: say what is missing, wait for it for WAIT_S at most, and then arm.

    checks: called while waiting; each raises if its device fails. Raises NotArmed when told to stop or if something is
    missing for too long, what a check raises, and what arm() raises.
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
            raise NotArmed("told to stop before a human armed the car")
    check_age(clock() - asked_s, WAIT_S)
    return arm()


class _Arming:
    """Arms the car and prepares the drive: a camera that sees, real-time priority, a fresh plan, and a recorder.

    If arming is refused, all of that is undone. A context manager: leaving it ends what arming began. still_wanted: see
    arm_capped().
    """

    still_wanted: Callable[[], object] = staticmethod(lambda: None)

    def __init__(self, opened: _Opened, planner: Planner, camera: Camera, mode: str, pilot: PolicyPilot):
        options = opened.options
        self._options, self._settings, self._link, self._log = options, opened.settings, opened.link, opened.log
        self._planner, self._camera, self._mode, self._pilot = planner, camera, mode, pilot
        self._room: int | None = None
        if options.record and options.record_mb:
            self._room = room_for(options.record, options.record_mb)  # now, because it may take a while
        self._recorder: TakeoverRecorder | None = None
        self._armed: Telemetry | None = None
        self._driving, self._recording = ExitStack(), ExitStack()

    def __enter__(self) -> "_Arming":
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
        if self._link:
            self._link.request(keep=True)
        with ExitStack() as recording, ExitStack() as driving:
            driving.enter_context(self._planner.without_rest())
            if self._options.record:
                recorder = recording.enter_context(self._new_recorder(self._options.record))
                self._recorder = TakeoverRecorder(recorder, self._mode)
            driving.enter_context(boost_priority(self._log))
            self._planner.renew(self._settings.fade_s)
            self._pilot.check_sight()
            limit = self._settings.throttle_limit
            telemetry = None
            if self._link:
                telemetry = arm_capped(self._link, limit, limit, self._log.event, self.still_wanted)
            self._armed = telemetry
            self._driving, self._recording = driving.pop_all(), recording.pop_all()
        return telemetry

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

    def _new_recorder(self, folder: Path) -> Recorder:
        about = About(
            f"driven by {self._mode}",
            arduino_port=self._link.port if self._link else "",
            source="rover drive",
            car=self._link.car if self._link else this_car(),
        )
        return Recorder(folder, self._camera, about, rate_hz=self._options.hz, most_bytes=self._room)


def _first_of(*ends: Callable[[], str | None]) -> Callable[[], str | None]:
    """Combine several reasons to end a drive; the first that applies is returned."""
    return lambda: next((why for end in ends if (why := end())), None)


def _all_of(*sources: Warnings) -> Warnings:
    """Combine several sources of warnings."""

    def warnings() -> Iterator[str]:
        for source in sources:
            yield from source()

    return warnings


@contextlib.contextmanager
def _open_flight_log(options: DriveOptions, settings: Settings, report: Report) -> Iterator[FlightLog]:
    """Open a flight log whose events are also lines on the terminal, above the report's status."""
    (max_bytes, keep), path = log_limits(), options.log_file or default_log()
    header: dict[str, Any] = {"artifact": str(options.artifact or options.replay), "hz": options.hz, **vars(settings)}
    if not (car := this_car()).drives_like(Car()):
        header["car"] = car.description()
    with StatusLine(lambda: report.status, sys.stderr) as status:
        logging.basicConfig(level=logging.INFO, format="rover: %(message)s", handlers=[status.handler], force=True)
        unfinished = find_unfinished_drive(path)
        with FlightLog(path, header=header, max_bytes=max_bytes, keep=keep) as log:
            if unfinished:
                log.event(unfinished, level=logging.WARNING)
            yield log
