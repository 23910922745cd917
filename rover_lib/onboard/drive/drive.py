"""A whole drive: open all devices in order, arm and drive (session.py), and close everything in reverse order."""

import contextlib
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from typing import Any

from rover_lib.onboard.artifact.manifest import Artifact, car_of, seen_size
from rover_lib.onboard.car.camera import Camera, check_shape, size_like
from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.car.host import default_log, default_view
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.drive.feed import Feed
from rover_lib.onboard.drive.flight_log import FlightLog, log_limits
from rover_lib.onboard.drive.inference import Planner, PolicyProcess
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.drive.plan import Commanded, Settings
from rover_lib.onboard.drive.service import Service
from rover_lib.onboard.drive.session import DriveOptions, Session
from rover_lib.onboard.drive.watch import exit_if_hung, stop_on_signals
from rover_lib.onboard.errors import CarError
from rover_lib.onboard.params import params
from rover_lib.onboard.signal_event import SignalEvent
from rover_lib.onboard.status_line import StatusLine

MIRRORED = "calibrate with recordings of this car, or LeRobot's where its car.yml is; see docs/build.md"
REST_S = 1.0  # between plans while the car is not driving


def drive_car(
    options: DriveOptions, report: Report, car: Callable[[], AbstractContextManager[Any]] | None = None
) -> None:
    """Drive as the options say, in this process's main thread. Raises as loop.drive() does.

    report: filled during the drive. car: opens another car, with a camera, a port and a summary() for the report.
    As a service, this drives each time that a human arms the car, until it is told to stop.
    """
    settings = Settings.of(params()["drive"], throttle_limit=options.throttle_limit)
    with ExitStack() as stack:
        # Resolved: `current` may point to another one later. Opened first: it may be missing, or no artifact.
        artifact = stack.enter_context(Artifact(options.artifact.resolve()))
        size = seen_size(artifact.manifest)
        warning = another_car(artifact.manifest, this_car())
        log = stack.enter_context(open_flight_log(options, settings, report))
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
        if options.service:
            service = stack.enter_context(Service(report, stop, log.event, model=artifact.content_hash))
        place = options.view or default_view()
        feed = stack.enter_context(contextlib.closing(Feed(place, log, options.artifact.name)))
        link = None if options.dry_run else stack.enter_context(ServoLink(options.port, car=this_car()))
        camera = stack.enter_context(Camera(options.camera, size=size_like(*size)))
        if frame := camera.latest():
            check_shape(options.camera, frame.image, size)
        policy = stack.enter_context(PolicyProcess(artifact, threads=options.threads))
        if policy.unconfined:
            log.event(f"the policy's process is not confined: {policy.unconfined}", level=logging.WARNING)
        if warning:
            log.event(warning, level=logging.WARNING)
        commanded = Commanded()
        planner = Planner(
            camera, policy, commanded,
            rest_s=REST_S, latency_s=options.latency_ms / 1e3, limits=this_car().limits,
        )  # fmt: skip
        stack.enter_context(planner)
        session = Session(
            options, settings, report, log, feed, link, camera, planner, commanded,
            rate_hz=policy.rate_hz, mode=policy.manifest["mode"], service=service, terminal=sys.stdin.isatty(),
        )  # fmt: skip
        session.drive(stop)
        while service and not stop.is_set():
            session.drive(stop, said=report.ended)


def another_car(manifest: dict[str, Any], this: Car) -> str:
    """Return a warning if an artifact was calibrated for another car, else "". It may drive all the same.

    Raises CarError if positive steering turns the other car to the other side, so that this one would steer mirrored.
    """
    meant = car_of(manifest)
    if meant.positive != this.positive:
        raise CarError(f"this policy would steer mirrored: {meant.unlike(this)}", remedy=MIRRORED)
    if meant.drives_like(this):
        return ""
    return f"this policy was calibrated for {meant.name!r}, and this car is {this.name!r}: see that the way is free"


@contextlib.contextmanager
def open_flight_log(options: DriveOptions, settings: Settings, report: Report) -> Iterator[FlightLog]:
    """Open a flight log whose events are also lines on the terminal, above the report's status."""
    (max_bytes, keep), path = log_limits(), options.log_file or default_log()
    header: dict[str, Any] = {"artifact": str(options.artifact), "hz": options.hz, **vars(settings)}
    if not (car := this_car()).drives_like(Car()):
        header["car"] = car.description()
    with StatusLine(lambda: report.status) as status:
        logging.basicConfig(level=logging.INFO, format="rover: %(message)s", handlers=[status], force=True)
        with FlightLog(path, header=header, max_bytes=max_bytes, keep=keep) as log:
            yield log
