"""Arduinos without a board: what goes for the stand-in too, and what only the real firmware does."""

import time
from dataclasses import astuple

import needs
import pytest
from needs import until

from balloon_world.simulated_arduino import StandIn
from lab.arduino.emulator import board
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.car.servo_link import ServoLink, State

with_firmware = [pytest.mark.emulated, needs.simavr]
BOARDS = [pytest.param(StandIn, id="stand-in"), pytest.param(board, id="firmware", marks=with_firmware)]


@pytest.mark.parametrize("kind", BOARDS)
@needs.real_time
def test_a_link_arms_drives_and_stops(kind):
    sent = astuple(PwmCalibration().pulses(0.1, 0.1))
    with kind() as board, ServoLink(board.port) as link:
        until(lambda: link.latest().missing == "-")
        assert link.arm().why == "autonomous: armed by the host"
        needs.keep_sending(lambda: link.send(*sent), 0.3)
        assert (link.latest().steering_us, link.latest().throttle_us) == sent
        until(lambda: link.latest().state is not State.AUTONOMOUS)
        assert link.latest().why == "stopped: no valid command for 150 ms"
        link.send(*sent)  # latched
        time.sleep(0.1)
        assert (link.latest().state, link.latest().result) == (State.STOPPED, "i")
        assert (link.latest().steering_us, link.latest().throttle_us) == (1456, 120)
