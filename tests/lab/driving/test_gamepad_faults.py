"""A gamepad's human on the pins of an emulated Arduino: whatever fails between hand and board stops the car in 200 ms.

Here the human drives by hand; `python -m lab faults --car lab/cars/gamepad.yml` has the rows of a drive. The gamepad is
FIFOs (lab/driving/virtual_gamepad.py); the relay is a process with a ServoLink, as a recording is.
"""

import functools
import os
import signal
import sys
import time

import needs
import pytest

from balloon_world.child_process import Child
from lab.arduino.emulator import NICE, EmulatedArduino
from lab.driving.bench import FaultError
from lab.driving.priority import boost, boost_priority
from lab.driving.virtual_gamepad import VirtualGamepad

pytestmark = [pytest.mark.emulated, pytest.mark.release, needs.simavr]  # in real time: of a quiet machine
STOP_MS = 200
CAP_US = 238  # of a stick at its end: the cap
RELAY = """
import sys
from pathlib import Path
from lab.driving.priority import boost_priority
from lab.driving.virtual_gamepad import plug_in
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.servo_link import LinkError, ServoLink
plug_in(Path(sys.argv[1]))
with ServoLink(sys.argv[2], car=Car(human="gamepad")) as link, boost_priority():
    print("open", flush=True)
    for line in sys.stdin:
        try:
            link.arm()
            print(link.latest().state.value, flush=True)
        except LinkError as error:
            print(error, error.remedy, flush=True)
"""


@pytest.fixture
def board():
    with EmulatedArduino(human="gamepad", every_pulse=False, nice=NICE) as board, boost_priority():
        boost(board.pid)
        yield board


@pytest.fixture
def pad(tmp_path):
    with VirtualGamepad(tmp_path) as pad:
        yield pad


@pytest.fixture
def relay(board, pad):
    """Running; the human holds L1, and the sticks rest."""
    child = start_relay(board, pad)
    pad.hold(True)
    throttle(board, 0.6)
    yield child
    child.close()


def start_relay(board, pad):
    child = Child("relay", sys.executable, "-c", RELAY, pad.folder, board.port, error=FaultError, talks=True)
    assert hear(child) == "open"
    return child


def hear(child):
    heard = child.read_line(30.0).strip()
    assert heard, child.errors()
    return heard


def throttle(board, seconds):
    """Return the throttle's changes on the pin in this time, (when, us), and for how long simavr had no time (ms)."""
    events, end = [], time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        time.sleep(min(left, 0.1))
        events += board.pulses()
    assert not [e for e in events if e.kind == "lost"]
    changes = [(e.monotonic_s, e.pulse_us) for e in events if e.pin == "throttle" and e.kind in ("pulse", "cut")]
    return changes, sum(e.pulse_us / 1e3 for e in events if e.kind == "stall")


def stops_in_time(board, at_s, what):
    """Whether the throttle was off soon enough after `at_s`, and stayed off for the rest of a second."""
    changes, stalled_ms = throttle(board, 1.0)
    off = [at for at, us in changes if us <= 124 and at > at_s]
    assert off, changes
    stopped_ms = (off[0] - at_s) * 1e3
    print(f"{what}: throttle off after {stopped_ms:.1f} ms (simavr stood for {stalled_ms:.0f})")
    assert stopped_ms <= STOP_MS + stalled_ms
    assert all(us <= 124 for at, us in changes if at > at_s + STOP_MS / 1e3 + stalled_ms / 1e3)


FAULTS = {
    "let go": lambda pad, relay: pad.hold(False),
    "pulled out": lambda pad, relay: pad.unplug(),
    "out of reach": lambda pad, relay: pad.freeze(),
    "relay stopped": lambda pad, relay: os.kill(relay.pid, signal.SIGSTOP),
    "relay killed": lambda pad, relay: os.kill(relay.pid, signal.SIGKILL),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_human_at_full_throttle_is_lost(board, pad, relay, fault):
    pad.move(0.3, 1)
    changes, _ = throttle(board, 0.5)
    assert abs(changes[-1][1] - CAP_US) <= 4
    at_s = time.monotonic()
    FAULTS[fault](pad, relay)
    stops_in_time(board, at_s, f"human, {fault}")
    if fault == "let go":  # a stick that is stuck gives no throttle to whoever presses L1 again
        pad.hold(True)
        assert all(us <= 124 for _, us in throttle(board, 0.5)[0])
        pad.move(0, 0)
        throttle(board, 0.5)
        pad.move(0, 1)
        assert any(us > 200 for _, us in throttle(board, 0.5)[0])
    if fault == "relay stopped":
        os.kill(relay.pid, signal.SIGCONT)
        assert all(us <= 124 for _, us in throttle(board, 0.5)[0])


def test_nothing_arms_it_unattended(board, pad):
    pad.hold(True)  # a button that is stuck since before
    relay = start_relay(board, pad)
    arm = functools.partial(ask, relay, "arm")
    throttle(board, 0.6)
    assert "hold L1" in arm()
    pad.wiggle()
    assert "hold L1" in arm()
    pad.hold(True)  # a press that is seen, and no gesture
    throttle(board, 0.6)
    assert "nobody has just wiggled" in arm()
    pad.wiggle()
    pad.hold(False)  # the gesture is over with it
    throttle(board, 0.3)
    pad.hold(True)
    throttle(board, 0.6)
    assert "nobody has just wiggled" in arm()
    os.kill(relay.pid, signal.SIGSTOP)  # what waited meanwhile is not played to the Arduino
    pad.wiggle()
    os.kill(relay.pid, signal.SIGCONT)
    throttle(board, 0.6)
    assert "nobody has just wiggled" in arm()
    assert arm_by_gesture(board, pad, relay) == "A"
    assert all(us <= 124 for _, us in throttle(board, 0.5)[0])
    relay.close()


def arm_by_gesture(board, pad, relay):
    """Press L1, wiggle and arm; again if this machine had no time for the gamepad, which counts as lost then."""
    for _ in range(5):
        pad.hold(True)
        throttle(board, 0.6)
        pad.wiggle()
        if (said := ask(relay, "arm")) == "A":
            break
    return said


def ask(relay, what):
    relay.send_line(what)
    return hear(relay)
