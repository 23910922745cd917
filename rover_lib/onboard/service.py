"""A drive as a systemd service: ready once it could drive, disarmed until a human arms it, watched by its ticks.

How a human arms: `sudo rover arm-car` on the rover, or `ansible-playbook ansible/drive.yml -e rover_arm=true`. Either
sends SIGUSR1 to the service, and a signal is all there is to it: only root and the service's own user can send one, it
leaves nothing behind that could arm the car later (no file, no port), and one that comes while the car is not ready is
forgotten. The Arduino has the last word, as always: it refuses without the transmitter's signal, and when the throttle
stick is not at rest. Moving a stick takes the car back; the service then ends, is started again and is disarmed.

Disarmed, it is not in a hurry: no real-time priority, a plan a second. Both come before the Arduino is asked, and the
car begins by a fresh plan.

What the service says of itself (systemctl show --property=StatusText) begins with one of STATES; deploy.yml restarts it
only while that is "disarmed".

systemd's watchdog hears of ticks that happened and of nothing else: while the car drives, those of the control loop;
while it is disarmed, the checks of camera, policy and Arduino. A loop that hangs, or a process that does, is killed
after WatchdogSec; the Arduino has stopped the car 150 ms after the last command.
"""

import contextlib
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from systemd_watchdog import WatchDog

from rover_lib.onboard.errors import RoverError

if TYPE_CHECKING:  # who asks for the service's state, as every playbook does, waits for neither numpy nor OpenCV
    from rover_lib.onboard.loop import Arm, Report
    from rover_lib.onboard.servo_link import Telemetry

UNIT = "rover-drive.service"
ARM = signal.SIGUSR1
CHECK_S = 0.1  # between checks while disarmed
FEED_S = 0.25  # WatchdogSec is 2 s
STATUS_S = 1.0
ARMED_S = 5.0  # the Arduino answers within 0.5
DISARMED, DRIVING, STOPPING = STATES = ("disarmed", "driving", "stopping")


class NotArmed(RoverError):
    """The service was told to stop before a human armed the car."""


class ServiceError(RoverError):
    """What cannot be asked of the service now."""


class Service:
    """systemd's side of a drive; a context manager, for the main thread.

    report: of the drive, whose ticks feed the watchdog. stop: ends the waiting. Without systemd (no NOTIFY_SOCKET)
    nothing is told to anybody, and all else is the same.
    """

    def __init__(self, report: "Report", stop: threading.Event, notify: Callable[[str], None] = lambda text: None):
        self._report, self._stop, self._notify = report, stop, notify
        # One that never waits: systemd may be busy, and the loop must not be.
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._systemd = WatchDog(sock=self._socket)
        self._rounds = 0  # of checks that passed
        self._state = ""
        self._asked = threading.Event()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._feed, name="watchdog", daemon=True)

    def __enter__(self) -> "Service":
        self._before = signal.signal(ARM, lambda number, frame: self._asked.set())
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._done.set()
        self._thread.join()
        if self._state != STOPPING:
            self._stopping(self._report.ended or str(exc[1] or "ended"))
        signal.signal(ARM, self._before)
        self._socket.close()

    def wait_for_human(self, arm: "Arm", checks: Iterable[Callable[[], object]] = ()) -> "Telemetry | None":
        """Ready: waits until a human arms the car and the Arduino agrees; what arm() returned.

        checks: what must go on working meanwhile; each raises if it does not. Raises NotArmed when told to stop, and
        what a check raises.
        """
        checks = tuple(checks)
        self._asked.clear()  # whoever asked before could not know what the car would do
        self._tell(f"{DISARMED}: waiting for a human to arm it")
        with contextlib.suppress(OSError):
            self._systemd.ready()
        while not self._stop.is_set():
            for check in checks:
                check()
            self._rounds += 1
            if not self._asked.wait(CHECK_S):
                continue
            self._asked.clear()
            try:
                telemetry = arm()
            except RoverError as error:  # what is broken, and not only in the way, the next check finds
                self._notify(f"not armed: {error}")
                self._tell(f"{DISARMED}: {error}")
                continue
            self._state = DRIVING
            self._tell(f"{DRIVING}: armed by a human")
            return telemetry
        raise NotArmed("told to stop before a human armed the car")

    def _feed(self) -> None:
        seen, told_s = -1, 0.0
        while not self._done.wait(FEED_S):
            if self._report.ended:
                return self._stopping(self._report.ended)
            happened = self._rounds + self._report.ticks
            if happened == seen or not self._rounds:
                continue
            seen = happened
            with contextlib.suppress(OSError):
                self._systemd.notify()
            if self._state == DRIVING and time.monotonic() - told_s > STATUS_S and self._report.ticks:
                told_s = time.monotonic()
                self._tell(f"{DRIVING}: {self._report.status}")

    def _stopping(self, why: str) -> None:
        """Ends the watchdog's time: a policy has to be ended, and files to be written."""
        self._state = STOPPING
        # A notification is lines, and the library has no word for this one.
        self._tell(f"{STOPPING}: {why}", "STOPPING=1")

    def _tell(self, text: str, *more: str) -> None:
        with contextlib.suppress(OSError):
            self._systemd.status("\n".join([" ".join(text.split()), *more]))


def state_of(unit: str = UNIT) -> dict[str, Any]:
    """What systemd knows of the service: active, state (one of STATES, or ""), text, since, restarts, result.

    Raises ServiceError where there is no systemd.
    """
    names = ("LoadState", "ActiveState", "StatusText", "ActiveEnterTimestamp", "NRestarts", "Result", "UnitFileState")
    try:
        result = subprocess.run(
            ["systemctl", "show", f"--property={','.join(names)}", unit], capture_output=True, text=True, timeout=30
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise ServiceError(f"systemctl cannot be asked about {unit} ({error})", remedy="is this a rover?") from None
    if result.returncode:
        raise ServiceError(
            f"systemctl does not know about {unit}: {' '.join(result.stderr.split())}", remedy="is this a rover?"
        )
    properties = dict(line.partition("=")[::2] for line in result.stdout.splitlines())
    text = properties.get("StatusText", "")
    return {
        "installed": properties.get("LoadState") == "loaded",
        "active": properties.get("ActiveState", "unknown"),
        "state": next((s for s in STATES if text.startswith(s)), ""),
        "text": text,
        "since": properties.get("ActiveEnterTimestamp", ""),
        "restarts": int(properties.get("NRestarts") or 0),
        "result": properties.get("Result", ""),
        "at_boot": properties.get("UnitFileState") == "enabled",
    }


def arm_car(unit: str = UNIT, *, timeout_s: float = ARMED_S) -> str:
    """Arm the car whose service waits for it; what the service says then. Raises ServiceError if it does not drive."""
    before = state_of(unit)
    if before["active"] != "active" or before["state"] != DISARMED:
        text = before["text"] or "it says nothing"
        remedy = "it drives already" if before["state"] == DRIVING else f"sudo systemctl start {unit}"
        raise ServiceError(f"{unit} is {before['active']}, not waiting to be armed ({text})", remedy=remedy)
    sent = subprocess.run(
        ["systemctl", "kill", "--kill-whom=main", f"--signal={ARM.name}", unit], capture_output=True, text=True
    )
    if sent.returncode:
        raise ServiceError(f"{unit} cannot be told to arm ({sent.stderr.strip()})", remedy="use sudo")
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        time.sleep(CHECK_S)
        now = state_of(unit)
        if now["active"] != "active" or now["state"] == DRIVING or now["text"] != before["text"]:
            break
    if now["active"] != "active" or now["state"] != DRIVING:
        raise ServiceError(
            f"{unit} did not arm: {now['text'] or now['active']}", remedy="'rover doctor' says what it needs"
        )
    return now["text"]
