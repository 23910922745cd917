"""The serial port that a robot and its transmitter share: one owner, found by the port's name.

line = line_to("/dev/ttyUSB0")      # the same value for whoever names the same port in this process
link = line.open()                  # the first opens it, the last that closes it closes it
"""

from __future__ import annotations

import os
from collections.abc import Callable
from weakref import WeakSet, WeakValueDictionary

from rover_lib.onboard.servo_link import LinkError, ServoLink

_lines: WeakValueDictionary[str, Line] = WeakValueDictionary()


class Line:
    """A port, and who uses it. Use line_to(). For one thread.

    transmitters: the teleoperators on it; with one, a human may drive without arming anything. humans_action: whether
    the newest action that a teleoperator gave is the human's own and was not sent yet. before_drive: waits until the
    car can be armed, None while no robot is connected.
    """

    def __init__(self, port: str):
        self.port = port
        self.transmitters: WeakSet[object] = WeakSet()
        self.humans_action = False
        self.before_drive: Callable[[], None] | None = None
        self._link: ServoLink | None = None
        self._users = 0

    def open(self) -> ServoLink:
        """The link, opened by the first. Raises CarError for a bad car.yml, LinkError as ServoLink.open()."""
        if self._link is None:
            link = ServoLink(self.port)
            link.open()
            self._link = link
        self._users += 1
        return self._link

    def close(self) -> None:
        """Given back by one; the last sends neutral and closes the port. Raises nothing."""
        self._users = max(0, self._users - 1)
        if not self._users and self._link:
            link, self._link = self._link, None
            link.close()

    @property
    def link(self) -> ServoLink:
        """The open link. Raises LinkError if nobody has opened it."""
        if self._link is None:
            raise LinkError(f"{self.port}: the link is not open", remedy="connect() first")
        return self._link

    def take_humans_action(self) -> bool:
        """Whether the action that now comes to the robot is the human's own; said once."""
        humans, self.humans_action = self.humans_action, False
        return humans


def line_to(port: str) -> Line:
    """The one of this process to a port, by whatever name, /dev/serial/by-id/... too."""
    key = os.path.realpath(port)  # not Path's: a name, which need not exist yet
    line = _lines.get(key)
    # After plugging in anew, the port may have been given to another device than the line's own name leads to.
    if line is None or os.path.realpath(line.port) != key:
        line = _lines[key] = Line(port)
    return line


def wait_for_humans() -> None:
    """Before an episode: waits until the car of each connected robot can be armed. Raises as its connect()."""
    for line in list(_lines.values()):
        if line.before_drive:
            line.before_drive()
