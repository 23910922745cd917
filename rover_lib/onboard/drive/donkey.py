"""A part for donkeycar: an artifact drives in its vehicle loop, by plans used by time, and stops as `rover drive` does.

    V.add(RoverPilot("policy_static.pt", throttle_limit=0.3), outputs=["pilot/angle", "pilot/throttle"],
          inputs=["cam/image_array", "user/mode", "steering", "throttle"])

It does not import donkeycar, whose loop calls run() and shutdown(). No fault leaves run(): an exception would end that
loop, which then shuts its parts down one after the other, most often the throttle last.
"""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from rover_lib.onboard.artifact.manifest import car_of, seen_size
from rover_lib.onboard.car.camera import Camera, check_shape
from rover_lib.onboard.drive.drive import REST_S
from rover_lib.onboard.drive.inference import FRESH_S, Planner, PolicyProcess
from rover_lib.onboard.drive.pilot import MISSING_S, MOVING, PolicyPilot
from rover_lib.onboard.drive.plan import IN_FORCE_S, Commanded, Settings
from rover_lib.onboard.errors import DriveFault, PolicyError, RoverError, sentence_of
from rover_lib.onboard.params import params

USER = "user"  # donkeycar's mode in which a human drives
NEUTRAL = 0.0, 0.0  # angle, throttle
NEVER_BY_HAND = f"no human has driven yet; choose the mode '{USER}' first"
WARN_EVERY_S = 1.0

_log = logging.getLogger("rover")


class RoverPilot:
    """Drives in the modes other than `user`. It begins when a human leaves that mode, and not by itself after a fault.

    artifact: a file. throttle_limit: the most throttle, forwards and backwards, in donkeycar's units; None: that of
    params.yml. stopped: why it gives neutral, "" while it may drive. Raises PolicyError for an artifact that cannot be
    used here; it takes seconds, because the policy's process starts.
    """

    def __init__(
        self, artifact: Path | str, *, throttle_limit: float | None = None, clock: Callable[[], float] = time.monotonic
    ):
        self._settings = Settings.of(params()["drive"], throttle_limit=throttle_limit)
        self._clock = clock
        self._policy = PolicyProcess(Path(artifact).resolve())
        self._policy.__enter__()
        self._car = car_of(self._policy.manifest)  # which side is positive, and whether it reverses
        self._side = -self._car.left  # donkeycar's angle is positive to the right
        self._camera = Camera("cam/image_array", rate_hz=self._policy.rate_hz, clock=clock)
        self._commanded = Commanded()
        self._planner = self._start_planner()
        self._pilot: PolicyPilot | None = None  # of this drive; None while a human drives
        self._planning = ExitStack()  # without rest, while it drives
        self._ready = False  # whether this drive has had a plan to begin with
        self._picture: np.ndarray | None = None
        self._seen_s = self._called_s = self._begun_s = self._warned_s = self._throttle = 0.0
        self.stopped = NEVER_BY_HAND

    def run(
        self, image_rgb: np.ndarray | None, mode: str | None, angle: float | None, throttle: float | None
    ) -> tuple[float, float]:
        """Return donkeycar's angle and throttle for this turn of its loop; 0, 0 while stopped. Raises and waits never.

        image_rgb: (h, w, 3) uint8. mode: user/mode. angle, throttle: what went to the car in the turn before, whoever
        drove. None: not known yet.
        """
        now_s = self._clock()
        try:
            self._take_note(angle, throttle)
            self._see(image_rgb, now_s)
            if mode is None or mode == USER:
                self._end("")
                return NEUTRAL
            if self.stopped:
                return NEUTRAL
            return self._drive(now_s)
        except Exception as error:  # of any kind, see above
            self._end(sentence_of(error))
            return NEUTRAL
        finally:
            self._called_s = now_s

    def shutdown(self) -> None:
        """Close the policy, in a thread: the parts that donkeycar shuts down after this one stop the car."""
        self._end("")
        self.stopped = "shut down"
        threading.Thread(target=self._close, name="closes the policy").start()

    def _close(self) -> None:
        self._policy.close()  # ends the planner's wait for it
        self._planner.__exit__()

    def _start_planner(self) -> Planner:
        planner = Planner(
            self._camera, self._policy, self._commanded, rest_s=REST_S, limits=self._car.limits, clock=self._clock
        )
        return planner.__enter__()

    def _take_note(self, angle: float | None, throttle: float | None) -> None:
        """Take note of what was sent in the turn before: the policy's state, and whether the car moves."""
        if angle is None or throttle is None:
            return
        sent = np.clip([self._side * angle, throttle], *self._car.limits)
        steering, self._throttle = map(float, sent)
        self._commanded.add(self._called_s, steering, self._throttle)
        if self._pilot:
            self._pilot.sight.sent(self._called_s, self._throttle)

    def _see(self, image_rgb: np.ndarray | None, now_s: float) -> None:
        """Give the camera's picture to those who watch it. Raises CameraError for one that is none.

        donkeycar hands out a camera's newest picture without a number or a time: the same one again if the camera is
        slower than the loop. That is no frame until it is as old as a missing one; while the car moves, not even then.
        """
        if image_rgb is None:
            return
        image = np.ascontiguousarray(image_rgb[..., ::-1])
        if self._picture is not None and np.array_equal(image, self._picture):
            if abs(self._throttle) > MOVING or now_s - self._seen_s < MISSING_S:
                return
        elif self._picture is None:
            check_shape(self._camera.source, image, seen_size(self._policy.manifest))
        self._camera.add(image, now_s, None)
        self._picture = image
        self._seen_s = now_s

    def _begin(self, now_s: float) -> PolicyPilot:
        try:
            self._planner.newest()
        except RoverError:  # that of a drive before; its thread has ended
            self._planner = self._start_planner()
        self._planning.enter_context(self._planner.without_rest())
        self._begun_s = now_s
        self._ready = False
        _log.info("the policy drives")
        return PolicyPilot(
            self._camera, self._planner, self._commanded, self._settings, self._policy.rate_hz,
            calibration=self._car.pwm,
        )  # fmt: skip

    def _drive(self, now_s: float) -> tuple[float, float]:
        """Return angle and throttle by the newest plan. Raises RoverError for what must stop the car."""
        if self._pilot is None:
            self._pilot = self._begin(now_s)
        elif (pause_s := now_s - self._called_s) > IN_FORCE_S:
            raise DriveFault(f"donkeycar's loop paused for {pause_s:.2f} s", remedy="is this machine too busy?")
        if not self._ready:
            plan = self._planner.newest()
            if plan is None or plan.captured_s < self._begun_s:
                if now_s - self._begun_s > FRESH_S:
                    raise PolicyError(f"no fresh plan within {FRESH_S:g} s", remedy="is this machine too busy?")
                return NEUTRAL
            self._pilot.check()
            self._ready = True
        order = self._pilot.order(now_s)
        if now_s - self._warned_s >= WARN_EVERY_S:
            self._warned_s = now_s
            for warning in self._pilot.warnings():
                _log.warning(warning)
        return self._side * order.steering, order.throttle

    def _end(self, why: str) -> None:
        """Drive no longer. why: the fault, "" if a human has taken the car; a fault holds until one has."""
        if why and why != self.stopped:
            _log.error("stopped: %s; choose the mode '%s' to begin again", why, USER)
        self.stopped = why
        self._pilot = None
        self._planning.close()
