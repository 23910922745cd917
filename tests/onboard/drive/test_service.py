"""The drive as a service: what systemd hears, and who arms."""

import contextlib
import inspect
import itertools
import json
import math
import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from click.testing import CliRunner
from needs import until

from rover_lib.cli import main
from rover_lib.onboard.car import host
from rover_lib.onboard.car.camera import Frame
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.car.servo_link import MISSING, LinkError, State, Telemetry
from rover_lib.onboard.drive import service as s
from rover_lib.onboard.drive.arming import arm_capped, arm_when_asked, arm_when_ready, wanted_since
from rover_lib.onboard.drive.drive import drive_car
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.drive.opening import DriveOptions
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.drive.session import Arming, Session
from rover_lib.onboard.errors import CameraError, PolicyError
from rover_lib.onboard.recording.episode import json_controls

STATUS = Telemetry(0.0, 7, 0, 0, "k", State.MANUAL, "h", "-", 1456, 120, 238, None, None, None, None, 0, 0, 0, 0)
REQUEST_S = s.REQUEST_S


class Systemd:
    """The other end of NOTIFY_SOCKET."""

    def __init__(self, path: Path):
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))
        self.socket.settimeout(0.01)
        self.lines: list[str] = []

    def hear(self, seconds: float = 0.0) -> list[str]:
        """What has come, after so long."""
        end, new = time.monotonic() + seconds, []
        while True:
            try:
                new += [line for line in self.socket.recv(4096).decode().split("\n") if line]
            except TimeoutError:
                if time.monotonic() >= end:
                    break
        self.lines += new
        return new

    def hear_until(self, text: str) -> None:
        end = time.monotonic() + 90
        while not any(text in line for line in self.lines):
            assert time.monotonic() < end, self.lines
            self.hear(0.05)

    def feeds(self, seconds: float) -> int:
        """How often the watchdog is fed within a duration."""
        return self.hear(seconds).count("WATCHDOG=1")


@pytest.fixture
def systemd(tmp_path, monkeypatch):
    monkeypatch.setattr(s, "REQUEST_S", 30.0)  # a busy machine takes its time to arm, as none that drives may
    found = Systemd(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))

    def give_up(*_) -> None:
        pytest.fail("the service still waits for a human: has what asks for the car failed?")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(120)
    yield found
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
    found.socket.close()


def served(stop=None, said=None, report=None, **more) -> s.Service:
    notify = (said if said is not None else []).append
    return s.Service(report or Report(), stop or threading.Event(), notify, model="ab12", **more)


@contextlib.contextmanager
def beside(systemd: Systemd, *actions):
    """Do things once the service says that it is ready, beside the test; yields what they returned."""
    returned = []

    def run() -> None:
        systemd.hear_until("READY=1")
        for action in actions:
            returned.append(action())

    thread = threading.Thread(target=run)
    thread.start()
    yield returned
    thread.join()


def waits_unarmed(systemd: Systemd, action, arm=lambda: pytest.fail("armed"), **more) -> list:
    """A service that nothing arms while the action runs beside it; returns what that returned."""
    stop = threading.Event()
    refused = pytest.raises(s.RoverError, match="told to stop")
    with served(stop, **more) as service, beside(systemd, action, stop.set) as returned, refused:
        service.wait_for_human(lambda: arm(service) if more else arm())
    return returned


def human(**limits) -> str:
    """Arms, and returns what the service says then, or why it did not."""
    try:
        return s.arm_car(s.Request(**limits))
    except s.RoverError as error:
        return str(error)


def armed() -> str:
    return "telemetry"


def ask_to_arm(**more) -> dict:
    """Ask as `rover arm-car` does, with a good ticket."""
    asked = {"ask": "arm", "model": "ab12", "ticket": s.ask_service(ask="state")["ticket"], "asked_s": host.boottime()}
    return s.ask_service(**asked | more)


def test_ready_and_disarmed_until_a_human_arms(systemd, tmp_path):
    calls = []
    with served() as service:
        assert stat.S_IMODE((tmp_path / "operators").stat().st_mode) == 0o600
        assert "it is not ready" in human()  # who asked now could not know what the car would do
        with beside(systemd, human) as answers:
            assert service.wait_for_human(lambda: calls.append("now") or "telemetry") == "telemetry"
    systemd.hear()
    assert calls == ["now"] and answers == ["driving: armed by a human"]
    ready = systemd.lines.index("READY=1")
    assert systemd.lines[ready - 1] == "STATUS=disarmed: waiting for a human to arm it"
    assert "STATUS=driving: armed by a human" in systemd.lines[ready:]
    assert systemd.lines[-1] == "STOPPING=1" and systemd.lines[-2].startswith("STATUS=stopping: ")


def test_an_arduino_that_refuses_leaves_it_waiting(systemd):
    refusals, said = [LinkError("no transmitter")], []

    def arm():
        if refusals:
            raise refusals.pop()
        return "telemetry"

    with served(said=said) as service, beside(systemd, human, human) as answers:
        assert service.wait_for_human(arm) == "telemetry"
    systemd.hear()
    assert "STATUS=disarmed: not armed: no transmitter; waiting for a human to arm it" in systemd.lines
    assert said == ["not armed: no transmitter"]
    assert "did not arm: no transmitter" in answers[0] and answers[1] == "driving: armed by a human"


@pytest.mark.slow
def test_one_request_is_one_attempt(systemd):
    """Two at once, of which the first is refused: the second must not arm the car half a second later."""
    calls, answers = [], []

    def arm():
        calls.append(1)
        threading.Thread(target=lambda: answers.append(s.ask_service(**asked))).start()
        time.sleep(0.2)
        if len(calls) == 1:
            raise LinkError("not yet")

    asked = {"ask": "arm", "model": "ab12", "asked_s": host.boottime()}

    def twice() -> None:
        asked["ticket"] = s.ask_service(ask="state")["ticket"]
        answers.append(s.ask_service(**asked))
        time.sleep(0.5)

    waits_unarmed(systemd, twice, arm)
    assert len(calls) == 1 and [answer["armed"] for answer in answers] == [False, False]


def test_nobody_can_ask_for_the_car_while_it_drives(systemd):
    """Such a request would arm it again as soon as that drive ends."""
    with served() as service:
        with beside(systemd, ask_to_arm) as asked:
            assert service.wait_for_human(armed) == "telemetry"
        assert asked[0]["armed"] and s.ask_service(ask="state")["ticket"] == ""


@pytest.mark.parametrize("old", [{"asked_s": s} for s in (-1e9, math.nan, math.inf, 101.0)] + [{"asked_s": 100.0}])
def test_an_operator_who_asked_long_ago_is_asked_again(systemd, monkeypatch, old):
    """The camera was slow, or this process was stopped: the car must not set off when nobody expects it any more."""
    monkeypatch.setattr(s, "REQUEST_S", REQUEST_S)
    calls, now = [], [100.0]

    def arm(service):
        if old["asked_s"] == 100:
            now[0] += s.REQUEST_S + 0.1  # arming itself takes too long
        service.check_request()
        calls.append(1)

    answer, _ = waits_unarmed(systemd, lambda: ask_to_arm(**old), arm, clock=lambda: now[0])
    assert not calls and not answer["armed"] and "ask again" in answer["text"]


def test_who_has_hung_up_gets_no_car(systemd, tmp_path):
    """The car set off although nobody waited for it any more."""
    calls = []

    def operator() -> None:
        question = {"ask": "arm", "model": "ab12", "asked_s": host.boottime()}
        question["ticket"] = s.ask_service(ask="state")["ticket"]
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
            connection.connect(str(tmp_path / "operators"))
            connection.send(json.dumps(question).encode())
        until(lambda: calls)

    def arm(service):
        time.sleep(0.2)  # as long as a fresh plan takes
        calls.append("tried")
        service.check_request()
        calls.append("armed")

    waits_unarmed(systemd, operator, arm, clock=host.boottime)
    assert calls == ["tried"]


def test_a_request_names_the_model_that_it_arms(systemd):
    """Another operator deployed in between, and the service was started again."""

    def operator() -> list:
        with pytest.raises(s.RoverError, match="another model than cd34"):
            s.arm_car(s.Request(), model="cd34")
        return [ask_to_arm(**wrong)["armed"] for wrong in ({"model": "cd34"}, {"ticket": "old"}, {"ticket": ""})]

    answers, _ = waits_unarmed(systemd, operator)
    assert answers == [False] * 3


@pytest.mark.parametrize(
    "nonsense",
    [b"", b"[]", b'{"ask": "arm", "seconds": 7}', b'{"ask": "arm", "max_seconds": NaN}', b"\xff", b"[" * 4000],
)
def test_nonsense_arms_nothing(systemd, tmp_path, nonsense):
    def talk() -> str:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
            connection.connect(str(tmp_path / "operators"))
            connection.send(nonsense)
        return s.ask_service(ask="state")["text"]  # it still answers

    assert waits_unarmed(systemd, talk)[0] == "disarmed: waiting for a human to arm it"


@pytest.mark.parametrize(
    "limits", [{"max_seconds": -1}, {"asked_s": 10**400}, {"asked_s": "soon"}, {"asked_s": None}], ids=range(4)
)
def test_a_request_with_a_number_that_is_none_is_no_attempt(systemd, limits):
    """All else in it is right: the model, and the ticket, which stays good."""

    def operator() -> None:
        state = s.ask_service(ask="state")
        with pytest.raises(s.RoverError, match="no answer"):
            ask_to_arm(**limits)
        assert s.ask_service(ask="state") == state

    waits_unarmed(systemd, operator)


def test_a_second_service_leaves_the_first_its_operators(systemd, monkeypatch):
    with served() as first:
        with pytest.raises(s.RoverError, match="another service"), served():
            pass
        with beside(systemd, human):
            assert first.wait_for_human(armed) == "telemetry"
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/nowhere")
    with pytest.raises(s.RoverError, match="/nowhere/operators"), served():
        pass


def test_says_what_is_missing_and_refuses_until_then(systemd):
    missing, told = ["switch the transmitter on"], []

    def operator() -> str:
        systemd.hear_until("STATUS=disarmed: switch the transmitter on")
        assert "did not arm: switch the transmitter on" in human()
        missing[0] = "wiggle the stick"
        with pytest.raises(s.RoverError, match="did not arm: wiggle the stick"):
            s.arm_car(s.Request(), wait_s=0.1)
        threading.Timer(0.2, missing.__setitem__, (0, "")).start()
        return s.arm_car(s.Request(), notify=told.append, wait_s=10)

    with served() as service, beside(systemd, operator) as answers:
        assert service.wait_for_human(armed, missing=lambda: missing[0]) == "telemetry"
    assert answers == ["driving: armed by a human"] and told == ["wiggle the stick"]


def test_what_breaks_while_it_waits_ends_it(systemd):
    def check() -> None:
        raise LinkError("the Arduino said nothing for 0.6 s")

    with served() as service, pytest.raises(LinkError):
        service.wait_for_human(lambda: pytest.fail("armed"), [check])


def test_a_request_limits_its_drive(systemd):
    """And those limits are forgotten with the drive; who asked before does not arm the car again."""
    now, report = [1000.0], Report()
    with served(clock=lambda: now[0], report=report) as service:
        with beside(systemd, lambda: human(max_seconds=30, heartbeat_s=5)):
            service.wait_for_human(armed)
        assert "did not arm: driving: armed by a human" in human()
        now[0] += 4.9
        assert service.over() is None
        now[0] += 0.2
        assert "no heartbeat" in service.over()  # the laptop is gone
        for _ in range(5):
            s.ask_service(ask="heartbeat")
            now[0] += 4.9
            assert service.over() is None
        s.ask_service(ask="heartbeat")
        now[0] += 0.9
        assert service.over() == "30 s, as requested"
        report.ended = "the human took over"
        report.clear()
        thread = threading.Thread(target=lambda: (systemd.hear_until("STATUS=disarmed: the human took over"), human()))
        thread.start()
        service.wait_for_human(armed, said="the human took over")
        thread.join()
        now[0] += 100
        assert service.over() is None
    assert systemd.lines.count("READY=1") == 1


@pytest.mark.slow
def test_the_watchdog_hears_of_ticks_that_happened_only(systemd, monkeypatch):
    monkeypatch.setattr(s, "FEED_S", 0.05)
    report = Report()
    with served(report=report) as service:
        assert systemd.feeds(0.2) == 0  # nothing before it is ready: loading takes what it takes
        with beside(systemd, lambda: (time.sleep(0.4), human())):
            service.wait_for_human(lambda: None)
        systemd.hear(2 * s.FEED_S)
        assert systemd.lines.count("WATCHDOG=1") >= 2  # the checks while it waits
        assert systemd.feeds(0.3) == 0  # armed, and the loop hangs
        report.status = "steering +0.10\nREADY=0"
        for _ in range(16):
            report.ticks += 1
            systemd.hear(0.02)
        assert systemd.lines[-20:].count("WATCHDOG=1") >= 2
        systemd.hear(2 * s.FEED_S)
        assert systemd.feeds(0.3) == 0
    assert "STATUS=driving: steering +0.10 READY=0" in systemd.lines and "READY=0" not in systemd.lines


@pytest.mark.slow
def test_an_episode_may_be_finished_after_a_drive_but_not_for_ever(systemd, monkeypatch):
    monkeypatch.setattr(s, "FEED_S", 0.05)
    monkeypatch.setattr(s, "FINISH_S", 0.5)
    report = Report()
    with served(report=report) as service:
        with beside(systemd, human):
            service.wait_for_human(lambda: None)
        report.ended = "the human took over"
        assert systemd.feeds(0.4) >= 2
        systemd.hear(0.6)
        assert systemd.feeds(0.4) == 0


def test_the_watchdog_has_no_say_once_it_was_told_to_stop(systemd):
    """An episode is finished, say, which takes what it takes; said once."""
    report, stop = Report(), threading.Event()
    with served(stop, report=report):
        report.ended = "told to stop"
        stop.set()
        systemd.hear_until("STOPPING=1")
    systemd.hear(0.1)
    assert systemd.lines == ["STATUS=stopping: told to stop", "STOPPING=1"]


@pytest.mark.parametrize("there", ["busy", "none"])
def test_a_systemd_that_takes_nothing_holds_nobody_up(systemd, monkeypatch, tmp_path, there):
    if there == "none":
        monkeypatch.delenv("NOTIFY_SOCKET")
    with served() as service:
        systemd.socket.close()
        threading.Timer(0.1, human).start()
        assert service.wait_for_human(armed) == "telemetry"
    assert not (tmp_path / "operators").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be another user")
def test_another_user_arms_nothing_even_if_the_socket_is_open_to_all(systemd, monkeypatch):
    """Only the socket's mode was tested, and not who asks."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(folder))
    code = (
        "import os, socket; os.setuid(65534); c = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)\n"
        f"c.connect('{folder}/operators'); c.send(b'{{\"ask\": \"state\"}}'); print(c.recv(100))"
    )
    with served():
        (folder / "operators").chmod(0o666)
        assert s.ask_service(ask="state")["model"] == "ab12"
        done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True)
    shutil.rmtree(folder)
    assert "connect" not in done.stderr and "ab12" not in done.stdout, done  # it got no answer, or was cut off


# rover arm-car


@pytest.mark.parametrize("active", ["inactive", "activating"])
def test_a_service_that_is_not_there_is_not_armed(tmp_path, monkeypatch, active):
    script = tmp_path / "systemctl"
    shown = f"LoadState=loaded\\nActiveState={active}\\nStatusText=driving: x\\nNRestarts=2\\nUnitFileState=disabled\\n"
    script.write_text(f"#!/bin/sh\nprintf '{shown}'\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    found = s.state_of()
    assert found["state"] == "driving" and found["restarts"] == 2 and found["installed"] and not found["at_boot"]
    with pytest.raises(s.RoverError, match=f"is {active}, not waiting to be armed .*; sudo systemctl start rover"):
        s.arm_car(s.Request())
    script.write_text("#!/bin/sh\nexit 1\n")
    with pytest.raises(s.RoverError, match="is this a rover"):
        s.state_of()
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(s.RoverError, match="is this a rover"):
        s.state_of()


def test_arming_asks_first(systemd):
    def operator() -> list:
        run = lambda answer, *options: CliRunner().invoke(main, ["arm-car", *options], input=f"{answer}\n")  # noqa: E731
        no, yes = run("n", "--max-seconds", "9"), run("y", "--max-seconds", "9")
        return [run("y", "--model", "cd34"), no, yes, CliRunner().invoke(main, ["arm-car", "--heartbeat"])]

    with served() as service, beside(systemd, operator) as results:
        service.wait_for_human(armed)
    other, no, yes, beat = results[0]
    assert other.exit_code == 1 and "another model than cd34" in other.output
    assert no.exit_code == 1 and "model ab12" in no.output
    assert yes.exit_code == 0 and "driving: armed by a human" in yes.output
    assert (beat.exit_code, beat.output) == (0, "driving: armed by a human\n")


def test_ages_of_consent_go_on_while_the_machine_is_suspended(monkeypatch):
    """CLOCK_MONOTONIC stands still then: a request of before armed the car."""
    asked, answer = [], {"model": "", "ticket": "", "armed": True, "text": ""}
    monkeypatch.setattr(s, "ask_service", lambda unit, ask, **more: asked.append(more) or answer)
    monkeypatch.setattr(host.time, "clock_gettime", {time.CLOCK_BOOTTIME: 5000.0}.__getitem__)
    s.arm_car(s.Request())
    assert asked[-1]["asked_s"] == 5000.0
    for function in (s.Service.__init__, wanted_since, Session.__init__):
        parameters = inspect.signature(function).parameters
        assert (parameters.get("clock") if function is not Session.__init__ else parameters["now"]).default() == 5000.0
    assert DriveOptions(Path("policy.pt")).asked_s == 5000.0


# arming.py


def test_an_old_plan_is_renewed_before_the_car_is_armed():
    """Or it would set off by a picture of long ago."""
    asked = []

    def renew(age_s):
        asked.append(age_s)
        raise PolicyError("no fresh plan")

    with pytest.raises(PolicyError):
        arms(renew)
    assert asked == [Settings().fade_s]


def arms(renew=lambda age_s: None, check_sight=lambda: None, asked_s=0.0):
    """Arm at 40 s by a session whose car was asked for at asked_s."""
    planner = SimpleNamespace(without_rest=contextlib.nullcontext, renew=renew)
    cap = replace(STATUS, cap_us=238)
    link = SimpleNamespace(request=lambda keep: None, calibration=PwmCalibration(), lower_cap=lambda us: cap)
    link.arm = lambda: "armed"
    log, options = SimpleNamespace(event=lambda *_: None), DriveOptions(Path("policy.pt"), asked_s=asked_s)
    session = Session(options, Settings(), Report(), log, None, link, None, planner, None, 30.0, "static",
                      boost=contextlib.nullcontext, now=lambda: 40.0)  # fmt: skip
    with Arming(session, SimpleNamespace(check_sight=check_sight)) as arming:
        return arming.arm()


def test_no_car_is_armed_whose_camera_shows_nothing():
    def check_sight():
        raise CameraError("black")

    assert arms(asked_s=11.0) == "armed"
    with pytest.raises(CameraError):
        arms(check_sight=check_sight, asked_s=11.0)


def test_no_car_is_armed_for_a_command_of_long_ago():
    """Loading a policy took 45 s, and the 30 s began after it."""
    with pytest.raises(s.RoverError):
        arms()


def lacking(steps):
    """Return a link whose statuses lack one of these after the other."""
    latest = lambda: replace(STATUS, missing=next(steps))  # noqa: E731
    return SimpleNamespace(latest=latest, request=lambda: None, remedy=MISSING.get)


def test_a_human_in_a_terminal_is_told_what_is_missing():
    """In the order in which a human does it; said once each."""
    link, stop, said, checked = lacking(iter("sstwww-")), threading.Event(), [], []
    checks = [lambda: checked.append(1)]
    wanted = {"still_wanted": lambda: None, "terminal": True}
    assert arm_when_asked(armed, link, stop, said.append, checks, **wanted) == "telemetry"
    assert [text.partition(": ")[2] for text in said] == [MISSING[step] for step in "stw"]
    assert len(checked) == 6
    stop.set()  # who goes away gets nothing
    with pytest.raises(s.RoverError):
        arm_when_asked(lambda: pytest.fail("armed"), lacking(itertools.repeat("s")), stop, print, **wanted)


@pytest.mark.parametrize("missing", ["ww-", "-"])
def test_a_drive_that_waits_in_a_terminal_does_not_arm_later(missing):
    """It armed 3,628 s after the command, as the human let go of the throttle; or when a suspended machine woke up."""
    wanted = wanted_since(0.0, iter([3600.0] if missing == "-" else [20.0, 31.0]).__next__)
    with pytest.raises(s.RoverError, match="at most 30"):
        arm_when_ready(lambda: pytest.fail("armed"), lacking(iter(missing)), threading.Event(), print, (), wanted)


# The whole: rover drive --service, as systemd starts it


class Link:
    """An Arduino that arms once the stick was wiggled, and whose human takes over after ten commands."""

    port, hello, garbled, calibration, car = "fake", None, 0, PwmCalibration(), Car()
    opened, missing, remedy = 0, "-", MISSING.get
    arms: ClassVar[list[float]] = []
    caps: ClassVar[list[int]] = []

    def __init__(self, port, car=None):
        self.state, self.sequence, self.left = State.MANUAL, 0, 10

    def unacknowledged_s(self, now_s):
        return 0.0

    def request(self, keep=False):
        pass

    def __enter__(self):
        type(self).opened += 1
        return self

    def __exit__(self, *exc):
        pass

    def arm(self):
        self.arms.append(time.monotonic())
        self.state, self.left = State.AUTONOMOUS, 10
        return self.latest()

    def lower_cap(self, throttle_us):
        self.caps.append(throttle_us)
        return replace(self.latest(), cap_us=min(throttle_us, 200))

    def neutral(self):
        return self.latest()

    def send(self, steering_us, throttle_us):
        self.sequence += 1
        self.left -= 1
        self.state = State.AUTONOMOUS if self.left else State.MANUAL
        return self.sequence

    def latest(self):
        return replace(STATUS, host_s=time.monotonic(), sequence=self.sequence, state=self.state, missing=self.missing)


class DrivenLink(Link):
    """And who then drives for three seconds."""

    sent_later: ClassVar[list[int]] = []
    taken_s = 0.0

    def send(self, steering_us, throttle_us):
        if self.taken_s:
            self.sent_later.append(self.sequence)
        super().send(steering_us, throttle_us)
        if self.state is State.MANUAL:
            type(self).taken_s = time.monotonic()
        return self.sequence

    @property
    def turned(self):
        return self.latest()

    def latest(self):
        moved = self.state is State.MANUAL and time.monotonic() - self.taken_s < 3
        steering_us, throttle_us = (1600, 180) if moved else (1456, 120)
        sticks = {"receiver_steering_us": steering_us, "receiver_throttle_us": throttle_us}
        periods = {"receiver_steering_period_us": 21316, "receiver_throttle_period_us": 1016}
        pins = {"steering_us": steering_us, "throttle_us": throttle_us}
        return replace(super().latest(), uptime_ms=int(time.monotonic() * 1000), **sticks, **periods, **pins)


@pytest.fixture(autouse=True)
def _new_links(monkeypatch):
    for kind, names in ((Link, ("arms", "caps")), (DrivenLink, ("arms", "caps", "sent_later"))):
        monkeypatch.setattr(kind, "opened", 0)
        for name in names:
            monkeypatch.setattr(kind, name, [], raising=False)
    monkeypatch.setattr(DrivenLink, "taken_s", 0)


def test_the_arduino_is_told_what_a_drive_may_use():
    """And the human, where it gives less than that: it was cut in silence."""
    link, said = Link("port"), []
    assert arm_capped(link, 0.1, said.append).state is State.AUTONOMOUS
    assert (link.caps, said) == ([179], [])
    arm_capped(link, 0.2, said.append)
    assert link.caps == [179, 238] and "at most throttle 0.14 (200 us)" in said[0]
    with pytest.raises(s.RoverError, match=r"3\.0 s have passed"):
        arm_capped(link, 0.1, said.append, lambda: s.check_age(3.0))
    assert len(link.arms) == 2


class Opened:
    """Any device that a drive opens."""

    def __init__(self, given, **options):
        self.path = given

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass


class Policy(Opened):
    manifest: ClassVar[dict] = {"mode": "fake"}
    rate_hz, pids, unconfined = 30.0, (), ""

    def predict(self, frame_bgr, state):
        return np.tile(np.float32([0.1, 0.05]), (32, 1))


class OneFile(Opened):
    manifest: ClassVar[dict] = {"mode": "fake", "cameras": [{"height": 160, "width": 320}]}
    content_hash = "ab12"


class Eyes(Opened):
    """A camera that has a new picture whenever it is asked."""

    wanted_hz, number = 30.0, 0

    def begin(self):
        pass

    def latest(self):
        self.number += 1
        return Frame(np.zeros((160, 320, 3), np.uint8), time.monotonic(), self.number, 0, 100.0, 40.0)

    def wait(self, after, timeout_s):
        time.sleep(0.005)
        return self.latest()


@pytest.fixture
def drive_fakes(monkeypatch, tmp_path):
    """Drive as a service with fakes for all devices: drive_fakes(link's class, more options)."""

    def drive(link, **options):
        for name, fake in {"ServoLink": link, "PolicyProcess": Policy, "Artifact": OneFile, "Camera": Eyes}.items():
            monkeypatch.setattr(f"rover_lib.onboard.drive.drive.{name}", fake)
        given = {"artifact": tmp_path / "policy.pt", "camera": str(tmp_path), "film": True, "service": True}
        drive_car(DriveOptions(**given | {"log_file": tmp_path / "flight.log"} | options), Report())

    return drive


def test_the_age_of_a_command_begins_before_its_policy_is_loaded(monkeypatch, drive_fakes):
    now_s = [100.0]

    def loads(policy):
        now_s[0] += 45
        return policy

    monkeypatch.setattr(host.time, "clock_gettime", lambda clock: now_s[0])
    monkeypatch.setattr(Policy, "__enter__", loads)
    with pytest.raises(s.RoverError):
        drive_fakes(Link, service=False)
    assert Link.arms == []


@pytest.mark.slow
def test_after_a_takeover_the_same_process_waits_for_another_request(systemd, tmp_path, monkeypatch, drive_fakes):
    """The port stays open: opened again, it might reset the Arduino, and the human would lose the car."""
    monkeypatch.setattr(Link, "missing", "w")

    def operator() -> list:
        systemd.hear_until("STATUS=disarmed: move the steering stick")
        assert "did not arm: move the steering stick" in human()
        Link.missing = "-"
        answers = [human()]
        systemd.hear_until("STATUS=disarmed: the human took over with the transmitter; waiting for a human to arm it")
        answers.append(human(max_seconds=0.2))
        systemd.hear_until("STATUS=disarmed: 0.2 s, as requested; waiting for a human to arm it")
        os.kill(os.getpid(), signal.SIGTERM)
        return answers

    with beside(systemd, operator) as answers, pytest.raises(s.RoverError, match="told to stop"):
        drive_fakes(Link)
    assert answers == [["driving: armed by a human"] * 2]
    assert (Link.opened, len(Link.arms)) == (1, 2)
    assert Link.caps == [238, 238]  # before each: the Arduino may have been reset meanwhile
    first, second = read_log(tmp_path / "flight.log", 0), read_log(tmp_path / "flight.log", 1)
    assert len(first.ticks["t_s"]) == 10 and first.drives == 2
    # 0.2 s are six periods; a busy machine misses some of them, and the wait for the human is none.
    assert 5 <= len(second.ticks["t_s"]) + second.summary()["missed"] <= 8
    assert any(e.text == "the human took over with the transmitter" for e in first.events)


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["let go", "SIGTERM"])
def test_a_takeover_is_recorded_and_then_the_service_waits_disarmed(systemd, tmp_path, monkeypatch, drive_fakes, ends):
    monkeypatch.setattr("rover_lib.onboard.drive.takeover.LET_GO_S", 0.5)
    monkeypatch.setattr(s, "FINISH_S", 0.0)  # the watchdog hears of what happens, and of nothing else

    def operator() -> list:
        answers = [human()]
        until(lambda: DrivenLink.taken_s)
        systemd.hear_until("STATUS=driving: the human took over")
        answers.append(human())  # nobody can ask for a car that the human has
        systemd.lines.clear()
        if ends == "let go":
            assert systemd.feeds(0.8) >= 2
            systemd.hear_until("STATUS=disarmed: the human took over with the transmitter; waiting for a human")
        os.kill(os.getpid(), signal.SIGTERM)
        return answers

    # A service that waits again raises; one that was told to stop before just ends.
    with beside(systemd, operator) as answers, contextlib.suppress(s.RoverError):
        drive_fakes(DrivenLink, record=tmp_path / "episodes")
    assert answers[0][0] == "driving: armed by a human" and "did not arm" in answers[0][1]
    assert (len(DrivenLink.arms), DrivenLink.opened, DrivenLink.sent_later) == (1, 1, [])
    (episode,) = (tmp_path / "episodes").iterdir()
    content = json.loads((episode / "episode_data.json").read_text())
    drivers = [row["driver"] for row in content["control_samples"]]
    commands = drivers.index("human")
    assert 4 < commands <= 10 and set(drivers[:commands]) == {"policy"} and set(drivers[commands:]) == {"human"}
    takeover = content["metadata"]["takeover"]
    assert ("rest" if ends == "let go" else "told to stop") in takeover["ended"]
    assert takeover["controls"] == {"human": len(drivers) - commands, "nobody": 0}
    assert "fault" not in content["metadata"]
    events = [e.text for e in read_log(tmp_path / "flight.log", 0).events]
    assert events.index("the human took over with the transmitter") < events.index(f"recorded: {episode}")


def test_a_service_is_armed_by_a_human_and_a_loop_that_hangs_is_not_fed_for(systemd, tmp_path, demo_run):
    command = [str(Path(sys.executable).with_name("rover")), "drive", str(demo_run / "policy_static.pt"), "--world"]
    options = ["--service", "--log", tmp_path / "flight.log", "--record", tmp_path / "episodes", "--record-mb", "200"]
    env = {**os.environ, "WATCHDOG_USEC": "2000000"}
    process = subprocess.Popen([*command, *map(str, options)], stderr=subprocess.PIPE, text=True, env=env)
    try:
        systemd.hear_until("READY=1")
        assert systemd.feeds(1.5) >= 3
        assert not any("driving" in line for line in systemd.lines)
        assert os.sched_getscheduler(process.pid) == os.SCHED_OTHER  # nobody is in a hurry
        assert human() == "driving: armed by a human"
        if os.geteuid() == 0:
            assert os.sched_getscheduler(process.pid) == os.SCHED_RR | os.SCHED_RESET_ON_FORK
        assert systemd.feeds(2.0) >= 4
        assert any(line.startswith("STATUS=driving: ") and "steering" in line for line in systemd.lines)
        process.send_signal(signal.SIGSTOP)
        systemd.hear(0.5)
        assert systemd.feeds(2.0) == 0  # here systemd would kill it; the Arduino has stopped the car
        systemd.lines.clear()
        process.send_signal(signal.SIGCONT)
        # Which of the two it finds first is a matter of threads; it does not drive on.
        systemd.hear_until("STATUS=disarmed: ")
        systemd.hear(0.5)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 0 and "told to stop before a human armed the car" in said, said
    assert not any("driving" in line for line in systemd.hear()) and "STOPPING=1" in systemd.lines
    flight = read_log(tmp_path / "flight.log")
    assert any(e.text == "armed" for e in flight.events)
    (episode,) = (tmp_path / "episodes").iterdir()  # of the drive, not of the time before
    assert len(json_controls(episode / "episode_data.json")) == pytest.approx(len(flight.ticks["t_s"]), abs=2)
    assert flight.ticks["plan"][0] < 10 and flight.ticks["plan_age_ms"][0] <= 1e3 * Settings().fade_s


def test_a_service_is_no_dry_run():
    result = CliRunner().invoke(main, ["drive", "--service", "policy.pt", "--dry-run"])
    assert result.exit_code != 0
