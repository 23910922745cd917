"""Drive by actions that come from elsewhere: `rover drive`'s control loop, in a thread beside LeRobot's loop.

It repeats LeRobot's newest action for at most HOLD_S. After that the car is put in neutral and disarmed.
"""

import sys
import threading
import time

from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.car.protocol import Telemetry
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.drive.loop import Hooks, Report, Until, drive
from rover_lib.onboard.drive.pilot import Order, Sight
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.drive.session import arm_capped
from rover_lib.onboard.drive.watch import SWITCH_S, HealthWatch
from rover_lib.onboard.errors import DriveFault

RATE_HZ = 50.0  # an action waits 20 ms at most
# How long an action is repeated: LeRobot's loop, at 30 Hz, may miss two turns. Neutral goes out at 120 ms or before,
# where the Arduino allows a silent host 150 ms.
HOLD_S = 0.1
ARMED_S = 3.0  # the answers to the cap and to arming, 0.5 s each, and time for a busy machine


class Ride:
    """One drive, from arming to neutral: begin(), then put() at least every HOLD_S, then end()."""

    def __init__(self, camera: Camera, link: ServoLink, settings: Settings, log: FlightLog):
        self._camera = camera
        self._link = link
        self._settings = settings
        self._log = log
        self._sight = Sight(camera, settings)
        self._action = (0.0, 0.0)
        self._given_s = 0.0
        self._stop = threading.Event()
        self._settled = threading.Event()  # armed, or over
        self._error: BaseException | None = None
        self.report = Report()
        # Not a daemon: a program that ends without disconnect() waits the 120 ms until neutral was sent.
        self._thread = threading.Thread(target=self._run, name="rover drive", daemon=False)

    @property
    def over(self) -> bool:
        """Whether the drive has ended, for whatever reason."""
        return self._thread.ident is not None and (bool(self.report.ended) or not self._thread.is_alive())

    def begin(self, steering: float, throttle: float) -> None:
        """Arm the car and drive by this action. Raises LinkError, CameraError or DriveFault if it cannot be armed."""
        self._sight.check()
        self._action = (steering, throttle)
        self._thread.start()
        if not self._settled.wait(ARMED_S):
            self.end()
            raise DriveFault(f"the car was not armed within {ARMED_S:g} s", remedy="is this machine too busy?")
        self.check()

    def put(self, steering: float, throttle: float) -> None:
        """Drive by this action from now on. Raises what ended the drive; DriveFault if no action came in time."""
        if self.over:
            self.check()
            late_ms = (time.monotonic() - self._given_s) * 1e3
            problem = (
                f"LeRobot's loop gave no action for {late_ms:.0f} ms, and after {HOLD_S * 1e3:g} the car was stopped"
            )
            raise DriveFault(problem, remedy="is the policy too slow for it? `rover drive` plans while it drives")
        self._action = (steering, throttle)
        self._given_s = time.monotonic()

    def check(self) -> None:
        """Raise what ended the drive, if it was a fault or the human's takeover."""
        if self.over:
            self._thread.join()  # it may still be waiting for the answer to neutral
        if self._settled.is_set() and self._error:
            raise self._error

    def end(self) -> None:
        """End the drive in neutral and disarmed. Raises nothing; check() raises a fault that came before."""
        self._stop.set()
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def ready(self, stop: threading.Event) -> None:
        """Return at once: there is an action from the start."""

    def order(self, now_s: float) -> Order:
        """Return the newest action as an order. Raises CameraError or DriveFault for pictures that stop the car."""
        frame = self._camera.latest()
        if frame:
            self._sight.watch(frame, now_s)
            self._sight.watch_motion(frame)
        steering, throttle = self._action
        pulses = self._link.calibration.pulses(steering, throttle)
        number = frame.number if frame else 0
        return Order(steering, throttle, pulses.steering_us, pulses.throttle_us, frame=number)

    def sent(self, at_s: float, order: Order) -> None:
        """Take note of when an order was sent."""
        self._sight.sent(at_s, order.throttle)

    def _late(self) -> str | None:
        late = time.monotonic() - self._given_s > HOLD_S
        return f"no action came from LeRobot for {HOLD_S * 1e3:g} ms" if late else None

    def _arm(self) -> Telemetry:
        telemetry = arm_capped(self._link, self._settings.throttle_limit, self._log.event)
        self._given_s = time.monotonic()
        self._settled.set()
        return telemetry

    def _run(self) -> None:
        before = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        health = HealthWatch(self.report, self._link, self._log, self._settings.undervoltage_s)
        until = Until(stop=self._stop, over=self._late)
        hooks = Hooks(self._arm, health)
        try:
            drive(self, self._link, self._log, rate_hz=RATE_HZ, until=until, hooks=hooks, report=self.report)
        except BaseException as error:  # of any kind: LeRobot's loop must learn of it
            self._error = error
        finally:
            sys.setswitchinterval(before)
            self._settled.set()
