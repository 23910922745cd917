"""The drive's end of the view: it sends what the view shows, and accepts one request, a stop.

The view is another process; on a rover, another user runs it. It listens at a Unix socket that transports whole
messages. Neither side waits for the other: a message is dropped while the previous one has not been read, so that a
view that hangs, floods or dies costs a drive no more than a failed system call.

A message is a line of JSON, followed by the camera's newest picture, a JPEG; none if the camera delivers raw pictures.
"""

import contextlib
import fcntl
import json
import re
import socket
import struct
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.car.protocol import REASONS
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.drive.flight_log import FlightLog, Tick
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.drive.pilot import PolicyPilot
from rover_lib.onboard.errors import RoverError

EVERY_S = 0.1  # between two messages
AGAIN_S = 1.0  # between two checks whether a view listens
LAST_S = 0.2  # for delivering the last message of a drive; the car has stopped by then
ASKED_MOST = 8  # messages of the view that are read at a tick
STOP = re.compile(rb"stop ([0-9a-f.:]{1,45})", re.ASCII)  # with the address that asked
MOST_BYTES = 400_000  # of a message; a larger one is sent without its picture
DRIVING, WAITING, TAKEN, ENDED = "driving", "waiting", "taken over", "ended"


class Feed:
    """A drive's end of the view, for the loop's thread. It raises nothing, and waits only in ended().

    place: the socket at which the view listens. title: the name of what drives.
    """

    def __init__(
        self,
        place: Path,
        log: FlightLog,
        title: str,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._place = place
        self._log = log
        self._title = title
        self._clock = clock
        self._sleep = sleep
        self._socket: socket.socket | None = None
        self._look_s = self._due_s = 0.0  # earliest times: look for a view, send

    def close(self) -> None:
        if self._socket:
            self._socket.close()
            self._socket = None

    def tick(self, report: Report, camera: Camera, pilot: PolicyPilot, tick: Tick) -> None:
        """Call this after each command that went out."""
        if self._due():
            pins = {"pins": [tick.pins_steering_us, tick.pins_throttle_us], "who": tick.state}
            message = {"tick": tick._asdict(), **pins, "why": REASONS.get(tick.reason, "")}
            if pilot.plan:
                plan, rate_hz = pilot.plan
                actions = plan.actions.round(3).tolist()
                message["plan"] = {"captured_s": plan.captured_s, "rate_hz": rate_hz, "actions": actions}
            self._send(DRIVING, "", report, camera, message)

    def show(self, phase: str, text: str, report: Report, camera: Camera, link: ServoLink | None) -> None:
        """Call this while the car does not drive by commands. phase: WAITING or TAKEN. text: a sentence for people."""
        if self._due():
            self._send(phase, text, report, camera, self._pins(link) | ({"missing": ""} if phase == TAKEN else {}))

    def ended(self, report: Report, camera: Camera, link: ServoLink | None) -> None:
        """Call this once after a drive: it shows what the pins do now, and retries up to LAST_S if the view is busy."""
        end_s = self._clock() + LAST_S
        while self._connected() and not self._send(ENDED, report.ended, report, camera, self._pins(link)):
            if self._clock() > end_s:
                return
            self._sleep(LAST_S / 10)

    def over(self) -> str | None:
        """Why this drive must end; None if nobody asked for a stop. The loop calls this at each tick."""
        for _ in range(ASKED_MOST):
            try:
                request = self._socket.recv(64) if self._socket else None
            except BlockingIOError:
                return None
            except OSError:
                request = b""
            if not request:
                if self._socket:  # an empty message: the other end has closed it
                    self._lost("the view is gone")
                return None
            if stop := STOP.fullmatch(request):
                return f"stopped from the view ({stop[1].decode()})"
        return None

    def _due(self) -> bool:
        now_s = self._clock()
        if now_s < self._due_s:
            return False
        if now_s >= self._due_s + EVERY_S:
            self._due_s = now_s
        self._due_s += EVERY_S
        return self._connected()

    def _connected(self) -> bool:
        now_s = self._clock()
        if self._socket or now_s < self._look_s:
            return self._socket is not None
        self._look_s = now_s + AGAIN_S
        wire = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            wire.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MOST_BYTES)
            wire.connect(str(self._place))
        except OSError:  # nobody listens, or the view is too busy to answer
            wire.close()
            return False
        self._socket = wire
        return True

    def _lost(self, why: str) -> None:
        self.close()
        self._log.event(why)

    def _pins(self, link: ServoLink | None) -> dict[str, Any]:
        with contextlib.suppress(RoverError):  # whoever needs the link reports that it is gone
            if link and (telemetry := link.latest()):
                missing = "" if telemetry.missing == "-" else link.remedy(telemetry.missing)
                pins = {"pins": [telemetry.steering_us, telemetry.throttle_us], "who": telemetry.state.value}
                return {**pins, "why": REASONS.get(telemetry.reason, ""), "missing": missing}
        return {"pins": None, "who": "", "why": ""}

    def _send(self, phase: str, text: str, report: Report, camera: Camera, message: dict[str, Any]) -> bool:
        try:
            view, picture = self._picture(camera)
            events = [[round(event.t_s, 2), event.text[:200]] for event in tuple(self._log.recent)]
            head = {"phase": phase, "text": text, "title": self._title, "sent_s": self._clock(), "tick": None}
            line = head | {"missed": report.missed, "machine": self._log.machine, "events": events} | message | view
            return self._put(json.dumps(line).encode() + b"\n", picture)
        except Exception as error:  # whatever fails here, the drive goes on without a view
            self._lost(f"the view is not fed any more: {type(error).__name__}: {error}")
            self._look_s = float("inf")
            return False

    def _picture(self, camera: Camera) -> tuple[dict[str, Any], bytes]:
        frame = None
        with contextlib.suppress(RoverError):  # whoever needs the camera reports that it is gone
            frame = camera.latest()
        if frame is None:
            return {}, b""
        height, width = frame.image.shape[:2]
        view: dict[str, Any] = {"frame": frame.number, "captured_s": frame.captured_s, "size": [width, height]}
        return view, frame.jpeg or b""

    def _put(self, line: bytes, picture: bytes) -> bool:
        """Give the view a message unless it has not read the previous one. Never waits."""
        try:
            if self._socket and not struct.unpack("i", fcntl.ioctl(self._socket, termios.TIOCOUTQ, bytes(4)))[0]:
                if len(line) + len(picture) < MOST_BYTES:
                    line += picture
                self._socket.send(line)
                return True
        except BlockingIOError:
            pass
        except OSError:
            self._lost("the view is gone")
        return False
