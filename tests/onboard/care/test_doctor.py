"""The doctor on invented machines: a healthy rover, and rovers with one thing wrong each."""

import json
import re
import threading
import time
from collections import namedtuple
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from pty_board import board_of
from recorded import pass_a_wall

from rover_lib.cli import main
from rover_lib.onboard.car.camera import CameraError, Frame
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.host import Host
from rover_lib.onboard.car.servo_link import LinkError, ServoLink
from rover_lib.onboard.care import doctor
from rover_lib.onboard.care.doctor import Check, examine
from rover_lib.onboard.errors import EpisodeError


def only(checks):
    (check,) = checks
    return check


def verdicts(checks):
    return {c.name: c.verdict for c in checks}


@pytest.fixture
def proc(tmp_path):
    """An empty process table."""
    folder = tmp_path / "no processes"
    folder.mkdir()
    return folder


# ---- groups and cameras


@pytest.mark.parametrize(("there", "usable", "verdict"), [(1, 1, "ok"), (1, 0, "fail"), (0, 0, "warning")])
def test_access(tmp_path, monkeypatch, there, usable, verdict):
    device = tmp_path / "video0"
    if there:
        device.touch()
    monkeypatch.setattr(doctor.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: bool(usable))
    check = only(doctor.access("group video", device, "a group of another name"))
    assert check.verdict == verdict and ("usermod" in check.remedy) == (verdict != "ok")


LISTED = """\
Driver Info:
\tDriver name      : uvcvideo
\tCard type        : HD Camera: HD Camera
\tCapabilities     : 0x84a00001
\t\tVideo Capture
\tDevice Caps      : 0x04200001
\t\t{caps}
\t\tStreaming
ioctl: VIDIOC_ENUM_FMT
\tType: Video Capture

\t[0]: 'MJPG' (Motion-JPEG, compressed)
\t\tSize: Discrete 640x360
\t\t\tInterval: Discrete 0.033s (30.000 fps)
\t\tSize: Discrete 1280x720
\t[1]: 'Y16 ' (16-bit Greyscale)
\t\tSize: Stepwise 16x16 - 16384x8192 with step 16/1
"""


def test_cameras_are_listed_with_formats_and_sizes(tmp_path):
    for name, caps in (("video0", "Video Capture"), ("video1", "Metadata Capture"), ("video10", None)):
        (tmp_path / name).write_text(LISTED.format(caps=caps) if caps else "")
    program = tmp_path / "v4l2-ctl"
    program.write_text('#!/bin/sh\n[ -s "$2" ] || { echo "no ioctl" >&2; exit 1; }\ncat "$2"\n')
    program.chmod(0o755)
    checks = list(doctor.cameras(tmp_path, str(program)))
    assert [c.verdict for c in checks] == ["ok", "warning"]
    assert checks[0].found.endswith(
        "video0: uvcvideo, HD Camera: HD Camera: MJPG 640x360 1280x720; Y16 16x16 to 16384x8192"
    )
    assert checks[1].found.endswith("video10: no ioctl")
    assert "v4l-utils" in only(doctor.cameras(tmp_path, str(tmp_path / "none"))).remedy
    for node in tmp_path.glob("video*"):
        node.unlink()
    assert only(doctor.cameras(tmp_path)).verdict == "fail"


class FakeCamera:
    """A camera whose frames come at a rate, on a clock of its own."""

    time_stamps = "monotonic"

    def __init__(self, hz=30.0, level=100, stops=False, repeats=0, contrast=40.0, seen=None):
        self.seen = seen  # what the policy has seen
        self.hz, self.level, self.stops, self.number = hz, level, stops, 1
        self.repeats, self.contrast = repeats, contrast

    def __call__(self, source, rate_hz, size=(640, 360)):
        assert size == ((640, 480) if self.seen == (64, 48) else (640, 360))
        return self

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass

    def latest(self):
        image = np.full((360, 640, 3), self.level, np.uint8)
        return Frame(image, 100 + self.number / self.hz, self.number, self.repeats, float(self.level), self.contrast)

    def wait(self, after, timeout_s):
        time.sleep(0.02)
        if self.stops:
            return None
        self.number += 1
        return self.latest()


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(doctor, "SETTLE_S", 0.05)
    monkeypatch.setattr(doctor, "MEASURE_S", 0.1)


@pytest.mark.parametrize(
    ("camera", "verdict", "found"),
    [
        (FakeCamera(), "ok", "640x360, monotonic time stamps, 30.0 frames a second"),
        (FakeCamera(hz=15), "warning", "15.0 frames a second, wanted 30"),
        (FakeCamera(level=3), "warning", "black"),
        (FakeCamera(repeats=9), "fail", "frozen"),
        (FakeCamera(stops=True), "fail", "no new frame within"),
        (FakeCamera(seen=(64, 48)), "fail", "gives 640x360"),
    ],
)
def test_the_real_frame_rate(tmp_path, quick, camera, verdict, found):
    source = tmp_path / "video0"
    source.touch()
    check = only(doctor.camera_rate(source, camera.seen, open_camera=camera))
    assert check.verdict == verdict and found in check.found
    assert bool(check.remedy) == (verdict != "ok")


def test_a_camera_that_cannot_be_opened(tmp_path):
    source = tmp_path / "video0"
    source.touch()

    def refuse(source, rate_hz):
        raise CameraError(f"{source}: cannot be opened", remedy="do something")

    check = only(doctor.camera_rate(source, open_camera=refuse))
    assert (check.verdict, check.found, check.remedy) == ("fail", f"{source}: cannot be opened", "do something")


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
    assert checks["Arduino"].found == f"{board.port}: firmware 4.1.1, protocol 4"
    assert re.search(r"round trip \d+\.\d ms median, \d+\.\d ms at most of 20", checks["link"].found)
    assert checks["transmitter"].verdict == verdict and found in checks["transmitter"].found
    assert not [b for b in board.heard if b[1] in "AD"]  # nothing was armed, nothing driven
    assert board.heard.count(">Q") >= 20


class Held:
    """An open gamepad of which somebody holds L1, or nobody."""

    def __init__(self, held):
        self.held = held

    def sticks(self):
        return (0.0, 0.0) if self.held else None

    def close(self):
        pass


NODES = ("A (event0)", "B (event1, without motion sensors)")


@pytest.mark.parametrize(
    ("receiver", "opened", "name", "verdict", "found"),
    [
        ("1460 21316 124 1016", True, "transmitter", "ok", "steering 1460 us, throttle 124 us"),
        ("- - - -", True, "transmitter", "warning", "nobody holds L1"),
        ("- - - -", True, "gamepad", "ok", "A (event0), B (event1, without motion sensors)"),
        ("- - - -", False, "Arduino", "fail", "no gamepad"),
    ],
)  # fmt: skip
def test_a_gamepad(proc, monkeypatch, receiver, opened, name, verdict, found):
    gamepad_car = Car(human="gamepad")
    monkeypatch.setattr(doctor, "SIGNAL_S", 0.1)
    monkeypatch.setattr(doctor, "this_car", lambda: gamepad_car)
    monkeypatch.setattr("rover_lib.onboard.car.servo_link.this_car", lambda: gamepad_car)
    if opened:
        for module in ("care.doctor", "car.servo_link"):
            monkeypatch.setattr(f"rover_lib.onboard.{module}.open_gamepad", lambda: Held(receiver[0] != "-"))
        monkeypatch.setattr(doctor, "list_gamepads", lambda: NODES)
    with board_of(answer=talking(receiver), hello=f"<H 4 4.1.1-gamepad 7 0 e {gamepad_car.id}") as board:
        checks = {
            c.name: c for c in examine(camera=str(proc / "none"), port=board.port, host=Host(proc_root=proc), boot_s=2)
        }
    assert checks[name].verdict == verdict and found in checks[name].found
    assert opened or checks[name].remedy.startswith("connect a DualShock 4")


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
    now, asked, done = {"missing": "w", "receiver": RESTING}, [], threading.Event()

    def ask(text):
        asked.append(text)
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
    assert len(asked) == (4 if len(verdicts) == 3 else 2)
    assert not [b for b in board.heard if b[1] in "AD"]  # nothing was armed, nothing driven


def test_a_port_that_is_not_there_or_somebody_else_has(tmp_path):
    check = only(doctor.arduino(str(tmp_path / "ttyUSB0"), dev=tmp_path))
    assert check.verdict == "fail" and "no other serial port" in check.found
    (tmp_path / "ttyACM0").touch()
    check = only(doctor.arduino(str(tmp_path / "ttyUSB0"), dev=tmp_path))
    assert check.remedy == f"--port {tmp_path / 'ttyACM0'}"
    with board_of() as board, ServoLink(board.port, boot_s=2):
        before = board.heard.count(">Q")
        with pytest.raises(LinkError, match="no other program"):
            list(doctor.arduino(board.port, boot_s=2))
        assert board.heard.count(">Q") == before


def test_modem_manager(proc):
    assert only(doctor.modem_manager(proc)).verdict == "ok"
    (proc / "7").mkdir()  # a process that has just ended
    for number, name in (("8", "sh"), ("9", "ModemManager")):
        (proc / number).mkdir()
        (proc / number / "comm").write_text(f"{name}\n")
    check = only(doctor.modem_manager(proc))
    assert check.verdict == "warning" and "systemctl disable" in check.remedy


# ---- torch and the artifact


def test_engines():
    torch_here, onnx_here = doctor.engines_here()
    assert torch_here.verdict == onnx_here.verdict == "ok" and "qnnpack" in torch_here.found


@pytest.mark.slow
def test_a_good_artifact(artifacts):
    checks = list(doctor.policy(artifacts["static"]))
    assert verdicts(checks) == {"artifact": "ok", "confinement": "ok", "inference": "ok"}
    assert re.search(r"static, \d+ actions at 30 Hz, camera \S+ \d+x\d+", checks[0].found)
    assert re.match(r"\d+ ms;", checks[2].found)
    assert only(doctor.policy(None)).verdict == "warning"


@pytest.mark.slow
def test_a_damaged_artifact(artifacts, tmp_path, proc):
    data = bytearray(artifacts["static"].read_bytes())
    data[len(data) // 2] ^= 0xFF
    broken = tmp_path / "policy.pt"
    broken.write_bytes(data)
    checks = examine(broken, port=str(tmp_path / "none"), dev=tmp_path, host=Host(proc_root=proc))
    check = only(c for c in checks if c.name == "artifact")
    assert check.verdict == "fail" and check.found.startswith(f"{broken}: damaged")
    (missing,) = [c for c in examine(tmp_path / "no.pt", dev=tmp_path) if c.name == "artifact"]
    assert missing.verdict == "fail"


# ---- the machine


def test_a_pi_that_was_short_of_power(pi_host):
    check = only(doctor.power(pi_host))
    assert check.verdict == "warning" and "supply" in check.remedy
    for value, verdict in (("0x0", "ok"), ("0x80000", "warning")):
        Path(pi_host.vcgencmd).write_text(f"#!/bin/sh\necho throttled={value}\n")
        assert only(doctor.power(pi_host)).verdict == verdict
    for words in ("VCHI initialization failed", ""):
        Path(pi_host.vcgencmd).write_text(f'#!/bin/sh\necho "{words}" >&2; exit 255\n')
        check = only(doctor.power(pi_host))
        assert check.verdict == "warning" and "cannot be read" in check.found and words in check.found


def test_temperature(pi_host, bare_host):
    assert only(doctor.temperature(pi_host)) == Check("temperature", "ok", "61 C")
    (pi_host.sys_root / "class/thermal/thermal_zone0/temp").write_text("81000")
    assert only(doctor.temperature(pi_host)).verdict == "warning"
    assert only(doctor.temperature(bare_host)).found == "not reported"
    assert "no vcgencmd" in only(doctor.power(bare_host)).found


def test_governor(pi_host, tmp_path):
    assert only(doctor.governor(tmp_path / "none")).verdict == "ok"
    for core, name in enumerate(("performance", "ondemand")):
        file = pi_host.sys_root / f"devices/system/cpu/cpu{core}/cpufreq/scaling_governor"
        file.write_text(f"{name}\n")
        check = only(doctor.governor(pi_host.sys_root))
        assert check.verdict == ("warning" if core else "ok")
    assert "performance | sudo tee" in check.remedy


def test_disk(tmp_path, monkeypatch):
    Usage = namedtuple("Usage", "free")
    asked = []

    def usage(path):
        asked.append(path)
        return Usage(500e6)

    logs, recordings = doctor.disk(tmp_path / "not/made/yet", tmp_path, usage)
    assert asked == [tmp_path, tmp_path]
    assert (logs.verdict, recordings.verdict) == ("ok", "warning")
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    assert all("not writable" in c.found for c in doctor.disk(tmp_path, tmp_path))


@pytest.mark.parametrize(("kb", "verdict"), [(4_000_000, "ok"), (300_000, "warning")])
def test_memory(proc, kb, verdict):
    (proc / "meminfo").write_text(f"MemTotal:  8000000 kB\nMemAvailable:   {kb} kB\n")
    assert only(doctor.memory(proc)).verdict == verdict


def test_clock():
    assert only(doctor.clock()).verdict == "ok"
    for now_s, built_s in ((0, 0), (1.75e9, 1.76e9)):
        assert only(doctor.clock(now_s, built_s)).verdict == "warning"
    assert only(doctor.clock(1.76e9, 1.75e9)).verdict == "ok"


# ---- all together


def test_a_check_that_breaks_is_its_own_fail(tmp_path, proc, monkeypatch):
    def broken(*args):
        yield Check("memory", "ok", "half of it")
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(doctor, "memory", broken)
    monkeypatch.setattr(doctor, "governor", lambda *args: 1 / 0)
    checks = list(examine(port=str(tmp_path / "none"), dev=tmp_path, host=Host(proc_root=proc)))
    assert (
        only(c for c in checks if c.name == "governor").found
        == "could not be checked: ZeroDivisionError: division by zero"
    )
    assert [c.verdict for c in checks if c.name == "memory"] == ["ok", "fail"]
    assert checks[-1].name == "clock"


def rover(*args):
    return CliRunner().invoke(main, [str(a) for a in args])


def test_a_desktop_cannot_drive(tmp_path):
    result = rover("doctor", "--camera", tmp_path / "video0", "--port", tmp_path / "ttyUSB0")
    assert result.exit_code == 1
    assert "camera, Arduino" in result.stderr
    found = json.loads(rover("doctor", "--json", "--camera", tmp_path / "video0", "--port", tmp_path / "none").stdout)
    assert found["drives"] is False
    assert {"name", "verdict", "found", "remedy"} == set(found["checks"][0])


@pytest.mark.slow
def test_a_rover_that_drives(tmp_path, artifacts, quick):
    for k in range(60):
        cv2.imwrite(str(tmp_path / f"{k:03d}.jpg"), np.full((90, 160, 3), 100 + k, np.uint8))
    with board_of(answer=talking("1460 21316 124 1016")) as board:
        result = rover("doctor", artifacts["static"], "--camera", tmp_path, "--port", board.port, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["drives"] is True
    assert {"camera", "Arduino", "link", "transmitter", "artifact", "inference"} <= {c["name"] for c in found["checks"]}
    assert not [c for c in found["checks"] if c["verdict"] == "fail"]


@pytest.mark.parametrize(
    ("gain", "positive", "verdict"),
    [(8, "right", "fail"), (8, "left", "ok"), (0, "right", "warning")],
)
def test_which_way_a_recorded_minute_steers(tmp_path, monkeypatch, gain, positive, verdict):
    content = {"control_samples": [], "frame_samples": []}
    for i, (steering, frame) in enumerate(pass_a_wall(gain)):
        cv2.imwrite(str(tmp_path / f"{i}.jpg"), frame)
        content["control_samples"].append({"system_timestamp": 9 + i / 30, "steering_normalized": steering})
        content["frame_samples"].append({"timestamp": 9 + i / 30, "image_path": f"{i}.jpg"})
    (tmp_path / "episode_data.json").write_text(json.dumps(content))
    monkeypatch.setattr(doctor, "this_car", lambda: replace(Car(), positive=positive))
    found = only(doctor.side(tmp_path))
    (tmp_path / "episode_data.json").write_text("{}")
    with pytest.raises(EpisodeError, match="no drive to measure"):
        list(doctor.side(tmp_path))
    assert found.verdict == verdict and bool(found.remedy) == (verdict != "ok")
