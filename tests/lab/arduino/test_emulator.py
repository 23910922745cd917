"""Arduinos without a board: what goes for the stand-in too, and what only the real firmware does."""

import time
from dataclasses import astuple

import needs
import pytest
from needs import until

from balloon_world.simulated_arduino import StandIn
from lab.arduino import emulator as arduino
from lab.arduino.emulator import board
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US, PwmCalibration
from rover_lib.onboard.car.servo_link import ServoLink, State
from rover_lib.onboard.errors import RoverError

with_firmware = [pytest.mark.emulated, needs.simavr]
BOARDS = [pytest.param(StandIn, id="stand-in"), pytest.param(board, id="firmware", marks=with_firmware)]


def arm(link):
    until(lambda: link.latest().missing == "-")
    return link.arm()


def drive(link, seconds, steering=0.1, throttle=0.1):
    needs.keep_sending(lambda: link.send(*astuple(PwmCalibration().pulses(steering, throttle))), seconds)


@pytest.mark.parametrize("kind", BOARDS)
@needs.real_time
def test_a_link_arms_drives_and_stops(kind):
    with kind() as board:
        sent = PwmCalibration().pulses(0.1, 0.1)
        with ServoLink(board.port) as link:
            assert link.hello.reset == "reset pin"
            assert arm(link).why == "autonomous: armed by the host"
            armed = time.monotonic()
            drive(link, 0.3)
            assert (link.latest().steering_us, link.latest().throttle_us) == (sent.steering_us, sent.throttle_us)
            stopped = time.monotonic()
            until(lambda: link.latest().state is not State.AUTONOMOUS)
            assert link.latest().why == "stopped: no valid command for 150 ms"
            assert time.monotonic() - stopped > 0.1
            time.sleep(0.05)
            link.send(sent.steering_us, sent.throttle_us)  # latched
            time.sleep(0.1)
            assert (link.latest().state, link.latest().result) == (State.STOPPED, "i")
            assert (link.latest().steering_us, link.latest().throttle_us) == (1456, 120)
            assert link.round_trip_s() < 0.2
        events = [e for e in board.pulses() if e.monotonic_s > armed and e.kind == "pulse"]
        for pin, wanted, neutral in (("steering", sent.steering_us, 1456), ("throttle", sent.throttle_us, 120)):
            widths = [e.pulse_us for e in events if e.pin == pin]
            assert min(widths) >= neutral - ARDUINO_STEP_US
            assert max(widths) == pytest.approx(wanted, abs=ARDUINO_STEP_US)
            assert widths[-1] == pytest.approx(neutral, abs=ARDUINO_STEP_US)
        assert 0.1 < max(e.end_s for e in events if e.pin == "throttle") - stopped < 0.4
        with ServoLink(board.port) as again:  # which does not reset it: the human's pulses were gone for a second
            assert (again.hello.boot, again.latest().state) == (link.hello.boot, State.STOPPED)


def test_what_it_needs_is_named(monkeypatch):
    monkeypatch.setitem(arduino.NEEDS, "/nowhere", "gcc-avr")
    with pytest.raises(RoverError, match=r"apt-get install .*gcc-avr"):
        arduino.build.__wrapped__()
