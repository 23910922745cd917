"""A pilot says what to send at each tick of the control loop: here, by a policy's plans."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from rover_lib.onboard.car.camera import Camera, Frame
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.drive.inference import Planner
from rover_lib.onboard.drive.motion import Motion
from rover_lib.onboard.drive.plan import STOP, WARN, Commanded, Follower, Plan, Settings, is_unfamiliar
from rover_lib.onboard.errors import CameraError, DriveFault, PolicyError, RoverError

FIRST_PLAN_S = 10.0
MOVING = 0.004  # throttle above which a car moves, so that it matters what it sees
COASTS_S = 0.5  # a car whose throttle is released rolls on for this time
BEGINS_S = 0.12  # a car that is told to go may see the same picture for this time: it stops 0.2 s after it was told
LATE_FRAME_S = 0.2  # six frames of a camera
# The newest picture may be this old: with a tick of 33 ms, the car stops within 0.2 s of a camera's last picture. A
# camera at 15 Hz, whose pictures arrive 50 ms late, shows ones of 117 ms.
MISSING_S = 0.14
LATE_WARNING_S = 0.1
READ_S = 0.005  # time for the camera's thread, after a pause of the whole process
CUT = 0.005  # of throttle; less is rounding and blending
RECORD_HERE = "record here and train, or set drive.unfamiliar in params.yml"
CAP = "is there a cap or dirt on the lens?"
HOLE_S = 0.3  # a gap between actions after which another episode has begun


@dataclass(frozen=True)
class Order:
    """What to send at a tick, and where it comes from.

    plan: its number, 0 without one. age_s, latency_s, fade: of that plan. frame: number of the camera's newest frame, 0
    without one. strange: Follower.strange.
    """

    steering: float
    throttle: float
    steering_us: int
    throttle_us: int
    plan: int = 0
    age_s: float | None = None
    latency_s: float | None = None
    fade: float = 1.0
    frame: int = 0
    strange: float | None = None


class Pilot(Protocol):
    """Something that says what to send at each tick."""

    def ready(self, stop: threading.Event) -> None:
        """Wait until there is something to drive by, or `stop` is set. Raises RoverError if it does not come."""

    def order(self, now_s: float) -> Order | None:
        """Return the order for this tick; None if the drive is done. Raises RoverError for what must stop the car."""

    def sent(self, at_s: float, order: Order) -> None:
        """Take note that the order was sent at that time."""


class Sight:
    """Judges whether the car may drive by what the camera shows."""

    def __init__(self, camera: Camera, settings: Settings):
        self._camera = camera
        self._settings = settings
        self._moving_s: float | None = None  # since when the car has been moving
        self._throttle_s = 0.0  # when it was last told to move
        self._blank_s: float | None = None  # since when the picture has been blank
        self._motion = Motion(settings.stuck_s)
        self._throttle = 0.0

    def check(self) -> None:
        """Raise CameraError if nobody may drive by the newest frame: it is frozen, black, without contrast or none."""
        frame = self._camera.latest()
        if not frame:
            raise CameraError("the camera has given no picture")
        if fault := frozen(frame, self._settings) or blank(frame, self._settings):
            raise fault

    def sent(self, at_s: float, throttle: float) -> None:
        """Take note that this throttle was sent: if it moves the car, the pictures must change from then on."""
        self._throttle = throttle
        if abs(throttle) > MOVING:
            self._throttle_s = at_s
            if self._moving_s is None:
                self._moving_s = at_s
        elif at_s - self._throttle_s > COASTS_S:
            self._moving_s = None

    def watch_motion(self, frame: Frame) -> None:
        """Raise DriveFault if the car stands although the throttle is on. For whoever drives it, not for a human."""
        self._motion.watch(frame, self._throttle)

    def watch(self, frame: Frame, now_s: float) -> None:
        """Raise CameraError if the newest frame is old, or frozen while the car moves, or blank for too long."""
        if now_s - frame.captured_s > MISSING_S:
            frame = self._camera.wait(frame.number, READ_S) or frame
            if (age_s := now_s - frame.captured_s) > MISSING_S:
                raise CameraError(f"no new frame for {age_s:.2f} s", remedy="is the camera plugged in?")
        moves = self._moving_s is not None and now_s - self._moving_s > BEGINS_S
        if moves and (fault := frozen(frame, self._settings)):
            raise fault
        fault = blank(frame, self._settings)
        if not fault:
            self._blank_s = None
            return
        if self._blank_s is None:
            self._blank_s = frame.captured_s
        if frame.captured_s - self._blank_s >= (self._settings.black_frames - 1.5) / self._camera.wanted_hz:
            raise fault


class PolicyPilot:
    """Drives by a policy's plans, and watches the camera that they come from. rate_hz: steps of a plan per second."""

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
        self._camera = camera
        self._planner = planner
        self._commanded = commanded
        self._settings = settings
        self._calibration = calibration or PwmCalibration()
        self._follower = Follower(settings, rate_hz)
        self.sight = Sight(camera, settings)
        self._frame_age_s = self._asking_s = 0.0  # the longest since the last warnings()
        self._cut = 0.0  # the most throttle that the limit has taken away, not said yet
        self._said_cut = self._said_strange = False

    @property
    def plan(self) -> tuple[Plan, float] | None:
        """The plan in use and its steps per second; None before the first plan."""
        plan = self._follower.plan
        return (plan, self._follower.rate_hz) if plan else None

    def ready(self, stop: threading.Event) -> None:
        end = time.monotonic() + FIRST_PLAN_S
        while self._planner.wait(0.1) is None and not stop.is_set():
            if time.monotonic() > end:
                raise PolicyError(f"no plan within {FIRST_PLAN_S:g} s", remedy="does 'rover benchmark' run on it?")

    def order(self, now_s: float) -> Order:
        frame = self._camera.latest()
        if frame:
            self._frame_age_s = max(self._frame_age_s, now_s - frame.captured_s)
            self.sight.watch(frame, now_s)
            self.sight.watch_motion(frame)
        self._asking_s = max(self._asking_s, self._planner.asking_s)
        if plan := self._planner.newest():
            self._follower.add(plan, now_s)
        command = self._follower.command(now_s)
        if command is None:
            if self._follower.strange_s is not None:
                raise DriveFault(unfamiliar(self._follower.strange), remedy=RECORD_HERE)
            why = f"the policy has not answered for {self._planner.asking_s:.1f} s"
            raise DriveFault(f"the newest plan is too old to drive by ({self._follower.stop_s():g} s): {why}")
        self._cut = max(self._cut, command.cut)
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
            self._follower.strange,
        )

    def check(self) -> None:
        """Raise RoverError if nobody may drive by the newest picture, or it is unfamiliar to the policy."""
        self.sight.check()
        plan = self._planner.newest()
        if plan and plan.strange is not None and is_unfamiliar(plan.strange) and self._settings.unfamiliar == STOP:
            raise RoverError(unfamiliar(plan.strange), remedy=RECORD_HERE, kind="not armed")

    def sent(self, at_s: float, order: Order) -> None:
        self._commanded.add(at_s, order.steering, order.throttle)
        self.sight.sent(at_s, order.throttle)

    def warnings(self) -> Iterator[str]:
        """Yield sentences about how late camera and policy were since the last call."""
        age_s = self._frame_age_s
        asking_s = self._asking_s
        plan = self._follower.plan
        self._frame_age_s = self._asking_s = 0.0
        if self._cut > CUT and not self._said_cut:
            self._said_cut = True
            limit = self._settings.throttle_limit
            yield f"the policy asks for throttle {limit + self._cut:.2f}, cut at throttle_limit {limit:g} (params.yml)"
        if self._follower.strange_s is not None and self._settings.unfamiliar == WARN and not self._said_strange:
            self._said_strange = True
            yield unfamiliar(self._follower.strange)
        if age_s > LATE_WARNING_S:
            yield f"no new frame for {age_s:.2f} s"
        if plan and asking_s > LATE_FRAME_S + 1.5 * plan.latency_s:
            yield f"the policy took {asking_s:.2f} s or more, for the plan before {plan.latency_s:.2f} s"


def unfamiliar(strange: float | None) -> str:
    """Return the sentence for pictures that the policy has seen nothing like. strange: the smoothed Plan.strange."""
    return f"the policy has seen nothing like these pictures ({strange or 0:.2f} of its limit)"


def frozen(frame: Frame, settings: Settings) -> CameraError | None:
    """Return an error if the pictures have stopped changing. It matters only while the car moves."""
    count = frame.repeats + 1
    if count < settings.frozen_frames:
        return None
    return CameraError(f"the camera is frozen: {count} frames showed nothing new", remedy="plug it in again")


def blank(frame: Frame, settings: Settings) -> CameraError | None:
    """Return an error if this frame is black or without contrast."""
    if frame.mean < settings.black_level:
        return CameraError(f"the camera's picture is black (mean {frame.mean:.1f} of 255)", remedy=CAP)
    if frame.contrast < settings.flat_level:
        return CameraError(f"nothing is on the camera's picture (contrast {frame.contrast:.1f} of 255)", remedy=CAP)
    return None
