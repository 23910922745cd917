"""A gamepad's rules, by FIFOs that speak struct input_event: this kernel has no uinput, and no real one was tried."""

import time
from functools import partial

import pytest
from virtual_gamepad import VirtualGamepad, open_virtual

from rover_lib.onboard.car import gamepad as gamepads
from rover_lib.onboard.car import servo_link
from rover_lib.onboard.car.car import Car, read_car, yaml_of
from rover_lib.onboard.car.gamepad import ABS, BTN_L1, DROPPED, KEY, STEERING, SYN
from rover_lib.onboard.car.servo_link import MISSING, ServoLink
from rover_lib.onboard.errors import CarError


@pytest.fixture
def pad(tmp_path):
    with VirtualGamepad(tmp_path) as pad:
        yield pad


@pytest.fixture
def opened(pad):
    opened = open_virtual(pad.folder)
    time.sleep(0.05)
    yield opened
    opened.close()


def test_the_human_counts_while_l1_is_held(pad, opened):
    pad.move(1, 1)
    assert opened.sticks() is None
    pad.hold(True)
    assert opened.sticks() == (1, 1)
    pad.move(-0.55, -0.05)  # near its middle a stick rests
    assert opened.sticks() == (pytest.approx(-0.5, abs=1e-4), 0)
    pad.hold(False)
    assert opened.sticks() is None


@pytest.mark.parametrize("what", ["repeated", "old", "another button"])
def test_only_a_press_that_is_seen_counts(pad, opened, what):
    """A button that is stuck, or events that waited, are nobody."""
    if what == "repeated":
        pad.send(KEY, BTN_L1, 2)
    elif what == "old":
        pad.send(KEY, BTN_L1, 1, age_s=0.2)
    elif what == "another button":
        pad.send(KEY, BTN_L1 + 1, 1)
    pad.move(0.5, 0)
    assert opened.sticks() is None


@pytest.mark.parametrize("what", ["silence", "lost events"])
def test_after_a_loss_l1_must_be_pressed_again(pad, opened, what):
    pad.hold(True)
    pad.move(0.5, 0.5)
    assert opened.sticks()
    if what == "silence":
        assert opened.sticks(time.monotonic() + 0.15) is None
    else:
        pad.send(SYN, DROPPED, 0)
        assert opened.sticks() is None
    pad.send(ABS, STEERING, 0)
    time.sleep(0.02)
    assert opened.sticks() is None
    pad.hold(True)
    assert opened.sticks()


def test_one_that_is_unplugged_is_nobody(pad, opened, caplog):
    pad.hold(True)
    assert opened.sticks()
    pad.unplug()
    assert opened.sticks() is None
    assert opened.sticks() is None
    assert caplog.text.count("is gone") == 1


def test_one_that_is_back_is_opened_again(pad, monkeypatch):
    """Whoever waits to be armed asks what is missing ten times a second."""
    link = ServoLink("none", car=Car(human="gamepad"))
    link._gamepad = first = open_virtual(pad.folder)
    pad.unplug()
    assert first.sticks() is None and first.gone
    monkeypatch.setattr(servo_link, "open_gamepad", partial(gamepads.open_gamepad, list))
    assert "no gamepad that can be used is connected" in link.remedy("s")
    pad.plug()
    monkeypatch.setattr(servo_link, "open_gamepad", lambda: open_virtual(pad.folder))
    assert link.remedy("s") == "hold L1 of the gamepad"
    time.sleep(0.05)
    pad.hold(True)
    assert link._gamepad is not first and link._gamepad.sticks() and first.sticks() is None
    link._gamepad.close()


def kernel(root, *nodes):
    """Make a folder like /sys/class/input. nodes: (name, which gamepad, kind)."""
    for i, (name, whole, kind) in enumerate(nodes):
        device = root / f"event{i}" / "device"
        (device / "capabilities").mkdir(parents=True)
        (root / whole).mkdir(exist_ok=True)
        (device / "device").symlink_to(root / whole)
        (device / "name").write_text(name + "\n")
        (device / "properties").write_text("40\n" if kind == "motion" else "0\n")
        (device / "capabilities" / "abs").write_text({"pad": "3003f\n", "motion": "3f\n"}.get(kind, "0\n"))
        (device / "capabilities" / "key").write_text("7fdb000000000000 0 0 0 0\n" if kind == "pad" else "0\n")
    return lambda: gamepads.list_gamepads(root, root)


@pytest.mark.parametrize(
    ("nodes", "sentence"),
    [
        ([("keyboard", "a", "keys")], "none in /dev/input"),
        ([("X-Box", "a", "pad")], "X-Box (event0, without motion sensors: cannot be used)"),
        ([("A", "a", "pad"), ("B", "b", "pad"), ("", "a", "motion"), ("", "b", "motion")], "A (event0), B (event1)"),
        ([("DualSense", "a", "pad"), ("motion", "a", "motion")], "DualSense (event0) cannot be read"),
    ],
)  # fmt: skip
def test_one_sentence_says_what_is_there(tmp_path, nodes, sentence):
    with pytest.raises(CarError) as error:
        gamepads.open_gamepad(kernel(tmp_path, *nodes))
    assert sentence in str(error.value) and error.value.remedy


def test_car_yml_names_the_human(tmp_path):
    path = tmp_path / "car.yml"
    assert "human" not in yaml_of(Car())
    path.write_text(yaml_of(Car(human="gamepad")))
    assert read_car(path) == Car(human="gamepad")
    assert read_car(path).drives_like(Car()) and read_car(path).id == Car().id
    assert [ServoLink("none", car=car).remedy("s") for car in (Car(), read_car(path))] == [
        MISSING["s"],
        "hold L1 of the gamepad",
    ]
