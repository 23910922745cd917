"""Who says what to do at a tick of the control loop: a policy's plans, or a recording's pulses."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rover_lib.onboard.camera import Camera
from rover_lib.onboard.errors import DriveFault, PolicyError
from rover_lib.onboard.inference import Planner
from rover_lib.onboard.plan import Commanded, Follower, Settings
from rover_lib.onboard.pwm import PwmCalibration
from rover_lib.onboard.recording import Controls

FIRST_PLAN_S = 10.0
MOVING = 0.004  # throttle above which a car moves, and no two pictures are the same
LATE_FRAME_S = 0.2  # six frames of a camera
SLACK_S = 0.002  # a control of this much later is of the same tick: recordings have the ticks' rate, or close to it
HOLE_S = 0.3  # a gap between measured pulses after which a replay stops the car
LAST_S = 0.1  # how long a replay's last pulses are held


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
        self._frame_age_s = self._asking_s = 0.0  # the most, since warnings()

    def ready(self, stop: threading.Event) -> None:
        end = time.monotonic() + FIRST_PLAN_S
        while self._planner.wait(0.1) is None and not stop.is_set():
            if time.monotonic() > end:
                raise PolicyError(
                    f"no plan within {FIRST_PLAN_S:g} s", remedy="does 'rover benchmark' run on this artifact?"
                )

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

    def warnings(self) -> Iterator[str]:
        """A source of warnings: of camera and policy, since it was asked last."""
        age_s, asking_s, plan = self._frame_age_s, self._asking_s, self._follower.plan
        self._frame_age_s = self._asking_s = 0.0
        if age_s > LATE_FRAME_S:
            yield f"no new frame for {age_s:.2f} s"
        if plan and asking_s > LATE_FRAME_S + 1.5 * plan.latency_s:
            yield f"the policy took {asking_s:.2f} s or more, for the plan before {plan.latency_s:.2f} s"

    def _watch(self, captured_s: float, repeats: int, mean: float, now_s: float) -> None:
        limit, period_s = self._settings.frozen_frames, 1 / self._camera.wanted_hz
        moving_s = now_s - self._moving_s if self._moving_s is not None else 0.0
        if limit and repeats + 1 >= limit and moving_s > repeats * period_s:
            raise DriveFault(f"the camera is frozen: {repeats + 1} frames were the same while the car was driving")
        if mean >= self._settings.black_level or not self._settings.black_frames:
            self._black_s = None
            return
        self._black_s = captured_s if self._black_s is None else self._black_s
        if captured_s - self._black_s >= (self._settings.black_frames - 1.5) * period_s:
            raise DriveFault(
                f"the camera's picture is black (mean {mean:.1f} of 255)", remedy="is there a cap on the lens?"
            )


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
        if i >= len(self._times) - 1 and now_s - self._start_s > self._times[-1] + LAST_S:
            return None
        steering_us, throttle_us = int(self._steering[max(i, 0)]), int(self._throttle[max(i, 0)])
        if now_s - self._start_s - self._times[max(i, 0)] > HOLE_S:  # nobody knows what the human did meanwhile
            throttle_us = self._calibration.throttle.neutral_us
        actions = self._calibration.actions_from_pulses(steering_us, throttle_us)
        return Order(actions.steering or 0.0, actions.throttle or 0.0, steering_us, throttle_us)

    def sent(self, at_s: float, order: Order) -> None:
        pass
