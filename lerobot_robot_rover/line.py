"""Share a serial port between a robot and its transmitter: both find its only owner by the port's name."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any
from weakref import WeakSet, WeakValueDictionary

from rover_lib.onboard.car.servo_link import ServoLink

# lerobot-rollout leaves out each number whose name does not end in .pos or .vel, and moves those in .pos to where they
# were at the start. Recording and replaying use the same names, so that datasets can be merged.
ENDING = ".vel" if find_spec("lerobot.rollout") else ""
ACTIONS = ("steering", "throttle")
FEATURES = {name + ENDING: float for name in ACTIONS}

_lines: WeakValueDictionary[str, Line] = WeakValueDictionary()


class Line:
    """A port and its users, of line_to(). For one thread.

    transmitters: the teleoperators on the port. humans_action: whether one has returned the human's own action, and the
    robot has not been given it yet. before_drive: waits until the car can be armed; None without a robot.
    """

    def __init__(self, port: str):
        self.port = port
        self.transmitters: WeakSet[object] = WeakSet()
        self.humans_action = False
        self.before_drive: Callable[[], None] | None = None
        self._link: ServoLink | None = None
        self._users = 0

    def open(self) -> ServoLink:
        """Return the link, which the first user opens. Raises CarError, and LinkError, as ServoLink.open() does."""
        link = self._link or ServoLink(self.port)
        if self._link is None:
            link.open()
        self._link = link
        self._users = self._users + 1
        return link

    def close(self) -> None:
        """Give the link back. When the last user does, neutral is sent and the port is closed. Raises nothing."""
        self._users -= 1
        if not self._users and self._link:
            link = self._link
            self._link = None
            link.close()


class CarPart:
    """What LeRobot asks of a robot and of a teleoperator alike. A car is measured once, by `rover calibrate`."""

    is_calibrated = True

    @property
    def action_features(self) -> dict[str, type]:
        """Steering in [-1, 1], its side as car.yml says, and throttle in [0, 1], or from -1 on a car with reverse."""
        return dict(FEATURES)

    def configure(self) -> None:
        """Do nothing: the Arduino is told of the car when its port is opened."""

    calibrate = configure


def line_to(port: str) -> Line:
    """Return this process's only line to a port. Any name of the port will do, also /dev/serial/by-id/..."""
    return _lines.setdefault(os.path.realpath(port), Line(port))  # the port need not exist yet


def wait_for_humans() -> None:
    """Wait, before an episode, until the car of each connected robot can be armed. Raises as Rover.connect() does."""
    for line in list(_lines.values()):
        if line.before_drive:
            line.before_drive()


def named(steering: float, throttle: float) -> dict[str, float]:
    """Return an action, or a state, by LeRobot's names."""
    return dict(zip(FEATURES, (steering, throttle), strict=True))


def unnamed(action: Mapping[str, Any]) -> dict[str, Any]:
    """Return an action by our names, whichever of the two LeRobot recorded it with."""
    return {name.removesuffix(".vel"): value for name, value in action.items()}
