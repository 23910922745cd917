"""A whole drive: open all devices in order, run the control loop, and close everything in reverse order.

    report = Report()
    drive_car(DriveOptions(artifact=Path("policy_static.pt"), camera="0", port="/dev/ttyUSB0"), report)

The loop itself is in loop.py, what the car does at a tick in pilot.py, and how it is armed in arming.py.
"""

import contextlib
import logging
import os
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from functools import partial

from rover_lib.onboard.artifact.manifest import Artifact, seen_size
from rover_lib.onboard.car.camera import Camera, check_shape, path_of, size_like
from rover_lib.onboard.car.car import this_car
from rover_lib.onboard.car.host import default_view
from rover_lib.onboard.car.servo_link import ServoLink, Telemetry
from rover_lib.onboard.drive.arming import TAKEN_OVER, Arming, arm_when_asked
from rover_lib.onboard.drive.feed import TAKEN, WAITING, Feed
from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.drive.inference import Planner, PolicyProcess
from rover_lib.onboard.drive.loop import Hooks, Report, Until, drive
from rover_lib.onboard.drive.opening import DriveOptions, OtherCar, another_car, check_no_film, open_flight_log
from rover_lib.onboard.drive.pilot import PolicyPilot
from rover_lib.onboard.drive.plan import Commanded, Settings
from rover_lib.onboard.drive.service import Service
from rover_lib.onboard.drive.watch import HealthWatch, exit_if_hung, stop_on_signals
from rover_lib.onboard.errors import DriveFault, RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.signal_event import SignalEvent

REST_S = 1.0  # between plans while the car is not driving


def drive_car(
    options: DriveOptions, report: Report, car: Callable[[], AbstractContextManager[OtherCar]] | None = None
) -> None:
    """Drive as the options say, in this process's main thread. Raises as loop.drive() does.

    report: filled during the drive, so that it is complete even after a fault. car: opens a car that is driven instead
    of the one at the options' camera and port. As a service, this drives each time that a human arms the car, until it
    is told to stop.
    """
    given = {name: getattr(options, name) for name in ("throttle_limit", "blend_ticks", "ensemble")}
    settings = Settings.of(params()["drive"], **given)
    with ExitStack() as stack:
        # Resolved: `current` may point to another one later. Opened first: it may be missing, or no artifact.
        artifact = stack.enter_context(Artifact(options.artifact.resolve()))
        seen = seen_size(artifact.manifest)
        if not (car or options.dry_run or options.film):
            check_no_film(options.camera)
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
        camera = stack.enter_context(Camera(options.camera, size=size_like(*seen), held=options.film))
        if (frame := camera.latest()) and not path_of(options.camera).is_dir():  # a folder is of an episode, for a look
            check_shape(options.camera, frame.image, seen)
        policy = stack.enter_context(PolicyProcess(artifact, threads=options.threads))
        if policy.unconfined:
            log.event(f"the policy's process is not confined: {policy.unconfined}", level=logging.WARNING)
        if sentence := another_car(policy.manifest, this_car()):
            log.event(sentence, level=logging.WARNING)
        commanded = Commanded()
        planner = Planner(
            camera, policy.predict, commanded, policy.rate_hz,
            rest_s=REST_S, latency_s=options.latency_ms / 1e3, limits=this_car().limits,
        )  # fmt: skip
        stack.enter_context(planner)
        opened = _Opened(options, settings, report, log, service, feed, link, camera, policy, planner, commanded)
        opened.drive(stop)
        while service and not stop.is_set():
            opened.drive(stop, said=report.ended)


@dataclass(frozen=True)
class _Opened:
    """All that a drive has opened. service: None: there is one drive. link: None: no motor is driven."""

    options: DriveOptions
    settings: Settings
    report: Report
    log: FlightLog
    service: Service | None
    feed: Feed
    link: ServoLink | None
    camera: Camera
    policy: PolicyProcess
    planner: Planner
    commanded: Commanded

    def drive(self, stop: SignalEvent, said: str = "") -> None:
        """Arm the car when somebody asks for it, and drive once. said: how the previous drive ended.

        Raises as loop.drive() does, but a service's drive may end by a fault or a takeover.
        """
        options, report, log, link, service = self.options, self.report, self.log, self.link, self.service
        rate_hz, pwm = self.policy.rate_hz, this_car().pwm
        pilot = PolicyPilot(self.camera, self.planner, self.commanded, self.settings, rate_hz, calibration=pwm)
        health = HealthWatch(report, link, [os.getpid(), *self.policy.pids])
        checks = [self.camera.latest, self.planner.newest, *([link.latest] if link else [])]
        checks.append(partial(self._show_waiting, said))
        with Arming(
            options, self.settings, link, log, self.planner, self.camera, pilot,
            mode=self.policy.manifest["mode"], still_wanted=service.check_request if service else lambda: None,
        ) as arming:  # fmt: skip
            report.clear()

            def arm() -> Telemetry | None:
                telemetry = arm_when_asked(
                    arming.arm, link, stop, log.event, checks, service=service, said=said, terminal=sys.stdin.isatty()
                )
                self.camera.begin()  # a film must start with the loop, not while arming waits
                return telemetry

            show = partial(self.feed.tick, report, self.camera, pilot)
            hooks = Hooks(arm, lambda: [*pilot.warnings(), *health()], arming.record if options.record else None, show)
            until = Until(options.ticks, options.max_seconds, stop, self._over)
            try:
                drive(pilot, link, log, rate_hz=options.hz, until=until, hooks=hooks, report=report)
            except DriveFault as error:
                if link and error.kind == "taken over":
                    arming.record_human(link, stop, self._human_over)
                if not service:
                    raise
            finally:
                self.feed.ended(report, self.camera, link)

    def _over(self) -> str | None:
        return (self.service.over() if self.service else None) or self.feed.over()

    def _show_waiting(self, said: str) -> None:
        asked = self.feed.over()  # a waiting service ignores a stop from the view: it is disarmed anyway
        self.feed.show(WAITING, said, self.report, self.camera, self.link)
        if asked and not self.service:
            raise RoverError(asked, kind="not armed")

    def _human_over(self) -> str | None:
        if self.service:
            self.service.alive()
        self.report.status = TAKEN_OVER
        self.feed.show(TAKEN, TAKEN_OVER, self.report, self.camera, self.link)
        return self.feed.over()
