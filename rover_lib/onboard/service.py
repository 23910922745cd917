"""A drive as a systemd service: ready once it could drive, disarmed until a human arms it, watched by its ticks.

How a human arms: `sudo rover arm-car` on the rover, or `ansible-playbook ansible/drive.yml -e rover_arm=true`. Either
talks to the service through a socket that only root can use, asks what the car would drive by, and then requests to
arm. A request names what it arms: the model's content hash, and a ticket of the service's, which is another after each
start and after each attempt. So nobody is surprised by what another operator deployed in between, one request is one
attempt, and nothing is left behind that could arm the car later. The Arduino has the last word, as always: the service
says what it still wants (switch the transmitter on, let go of the throttle, wiggle the steering), and refuses
requests meanwhile. Moving a stick takes the car back.

However a drive ends, by a takeover too, the same process waits disarmed again, with the port open: opening it anew
might reset the Arduino, and take the car from the human who has just taken it. While a takeover is recorded, nobody can
ask for the car. What is broken for good (a camera that is gone, a port) ends the service, and systemd starts it again,
disarmed.

A drive is over after --max-seconds of the service, or what the request says if that is less. Who arms from afar also
promises to be heard of: without `rover heartbeat` within the time that the request says, the drive ends.

Disarmed, it is not in a hurry: no real-time priority, a plan a second. Both come before the Arduino is asked, and the
car begins by a fresh plan.

What the service says of itself (systemctl show --property=StatusText) begins with one of STATES; deploy.yml restarts it
only while that is "disarmed".

systemd's watchdog hears of ticks that happened: while the car drives, those of the control loop; while it is disarmed,
the checks of camera, policy and Arduino; while a human is recorded who took over, those of that; and for a while after
a drive has ended, when an episode is finished. A loop that hangs, or a process that does, is killed after WatchdogSec;
the Arduino has stopped the car 150 ms after the last command.
"""

import contextlib
import json
import math
import os
import secrets
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from systemd_watchdog import WatchDog

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.host import is_listened_at

if TYPE_CHECKING:  # who asks for the service's state, as every playbook does, waits for neither numpy nor OpenCV
    from rover_lib.onboard.loop import Arm, Report
    from rover_lib.onboard.servo_link import Telemetry

UNIT = "rover-drive.service"
RUNTIME = Path("/run/rover-drive")  # the unit's RuntimeDirectory=
CHECK_S = 0.1  # between checks while disarmed
FEED_S = 0.25  # WatchdogSec is 2 s
FINISH_S = 80.0  # an episode on a slow card; TimeoutStopSec is 90 s then
STATUS_S = 1.0
REQUEST_S = 2.0  # how old a request to arm may be: a fresh plan within 0.8 s, an episode's folder, the Arduino's cap
ARMED_S = 10.0  # a fresh plan comes within 0.8 s, the Arduino answers within 0.5, an episode's folder is made
QUESTION_BYTES = 4096
PERSONS = 1000  # users from here on are people; the service's own is not
DISARMED, DRIVING, STOPPING = STATES = ("disarmed", "driving", "stopping")
WAITING = "waiting for a human to arm it"


class NotArmed(RoverError):
    """The service was told to stop before a human armed the car."""


class ServiceError(RoverError):
    """What cannot be asked of the service now."""


@dataclass(frozen=True)
class Request:
    """What an operator asks of a drive. None: the service's own limit; no heartbeat. Raises ValueError for no time."""

    max_seconds: float | None = None
    heartbeat_s: float | None = None

    def __post_init__(self) -> None:
        if not all(value is None or 0 < value < math.inf for value in vars(self).values()):
            raise ValueError(f"seconds above 0, not {self}")


def check_age(age_s: float) -> None:
    """Raises NotArmed for a request to arm that is too old: who asked may be elsewhere with eyes and hands by now."""
    if not age_s <= REQUEST_S:  # nor is NaN
        raise NotArmed(
            f"{age_s:.1f} s have passed since the car was asked for, at most {REQUEST_S:g} may", remedy="ask again"
        )


class Service:
    """systemd's and the operators' side of a car's drives; a context manager, for the main thread.

    report: of the drive, whose ticks feed the watchdog. stop: ends the waiting. model: content hash of what it drives
    by. Without systemd (no NOTIFY_SOCKET) nothing is told to anybody, and all else is the same; the socket is in
    $RUNTIME_DIRECTORY. Raises ServiceError if it cannot be made there.
    """

    def __init__(
        self,
        report: "Report",
        stop: threading.Event,
        notify: Callable[[str], None] = lambda text: None,
        *,
        model: str = "",
        clock: Callable[[], float] = time.monotonic,
    ):
        self._report, self._stop, self._notify, self._model, self._clock = report, stop, notify, model, clock
        # One that never waits: systemd may be busy, and the loop must not be.
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._systemd = WatchDog(sock=self._socket)
        self._rounds = 0  # of checks that passed
        self._state = self._text = self._missing = ""
        self._done = threading.Event()
        self._threads = [
            threading.Thread(target=self._feed, name="watchdog", daemon=True),
            threading.Thread(target=self._listen, name="operators", daemon=True),
        ]
        self._turn = threading.Condition()  # guards the five below
        self._ticket = ""  # of the next attempt; none: nobody can ask for one now
        self._request: Request | None = None  # of the attempt, and of the drive
        self._asked = False
        self._asked_s = 0.0
        self._answer: dict[str, Any] | None = None
        self._armed_s = self._heard_s = 0.0

    def __enter__(self) -> "Service":
        path = _socket_path()
        self._operators = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            if is_listened_at(path):  # taken from it, nobody could arm its car, and no heartbeat would reach a drive
                self._operators.close()
                raise ServiceError(f"{path}: another service listens there", remedy="end that one first")
            path.unlink(missing_ok=True)
            self._operators.bind(str(path))
            path.chmod(0o600)
        except OSError as error:
            self._operators.close()
            raise ServiceError(f"{path}: no operator could arm the car ({error})", remedy="use systemd") from None
        self._operators.listen()
        self._operators.settimeout(FEED_S)
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._done.set()
        for thread in self._threads:
            thread.join()
        self._operators.close()
        _socket_path().unlink(missing_ok=True)
        if self._state != STOPPING:
            self._stopping(self._report.ended or str(exc[1] or "ended"))
        self._socket.close()

    def wait_for_human(
        self,
        arm: "Arm",
        checks: Iterable[Callable[[], object]] = (),
        missing: Callable[[], str] = lambda: "",
        *,
        said: str = "",
    ) -> "Telemetry | None":
        """Ready: waits until a human arms the car and the Arduino agrees; what arm() returned.

        arm: calls check_request() just before the Arduino is told. checks: what must go on working meanwhile; each
        raises if it does not. missing: what must be done before the car can be armed, "" if nothing; requests are
        refused with it. said: how the drive before this ended. Raises NotArmed when told to stop, and what a check
        raises.
        """
        checks = tuple(checks)
        first, self._state, self._text = not self._rounds, DISARMED, ""
        while not self._stop.is_set():
            for check in checks:
                check()
            self._rounds += 1
            self._missing = missing()
            self._tell(f"{DISARMED}: {said + '; ' if said else ''}{self._missing or WAITING}")
            with self._turn:
                self._ticket = self._ticket or secrets.token_hex(8)
            if first:
                first = False
                with contextlib.suppress(OSError):
                    self._systemd.ready()
            with self._turn:
                if not self._turn.wait_for(lambda: self._asked, CHECK_S):
                    continue
            try:
                if refusal := missing():
                    raise NotArmed(refusal)
                telemetry = arm()
            except RoverError as error:  # what is broken, and not only in the way, the next check finds
                said = f"not armed: {error}"
                self._notify(said)
                self._reply(armed=False, text=str(error))
                continue
            except BaseException:
                self._reply(armed=False, text="the service failed")
                raise
            self._armed_s = self._heard_s = self._clock()
            self._state = DRIVING
            self._tell(f"{DRIVING}: armed by a human")
            self._reply(armed=True, text=self._text)
            return telemetry
        raise NotArmed("told to stop before a human armed the car")

    def check_request(self) -> None:
        """Call this just before the Arduino is told to arm. Raises NotArmed where the operator asked too long ago."""
        check_age(self._clock() - self._asked_s)

    def alive(self) -> None:
        """Tell the watchdog that what goes on after a drive is alive; to be called at each of its turns."""
        self._rounds += 1

    def over(self) -> str | None:
        """Why this drive is over by what was requested, None if it is not. The loop asks at each tick."""
        request, now = self._request or Request(), self._clock()
        if request.max_seconds is not None and now - self._armed_s >= request.max_seconds:
            return f"{request.max_seconds:g} s, as requested"
        if request.heartbeat_s is not None and now - self._heard_s > request.heartbeat_s:
            return f"no heartbeat of the operator for {request.heartbeat_s:g} s"
        return None

    def _reply(self, **answer: Any) -> None:
        """To the request that was tried. A refused one has used up its ticket, and no moment is without the next."""
        with self._turn:
            self._asked, self._answer = False, answer
            self._ticket = "" if answer["armed"] else secrets.token_hex(8)
            self._turn.notify_all()

    # ---- operators

    def _listen(self) -> None:
        while not self._done.is_set():
            try:
                connection, _ = self._operators.accept()
            except TimeoutError:
                continue
            with (
                connection,
                contextlib.suppress(OSError, ValueError, TypeError, OverflowError, RecursionError),
            ):  # nonsense has no answer
                connection.settimeout(1.0)
                _, uid, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
                if uid == 0 or uid == os.geteuid() >= PERSONS:
                    answer = self._answer_to(**json.loads(connection.recv(QUESTION_BYTES)))
                    connection.send(json.dumps(answer).encode())

    def _answer_to(
        self, ask: str, model: str = "", ticket: str = "", asked_s: float | None = None, **limits: float | None
    ) -> dict[str, Any]:
        """asked_s: by the operator's own clock, time.monotonic() too; this process may have been stopped since."""
        if ask == "heartbeat":
            self._heard_s = self._clock()
        if ask != "arm":
            return {"text": self._text, "missing": self._missing, "model": self._model, "ticket": self._ticket}
        now_s = self._clock()
        asked_at_s = now_s if asked_s is None else min(float(asked_s), now_s)
        request = Request(**{name: None if value is None else float(value) for name, value in limits.items()})
        with self._turn:
            if not self._ticket:
                return {"armed": False, "text": self._text or "it is not ready"}
            if (model, ticket) != (self._model, self._ticket):
                text = "the request names another model, or the service was started or tried again meanwhile: ask anew"
                return {"armed": False, "text": text}
            self._ticket, self._request, self._asked, self._answer = "", request, True, None
            self._asked_s = asked_at_s
            self._turn.notify_all()
            while not self._done.is_set():
                if self._turn.wait_for(lambda: self._answer, FEED_S):
                    return self._answer or {}
        return {"armed": False, "text": "the service has ended"}

    # ---- systemd

    def _feed(self) -> None:
        seen, ended, told_s = -1, 0, 0.0
        while not self._done.wait(FEED_S):
            if self._report.ended and self._stop.is_set():
                return self._stopping(self._report.ended)
            happened = self._rounds + self._report.ticks
            ended = ended + 1 if self._report.ended and happened == seen else 0
            if not self._rounds or (happened == seen and not 0 < ended * FEED_S < FINISH_S):
                continue
            seen = happened
            with contextlib.suppress(OSError):
                self._systemd.notify()
            if self._state == DRIVING and time.monotonic() - told_s > STATUS_S and self._report.ticks:
                told_s = time.monotonic()
                self._tell(f"{DRIVING}: {self._report.ended or self._report.status}")

    def _stopping(self, why: str) -> None:
        """Ends the watchdog's time: a policy has to be ended, and files to be written."""
        self._state = STOPPING
        # A notification is lines, and the library has no word for this one.
        self._tell(f"{STOPPING}: {why}", "STOPPING=1")

    def _tell(self, text: str, *more: str) -> None:
        text = " ".join(text.split())
        if text == self._text and not more:
            return
        self._text = text
        with contextlib.suppress(OSError):
            self._systemd.status("\n".join([self._text, *more]))


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


def ask_service(unit: str = UNIT, **question: Any) -> dict[str, Any]:
    """A service's answer to an operator. Raises ServiceError if it is not there to be asked, or gives none."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(ARMED_S)
        try:
            connection.connect(str(_socket_path()))
        except PermissionError as error:
            raise ServiceError(f"{unit} cannot be asked ({error})", remedy="use sudo") from None
        except OSError:
            state = state_of(unit)
            raise ServiceError(
                f"{unit} is {state['active']}, not waiting to be armed ({state['text'] or 'it says nothing'})",
                remedy=f"sudo systemctl start {unit}",
            ) from None
        try:
            connection.send(json.dumps(question).encode())
            return json.loads(connection.recv(QUESTION_BYTES))
        except (OSError, ValueError) as error:
            raise ServiceError(f"{unit} gave no answer ({error})", remedy="use sudo") from None


def arm_car(
    request: Request,
    unit: str = UNIT,
    *,
    model: str = "",
    confirm: Callable[[dict[str, Any]], None] = lambda state: None,
    notify: Callable[[str], None] = lambda text: None,
    wait_s: float = 0.0,
) -> str:
    """Arm the car whose service waits for it; what the service says then. Raises ServiceError if it does not drive.

    model: content hash of the one that is meant; "": whichever the service has, which `confirm` may look at (model,
    text), and raise. wait_s: for what is missing, such as the transmitter; each such sentence goes to `notify`.
    """
    state = ask_service(unit, ask="state")
    if model and state["model"] != model:
        raise ServiceError(
            f"{unit} has loaded another model than {model[:12]}",
            found=state["model"][:12],
            remedy="did somebody else deploy meanwhile?",
        )
    confirm(state)
    now, told, end_s = state, "", time.monotonic() + wait_s
    while now.get("missing") and time.monotonic() < end_s:
        if now["missing"] != told:
            notify(told := now["missing"])
        time.sleep(CHECK_S)
        now = ask_service(unit, ask="state")
    asked = {"model": state["model"], "ticket": state["ticket"], "asked_s": time.monotonic()}
    answer = ask_service(unit, ask="arm", **asked, **vars(request))
    if not answer["armed"]:
        raise ServiceError(f"{unit} did not arm: {answer['text']}", remedy="'rover doctor' says what it needs")
    return answer["text"]


def _socket_path() -> Path:
    return Path(os.environ.get("RUNTIME_DIRECTORY", RUNTIME)) / "operators"
