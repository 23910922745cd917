"""The human's transmitter as a teleoperator of LeRobot: what the Arduino measures of its receiver."""

import logging
import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_rover.line import line_to
from rover_lib.onboard.errors import ParamsError
from rover_lib.onboard.service import CHECK_S
from rover_lib.onboard.servo_link import MISSING, LinkError, ServoLink, Telemetry

WITHHELD_S = 0.5  # far longer than a status of a moved stick takes

_log = logging.getLogger("rover")


@TeleoperatorConfig.register_subclass("rover_transmitter")
@dataclass(kw_only=True)
class RoverTransmitterConfig(TeleoperatorConfig):
    """port: the Arduino's, the same as the robot's."""

    port: str = "/dev/ttyUSB0"

    def __post_init__(self) -> None:
        if not self.port:
            raise ParamsError("the transmitter needs a port, the robot's", found=repr(self.port))


class RoverTransmitter(Teleoperator):
    """The sticks of a human who drives the car in manual: the Arduino passes their pulses on, and measures them.

    LeRobot has no word for "not measured", and a lost signal is no zero: get_action() raises then. Not for several
    threads.
    """

    config_class = RoverTransmitterConfig
    name = "rover_transmitter"

    def __init__(self, config: RoverTransmitterConfig):
        super().__init__(config)
        self.config = config
        self._line = line_to(config.port)
        self._line.transmitters.add(self)  # before anybody connects: the robot need not wait for a gesture then
        self._link: ServoLink | None = None
        self._withheld_s: float | None = None

    @cached_property
    def action_features(self) -> dict[str, type]:
        """steering in [-1, 1], positive to the left, and throttle in [0, 1], or from -1 of a car with reverse."""
        return {"steering": float, "throttle": float}

    @property
    def feedback_features(self) -> dict[str, type]:
        """None: a transmitter cannot be told anything."""
        return {}

    @property
    def is_connected(self) -> bool:
        return self._link is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Nothing: `rover calibrate` measures the sticks' ends once, for car.yml."""

    def configure(self) -> None:
        """Nothing."""

    def connect(self, calibrate: bool = True) -> None:
        """Waits until the transmitter gives a signal, and says so. Raises LinkError and CarError as the robot, and
        DeviceAlreadyConnectedError."""
        if self._link:
            raise DeviceAlreadyConnectedError(f"the transmitter at {self.config.port} is connected already")
        link = self._line.open()
        try:
            told = False
            while _sticks(link.latest()) is None:
                if not told:
                    _log.warning("before the human can drive: %s", MISSING["s"])
                    told = True
                time.sleep(CHECK_S)
        except BaseException:
            self._line.close()
            raise
        self._link = link

    def get_action(self) -> dict[str, float]:
        """The sticks, as car.yml reads their pulses. Raises LinkError for a signal that is lost, for a throttle that
        the Arduino does not pass on, and for a link that is gone."""
        if not self._link:
            raise DeviceNotConnectedError(f"the transmitter at {self.config.port} is not connected: connect() first")
        telemetry = self._link.latest()
        sticks = _sticks(telemetry)
        if telemetry is None or sticks is None:
            raise self._lost()
        actions = self._link.calibration.actions_from_pulses(*sticks)
        if actions.steering is None or actions.throttle is None:
            raise self._lost()
        self._check_passed_on(telemetry)
        self._line.humans_action = True
        return {"steering": actions.steering, "throttle": actions.throttle}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nothing."""

    def disconnect(self) -> None:
        """The port is closed with the robot's end of it. Raises DeviceNotConnectedError."""
        if not self._link:
            raise DeviceNotConnectedError(f"the transmitter at {self.config.port} is not connected: connect() first")
        self._link = None
        self._line.humans_action = False
        self._line.close()

    def _lost(self) -> LinkError:
        return LinkError(
            f"{self.config.port}: the transmitter's signal was lost, and LeRobot cannot record that",
            remedy=f"{MISSING['s']} and record this episode again; those before it are kept",
        )

    def _check_passed_on(self, telemetry: Telemetry) -> None:
        """The Arduino withholds a throttle that was not at rest since a reset, a lost signal or a takeover."""
        throttle = telemetry.receiver_throttle_us
        moves = self._link is not None and self._link.calibration.throttle.moves
        if not moves or throttle is None or not moves(throttle) or moves(telemetry.throttle_us):
            self._withheld_s = None
            return
        self._withheld_s = telemetry.host_s if self._withheld_s is None else self._withheld_s
        if telemetry.host_s - self._withheld_s > WITHHELD_S:
            raise LinkError(
                f"{self.config.port}: the car does not get the stick's throttle, which was not at rest yet",
                remedy=f"{MISSING['t']}, then drive",
            )


def _sticks(telemetry: Telemetry | None) -> tuple[int, int, int, int] | None:
    """Pulses of steering and throttle, and their periods, microseconds; None where one is not measured."""
    if telemetry is None:
        return None
    t = telemetry
    steering_us, throttle_us = t.receiver_steering_us, t.receiver_throttle_us
    periods_us = t.receiver_steering_period_us, t.receiver_throttle_period_us
    if steering_us is None or throttle_us is None or periods_us[0] is None or periods_us[1] is None:
        return None
    return steering_us, throttle_us, periods_us[0], periods_us[1]
