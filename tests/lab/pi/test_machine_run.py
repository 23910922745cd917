"""What `make pi` makes of what it sees, without a Pi: what is missing, its pictures, and pulses against commands.

QEMU's protocol and the USB camera's are proven by its faults: both cables unplugged in a drive and plugged in again.
"""

import signal
from pathlib import Path

import cv2
import numpy as np
import pytest

from balloon_world.simulated_arduino import PinEvent
from lab import debian
from lab.pi import emulation, machine, machine_run
from lab.pi.machine import MachineError, Qmp
from lab.pi.pulses import compare, stopped
from lab.pi.usb_camera import UsbCamera
from rover_lib.onboard.drive.flight_log import Flight
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage

SLOW = 10.0


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
    with pytest.raises(RoverError, match="found 0 frames"):
        UsbCamera([])
    with pytest.raises(MachineError, match="QEMU does not answer"):
        Qmp(tmp_path / "none")


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
