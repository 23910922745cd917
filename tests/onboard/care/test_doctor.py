"""The doctor on invented machines: a healthy rover, and rovers with one thing wrong each."""

import json
import re
import threading
import time
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from pty_board import board_of

from rover_lib.cli import main
from rover_lib.onboard.car.camera import Frame
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.host import Host
from rover_lib.onboard.car.servo_link import LinkError, ServoLink
from rover_lib.onboard.care import doctor
from rover_lib.onboard.care.doctor import examine
from rover_lib.onboard.errors import CameraError


def only(checks):
    (check,) = checks
    return check


@pytest.fixture
def proc(tmp_path):
    """An empty process table."""
    folder = tmp_path / "no processes"
    folder.mkdir()
    return folder


# ---- groups and cameras


@pytest.mark.parametrize(("usable", "verdict"), [(True, "ok"), (False, "fail")])
def test_access(tmp_path, monkeypatch, usable, verdict):
    device = tmp_path / "video0"
    assert list(doctor.access("group video", device)) == []  # the camera's own check reports it
    device.touch()
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: usable)
    check = only(doctor.access("group video", device))
    assert check.verdict == verdict and ("usermod" in check.remedy) == (not usable)


def test_cameras_are_named_with_the_node_of_their_pictures(tmp_path):
    assert only(doctor.cameras(tmp_path)).verdict == "warning"
    folder = tmp_path / "v4l" / "by-id"
    folder.mkdir(parents=True)
    for index in (0, 1):  # the second gives metadata
        (folder / f"usb-HD_Camera-video-index{index}").symlink_to(f"../../video{index}")
    assert only(doctor.cameras(tmp_path)).found == f"{tmp_path}/video0: usb-HD_Camera"


class FakeCamera:
    """A camera whose frames come at a rate, by the doctor's own clock, which moves when it waits."""

    time_stamps = "monotonic"

    def __init__(self, hz=30.0, level=100, stops=False, repeats=0, contrast=40.0, seen=None):
        self.seen = seen  # what the policy has seen
        self.hz, self.level, self.stops, self.now_s = hz, level, stops, 100.0
        self.repeats, self.contrast = repeats, contrast

    def __call__(self, source, rate_hz, size=(640, 360)):
        assert size == ((640, 480) if self.seen == (64, 48) else (640, 360))
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
        return Frame(image, number / self.hz, number, self.repeats, float(self.level), self.contrast)

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
    check = only(doctor.camera_rate(source, camera.seen, open_camera=camera))
    assert check.verdict == verdict and found in check.found
    assert bool(check.remedy) == (verdict != "ok")


def test_a_camera_of_another_shape_than_the_policy_has_seen(tmp_path, monkeypatch):
    camera = FakeCamera(seen=(64, 48))
    monkeypatch.setattr(doctor, "time", camera)
    with pytest.raises(CameraError):
        list(doctor.camera_rate(tmp_path, camera.seen, open_camera=camera))


# ---- the Arduino


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
        ("1460 21316 - -", "fail", "no signal on throttle: arming will be refused"),
    ],
)
def test_an_arduino(monkeypatch, receiver, verdict, found):
    monkeypatch.setattr(doctor, "SIGNAL_S", 0.1)
    with board_of(answer=talking(receiver)) as board:
        checks = {c.name: c for c in doctor.arduino(board.port, boot_s=2)}
    assert checks["Arduino"].found == f"{board.port}: firmware 4.2.0, protocol 4"
    assert re.search(r"round trip \d+\.\d ms median, \d+\.\d ms at most of 20", checks["link"].found)
    assert checks["transmitter"].verdict == verdict and found in checks["transmitter"].found
    if verdict == "fail":  # an ordinary car's pulses are none of the recorded car's
        assert "rover calibrate" in checks["transmitter"].remedy
    assert not [b for b in board.heard if b[1] in "AD"]  # nothing was armed, nothing driven


@pytest.mark.parametrize("held", [True, False])
def test_a_gamepad(proc, monkeypatch, held):
    gamepad_car = Car(human="gamepad")
    monkeypatch.setattr(doctor, "SIGNAL_S", 0.1)
    pad = SimpleNamespace(sticks=lambda: (0.0, 0.0) if held else None, close=lambda: None)
    for module in ("care.doctor", "car.servo_link"):
        monkeypatch.setattr(f"rover_lib.onboard.{module}.this_car", lambda: gamepad_car)
        monkeypatch.setattr(f"rover_lib.onboard.{module}.open_gamepad", lambda: pad)
    monkeypatch.setattr(doctor, "list_gamepads", lambda: ("A (event0)", "B (event1)"))
    receiver = "1460 21316 124 1016" if held else "- - - -"
    with board_of(answer=talking(receiver), hello=f"<H 4 4.2.0-gamepad 7 0 e {gamepad_car.id}") as board:
        found = examine(camera=str(proc / "none"), port=board.port, host=Host(proc_root=proc), boot_s=2)
        checks = {c.name: c for c in found}
    assert checks["transmitter"].verdict == ("ok" if held else "warning")
    assert "A (event0), B (event1)" in checks["gamepad"].found


RESTING = "1456 21316 120 1016"


@pytest.mark.parametrize(
    ("wiggled", "without_transmitter", "verdicts", "found"),
    [
        ("-", "- - - -", ["ok", "ok", "ok"], "sends no pulses"),
        ("-", RESTING, ["ok", "ok", "warning"], "as before: nobody can tell"),
        ("-", "1700 21316 124 1016", ["ok", "ok", "warning"], "steering 1700 us"),
        ("-", "1456 21316 400 1016", ["ok", "ok", "fail"], "throttle 400 us"),
        ("w", RESTING, ["ok", "fail"], "did not show it"),
    ],
)
def test_a_human_is_led_through_the_receiver(monkeypatch, wiggled, without_transmitter, verdicts, found):
    """What the receiver sends when the transmitter is off decides whether the car then stands still."""
    monkeypatch.setattr(doctor, "SIGNAL_S", 0.2)
    monkeypatch.setattr(doctor, "RITUAL_S", 0.2)
    now, done = {"missing": "w", "receiver": RESTING}, threading.Event()

    def ask(text):
        if "steering stick" in text:
            now["missing"] = wiggled
        if "transmitter off" in text:
            now.update(missing="s", receiver=without_transmitter)
        time.sleep(0.05)  # time for a few statuses

    with board_of() as board:

        def talk():
            while not done.wait(0.01):
                board.say(f"<S 7 99 {board.sequence} k M r {now['missing']} 1456 120 238 {now['receiver']} 0 0 0 0")

        talker = threading.Thread(target=talk)
        talker.start()
        try:
            checks = list(doctor.receiver(board.port, ask, boot_s=2))
        finally:
            done.set()
            talker.join()
    assert [c.verdict for c in checks] == verdicts
    assert found in checks[-1].found
    assert not [b for b in board.heard if b[1] in "AD"]  # nothing was armed, nothing driven


def test_a_port_that_somebody_else_has():
    with board_of() as board, ServoLink(board.port, boot_s=2):
        before = board.heard.count(">Q")
        with pytest.raises(LinkError):
            list(doctor.arduino(board.port, boot_s=2))
        assert board.heard.count(">Q") == before


def test_modem_manager(proc):
    assert only(doctor.modem_manager(proc)).verdict == "ok"
    (proc / "7").mkdir()  # a process that has just ended
    for number, name in (("8", "sh"), ("9", "ModemManager")):
        (proc / number).mkdir()
        (proc / number / "comm").write_text(f"{name}\n")
    assert only(doctor.modem_manager(proc)).verdict == "warning"


# ---- the artifact


@pytest.mark.slow
def test_a_good_artifact_and_a_damaged_one(artifacts, tmp_path, proc):
    checks = list(doctor.policy(artifacts["static"]))
    assert {c.name: c.verdict for c in checks} == {"artifact": "ok", "confinement": "ok", "inference": "ok"}
    assert re.search(r"static, \d+ actions at 30 Hz, camera \S+ \d+x\d+", checks[0].found)
    data = bytearray(artifacts["static"].read_bytes())
    data[len(data) // 2] ^= 0xFF
    broken = tmp_path / "policy.pt"
    broken.write_bytes(data)
    for path, found in ((broken, f"{broken}: damaged"), (tmp_path / "no.pt", f"{tmp_path / 'no.pt'}: ")):
        checks = examine(path, port=str(tmp_path / "none"), dev=tmp_path, host=Host(proc_root=proc))
        check = only(c for c in checks if c.name == "artifact")
        assert check.verdict == "fail" and check.found.startswith(found)


# ---- the machine


def test_a_pi_that_was_short_of_power(pi_host, bare_host):
    check = only(doctor.power(pi_host))
    assert check.verdict == "warning" and "supply" in check.remedy
    assert "no vcgencmd" in only(doctor.power(bare_host)).found
    for script, verdict in (("echo throttled=0x0", "ok"), ("echo throttled=0x80000", "warning"), ("exit 1", "warning")):
        Path(pi_host.vcgencmd).write_text(f"#!/bin/sh\n{script}\n")
        assert only(doctor.power(pi_host)).verdict == verdict


def test_temperature(pi_host, bare_host):
    assert only(doctor.temperature(pi_host)).found == "61 C"
    (pi_host.sys_root / "class/thermal/thermal_zone0/temp").write_text("81000")
    assert only(doctor.temperature(pi_host)).verdict == "warning"
    assert only(doctor.temperature(bare_host)).found == "not reported"


def test_governor(pi_host, tmp_path):
    assert only(doctor.governor(tmp_path / "none")).verdict == "ok"
    for core, name in enumerate(("performance", "ondemand")):
        file = pi_host.sys_root / f"devices/system/cpu/cpu{core}/cpufreq/scaling_governor"
        file.write_text(f"{name}\n")
        assert only(doctor.governor(pi_host.sys_root)).verdict == ("warning" if core else "ok")


def test_disk(tmp_path, monkeypatch):
    Usage = namedtuple("Usage", "free")
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: Usage(500e6 * path.exists()))
    logs, recordings = doctor.disk(tmp_path / "not/made/yet", tmp_path)
    assert (logs.verdict, recordings.verdict) == ("ok", "warning")
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    assert all("not writable" in c.found for c in doctor.disk(tmp_path, tmp_path))


@pytest.mark.parametrize(("kb", "verdict"), [(4_000_000, "ok"), (300_000, "warning")])
def test_memory(proc, kb, verdict):
    (proc / "meminfo").write_text(f"MemTotal:  8000000 kB\nMemAvailable:   {kb} kB\n")
    assert only(doctor.memory(proc)).verdict == verdict


# ---- all together


def test_a_check_that_breaks_is_its_own_fail(tmp_path, proc, monkeypatch):
    monkeypatch.setattr(doctor, "governor", lambda *args: 1 / 0)
    checks = list(examine(port=str(tmp_path / "none"), dev=tmp_path, host=Host(proc_root=proc)))
    broken = only(c for c in checks if c.name == "governor")
    assert broken.verdict == "fail" and "ZeroDivisionError" in broken.found
    assert checks[-1].name == "memory"


def rover(*args):
    return CliRunner().invoke(main, [str(a) for a in args])


def test_a_desktop_cannot_drive(tmp_path):
    devices = ("--camera", tmp_path / "video0", "--port", tmp_path / "ttyUSB0")
    result = rover("doctor", *devices)
    assert result.exit_code == 1 and "camera, Arduino" in result.stderr
    found = json.loads(rover("doctor", "--json", *devices).stdout)
    assert found["drives"] is False
    assert {"name", "verdict", "found", "remedy"} == set(found["checks"][0])


@pytest.mark.slow
def test_a_rover_that_drives(tmp_path, artifacts, monkeypatch):
    monkeypatch.setattr(doctor, "SETTLE_S", 0.05)
    monkeypatch.setattr(doctor, "MEASURE_S", 0.1)
    slope = np.tile(np.arange(160, dtype=np.uint8), (90, 1))
    for k in range(60):
        cv2.imwrite(str(tmp_path / f"{k:03d}.jpg"), np.roll(slope, k, 1))
    with board_of(answer=talking("1460 21316 124 1016")) as board:
        result = rover("doctor", artifacts["static"], "--camera", tmp_path, "--port", board.port, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["drives"] is True
    assert {"camera", "Arduino", "link", "transmitter", "artifact", "inference"} <= {c["name"] for c in found["checks"]}
