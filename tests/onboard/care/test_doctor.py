"""The doctor on invented machines: a healthy rover, and rovers with one thing wrong each."""

import re
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard.car.camera import Frame
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.host import Host
from rover_lib.onboard.care import doctor
from rover_lib.onboard.care.doctor import examine
from rover_lib.onboard.errors import CameraError
from tests.helpers.command import rover
from tests.helpers.pty_board import board_of


def only(checks):
    (check,) = checks
    return check


@pytest.fixture
def proc(tmp_path):
    """An empty process table."""
    folder = tmp_path / "no processes"
    folder.mkdir()
    return folder


def test_what_this_user_may_use(tmp_path, monkeypatch):
    device = tmp_path / "video0"
    assert list(doctor.access("group video", device)) == []  # the camera's own check reports it
    device.touch()
    for usable, verdict in ((True, "ok"), (False, "fail")):
        monkeypatch.setattr(doctor.os, "access", lambda path, mode, usable=usable: usable)
        assert only(doctor.access("group video", device)).verdict == verdict


class FakeCamera:
    """A camera whose frames come at a rate, by the doctor's own clock, which moves when it waits."""

    time_stamps = "monotonic"

    def __init__(self, hz=30.0, level=100, stops=False, repeats=0, flicker=0.0):
        self.hz, self.level, self.stops, self.repeats, self.now_s = hz, level, stops, repeats, 100.0
        self.flicker = flicker

    def __call__(self, source, rate_hz, size=(640, 360)):
        self.size = size
        return self

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass

    def monotonic(self):
        return self.now_s

    def latest(self):
        number = int((100.0 if self.stops else self.now_s) * self.hz)
        image = np.full((360, 640, 3), self.level, np.uint8)
        image[:, :320] = self.level * (1 + self.flicker * (self.now_s % 0.2 > 0.1))  # a lamp at the left
        return Frame(image, number / self.hz, number, self.repeats, float(self.level), 40.0)

    def wait(self, after, timeout_s):
        self.now_s += timeout_s if self.stops else 1 / self.hz
        return None if self.stops else self.latest()


@pytest.mark.parametrize(
    ("camera", "verdict", "found"),
    [
        (FakeCamera(), "ok", "640x360, monotonic time stamps, 30.0 frames a second"),
        (FakeCamera(hz=15), "warning", "15.0 frames a second, wanted 30"),
        (FakeCamera(level=3), "fail", "black"),
        (FakeCamera(repeats=9), "fail", "frozen"),
        (FakeCamera(stops=True), "fail", "no new frame within"),
    ],
)
def test_the_real_frame_rate(tmp_path, monkeypatch, camera, verdict, found):
    source = tmp_path / "video0"
    source.touch()
    monkeypatch.setattr(doctor, "time", camera)
    monkeypatch.setattr(doctor, "Camera", camera)
    check, *light = doctor.camera_rate(source)
    assert [check.verdict for check in light] == ["ok"] * (verdict != "fail")
    assert check.verdict == verdict and found in check.found
    assert bool(check.remedy) == (verdict != "ok")
    with pytest.raises(CameraError):  # the policy has seen another shape than it gives
        list(doctor.camera_rate(source, (64, 48)))
    assert camera.size == (640, 480)


def test_light_in_which_a_stuck_car_would_not_be_stopped(tmp_path, monkeypatch):
    """The pictures change in the left half alone: by a share s of 100, the mean of both, cells differ by some 50 s."""
    (tmp_path / "video0").touch()
    for flicker, verdict in ((0.04, "ok"), (0.2, "warning")):
        camera = FakeCamera(flicker=flicker)
        monkeypatch.setattr(doctor, "time", camera)
        monkeypatch.setattr(doctor, "Camera", camera)
        _, light = doctor.camera_rate(tmp_path / "video0")
        assert (light.name, light.verdict) == ("light", verdict) and "mean 100 of 255" in light.found


def talking(receiver):
    """Return a function with which a board answers each question by a status with the receiver's pulses."""

    def answer(board, body):
        board.say(f"<S 7 99 {board.sequence} k M r w 1456 120 238 {receiver} 0 0 0 0")

    return answer


@pytest.mark.parametrize(
    ("receiver", "verdict", "found"),
    [
        ("1460 21316 124 1016", "ok", "steering 1460 us, throttle 124 us"),
        ("1460 21316 200 1016", "warning", "arming will be refused"),
        ("1460 21316 - -", "fail", "throttle None): arming will be refused"),
    ],
)
def test_an_arduino(monkeypatch, receiver, verdict, found):
    monkeypatch.setattr(doctor, "SIGNAL_S", 0.1)
    with board_of(answer=talking(receiver)) as board:
        checks = {c.name: c for c in doctor.arduino(board.port)}
    assert checks["Arduino"].verdict == "ok" and "link" in checks
    assert checks["transmitter"].verdict == verdict and found in checks["transmitter"].found
    assert not [b for b in board.heard if b[1] in "AD"]  # nothing was armed, nothing driven


def test_a_gamepad_that_nobody_holds(proc, monkeypatch):
    gamepad_car = Car(human="gamepad")
    monkeypatch.setattr(doctor, "SIGNAL_S", 0.1)
    pad = SimpleNamespace(sticks=lambda: None, close=lambda: None)
    for module in ("care.doctor", "car.servo_link"):
        monkeypatch.setattr(f"rover_lib.onboard.{module}.this_car", lambda: gamepad_car)
        monkeypatch.setattr(f"rover_lib.onboard.{module}.open_gamepad", lambda: pad)
    monkeypatch.setattr(doctor, "list_gamepads", lambda: ("A (event0)", "B (event1)"))
    with board_of(answer=talking("- - - -"), hello=f"<H 4 4.2.0-gamepad 7 0 e {gamepad_car.id}") as board:
        found = examine(camera=str(proc / "none"), port=board.port, host=Host(proc_root=proc))
        checks = {c.name: c for c in found}
    assert checks["transmitter"].verdict == "warning"
    assert "A (event0), B (event1)" in checks["gamepad"].found


RESTING = "1456 21316 120 1016"


@pytest.mark.parametrize(
    ("wiggled", "without_transmitter", "verdicts", "found"),
    [
        ("-", "- - - -", ["ok", "ok", "ok"], "sends no pulses"),
        ("-", RESTING, ["ok", "ok", "warning"], "nobody can tell"),
        ("-", "1456 21316 400 1016", ["ok", "ok", "fail"], "throttle 400 us"),
        ("w", RESTING, ["ok", "fail"], "did not show it"),
    ],
)
def test_a_human_is_led_through_the_receiver(monkeypatch, wiggled, without_transmitter, verdicts, found):
    """What the receiver sends when the transmitter is off decides whether the car then stands still."""
    monkeypatch.setattr(doctor, "SIGNAL_S", 0.2)
    monkeypatch.setattr(doctor, "RITUAL_S", 0.2)
    now = {"missing": "w", "receiver": RESTING}

    def ask(text):
        if "both sides" in text:
            now["missing"] = wiggled
        if "transmitter off" in text:
            now.update(missing="s", receiver=without_transmitter)
        board.say(f"<S 7 99 {board.sequence} k M r {now['missing']} 1456 120 238 {now['receiver']} 0 0 0 0")
        time.sleep(0.05)  # time to read it

    with board_of() as board:
        checks = list(doctor.receiver(board.port, ask))
    assert [c.verdict for c in checks] == verdicts
    assert found in checks[-1].found
    assert not [b for b in board.heard if b[1] in "AD"]  # nothing was armed, nothing driven


@pytest.mark.slow
def test_a_good_artifact_and_a_damaged_one(artifacts, tmp_path, proc):
    checks = list(doctor.policy(artifacts["static"]))
    assert {c.name: c.verdict for c in checks} == {"artifact": "ok", "confinement": "ok", "inference": "ok"}
    assert re.search(r"static, \d+ actions at 30 Hz, camera \S+ \d+x\d+", checks[0].found)
    broken = tmp_path / "policy.pt"
    broken.write_bytes(artifacts["static"].read_bytes()[:-99])
    checks = examine(broken, port=str(tmp_path / "none"), camera=str(tmp_path / "none"), host=Host(proc_root=proc))
    check = only(c for c in checks if c.name == "artifact")
    assert check.verdict == "fail" and check.found.startswith(f"{broken}: ")


def test_a_pi_that_is_well_and_one_that_is_not(pi_host, bare_host, proc, monkeypatch):
    """Its supply, governor, memory, disk, and a program that writes to serial ports."""
    free = {"mb": 5000}
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: SimpleNamespace(free=free["mb"] * 1e6))
    governor = pi_host.sys_root / "devices/system/cpu/cpu0/cpufreq/scaling_governor"
    (proc / "8").mkdir()

    def verdicts(throttled, mode, memory_kb, disk_mb, program):
        Path(pi_host.vcgencmd).write_text(f"#!/bin/sh\necho throttled={throttled}\n")
        governor.write_text(mode)
        (proc / "meminfo").write_text(f"MemAvailable:   {memory_kb} kB\n")
        (proc / "8" / "comm").write_text(program)
        free["mb"] = disk_mb
        checks = [doctor.power(pi_host), doctor.governor(pi_host.sys_root)]
        checks += [doctor.memory(proc), doctor.disk(proc, proc), doctor.modem_manager(proc)]
        return {check.verdict for found in checks for check in found}

    assert verdicts("0x0", "performance", 4_000_000, 5000, "sh") == {"ok"}
    assert verdicts("0x50000", "ondemand", 300_000, 10, "ModemManager") == {"warning"}
    for check in (doctor.power(bare_host), doctor.governor(bare_host.sys_root)):
        assert only(check).verdict == "ok"


def test_stops_that_are_off_are_named(set_params):
    set_params("{}")
    assert only(doctor.stops({"familiar": {}})).verdict == "ok"
    set_params(
        "drive: {unfamiliar: off, stuck_s: 0, undervoltage_s: 0, black_level: -255, flat_level: 0, frozen_frames: 1000}"
    )
    found = only(doctor.stops({"familiar": {}}))
    wanted = "unfamiliar: off, stuck_s: 0, undervoltage_s: 0, black_level: -255, flat_level: 0, frozen_frames: 1000"
    assert (found.verdict, found.found) == ("warning", f"off or late: {wanted}")
    set_params("drive: {undervoltage_s: 61}")
    assert only(doctor.stops({})).found == "off or late: undervoltage_s: 61, unfamiliar: this artifact knows no limit"


def test_a_policy_that_steers_mirrored_is_a_fail():
    mirrored = {"car": Car(positive="left").description()}
    assert [check.verdict for check in doctor.car(mirrored)] == ["ok", "fail"]
    assert [check.verdict for check in doctor.car({"car": Car().description()})] == ["ok"]


def test_a_check_that_breaks_is_its_own_fail(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "governor", lambda *args: 1 / 0)
    devices = ("--camera", tmp_path / "video0", "--port", tmp_path / "ttyUSB0")
    result = rover("doctor", *devices)
    assert {"camera", "Arduino", "governor"} <= set(re.findall(r"^fail +(\w+)", result.stdout, re.M))
    assert result.exit_code == 1 and re.search(r"^\w+ +memory ", result.stdout, re.M)
    checks = [doctor.Check("a", "ok", ""), doctor.Check("b", "warning", "")]
    monkeypatch.setattr(doctor, "examine", lambda *args, **options: checks)
    assert rover("doctor").exit_code == 0
