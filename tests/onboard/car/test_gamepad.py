"""A gamepad's rules, by pipes that speak struct input_event: this kernel has no uinput, and no real one was tried."""

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from rover_lib.onboard.car import gamepad as gamepads
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.gamepad import ABS, BTN_L1, DROPPED, KEY, STEERING, SYN, THROTTLE, Gamepad, GamepadDevice
from rover_lib.onboard.car.servo_link import MISSING, ServoLink, frame, parse
from rover_lib.onboard.errors import CarError

FULL = 32767
REPORT = (SYN, 0, 0)


class Pad:
    """An open gamepad in virtual time. values: where the kernel says that its sticks are."""

    def __init__(self):
        self.now_s = 100.0
        self.values = dict.fromkeys(gamepads.AXES, 0)
        self.open()

    def open(self):
        (pad, self._to_pad), (motion, self._to_motion) = os.pipe(), os.pipe()
        for end in (pad, motion):
            os.set_blocking(end, False)
        self.opened = Gamepad("virtual", pad, motion, "A", lambda fd, axis: (self.values[axis], -FULL, FULL))

    def unplug(self):
        os.close(self._to_pad)
        os.close(self._to_motion)

    def send(self, *events, age_s=0.0):
        """Send events of the sticks that are that old, as one report unless a SYN is among them."""
        at_s = self.now_s - age_s
        for event in events if any(kind == SYN for kind, _, _ in events) else (*events, REPORT):
            os.write(self._to_pad, gamepads.EVENT.pack(int(at_s), round(at_s % 1 * 1e6), *event))

    def hold(self, held):
        self.send((KEY, BTN_L1, int(held)))

    def move(self, steering, throttle):
        self.send((ABS, STEERING, round(steering * FULL)), (ABS, THROTTLE, round(-throttle * FULL)))

    def sticks(self, moving=True):
        """What the host reads of it. moving: its motion sensors send, too."""
        if moving:
            os.write(self._to_motion, gamepads.EVENT.pack(int(self.now_s), round(self.now_s % 1 * 1e6), ABS, 0, 1))
        return self.opened.sticks(self.now_s)


@pytest.fixture
def pad():
    pad = Pad()
    yield pad
    pad.opened.close()


def test_the_human_counts_while_l1_is_held(pad):
    pad.move(1, 1)
    assert pad.sticks() is None
    pad.hold(True)
    assert pad.sticks() == (1, 1)
    pad.move(-0.55, -0.05)  # near its middle a stick rests
    assert pad.sticks() == (pytest.approx(-0.5, abs=1e-4), 0)
    pad.hold(False)
    assert pad.sticks() is None


def test_only_a_press_that_is_seen_counts(pad):
    """A button that is stuck, or events that waited, are nobody."""
    for event, age_s in (((KEY, BTN_L1, 2), 0), ((KEY, BTN_L1, 1), 0.2), ((KEY, BTN_L1 + 1, 1), 0)):
        pad.send(event, age_s=age_s)
        pad.move(0.5, 0)
        assert pad.sticks() is None


def test_after_lost_events_all_is_asked_again_and_l1_pressed_again(pad):
    """What comes between the loss and the next report is a part only: an L1 in it does not count."""
    pad.hold(True)
    assert pad.sticks() == (0, 0)
    pad.values[THROTTLE] = -FULL  # this event is among the lost ones
    pad.send((SYN, DROPPED, 0), (KEY, BTN_L1, 1), (ABS, STEERING, FULL))
    assert pad.sticks() is None
    pad.send(REPORT)
    assert pad.sticks() is None
    pad.hold(True)
    assert pad.sticks() == (0, 1)


def test_after_a_silence_l1_must_be_pressed_again(pad):
    """Old events are no signs of life: they waited while the radio was out of reach, or the process had no time."""
    pad.hold(True)
    assert pad.sticks()
    pad.now_s += 0.15
    pad.send((ABS, STEERING, FULL), age_s=0.11)
    assert pad.sticks(moving=False) is None
    pad.move(1, 0)
    assert pad.sticks() is None
    pad.hold(True)
    assert pad.sticks() == (1, 0)


def test_one_that_is_unplugged_is_nobody_until_the_same_one_is_back(pad, monkeypatch):
    """Whoever waits to be armed asks what is missing ten times a second, and systemd's watchdog waits with them."""
    link = ServoLink("none", car=Car(human="gamepad"))
    link._gamepad = first = pad.opened
    pad.hold(True)
    assert pad.sticks()
    pad.unplug()
    assert first.sticks(pad.now_s) is None and first.sticks(pad.now_s) is None
    there = []
    monkeypatch.setattr(gamepads, "list_gamepads", lambda: there)
    monkeypatch.setattr(gamepads.time, "sleep", None)  # nothing is waited for
    assert "none in /dev/input" in link.remedy("s")
    there.append(GamepadDevice("virtual", Path("B"), Path("B"), identity="B"))
    assert "connect virtual again" in link.remedy("s") and link._gamepad is first
    there.append(GamepadDevice("virtual", Path("A"), Path("A"), identity="A"))
    monkeypatch.setattr(GamepadDevice, "open", lambda found: (pad.open(), pad.opened)[1])
    assert link.remedy("s") == "hold L1 of the gamepad"
    assert ServoLink("none", car=Car()).remedy("s") == MISSING["s"]
    assert link._gamepad is pad.opened is not first and first.sticks() is None


@pytest.mark.parametrize("cap_us", [118, 6])
def test_the_arduino_gets_each_stick_as_far_as_it_judges(cap_us):
    """Scaled to a small cap, or to a car without reverse, a stick at its end looked like one at rest."""
    link, sent = ServoLink("none", car=replace(Car(human="gamepad"), cap_us=cap_us)), []
    link._write = sent.append
    for host_s, sticks in enumerate([(0.5, 1.0), (0.0, -1.0), (-1.0, 0.0), None], 1):
        link._telemetry = parse(frame("<S 7 1000 5 k M r w 1456 120 238 - - - - 1 2 3 4")[:-1], host_s)
        link._relay(SimpleNamespace(sticks=lambda sticks=sticks: sticks), host_s)
    far_us = max(cap_us, 64)
    wanted = (1734, 120 + far_us), (1456, max(120 - far_us, 40)), (900, 120), (0, 0)
    assert sent == [frame(f">S 7 1000 {steering} {throttle}") for steering, throttle in wanted]


@pytest.mark.parametrize(
    ("nodes", "sentence"),
    [
        ([("keyboard", "a", "keys")], "none in /dev/input"),
        ([("X-Box", "a", "pad")], "X-Box (event0, without motion sensors: cannot be used)"),
        ([("A", "a", "pad"), ("B", "b", "pad"), ("", "a", "motion"), ("", "b", "motion")], "A (event0), B (event1)"),
        ([("DualSense", "a", "pad"), ("motion", "a", "motion")], "DualSense (event0) cannot be read"),
    ],
)
def test_one_sentence_says_what_is_there(tmp_path, nodes, sentence):
    """In a folder like /sys/class/input. nodes: (name, which gamepad, kind)."""
    for i, (name, whole, kind) in enumerate(nodes):
        device = tmp_path / f"event{i}" / "device"
        (device / "capabilities").mkdir(parents=True)
        (tmp_path / whole).mkdir(exist_ok=True)
        (device / "device").symlink_to(tmp_path / whole)
        (device / "name").write_text(name + "\n")
        (device / "properties").write_text("40\n" if kind == "motion" else "0\n")
        (device / "capabilities" / "abs").write_text({"pad": "3003f\n", "motion": "3f\n"}.get(kind, "0\n"))
        (device / "capabilities" / "key").write_text("7fdb000000000000 0 0 0 0\n" if kind == "pad" else "0\n")
    with pytest.raises(CarError) as error:
        gamepads.open_gamepad(lambda: gamepads.list_gamepads(tmp_path, tmp_path))
    assert sentence in str(error.value) and error.value.remedy
