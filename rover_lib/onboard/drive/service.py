"""Drive as a systemd service, which waits disarmed until a human arms the car, and which systemd's watchdog checks.

A human arms the car by `sudo rover arm-car` on the rover, or by `ansible-playbook ansible/drive.yml -e rover_arm=true`.
Both use a socket that only root may use. A request contains the content hash of the model that is meant, and a ticket,
which changes with each attempt, so that no old request can arm the car later.

However a drive ends, the same process then waits disarmed with the port still open: opening it again might reset the
Arduino, and take the car from the human. The status text (systemctl show --property=StatusText) begins with one of
STATES; deploy.yml restarts the service only while this is "disarmed".

The watchdog is fed only by work that was really done: ticks of the control loop, the checks while the car is disarmed,
ticks of the recording of a human, and for a limited time after a drive, while its episode is finished.
"""

import contextlib
import json
import math
import os
import secrets
import select
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from systemd_watchdog import WatchDog

from rover_lib.onboard.car.host import boottime, is_listened_at
from rover_lib.onboard.errors import RoverError

if TYPE_CHECKING:  # asking for the service's state, as every playbook does, must not import numpy or OpenCV
    from rover_lib.onboard.car.protocol import Telemetry
    from rover_lib.onboard.drive.loop import Arm, Report

UNIT = "rover-drive.service"
RUNTIME = Path("/run/rover-drive")  # the unit's RuntimeDirectory=
CHECK_S = 0.1  # between checks while disarmed
FEED_S = 0.25  # between two looks at whether to feed the watchdog, whose WatchdogSec is 2 s
FINISH_S = 80.0  # to finish an episode on a slow card; TimeoutStopSec is 90 s then
STATUS_S = 1.0
REQUEST_S = 2.0  # longest age of a request to arm: a fresh plan takes 0.8 s, then an episode's folder and the cap
ARMED_S = 10.0  # longest wait for an answer: a fresh plan takes 0.8 s, the Arduino 0.5, and an episode's folder
QUESTION_BYTES = 4096
PERSONS = 1000  # user ids from here on belong to people; the service's own is below
DISARMED, DRIVING, STOPPING = STATES = ("disarmed", "driving", "stopping")
WAITING = "waiting for a human to arm it"
Check = Callable[[], object]  # raises if its device fails


@dataclass(frozen=True)
class Request:
    """Limits that an operator sets for a drive, in seconds; None: no limit. Raises ValueError for one not above 0."""

    max_seconds: float | None = None
    heartbeat_s: float | None = None

    def __post_init__(self) -> None:
        if not all(value is None or 0 < value < math.inf for value in vars(self).values()):
            raise ValueError(f"seconds above 0, not {self}")


def check_age(age_s: float, most_s: float | None = None) -> None:
    """Raise RoverError for a request that is too old: whoever sent it may no longer be watching the car."""
    if most_s is None:
        most_s = REQUEST_S
    if not 0 <= age_s <= most_s:  # also refuses NaN, and a time that has not come yet
        problem = f"{age_s:.1f} s have passed since the car was asked for, at most {most_s:g} may"
        raise RoverError(problem, remedy="ask again", kind="not armed")


class Service:
    """Talks to systemd and to operators about a car's drives; a context manager, for the main thread.

    report: the drive's report, whose ticks feed the watchdog. stop: ends the waiting. model: content hash of the model
    that drives. The operators' socket is in $RUNTIME_DIRECTORY. Raises RoverError if it cannot be made there.
    """

    def __init__(
        self,
        report: "Report",
        stop: threading.Event,
        notify: Callable[[str], None] = lambda text: None,
        *,
        model: str = "",
        clock: Callable[[], float] = boottime,
    ):
        self._report = report
        self._stop = stop
        self._notify = notify
        self._model = model
        self._clock = clock
        # Non-blocking: systemd may be busy, and the loop must not wait for it.
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._systemd = WatchDog(sock=self._socket)
        self._rounds = 0  # rounds of checks that passed
        self._state = self._text = ""
        self._done = threading.Event()
        self._threads = [
            threading.Thread(target=self._feed, name="watchdog", daemon=True),
            threading.Thread(target=self._listen, name="operators", daemon=True),
        ]
        self._turn = threading.Condition()  # guards what is below
        self._ticket = ""  # for the next attempt; empty: nobody can ask for one now
        self._request: Request | None = None  # that of the present attempt or drive
        self._asked = False
        self._asked_s = math.nan
        self._hung_up: Callable[[], bool] = lambda: False
        self._answer: dict[str, Any] | None = None
        self._armed_s = self._heard_s = 0.0

    def __enter__(self) -> "Service":
        path = _socket_path()
        if is_listened_at(path):  # if we took its socket, nobody could arm its car or send it heartbeats
            raise RoverError(f"{path}: another service listens there", remedy="end that one first")
        self._operators = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            path.unlink(missing_ok=True)
            self._operators.bind(str(path))
            path.chmod(0o600)
        except OSError as error:
            self._operators.close()
            raise RoverError(f"{path}: no operator could arm the car ({error})", remedy="use systemd") from None
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
        self, arm: "Arm", checks: Sequence[Check] = (), missing: Callable[[], str] = lambda: "", *, said: str = ""
    ) -> "Telemetry | None":
        """Report ready, wait until a human arms the car and the Arduino agrees, and return what arm() returned.

        arm: must call check_request() just before the Arduino is told. checks: called repeatedly while waiting;
        each raises if its device fails. missing: what must be done before the car can be armed, "" if nothing. said:
        how the previous drive ended. Raises RoverError when told to stop, and what a check raises.
        """
        first = not self._rounds
        self._state = DISARMED
        self._text = ""
        while not self._stop.is_set():
            for check in checks:
                check()
            self._rounds += 1
            self._tell(f"{DISARMED}: {said + '; ' if said else ''}{missing() or WAITING}")
            if first:
                first = False
                with contextlib.suppress(OSError):
                    self._systemd.ready()
            with self._turn:
                self._ticket = self._ticket or secrets.token_hex(8)
                if not self._turn.wait_for(lambda: self._asked, CHECK_S):
                    continue
            try:
                if refusal := missing():
                    raise RoverError(refusal, kind="not armed")
                telemetry = arm()
            except RoverError as error:  # if something is really broken, the next check finds it
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
        raise RoverError("told to stop before a human armed the car", kind="not armed")

    def check_request(self) -> None:
        """Raise RoverError if the operator asked too long ago or is gone. For just before the Arduino is told."""
        check_age(self._clock() - self._asked_s)
        if self._hung_up():
            raise RoverError("whoever asked for the car is gone", remedy="ask again", kind="not armed")

    def alive(self) -> None:
        """Tell the watchdog that the work after a drive goes on."""
        self._rounds += 1

    def over(self) -> str | None:
        """Return why the operator's limits end this drive; None if they do not."""
        request = self._request or Request()
        now = self._clock()
        if request.max_seconds is not None and now - self._armed_s >= request.max_seconds:
            return f"{request.max_seconds:g} s, as requested"
        if request.heartbeat_s is not None and now - self._heard_s > request.heartbeat_s:
            return f"no heartbeat of the operator for {request.heartbeat_s:g} s"
        return None

    def _reply(self, **answer: Any) -> None:
        """Answer the request that was tried. A refused one has used up its ticket."""
        with self._turn:
            self._asked = False
            self._answer = answer
            self._ticket = "" if answer["armed"] else secrets.token_hex(8)
            self._turn.notify_all()

    def _listen(self) -> None:
        while not self._done.is_set():
            try:
                connection, _ = self._operators.accept()
            except TimeoutError:
                continue
            nonsense = OSError, ValueError, TypeError, OverflowError, RecursionError
            with connection, contextlib.suppress(*nonsense):  # it gets no answer
                connection.settimeout(1.0)
                _, uid, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
                if uid == 0 or uid == os.geteuid() >= PERSONS:
                    answer = self._answer_to(connection, **json.loads(connection.recv(QUESTION_BYTES)))
                    connection.send(json.dumps(answer).encode())

    def ask(self, ticket: str, asked_s: float, request: Request, hung_up: Callable[[], bool] = lambda: False) -> str:
        """Take a request, sent at asked_s, to arm the car in the next attempt. Return why it is not taken, or ""."""
        with self._turn:
            if not self._ticket:
                return self._text or "it is not ready"
            if ticket != self._ticket:
                return "the service was started or tried again meanwhile: ask anew"
            self._ticket = ""
            self._request = request
            self._asked = True
            self._answer = None
            self._asked_s = asked_s
            self._hung_up = hung_up
            self._turn.notify_all()
        return ""

    def _answer_to(
        self, operator: socket.socket, ask: str, model: str = "", ticket: str = "", asked_s: Any = None, **limits: Any
    ) -> dict[str, Any]:
        if ask == "heartbeat":
            self._heard_s = self._clock()
        if ask != "arm":
            return {"text": self._text, "model": self._model, "ticket": self._ticket}
        if model != self._model:
            return {"armed": False, "text": "the request names another model: ask anew"}
        request = Request(**{name: None if value is None else float(value) for name, value in limits.items()})
        if refusal := self.ask(ticket, float(asked_s), request, partial(_is_closed, operator)):
            return {"armed": False, "text": refusal}
        with self._turn:
            while not self._done.is_set():
                if self._turn.wait_for(lambda: self._answer, FEED_S):
                    return self._answer or {}
        return {"armed": False, "text": "the service has ended"}

    def _feed(self) -> None:
        number = -1
        ended = 0
        told_s = 0.0
        while not self._done.wait(FEED_S):
            if self._report.ended and self._stop.is_set():
                return self._stopping(self._report.ended)
            happened = self._rounds + self._report.ticks
            ended = ended + 1 if self._report.ended and happened == number else 0
            if not self._rounds or (happened == number and not 0 < ended * FEED_S < FINISH_S):
                continue
            number = happened
            with contextlib.suppress(OSError):
                self._systemd.notify()
            if self._state == DRIVING and time.monotonic() - told_s > STATUS_S and self._report.ticks:
                told_s = time.monotonic()
                self._tell(f"{DRIVING}: {self._report.ended or self._report.status}")

    def _stopping(self, why: str) -> None:
        """Tell systemd, so that its watchdog leaves time to end the policy and write files."""
        self._state = STOPPING
        self._tell(f"{STOPPING}: {why}", "STOPPING=1")  # the library has no function for this line

    def _tell(self, text: str, *more: str) -> None:
        text = " ".join(text.split())
        if text != self._text or more:
            self._text = text
            with contextlib.suppress(OSError):
                self._systemd.status("\n".join([text, *more]))


def _is_closed(connection: socket.socket) -> bool:
    try:
        return bool(select.select([connection], [], [], 0)[0]) and not connection.recv(1, socket.MSG_PEEK)
    except OSError:
        return True


def state_of() -> dict[str, Any]:
    """Return what systemd knows about the service: its state is one of STATES, or "". Raises RoverError without one."""
    command = ["systemctl", "show", "--property=LoadState,ActiveState,StatusText", UNIT]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        raise RoverError(f"systemctl cannot be asked about {UNIT} ({error})", remedy="is this a rover?") from None
    properties = dict(line.partition("=")[::2] for line in result.stdout.splitlines())
    text = properties.get("StatusText", "")
    return {
        "installed": properties.get("LoadState") == "loaded",
        "active": properties.get("ActiveState", "unknown"),
        "state": next((s for s in STATES if text.startswith(s)), ""),
        "text": text,
    }


def ask_service(**question: Any) -> dict[str, Any]:
    """Send a question to the service and return its answer. Raises RoverError if it is not reached or is silent."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(ARMED_S)
        try:
            connection.connect(str(_socket_path()))
            connection.send(json.dumps(question).encode())
            return json.loads(connection.recv(QUESTION_BYTES))
        except (FileNotFoundError, ConnectionRefusedError):
            state = state_of()
            problem = f"{UNIT} is {state['active']}, not waiting to be armed ({state['text'] or 'it says nothing'})"
            raise RoverError(problem, remedy=f"sudo systemctl start {UNIT}") from None
        except (OSError, ValueError) as error:
            raise RoverError(f"{UNIT} gave no answer ({error})", remedy="use sudo") from None


def arm_car(
    request: Request, *, model: str = "", confirm: Callable[[dict[str, Any]], None] = lambda state: None
) -> str:
    """Arm the car whose service waits for it; return what the service then says. Raises RoverError if it refuses.

    model: content hash of the model that is meant; "": whichever is loaded. confirm: called with the service's state
    before arming; may raise.
    """
    state = ask_service(ask="state")
    if model and state["model"] != model:
        problem = f"{UNIT} has loaded another model than {model[:12]}"
        raise RoverError(problem, found=state["model"][:12], remedy="did somebody else deploy meanwhile?")
    confirm(state)
    question = {"model": state["model"], "ticket": state["ticket"], "asked_s": boottime()}
    answer = ask_service(ask="arm", **question, **vars(request))
    if not answer["armed"]:
        raise RoverError(f"{UNIT} did not arm: {answer['text']}", remedy="'rover doctor' says what it needs")
    return answer["text"]


def _socket_path() -> Path:
    return Path(os.environ.get("RUNTIME_DIRECTORY", RUNTIME)) / "operators"
