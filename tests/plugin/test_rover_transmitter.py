"""The transmitter as a teleoperator: what is measured is given, what is not is refused, and the port has one owner."""

from dataclasses import replace
from functools import partial
from unittest.mock import Mock
from weakref import WeakValueDictionary

import pytest
from lerobot.teleoperators.utils import make_teleoperator_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_rover import Rover, RoverConfig, RoverTransmitterConfig, line
from lerobot_robot_rover.line import FEATURES, line_to, named, unnamed, wait_for_humans
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.car.servo_link import MISSING, LinkError, State, Telemetry

PORT = "/dev/ttyNONE"
CALIBRATION = PwmCalibration()
DRIVEN = CALIBRATION.pulses(0.5, 0.1)


def status(steering_us, throttle_us, at_s=1.0, pins=None):
    """A human drives, and the pins do what he does."""
    pins = pins or (steering_us or 1456, throttle_us or 120)
    periods = [None if us is None else period for us, period in ((steering_us, 21316), (throttle_us, 1016))]
    receiver = (steering_us, periods[0], throttle_us, periods[1])
    return Telemetry(at_s, 1, 1000, 0, "-", State.MANUAL, "r", "w", *pins, 238, *receiver, 0, 0, 0, 0)


@pytest.fixture(autouse=True)
def link(monkeypatch):
    """A link whose newest status is set by the test."""
    link = Mock(calibration=CALIBRATION, remedy=MISSING.get)
    link.latest.return_value = status(DRIVEN.steering_us, DRIVEN.throttle_us)
    monkeypatch.setattr(line, "ServoLink", {PORT: link}.__getitem__)
    monkeypatch.setattr(line, "_lines", WeakValueDictionary())
    yield link
    assert link.open.call_count == link.close.call_count


@pytest.fixture
def transmitter(tmp_path):
    teleop = make_teleoperator_from_config(RoverTransmitterConfig(port=PORT, calibration_dir=tmp_path))
    yield teleop
    if teleop.is_connected:
        teleop.disconnect()


def test_the_sticks_by_car_yml(transmitter, link):
    assert transmitter.is_calibrated and transmitter.action_features == FEATURES
    for ask in (transmitter.get_action, transmitter.disconnect):
        with pytest.raises(DeviceNotConnectedError):
            ask()
    transmitter.connect()
    with pytest.raises(DeviceAlreadyConnectedError):
        transmitter.connect()
    action = transmitter.get_action()
    assert action == pytest.approx(named(0.5, 0.1), abs=2e-3) and CALIBRATION.pulses(**unnamed(action)) == DRIVEN
    link.latest.return_value = status(2190, 118)  # beyond the ends
    assert transmitter.get_action() == named(1.0, 0.0)


def test_a_lost_pulse_is_refused(transmitter, link):
    transmitter.connect()
    stretched = replace(status(1456, 120), receiver_steering_period_us=2 * 21316)
    for link.latest.return_value in (status(None, 120), status(1456, None), None, stretched):
        with pytest.raises(LinkError):
            transmitter.get_action()


def test_a_withheld_throttle_is_refused(transmitter, link):
    transmitter.connect()
    withheld = partial(status, 1456, 170, pins=(1456, 120))
    never_for_long = withheld(1.0), withheld(1.4), status(1456, 170, 1.45), withheld(1.6), withheld(2.0)
    for link.latest.return_value in never_for_long:
        transmitter.get_action()
    link.latest.return_value = withheld(2.2)
    with pytest.raises(LinkError):
        transmitter.get_action()


def test_a_port_has_one_line_whichever_name_it_has(tmp_path):
    port, by_id = tmp_path / "ttyACM0", tmp_path / "by-id"
    port.touch()
    by_id.symlink_to(port)
    before = line_to(str(by_id))
    assert line_to(str(port)) is before is not line_to(str(tmp_path / "other"))


def test_the_robot_and_the_policy_know_that_a_human_may_drive(tmp_path, transmitter):
    rover, waits = Rover(RoverConfig(port=PORT, calibration_dir=tmp_path)), []
    assert list(rover._line.transmitters) == [transmitter]
    wait_for_humans()
    rover._line.before_drive = lambda: waits.append(1)
    wait_for_humans()
    assert waits == [1]
