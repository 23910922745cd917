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

import pytest
from click.testing import CliRunner

from rover_lib.cli import main
from rover_lib.onboard.car import host
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.car.servo_link import MISSING, LinkError
from rover_lib.onboard.drive import service as s
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.drive.session import Arming, DriveOptions, Session, arm_when_ready
from rover_lib.onboard.errors import CameraError
from tests.helpers.fake_drive import STATUS
from tests.helpers.needs import until

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


def test_who_was_refused_may_ask_again(systemd):
    """First something is missing, then the Arduino refuses; each request is used up."""
    missing, tickets, again = ["switch the transmitter on"], [], []

    def operator() -> list:
        systemd.hear_until("STATUS=disarmed: switch the transmitter on")
        tickets.append(s.ask_service(ask="state")["ticket"])
        first, missing[0] = human(), ""
        return [first, human(), human()]

    def arm():
        again.append(service.ask(tickets[0], host.boottime(), s.Request()))
        if len(again) == 1:
            raise LinkError("no transmitter")
        return "telemetry"

    with served(said=(said := [])) as service, beside(systemd, operator) as answers:
        assert service.wait_for_human(arm, missing=lambda: missing[0]) == "telemetry"
    systemd.hear()
    assert "STATUS=disarmed: not armed: no transmitter; waiting for a human to arm it" in systemd.lines
    assert said == ["not armed: switch the transmitter on", "not armed: no transmitter"] and all(again)
    assert "switch the transmitter on" in answers[0][0] and "no transmitter" in answers[0][1]
    assert answers[0][2] == "driving: armed by a human"


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

    assert waits_unarmed(systemd, operator)[0] == [False] * 3


NONSENSE = b"", b"[]", b'{"ask": "arm", "seconds": 7}', b"\xff", b"[" * 4000
NO_NUMBERS = {"max_seconds": math.nan}, {"max_seconds": -1}, {"asked_s": 10**400}, {"asked_s": "soon"}


def test_nonsense_arms_nothing_and_is_no_attempt(systemd, tmp_path):
    """Of the last, all else is right: the model, and the ticket, which stays good."""

    def operator() -> str:
        for nonsense in NONSENSE:
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
                connection.connect(str(tmp_path / "operators"))
                connection.send(nonsense)
        state = s.ask_service(ask="state")
        for limits in NO_NUMBERS:
            with pytest.raises(s.RoverError):
                ask_to_arm(**limits)
        assert s.ask_service(ask="state") == state
        return state["text"]

    assert waits_unarmed(systemd, operator)[0] == "disarmed: waiting for a human to arm it"


def test_a_second_service_leaves_the_first_its_operators(systemd, monkeypatch):
    with served() as first:
        with pytest.raises(s.RoverError, match="another service"), served():
            pass
        with beside(systemd, human):
            assert first.wait_for_human(armed) == "telemetry"
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/nowhere")
    with pytest.raises(s.RoverError, match="/nowhere/operators"), served():
        pass


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
    monkeypatch.setattr(s, "FINISH_S", 0.5)
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
        report.ended = "the human took over"  # an episode may be finished now, but not for ever
        assert systemd.feeds(0.4) >= 2
        systemd.hear(0.6)
        assert systemd.feeds(0.4) == 0
    assert "STATUS=driving: steering +0.10 READY=0" in systemd.lines and "READY=0" not in systemd.lines


def test_the_watchdog_has_no_say_once_it_was_told_to_stop(systemd):
    """An episode is finished, say, which takes what it takes; said once."""
    report, stop = Report(), threading.Event()
    with served(stop, report=report):
        report.ended = "told to stop"
        stop.set()
        systemd.hear_until("STOPPING=1")
    systemd.hear(0.1)
    assert systemd.lines == ["STATUS=stopping: told to stop", "STOPPING=1"]


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


def test_a_service_that_is_not_there_is_not_armed(tmp_path, monkeypatch):
    script = tmp_path / "systemctl"
    script.write_text("#!/bin/sh\nprintf 'LoadState=loaded\\nActiveState=inactive\\nStatusText=driving: x\\n'\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    assert s.state_of() == {"installed": True, "active": "inactive", "state": "driving", "text": "driving: x"}
    with pytest.raises(s.RoverError, match="inactive"):
        s.arm_car(s.Request())
    script.write_text("#!/bin/sh\nexit 1\n")
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
    monkeypatch.setattr(s, "ask_service", lambda ask, **more: asked.append(more) or answer)
    monkeypatch.setattr(host.time, "clock_gettime", {time.CLOCK_BOOTTIME: 5000.0}.__getitem__)
    s.arm_car(s.Request())
    assert asked[-1]["asked_s"] == 5000.0
    clocks = [(s.Service, "clock"), (Session, "now")]
    assert [inspect.signature(what).parameters[name].default() for what, name in clocks] == [5000.0] * 2
    assert DriveOptions(Path("policy.pt")).asked_s == 5000.0


def session_of(asked_s=0.0, renew=lambda age_s: None, **parts):
    """A session at 40 s, whose car was asked for at asked_s."""
    planner = SimpleNamespace(without_rest=contextlib.nullcontext, renew=renew)
    cap = replace(STATUS, cap_us=238)
    link = SimpleNamespace(request=lambda keep: None, calibration=PwmCalibration(), lower_cap=lambda us: cap)
    link.arm = lambda: "armed"
    log, options = SimpleNamespace(event=lambda *_: None), DriveOptions(Path("policy.pt"), asked_s=asked_s)
    given = {"link": link, "camera": None} | parts
    return Session(options, Settings(), Report(), log, None, planner=planner, commanded=None, rate_hz=30.0,
                   mode="static", boost=contextlib.nullcontext, now=lambda: 40.0, **given)  # fmt: skip


def arms(check=lambda: None, **given):
    with Arming(session_of(**given), SimpleNamespace(check=check)) as arming:
        return arming.arm()


def test_an_old_plan_is_renewed_before_the_car_is_armed():
    """Or it would set off by a picture of long ago."""
    asked = []
    assert arms(renew=asked.append, asked_s=11.0) == "armed" and asked == [Settings().fade_s]


def test_no_car_is_armed_whose_camera_shows_nothing():
    def check():
        raise CameraError("black")

    with pytest.raises(CameraError):
        arms(check, asked_s=11.0)


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
    assert arm_when_ready(armed, link, stop, said.append, checks) == "telemetry"
    assert [text.partition(": ")[2] for text in said] == [MISSING[step] for step in "stw"]
    assert len(checked) == 6
    stop.set()  # who goes away gets nothing
    with pytest.raises(s.RoverError):
        arm_when_ready(lambda: pytest.fail("armed"), lacking(itertools.repeat("s")), stop, print)


@pytest.mark.parametrize("missing", ["ww-", "-"])
def test_a_drive_that_waits_in_a_terminal_does_not_arm_later(monkeypatch, missing):
    """It armed 3,628 s after the command, as the human let go of the throttle; or when a suspended machine woke up."""
    times_s = [0.0, 3600.0] if missing == "-" else [0.0, 20.0, 31.0]
    monkeypatch.setattr("rover_lib.onboard.drive.session.boottime", iter(times_s).__next__)
    with pytest.raises(s.RoverError, match="at most 30"):
        arm_when_ready(lambda: pytest.fail("armed"), lacking(iter(missing)), threading.Event(), print)


def test_a_service_is_armed_by_a_human_and_a_loop_that_hangs_is_not_fed_for(systemd, tmp_path, demo_run):
    command = [str(Path(sys.executable).with_name("rover")), "drive", str(demo_run / "policy_static.pt"), "--world"]
    options = ["--service", "--log", tmp_path / "flight.log", "--record", tmp_path / "episodes", "--record-mb", "200"]
    env = {**os.environ, "WATCHDOG_USEC": "2000000"}
    process = subprocess.Popen([*command, *map(str, options)], stderr=subprocess.PIPE, text=True, env=env)
    try:
        systemd.hear_until("READY=1")
        assert systemd.feeds(1.0) >= 2
        assert not any("driving" in line for line in systemd.lines)
        assert os.sched_getscheduler(process.pid) == os.SCHED_OTHER  # nobody is in a hurry
        assert human() == "driving: armed by a human"
        if os.geteuid() == 0:
            assert os.sched_getscheduler(process.pid) == os.SCHED_RR | os.SCHED_RESET_ON_FORK
        assert systemd.feeds(1.5) >= 3
        process.send_signal(signal.SIGSTOP)
        systemd.hear(0.25)
        assert systemd.feeds(0.6) == 0  # the Arduino has stopped the car; after 1 s, its camera counts as unplugged
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
    controls = json.loads((episode / "episode_data.json").read_text())["control_samples"]
    assert len(controls) == pytest.approx(len(flight.ticks["t_s"]), abs=2)
    assert flight.ticks["plan"][0] < 10 and flight.ticks["plan_age_ms"][0] <= 1e3 * Settings().fade_s
