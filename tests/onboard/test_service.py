"""The drive as a service: what systemd hears, and who arms."""

import os
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from rover_lib.cli import main
from rover_lib.onboard import service as s
from rover_lib.onboard.errors import PolicyError
from rover_lib.onboard.loop import Report
from rover_lib.onboard.plan import Settings
from rover_lib.onboard.recording import read_controls
from rover_lib.onboard.servo_link import LinkError
from rover_lib.onboard.telemetry import read_log


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
                new += self.socket.recv(4096).decode().split("\n")
            except TimeoutError:
                if time.monotonic() >= end:
                    break
        new = [line for line in new if line]
        self.lines += new
        return new

    def hear_until(self, text: str) -> None:
        end = time.monotonic() + 10
        while not any(text in line for line in self.lines):
            assert time.monotonic() < end, self.lines
            self.hear(0.05)


@pytest.fixture
def systemd(tmp_path, monkeypatch):
    found = Systemd(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    yield found
    found.socket.close()


def waiting(systemd: Systemd, then) -> threading.Thread:
    """Does something once the service says that it is ready, beside the test."""

    def run() -> None:
        systemd.hear_until("READY=1")
        then()

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def human() -> None:
    """Arms: a signal to the process's main thread."""
    os.kill(os.getpid(), s.ARM)


def test_ready_and_disarmed_until_a_human_arms(systemd):
    armed = []
    with s.Service(Report(), threading.Event()) as service:
        thread = waiting(systemd, human)
        assert service.wait_for_human(lambda: armed.append("now") or "telemetry") == "telemetry"
        thread.join()
    systemd.hear()
    assert armed == ["now"]
    ready = systemd.lines.index("READY=1")
    assert systemd.lines[ready - 1] == "STATUS=disarmed: waiting for a human to arm it"
    assert "STATUS=driving: armed by a human" in systemd.lines[ready:]
    assert systemd.lines[-1] == "STOPPING=1" and systemd.lines[-2].startswith("STATUS=stopping: ")


def test_nothing_arms_by_itself(systemd):
    """A human who asked before the car was ready could not know what it would do."""
    stop, armed = threading.Event(), []
    with s.Service(Report(), stop) as service:
        human()
        thread = waiting(systemd, lambda: (time.sleep(0.3), stop.set()))
        with pytest.raises(s.NotArmed, match="told to stop before a human armed"):
            service.wait_for_human(lambda: armed.append(1))
        thread.join()
    assert not armed


def test_an_arduino_that_refuses_leaves_it_waiting(systemd):
    answers = [LinkError("no transmitter; switch it on"), "telemetry"]

    def arm():
        answer = answers.pop(0)
        if isinstance(answer, LinkError):
            raise answer
        return answer

    said = []

    def ask_twice() -> None:
        human()
        systemd.hear_until("switch it on")
        human()

    with s.Service(Report(), threading.Event(), said.append) as service:
        thread = waiting(systemd, ask_twice)
        assert service.wait_for_human(arm) == "telemetry"
        thread.join()
    assert "STATUS=disarmed: no transmitter; switch it on" in systemd.lines
    assert said == ["not armed: no transmitter; switch it on"]


def test_a_plan_that_is_late_is_no_reason_to_give_up(systemd):
    answers = [PolicyError("no fresh plan within 0.8 s"), "telemetry"]

    def arm():
        threading.Timer(0.1, human).start()
        if isinstance(answer := answers.pop(0), PolicyError):
            raise answer
        return answer

    with s.Service(Report(), threading.Event()) as service:
        thread = waiting(systemd, human)
        assert service.wait_for_human(arm) == "telemetry"
        thread.join()
        time.sleep(0.2)  # the last signal
    systemd.hear()
    assert "STATUS=disarmed: no fresh plan within 0.8 s" in systemd.lines


def test_what_breaks_while_it_waits_ends_it(systemd):
    def check() -> None:
        raise LinkError("the Arduino said nothing for 0.6 s; is it still plugged in?")

    with s.Service(Report(), threading.Event()) as service, pytest.raises(LinkError, match="plugged in"):
        service.wait_for_human(lambda: pytest.fail("armed"), [check])


def feeds(lines: list[str]) -> int:
    return lines.count("WATCHDOG=1")


def test_the_watchdog_hears_of_ticks_that_happened_only(systemd):
    report = Report()
    with s.Service(report, threading.Event()) as service:
        assert feeds(systemd.hear(0.6)) == 0  # nothing before it is ready: loading takes what it takes
        thread = waiting(systemd, lambda: (time.sleep(0.8), human()))
        service.wait_for_human(lambda: None)
        thread.join()
        systemd.hear()
        assert feeds(systemd.lines) >= 2  # the checks while it waits
        systemd.hear(2 * s.FEED_S)
        assert feeds(systemd.hear(0.8)) == 0  # armed, and the loop hangs
        report.status = "steering +0.10\nREADY=0"
        for _ in range(16):
            report.ticks += 1
            systemd.hear(0.05)
        assert feeds(systemd.lines[-20:]) >= 2
        systemd.hear(2 * s.FEED_S)
        assert feeds(systemd.hear(0.8)) == 0
    assert "STATUS=driving: steering +0.10 READY=0" in systemd.lines and "READY=0" not in systemd.lines


def test_the_watchdog_has_no_say_once_the_drive_has_ended(systemd):
    """An episode is finished, say, which takes what it takes; said once."""
    report = Report()
    with s.Service(report, threading.Event()):
        report.ended = "told to stop"
        systemd.hear_until("STOPPING=1")
    systemd.hear(0.1)
    assert systemd.lines == ["STATUS=stopping: told to stop", "STOPPING=1"]


def test_without_systemd_it_works_the_same(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    threading.Timer(0.3, human).start()
    with s.Service(Report(), threading.Event()) as service:
        assert service.wait_for_human(lambda: 7) == 7


def test_a_systemd_that_takes_nothing_holds_nobody_up(systemd, monkeypatch):
    with s.Service(Report(), threading.Event()) as service:
        systemd.socket.close()
        threading.Timer(0.2, human).start()
        assert service.wait_for_human(lambda: 7) == 7


def test_the_signal_means_what_it_meant_before(systemd):
    before = signal.getsignal(s.ARM)
    with s.Service(Report(), threading.Event()):
        assert signal.getsignal(s.ARM) != before
    assert signal.getsignal(s.ARM) == before


# rover arm-car

SYSTEMCTL = """#!/bin/sh
cd {folder}
case $1 in
  show) cat show ;;
  kill) echo "$*" > killed; cp after show; exit $(cat code) ;;
esac
"""


@pytest.fixture
def systemctl(tmp_path, monkeypatch):
    """Writes what systemctl says of the service, before it is told to arm and after."""
    script = tmp_path / "systemctl"
    script.write_text(SYSTEMCTL.format(folder=tmp_path))
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    def tell(before: str, after: str = "", active: str = "active", code: int = 0) -> Path:
        for name, text in (("show", before), ("after", after)):
            (tmp_path / name).write_text(
                f"LoadState=loaded\nActiveState={active}\nStatusText={text}\nNRestarts=2\nUnitFileState=disabled\n"
            )
        (tmp_path / "code").write_text(f"{code}\n")
        return tmp_path / "killed"

    return tell


def test_arms_a_car_that_waits(systemctl):
    killed = systemctl("disarmed: waiting for a human to arm it", "driving: armed by a human")
    assert s.arm_car() == "driving: armed by a human"
    assert killed.read_text() == "kill --kill-whom=main --signal=SIGUSR1 rover-drive.service\n"


@pytest.mark.parametrize(
    "text, active, sentence",
    [
        ("driving: steering +0.10", "active", "it drives already"),
        ("", "inactive", "is inactive, not waiting to be armed .*; sudo systemctl start rover-drive"),
        ("disarmed: waiting", "deactivating", "is deactivating, not waiting"),
        ("", "activating", "is activating, not waiting"),
    ],
)
def test_arms_no_other(systemctl, text, active, sentence):
    killed = systemctl(text, active=active)
    with pytest.raises(s.ServiceError, match=sentence):
        s.arm_car()
    assert not killed.exists()


def test_says_why_it_did_not_arm(systemctl):
    systemctl("disarmed: waiting for a human to arm it", "disarmed: no transmitter; switch it on")
    with pytest.raises(s.ServiceError, match="did not arm: disarmed: no transmitter; switch it on"):
        s.arm_car()
    systemctl("disarmed: waiting for a human to arm it", "disarmed: waiting for a human to arm it")
    with pytest.raises(s.ServiceError, match="did not arm"):
        s.arm_car(timeout_s=0.3)
    systemctl("disarmed: waiting for a human to arm it", code=1)
    with pytest.raises(s.ServiceError, match=r"cannot be told to arm .* use sudo"):
        s.arm_car()


def test_the_services_state(systemctl, monkeypatch):
    systemctl("driving: steering +0.10")
    found = s.state_of()
    assert found["state"] == "driving" and found["restarts"] == 2 and found["installed"] and not found["at_boot"]
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(s.ServiceError, match="is this a rover"):
        s.state_of()


# The whole: rover drive --service, as systemd starts it, in the balloon world


def started(systemd: Systemd, tmp_path: Path, artifact: Path) -> subprocess.Popen:
    command = [str(Path(sys.executable).with_name("rover")), "drive", str(artifact), "--world", "--service"]
    for option, name in (("log", "flight.log"), ("json", "drive.json"), ("record", "episodes")):
        command += [f"--{option}", str(tmp_path / name)]
    process = subprocess.Popen(
        [*command, "--record-mb", "200"],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "WATCHDOG_USEC": "2000000"},
    )
    end = time.monotonic() + 120
    while "READY=1" not in systemd.lines:
        assert process.poll() is None and time.monotonic() < end, process.communicate()[1]
        systemd.hear(0.1)
    return process


def test_a_service_is_armed_by_a_human_and_a_loop_that_hangs_is_not_fed_for(systemd, tmp_path, demo_run):
    process = started(systemd, tmp_path, demo_run / "policy_static.pt")
    try:
        assert feeds(systemd.hear(1.5)) >= 3
        assert not any("driving" in line for line in systemd.lines)
        assert os.sched_getscheduler(process.pid) == os.SCHED_OTHER  # nobody is in a hurry
        process.send_signal(s.ARM)
        systemd.hear_until("STATUS=driving: armed by a human")
        if os.geteuid() == 0:
            assert os.sched_getscheduler(process.pid) == os.SCHED_RR | os.SCHED_RESET_ON_FORK
        assert feeds(systemd.hear(2.0)) >= 4
        assert any(line.startswith("STATUS=driving: ") and "steering" in line for line in systemd.lines)
        process.send_signal(signal.SIGSTOP)
        systemd.hear(0.5)
        assert feeds(systemd.hear(2.0)) == 0  # here systemd would kill it; the Arduino has stopped the car
        process.send_signal(signal.SIGCONT)
        _, said = process.communicate(timeout=30)
    finally:
        process.kill()
    # Which of the two it finds first is a matter of threads; it does not drive on.
    assert process.returncode == 3 and ("stopped the car" in said or "the Arduino said nothing" in said), said
    systemd.hear()
    assert "STOPPING=1" in systemd.lines
    flight = read_log(tmp_path / "flight.log")
    assert any(e.text == "armed" for e in flight.events)
    (episode,) = (tmp_path / "episodes").iterdir()  # of the drive, not of the time before
    assert len(read_controls(episode).times_s) == pytest.approx(len(flight.ticks["t_s"]), abs=2)
    assert flight.ticks["plan"][0] < 10 and flight.ticks["plan_age_ms"][0] <= 1e3 * Settings().fade_s


def test_a_service_that_nobody_armed_ends_without_having_moved(systemd, tmp_path, demo_run):
    process = started(systemd, tmp_path, demo_run / "policy_static.pt")
    try:
        systemd.hear(1.0)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 0 and "told to stop before a human armed the car" in said, said
    systemd.hear()
    assert "STOPPING=1" in systemd.lines and not any("driving" in line for line in systemd.lines)
    flight = read_log(tmp_path / "flight.log")
    assert len(flight.ticks["t_s"]) == 0 and not any(e.text == "armed" for e in flight.events)
    assert not (tmp_path / "episodes").exists()


@pytest.mark.parametrize("options", [["policy.pt", "--dry-run"], ["--replay", "episode"]])
def test_a_service_drives_a_car_by_an_artifact(options):
    result = CliRunner().invoke(main, ["drive", "--service", *options])
    assert result.exit_code == 2 and "--service drives a car by an artifact" in result.output


def test_arming_asks_first(systemctl):
    killed = systemctl("disarmed: waiting for a human to arm it", "driving: armed by a human")
    result = CliRunner().invoke(main, ["arm-car"], input="n\n")
    assert result.exit_code == 1 and "Is the way free" in result.output and not killed.exists()
    result = CliRunner().invoke(main, ["arm-car"], input="y\n")
    assert result.exit_code == 0 and "driving: armed by a human" in result.output and killed.exists()
