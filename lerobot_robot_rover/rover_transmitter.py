"""The human's transmitter as a LeRobot teleoperator: its actions are what the Arduino measures of the receiver."""

import logging
import time
from dataclasses import dataclass
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_rover.line import CarPart, line_to, named
from rover_lib.onboard.car.protocol import MISSING, Telemetry
from rover_lib.onboard.car.pwm import Channel
from rover_lib.onboard.car.servo_link import LinkError, ServoLink
from rover_lib.onboard.drive.service import CHECK_S

WITHHELD_S = 0.5  # far longer than until a status shows a moved stick

_log = logging.getLogger("rover")


@TeleoperatorConfig.register_subclass("rover_transmitter")
@dataclass(kw_only=True)
class RoverTransmitterConfig(TeleoperatorConfig):
    """port: of the Arduino, the same as the robot's."""

    port: str = "/dev/ttyUSB0"


class RoverTransmitter(CarPart, Teleoperator):
    """The sticks of a human who drives: the Arduino passes on and measures their pulses. For one thread at a time.

    LeRobot has no word for "not measured", and a lost signal is not a zero, so get_action() raises then.
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

    @property
    def feedback_features(self) -> dict[str, type]:
        """Empty: a transmitter cannot be told anything."""
        return {}

    @property
    def is_connected(self) -> bool:
        return self._link is not None

    def connect(self, calibrate: bool = True) -> None:
        """Open the port and wait for the transmitter's signal. Raises as Rover.connect() does."""
        if self._link:
            raise DeviceAlreadyConnectedError(f"the transmitter at {self.config.port} is connected already")
        link = self._line.open()
        try:
            if _sticks(link.latest()) is None:
                _log.warning("before the human can drive: %s", link.remedy("s"))
            while _sticks(link.latest()) is None:
                time.sleep(CHECK_S)
        except BaseException:
            self._line.close()
            raise
        self._link = link

    def get_action(self) -> dict[str, float]:
        """Return the sticks' steering and throttle. Raises LinkError if signal, link or throttle is lost."""
        link = self._connected()
        telemetry = link.latest()
        sticks = _sticks(telemetry)
        steering, throttle = link.calibration.actions(*sticks) if sticks else (None, None)
        if telemetry is None or steering is None or throttle is None:
            problem = f"{self.config.port}: the transmitter's signal was lost, and LeRobot cannot record that"
            raise LinkError(
                problem, remedy=f"{link.remedy('s')} and record this episode again; those before it are kept"
            )
        self._check_passed_on(telemetry, link.calibration.throttle)
        self._line.humans_action = True
        return named(steering, throttle)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""

    def disconnect(self) -> None:
        """Give the port back; it is closed once the robot has given it back too. Raises DeviceNotConnectedError."""
        self._connected()
        self._link = None
        self._line.humans_action = False
        self._line.close()

    def _connected(self) -> ServoLink:
        if not self._link:
            raise DeviceNotConnectedError(f"the transmitter at {self.config.port} is not connected: connect() first")
        return self._link

    def _check_passed_on(self, telemetry: Telemetry, channel: Channel) -> None:
        """Raise LinkError if the throttle was withheld for WITHHELD_S: it was not at rest yet since a fault."""
        throttle = telemetry.receiver_throttle_us
        if throttle is None or not channel.moves(throttle) or channel.moves(telemetry.throttle_us):
            self._withheld_s = None
            return
        self._withheld_s = telemetry.host_s if self._withheld_s is None else self._withheld_s
        if telemetry.host_s - self._withheld_s > WITHHELD_S:
            problem = f"{self.config.port}: the car does not get the stick's throttle, which was not at rest yet"
            raise LinkError(problem, remedy=f"{MISSING['t']}, then drive")


def _sticks(telemetry: Telemetry | None) -> tuple[int, int, int, int] | None:
    """Return the pulses of steering and throttle, and their periods, in microseconds; None if one was not measured."""
    sticks = telemetry.receiver if telemetry else (None,)
    return None if None in sticks else sticks  # type: ignore[return-value]  # mypy does not see what `in` says
