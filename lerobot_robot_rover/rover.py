"""The rover as a robot of LeRobot: its camera, and its Arduino with all limits of `rover drive`."""

import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_rover.line import ACTIONS, CarPart, line_to, named, unnamed
from lerobot_robot_rover.ride import RATE_HZ, Ride
from lerobot_robot_rover.rollout import check_rollout, find_rollout
from rover_lib.onboard.car.camera import Camera, check_shape, size_like
from rover_lib.onboard.car.car import this_car
from rover_lib.onboard.car.host import boottime, default_log
from rover_lib.onboard.car.pwm import NEUTRAL
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.drive.flight_log import FlightLog, log_limits
from rover_lib.onboard.drive.pilot import HOLE_S, LATE_FRAME_S, Sight
from rover_lib.onboard.drive.plan import Plan, Settings
from rover_lib.onboard.drive.session import arm_when_ready
from rover_lib.onboard.errors import CameraError, PolicyError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.preprocess import prepare_frame


@RobotConfig.register_subclass("rover")
@dataclass(kw_only=True)
class RoverConfig(RobotConfig):
    """The rover's settings in LeRobot.

    port: of the Arduino. camera: a number, /dev/videoN, csi, or a FIFO of JPEGs. camera_name: of
    `observation.images.<camera_name>`. width, height: of the pictures that LeRobot gets, in pixels. throttle_limit: in
    [0, 1]; None: that of params.yml. log: file of the flight log; None: where `rover drive` writes it.
    """

    port: str = "/dev/ttyUSB0"
    camera: str = "0"
    camera_name: str = "cam_front"
    width: int = 640
    height: int = 360
    throttle_limit: float | None = None
    log: Path | None = None


class Rover(CarPart, Robot):
    """A car with a camera and an Arduino, as LeRobot's commands drive and record it. For one thread at a time.

    With a `rover_transmitter` on the same port the human drives, and nothing is sent. Otherwise send_action() arms the
    car, for which a human must make the gesture each time. When no action comes for 0.1 s, it is stopped and disarmed.
    """

    config_class = RoverConfig
    name = "rover"

    def __init__(self, config: RoverConfig):
        super().__init__(config)
        self.config = config
        self.settings = Settings.of(params()["drive"], throttle_limit=config.throttle_limit)
        self.cameras: dict[str, Camera | None] = {config.camera_name: None}  # LeRobot counts them
        self._line = line_to(config.port)
        self._open: ExitStack | None = None
        self._ride: Ride | None = None

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """The state, which is the previous action, and the camera's picture, (height, width, 3)."""
        return {**self.action_features, self.config.camera_name: (self.config.height, self.config.width, 3)}

    @property
    def is_connected(self) -> bool:
        return self._open is not None

    def connect(self, calibrate: bool = True) -> None:
        """Open camera and Arduino, and without a `rover_transmitter` wait until a human has made the gesture.

        Nothing is armed yet: the first action does that. Raises CameraError, LinkError or CarError for what is not
        there, ParamsError for options that a car cannot take, and DeviceAlreadyConnectedError.
        """
        if self._open:
            raise DeviceAlreadyConnectedError(f"the rover at {self.config.port} is connected already")
        if rollout := find_rollout():
            check_rollout(rollout)
        with ExitStack() as stack:
            self._log = stack.enter_context(self._flight_log())
            size = self.config.width, self.config.height
            self._camera = stack.enter_context(Camera(self.config.camera, size=size_like(*size)))
            if frame := self._camera.latest():
                check_shape(self.config.camera, frame.image, size)
            self._link: ServoLink = self._line.open()
            stack.callback(self._line.close)
            stack.callback(self._end_ride)
            self.cameras[self.config.camera_name] = self._camera
            stack.callback(self.cameras.update, {self.config.camera_name: None})
            self._sight = Sight(self._camera, self.settings)
            self._seen = 0  # number of the newest frame that LeRobot was given
            self._captured_s = self._looked_s = 0.0
            self._action = NEUTRAL
            self._acted_s = 0.0
            if not self._line.transmitters:
                self._wait_for_human()
            self._line.before_drive = self._wait_for_human
            stack.callback(setattr, self._line, "before_drive", None)
            self._open = stack.pop_all()

    def get_observation(self) -> dict[str, Any]:
        """Return the newest picture, (height, width, 3) uint8 RGB, and steering and throttle of the previous action.

        Waits for a picture that LeRobot has not seen, and for the human's gesture if the car is not armed. Raises
        CameraError for a camera that stopped, froze or shows nothing, LinkError, and DriveFault for what ended a drive.
        """
        self._check_connected()
        if self._ride:
            self._ride.check()
        if self._ride and self._ride.over:
            self._end_ride()
            self._action = NEUTRAL
        if not self._ride:
            self._link.latest()
            if not self._line.transmitters:
                self._wait_for_human()
        frame = self._next_frame()
        now_s = time.monotonic()
        if not self._ride:
            self._sight.watch(frame, now_s)
        if now_s - self._acted_s > HOLE_S:  # another episode
            self._action = NEUTRAL
        self._seen = frame.number
        self._captured_s = frame.captured_s
        self._looked_s = boottime()
        picture = prepare_frame(frame.image, self.config.height, self.config.width)
        return {**named(*self._action), self.config.camera_name: picture}

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Drive by an action and return what the car was told. A human's own action is not sent: the car follows them.

        action: finite steering and throttle, at most 0.25 beyond an end of their range, to which they are clipped.
        Raises PolicyError for other actions, LinkError if arming is refused, and what ended the drive.
        """
        self._check_connected()
        steering, throttle = self._valid(action)
        if self._line.humans_action:
            self._line.humans_action = False
            self._end_ride()
            self._sight.sent(time.monotonic(), throttle)
        else:
            limit = self.settings.throttle_limit
            steering, throttle = self._driven(steering, max(min(throttle, limit), -limit))
        self._action = (steering, throttle)
        self._acted_s = time.monotonic()
        return named(*self._action)

    def disconnect(self) -> None:
        """Send neutral, then close everything. Raises DeviceNotConnectedError."""
        self._check_connected()
        opened = self._open
        self._open = None
        opened.close()  # type: ignore[union-attr]  # it is connected

    def _check_connected(self) -> None:
        if not self._open:
            raise DeviceNotConnectedError(f"the rover at {self.config.port} is not connected: connect() first")

    def _flight_log(self) -> FlightLog:
        (max_bytes, keep), path = log_limits(), self.config.log or default_log()
        header = {"artifact": "LeRobot", "hz": RATE_HZ, **vars(self.settings), "car": this_car().description()}
        return FlightLog(path, header=header, max_bytes=max_bytes, keep=keep)

    def _wait_for_human(self) -> None:
        """Wait until the car can be armed, unless it is being driven."""
        if self._ride and not self._ride.over:
            return
        arm_when_ready(lambda: None, self._link, threading.Event(), self._log.event, [self._camera.latest])

    def _next_frame(self) -> Any:
        newest = self._camera.latest()
        after = self._seen
        if newest and time.monotonic() - newest.captured_s > LATE_FRAME_S:  # nobody asked for a while
            after = max(after, newest.number)
        if frame := self._camera.wait(after, LATE_FRAME_S):
            return frame
        raise CameraError(f"{self.config.camera}: no new frame for {LATE_FRAME_S:g} s", remedy="is it plugged in?")

    def _valid(self, action: dict[str, Any]) -> tuple[float, float]:
        """Return steering and throttle, checked and clipped as at the last boundary of `rover drive`."""
        action = unnamed(action)
        try:
            values = np.array([[float(action.pop(name)) for name in ACTIONS]])
        except (KeyError, TypeError, ValueError, OverflowError):
            raise PolicyError("an action needs numbers as steering and throttle", found=repr(action)[:80]) from None
        if action:
            raise PolicyError("an action of the rover is steering and throttle alone", found=sorted(map(str, action)))
        steering, throttle = Plan(0, 0.0, 0.0, values, self._link.car.limits).actions[0].tolist()
        return steering, throttle

    def _driven(self, steering: float, throttle: float) -> tuple[float, float]:
        """Drive by an action, and return what was sent: neutral if its picture was too old."""
        if self._ride:
            self._ride.put(steering, throttle)
            return steering, throttle
        self._camera.latest()  # raises if it failed
        age_s = max(time.monotonic() - self._captured_s, boottime() - self._looked_s)
        if age_s > self.settings.stop_s:
            self._log.event(f"an action came {age_s:.1f} s after its picture, and was not driven by")
            return NEUTRAL
        self._ride = Ride(self._camera, self._link, self.settings, self._log)
        try:
            self._ride.begin(steering, throttle)
        except BaseException:  # Ctrl-C too
            self._end_ride()
            raise
        return steering, throttle

    def _end_ride(self) -> None:
        if self._ride:
            self._ride.end()
        self._ride = None
