"""A drive by actions that come from elsewhere: the control loop of `rover drive`, in a thread beside LeRobot's loop.

LeRobot calls when it likes, and the Arduino wants a command every 34 ms. So the newest action is what the loop sends,
HOLD_S at most: then the car is in neutral and disarmed, as it is after each fault that the loop knows.
"""

import sys
import threading
import time
from collections.abc import Callable

from rover_lib.onboard.camera import Camera
from rover_lib.onboard.drive import arm_capped
from rover_lib.onboard.errors import DriveFault
from rover_lib.onboard.loop import Hooks, Log, Report, Until, drive
from rover_lib.onboard.pilot import Order, Sight
from rover_lib.onboard.plan import Settings
from rover_lib.onboard.servo_link import ServoLink, Telemetry
from rover_lib.onboard.watch import SWITCH_S, HealthWatch

RATE_HZ = 50.0  # an action waits 20 ms at most; at 100 Hz a busy machine's pauses of 10 ms would count as missed ticks
# How long an action is repeated: a loop of 30 Hz may miss two turns. The Arduino allows a silent host 150 ms, and a
# host whose loop hangs is to get no more than that: the next tick after these, 120 ms at the latest, sends neutral.
HOLD_S = 0.1
ARMED_S = 3.0  # the cap's answer and the arming's, 0.5 s each, and a busy machine


class Ride:
    """One drive, from arming to neutral. For one thread beside its own.

    Use it once: begin(), then put() at least every HOLD_S. over: it has ended, by itself or by a fault.
    """

    def __init__(
        self,
        camera: Camera,
        link: ServoLink,
        settings: Settings,
        log: Log,
        *,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._camera, self._link, self._settings, self._log, self._clock = camera, link, settings, log, clock
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
        """Whether the car is no longer driven by this."""
        return self._thread.ident is not None and (bool(self.report.ended) or not self._thread.is_alive())

    def begin(self, steering: float, throttle: float) -> None:
        """Arms the car, and drives by that action. Raises LinkError and CameraError where arming is refused, DriveFault
        where it takes too long."""
        self._sight.check()
        self._action = (steering, throttle)
        self._thread.start()
        if not self._settled.wait(ARMED_S):
            self.end()
            raise DriveFault(f"the car was not armed within {ARMED_S:g} s", remedy="is this machine too busy?")
        self.check()

    def put(self, steering: float, throttle: float) -> None:
        """The action from now on. Raises what ended the drive, DriveFault if that was that none came in time."""
        if self.over:
            self.check()
            late_ms = (self._clock() - self._given_s) * 1e3
            raise DriveFault(
                f"LeRobot's loop gave no action for {late_ms:.0f} ms, and after {HOLD_S * 1e3:g} the car was stopped",
                remedy="is the policy too slow for it? `rover drive` plans while it drives",
            )
        self._action, self._given_s = (steering, throttle), self._clock()

    def check(self) -> None:
        """Raises what ended the drive if that was a fault, or the human's takeover."""
        if self.over:
            self._thread.join()  # it may still hear what the Arduino answers to neutral
        if self._settled.is_set() and self._error:
            raise self._error

    def end(self) -> None:
        """Neutral, and disarmed. Raises nothing; a fault that was there already is kept for check()."""
        self._stop.set()
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join()

    # ---- in the thread: the pilot of loop.drive

    def ready(self, stop: threading.Event) -> None:
        """Waits for nothing: there is an action from the start."""

    def order(self, now_s: float) -> Order:
        """The newest action. Raises CameraError for a camera by which nobody should drive."""
        frame = self._camera.latest()
        if frame:
            self._sight.watch(frame, now_s)
        steering, throttle = self._action
        pulses = self._link.calibration.pulses(steering, throttle)
        number = frame.number if frame else 0
        return Order(steering, throttle, pulses.steering_us, pulses.throttle_us, frame=number)

    def sent(self, at_s: float, order: Order) -> None:
        """Notes when an order went out."""
        self._sight.sent(at_s, order.throttle)

    def _late(self) -> str | None:
        late = self._clock() - self._given_s > HOLD_S
        return f"no action came from LeRobot for {HOLD_S * 1e3:g} ms" if late else None

    def _arm(self) -> Telemetry:
        limit = self._settings.throttle_limit
        telemetry = arm_capped(self._link, limit, limit, self._log.event)
        self._given_s = self._clock()
        self._settled.set()
        return telemetry

    def _run(self) -> None:
        before = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        try:
            drive(
                self,
                self._link,
                self._log,
                rate_hz=RATE_HZ,
                until=Until(stop=self._stop, over=self._late),
                hooks=Hooks(self._arm, HealthWatch(self.report, self._link)),
                report=self.report,
                clock=self._clock,
            )
        except BaseException as error:  # of whatever kind, LeRobot's loop must learn of it
            self._error = error
        finally:
            sys.setswitchinterval(before)
            self._settled.set()
