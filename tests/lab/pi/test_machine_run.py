"""The whole emulated Pi, without booting it: QEMU's protocol, the USB camera's, and pulses against commands."""

import json
import signal
import socket
import struct
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from balloon_world.simulated_arduino import PinEvent
from lab import debian
from lab.pi import emulation, machine, machine_run
from lab.pi import usb_camera as camera
from lab.pi.machine import MachineError, Qmp
from lab.pi.pulses import compare, stopped
from lab.pi.usb_camera import UsbCamera
from rover_lib.onboard.drive.flight_log import Flight
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage

SLOW = 10.0


# ---- QEMU's protocol


@pytest.fixture
def qemu(tmp_path):
    """A socket that answers as QEMU does; `says` maps a command to the lines that follow it, `heard` has all."""
    path, listener = tmp_path / "qmp", socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen(1)

    def serve():
        connection, _ = listener.accept()
        with connection:
            connection.sendall(b'{"QMP": {"version": {}, "capabilities": []}}\n')
            while sent := connection.recv(4096):  # one at a time: the next comes after its answer
                command = json.loads(sent)
                qemu.heard.append(command)
                for answer in qemu.says.get(command["execute"], [{"return": {}}]):
                    if answer is None:
                        return
                    whose = {"id": command["id"]} if "id" in command and "event" not in answer else {}
                    connection.sendall(json.dumps({**answer, **whose}).encode() + b"\n")

    qemu = threading.Thread(target=serve, daemon=True)
    qemu.path, qemu.heard, qemu.says = path, [], {}
    qemu.start()
    yield qemu
    listener.close()


def test_qmp_commands_events_and_refusals(qemu):
    deleted = {"event": "DEVICE_DELETED", "data": {"device": "adapter", "path": "/x"}}
    qemu.says = {
        "device_del": [{"event": "RTC_CHANGE", "data": {}}, {"return": {}}, deleted],
        "query-status": [{"event": "STOP"}, {"return": {"status": "running"}}],
        "device_add": [{"error": {"class": "GenericError", "desc": "Duplicate device ID 'adapter'"}}],
    }
    qmp = Qmp(qemu.path)
    assert qmp.command("query-status") == {"status": "running"}
    qmp.command("device_del", id="adapter")
    qmp.wait_for("DEVICE_DELETED", device="adapter")
    with pytest.raises(MachineError, match="QEMU refused device_add: Duplicate device ID"):
        qmp.command("device_add", id="adapter")
    qmp.close()
    assert [c["execute"] for c in qemu.heard] == ["qmp_capabilities", "query-status", "device_del", "device_add"]
    assert qemu.heard[2]["arguments"] == {"id": "adapter"}


def test_an_event_of_another_device_is_not_taken_for_it(qemu):
    qemu.says = {"device_del": [{"return": {}}, {"event": "DEVICE_DELETED", "data": {"device": "camera"}}]}
    qmp = Qmp(qemu.path, timeout_s=0.2)
    qmp.command("device_del", id="adapter")
    with pytest.raises(MachineError, match="does not answer"):
        qmp.wait_for("DEVICE_DELETED", device="adapter")
    qmp.close()


def test_a_qemu_that_ends_or_is_not_there(qemu, tmp_path):
    qemu.says = {"quit": [None]}
    qmp = Qmp(qemu.path)
    with pytest.raises(MachineError, match=r"QEMU does not answer.*log may say why, if it has ended"):
        qmp.command("quit")
    qmp.close()
    with pytest.raises(MachineError, match="QEMU does not answer"):
        Qmp(tmp_path / "none")


# ---- what is missing


def test_what_is_missing_is_said_in_a_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr(debian, "which", lambda command: None if command == "qemu-img" else command)
    monkeypatch.setattr(emulation.os, "geteuid", lambda: 1000)
    with pytest.raises(MachineError, match=r"needs root \(and of the Debian packages qemu-utils\)"):
        machine.card()
    with pytest.raises(MachineError, match="1 to 60 times slower, found 0"):
        machine.Machine(machine.Card(tmp_path), tmp_path, slow=0)
    with pytest.raises(RoverError, match="no recorded frames"):
        machine_run._pictures(tmp_path)


def test_a_report_is_left_where_a_step_fails_too(monkeypatch, tmp_path):
    def fails():
        raise MachineError("no card for a test")

    monkeypatch.setattr(machine_run, "card", fails)
    monkeypatch.setattr(emulation.arduino, "missing_packages", list)
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "cache"))
    with pytest.raises(RoverError, match="no artifact to deploy"):
        machine_run.run_machine(tmp_path / "pi.json", tmp_path / "none.pt", tmp_path)
    (tmp_path / "policy.pt").write_bytes(b"x")
    monkeypatch.setattr(machine_run, "content_hash", lambda path: "abc")
    said = []
    report = machine_run.run_machine(tmp_path / "pi.json", tmp_path / "policy.pt", tmp_path, say=said.append)
    assert report.wrong == ["no card for a test"]
    written = read_stage(tmp_path / "pi.json", "pi")
    assert written["metrics"]["wrong"] == report.wrong
    assert [s["step"] for s in written["metrics"]["steps"]] == ["the card, as flashed"]
    assert not list((tmp_path / "cache").iterdir())


def test_sigterm_ends_a_run_as_ctrl_c_does():
    with pytest.raises(KeyboardInterrupt, match="SIGTERM"), emulation.interruptible():
        signal.raise_signal(signal.SIGTERM)


def test_frames_for_vivid_are_the_recorded_ones(tmp_path):
    folder = tmp_path / "episode_1" / "frames"
    folder.mkdir(parents=True)
    image = np.zeros((360, 640, 3), np.uint8)
    image[:, :320] = (200, 60, 20)
    cv2.imwrite(str(folder / "frame_000001.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 100])
    data = machine_run._frames(tmp_path, tmp_path / "frames").read_bytes()
    assert len(data) == machine_run.TWICE * 640 * 360 * 2
    assert len(data) % 512 == 0  # a disk has whole sectors
    back = cv2.cvtColor(np.frombuffer(data, np.uint8)[: 640 * 360 * 2].reshape(360, 640, 2), cv2.COLOR_YUV2BGR_YUY2)
    assert np.abs(back.astype(int) - image).max(initial=0, where=(np.abs(np.arange(640) - 320) > 8)[None, :, None]) < 6
    with pytest.raises(RoverError, match="must be 640x360"):
        cv2.imwrite(str(folder / "frame_000001.jpg"), image[:100])
        machine_run._frames(tmp_path, tmp_path / "frames")


# ---- the USB camera


class Driver:
    """The machine's side of usbredir, as far as a webcam's driver asks."""

    def __init__(self, path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(5)
        self.socket.connect(str(path))
        self.number = 0
        assert self.receive(camera.FIRST_HEADER)[0] == camera.HELLO
        self.send(camera.HELLO, b"test".ljust(64, b"\0") + struct.pack("<I", camera.CAPABILITIES), camera.FIRST_HEADER)

    def send(self, kind, body, header=camera.HEADER):
        self.number += 1
        self.socket.sendall(header.pack(kind, len(body), self.number) + body)
        return self.number

    def receive(self, header=camera.HEADER):
        kind, length, number = header.unpack(self._exactly(header.size))
        return kind, number, self._exactly(length)

    def _exactly(self, n):
        data = b""
        while len(data) < n:
            more = self.socket.recv(n - len(data))
            assert more, "the camera closed"
            data += more
        return data

    def control(self, request_type, request, value, index, length, data=b""):
        head = camera.CONTROL_HEADER.pack(request_type & 0x80, request, request_type, 0, value, index, length)
        number = self.send(camera.CONTROL, head + data)
        kind, found, body = self.receive()
        assert (kind, found) == (camera.CONTROL, number)
        *_, status, _, _, said = camera.CONTROL_HEADER.unpack_from(body)
        return status, said, body[camera.CONTROL_HEADER.size :]

    def bulk(self, wanted):
        return self.send(camera.BULK, camera.BULK_HEADER.pack(camera.ENDPOINT, 0, wanted & 0xFFFF, 0, wanted >> 16))

    def payload(self, wanted=1000):
        """A UVC payload: bulk transfers until a short one."""
        data = b""
        while True:
            number = self.bulk(wanted)
            kind, found, body = self.receive()
            assert (kind, found, body[1]) == (camera.BULK, number, camera.OK)
            data += body[camera.BULK_HEADER.size :]
            if len(body) - camera.BULK_HEADER.size < wanted:
                return data


@pytest.fixture
def plugged():
    jpegs = [b"\xff\xd8" + bytes([i]) * (1500 + 498 * i) + b"\xff\xd9" for i in range(3)]
    with UsbCamera(jpegs, slow=1) as usb:
        driver = Driver(usb.path)
        kinds = [driver.receive()[0] for _ in range(3)]
        assert kinds == [camera.INTERFACES, camera.ENDPOINTS, camera.CONNECT]
        yield driver, jpegs, usb
        driver.socket.close()


def test_descriptors_hold_together():
    whole_length = camera.configuration_descriptor()
    assert struct.unpack_from("<H", whole_length, 2)[0] == len(whole_length)
    assert len(camera.device_descriptor()) == 18
    rest, kinds = whole_length, []
    while rest:
        kinds.append(rest[1])
        rest = rest[rest[0] :]
    assert kinds == [2, 0x0B, 4, 0x24, 0x24, 0x24, 4, 0x24, 0x24, 0x24, 0x24, 5]


def test_a_camera_says_what_it_is(plugged):
    driver, _, _ = plugged
    status, said, data = driver.control(0x80, camera.GET_DESCRIPTOR, 0x0200, 0, 9)
    assert (status, said, data) == (camera.OK, 9, camera.configuration_descriptor()[:9])
    assert driver.control(0x80, camera.GET_DESCRIPTOR, 0x0600, 0, 10)[0] == camera.STALL  # no device qualifier
    status, _, data = driver.control(0xA1, camera.GET_CUR, 0x0100, camera.STREAMING_INTERFACE, 26)
    assert status == camera.OK
    assert camera.PROBE.unpack(data)[3] == 333_333
    assert driver.control(0x21, camera.SET_CUR, 0x0200, camera.STREAMING_INTERFACE, 26, data)[:2] == (camera.OK, 26)


def test_frames_come_one_by_one_at_their_rate(plugged):
    driver, jpegs, usb = plugged
    start = time.monotonic()
    found = [driver.payload() for _ in range(6)]
    seconds = time.monotonic() - start
    assert [f[2:] for f in found] == jpegs * 2  # the second is 2 * 1000 bytes with its header: an empty packet ends it
    assert [f[1] & 1 for f in found] == [0, 1] * 3
    assert all(f[0] == 2 and f[1] & 0x82 == 0x82 for f in found)
    assert usb.frames == 6
    assert 5 / 30 - 0.01 < seconds < 2


def test_a_driver_that_stops_gets_its_requests_back_and_a_whole_frame_later(plugged):
    driver, jpegs, _ = plugged
    driver.payload()
    first, second = driver.bulk(100), driver.bulk(100)  # part of a frame
    answered = {driver.receive()[1] for _ in range(2)}
    assert answered == {first, second}
    waiting = driver.bulk(5000)
    driver.socket.sendall(camera.HEADER.pack(camera.CANCEL, 0, waiting))
    kind, number, body = driver.receive()
    assert (kind, number) == (camera.BULK, waiting)
    assert body[1] in (camera.OK, camera.CANCELLED)
    assert driver.payload()[2:] in jpegs


def test_it_can_be_pulled_and_plugged_in_again(plugged):
    driver, jpegs, usb = plugged
    driver.payload()
    driver.socket.close()
    again = Driver(usb.path)
    for _ in range(3):
        again.receive()
    assert again.payload()[2:] == jpegs[0]
    again.socket.close()


def test_a_camera_without_frames_is_none():
    with pytest.raises(RoverError, match="found 0 frames"):
        UsbCamera([])


# ---- pulses


ZERO_S = 1000.0  # of the host's clock, when the rover's was 0


def host_s(rover_s):
    return ZERO_S + SLOW * rover_s


def a_flight(steering, throttle, hz=30.0, start_s=50.0):
    n = len(steering)
    ticks = {
        "t_s": np.arange(n) / hz,
        "steering_us": np.array(steering, float),
        "throttle_us": np.array(throttle, float),
    }
    header = {"start_monotonic_s": start_s}
    return Flight(Path("x"), header, ticks, [], {}, 0, 1, 0)


def pins_of(flight, wrong_us=0.0, late_s=0.01):
    """What the pins do if they obey: a pulse each period, of the newest command that came `late_s` before."""
    sent_s = flight.ticks["t_s"] + flight.header["start_monotonic_s"]
    events = []
    for pin, period_s in (("steering", 0.021316), ("throttle", 0.001016)):
        for at_s in np.arange(sent_s[0] - 0.1, sent_s[-1] + 0.1, period_s):
            i = int(np.searchsorted(sent_s, at_s - late_s, side="right")) - 1
            us = flight.ticks[f"{pin}_us"][i] if i >= 0 else {"steering": 1456, "throttle": 120}[pin]
            events.append(PinEvent(host_s(at_s), "pulse", pin, us + wrong_us, period_s * 1e6))
    return sorted(events)


def a_drive(n=60):
    return a_flight([1456 + 20 * i % 400 for i in range(n)], [120 + (8 * i) % 96 for i in range(n)])


def test_pulses_as_commanded():
    flight = a_drive()
    found = compare(flight, pins_of(flight, wrong_us=0.25), host_s, SLOW)
    assert found["worst_us"] == 0.25
    assert found["unseen"] == 0
    assert found["commands"] == 60
    assert found["pulses"] > 1800
    assert found["distinct"] == {"steering": 20, "throttle": 12}


def test_one_wrong_pulse_is_found():
    flight = a_drive()
    events = pins_of(flight)
    i = next(i for i, e in enumerate(events) if e.pin == "throttle" and e.monotonic_s > host_s(51))
    events[i] = events[i]._replace(pulse_us=130.5)
    assert compare(flight, events, host_s, SLOW)["worst_us"] == 21.5  # 152 is the nearest of its commands


def test_a_command_that_never_reached_the_pins_is_found():
    flight = a_drive()
    lost = flight.ticks["steering_us"].copy()
    lost[30] = 1900
    events = pins_of(flight)
    flight.ticks["steering_us"] = lost
    assert compare(flight, events, host_s, SLOW)["worst_us"] > 100


def test_pins_that_lag_are_found():
    flight = a_drive()
    assert compare(flight, pins_of(flight, late_s=0.3), host_s, SLOW)["worst_us"] > 4


def test_nothing_to_compare_is_no_agreement():
    flight = a_drive()
    assert compare(flight, [], host_s, SLOW)["worst_us"] is None
    gone = [e for e in pins_of(flight) if e.monotonic_s < host_s(51)]
    found = compare(flight, gone, host_s, SLOW)
    assert found["worst_us"] is None
    assert found["unseen"] > 0


def test_when_the_pins_went_to_neutral():
    def at(ms):
        return host_s(60 + ms / 1e3)

    events = [PinEvent(at(t), "pulse", "throttle", 160, 1016) for t in range(-500, 140)]
    events += [PinEvent(at(t), "pulse", "throttle", 120, 1016) for t in range(140, 400)]
    events += [PinEvent(at(t), "line", "", 0, 0) for t in (-40, -7)]
    events += [PinEvent(at(t), "pulse", "steering", 1700 if t < 150 else 1456, 21316) for t in range(-500, 400, 21)]
    found = stopped(sorted(events), at(0), SLOW)
    assert found == {"drove": True, "after_ms": 140.0, "after_line_ms": 147.0, "steering_us": 1456, "neutral": True}
    driving = [e for e in events if e.monotonic_s < at(100)]
    assert not stopped(sorted(driving), at(0), SLOW)["neutral"]
    parked = [e._replace(pulse_us=120) if e.pin == "throttle" else e for e in events]
    assert not stopped(sorted(parked), at(0), SLOW)["drove"]
