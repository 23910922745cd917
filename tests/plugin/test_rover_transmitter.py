"""The transmitter as a teleoperator: what is measured is given, what is not is refused, and the port has one owner."""

from dataclasses import replace
from weakref import WeakValueDictionary

import pytest
from lerobot.teleoperators.utils import make_teleoperator_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_rover import Rover, RoverConfig, RoverTransmitter, RoverTransmitterConfig, line
from lerobot_robot_rover.line import FEATURES, line_to, named, unnamed, wait_for_humans
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.car.servo_link import MISSING, LinkError, State, Telemetry
from rover_lib.onboard.errors import ParamsError

PORT = "/dev/ttyNONE"
CALIBRATION = PwmCalibration()
DRIVEN = CALIBRATION.pulses(0.5, 0.1)


class Link:
    """A link whose newest status is set by the test. opened: how many there are."""

    opened = 0
    status: Telemetry | None = None
    calibration, remedy = CALIBRATION, MISSING.get

    def __init__(self, port):
        assert port == PORT

    def open(self):
        Link.opened += 1

    def close(self):
        Link.opened -= 1

    def latest(self):
        return Link.status


def status(steering_us, throttle_us, at_s=1.0, pins=None):
    """A human drives, and the pins do what he does."""
    pins = pins or (steering_us or 1456, throttle_us or 120)
    periods = [None if us is None else period for us, period in ((steering_us, 21316), (throttle_us, 1016))]
    receiver = (steering_us, periods[0], throttle_us, periods[1])
    return Telemetry(at_s, 1, 1000, 0, "-", State.MANUAL, "r", "w", *pins, 238, *receiver, 0, 0, 0, 0)


@pytest.fixture(autouse=True)
def _links(monkeypatch):
    monkeypatch.setattr(line, "ServoLink", Link)
    monkeypatch.setattr(line, "_lines", WeakValueDictionary())
    Link.opened, Link.status = 0, status(DRIVEN.steering_us, DRIVEN.throttle_us)
    yield
    assert Link.opened == 0


@pytest.fixture
def transmitter(tmp_path):
    teleop = make_teleoperator_from_config(RoverTransmitterConfig(port=PORT, calibration_dir=tmp_path))
    yield teleop
    if teleop.is_connected:
        teleop.disconnect()


def test_the_sticks_by_car_yml(transmitter):
    assert isinstance(transmitter, RoverTransmitter) and not transmitter.is_connected and transmitter.is_calibrated
    assert transmitter.action_features == FEATURES
    assert transmitter.feedback_features == {}
    transmitter.connect()
    action = transmitter.get_action()
    assert action == pytest.approx(named(0.5, 0.1), abs=2e-3)
    assert CALIBRATION.pulses(**unnamed(action)) == DRIVEN


def test_the_sticks_ends_are_the_ends(transmitter):
    transmitter.connect()
    Link.status = status(2190, 118)
    assert transmitter.get_action() == named(1.0, 0.0)


def test_connected_once(transmitter):
    for ask in (transmitter.get_action, transmitter.disconnect):
        with pytest.raises(DeviceNotConnectedError, match=r"not connected: connect\(\) first"):
            ask()
    transmitter.connect()
    with pytest.raises(DeviceAlreadyConnectedError, match="connected already"):
        transmitter.connect()
    transmitter.disconnect()
    assert Link.opened == 0


@pytest.mark.parametrize("lost", [(None, 120), (1456, None), (None, None)])
def test_a_lost_pulse_is_no_zero(transmitter, lost):
    transmitter.connect()
    Link.status = status(*lost)
    with pytest.raises(LinkError, match=r"was lost, and LeRobot cannot record that; .* record this episode again"):
        transmitter.get_action()
    Link.status = None
    with pytest.raises(LinkError, match="signal was lost"):
        transmitter.get_action()


def test_a_period_that_is_none(transmitter):
    transmitter.connect()
    Link.status = replace(status(1456, 120), receiver_steering_period_us=2 * 21316)
    with pytest.raises(LinkError, match="signal was lost"):
        transmitter.get_action()


def test_it_waits_for_a_signal_and_says_so(transmitter, monkeypatch, caplog):
    Link.status = status(None, None)
    waits = []

    def sleep(seconds):
        waits.append(seconds)
        if len(waits) == 3:
            Link.status = status(1456, 120)

    monkeypatch.setattr("time.sleep", sleep)
    transmitter.connect()
    assert len(waits) == 3 and caplog.text.count("switch the transmitter on") == 1


def test_no_port_is_kept_by_one_who_gave_up_waiting(transmitter, monkeypatch):
    Link.status = status(None, None)

    def sleep(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", sleep)
    with pytest.raises(KeyboardInterrupt):
        transmitter.connect()
    assert not transmitter.is_connected and Link.opened == 0


def test_a_throttle_that_the_car_does_not_get_is_no_data(transmitter):
    transmitter.connect()
    for at_s, ends in ((1.0, False), (1.4, False), (1.6, True)):
        Link.status = status(1456, 170, at_s, pins=(1456, 120))
        if ends:
            with pytest.raises(LinkError, match=r"does not get the stick's throttle.*; let go of the throttle stick"):
                transmitter.get_action()
        else:
            transmitter.get_action()
    Link.status = status(1456, 170, 1.7)  # it gets it
    transmitter.get_action()
    Link.status = status(1456, 170, 2.0, pins=(1456, 120))  # for a moment: the stick has just moved
    transmitter.get_action()


def test_a_transmitter_wants_a_port():
    with pytest.raises(ParamsError, match="the robot's"):
        RoverTransmitterConfig(port="")


# ---- one port, one owner


def test_who_names_the_same_port_has_the_same_line(tmp_path):
    port = tmp_path / "ttyACM0"
    port.touch()
    (tmp_path / "by-id").symlink_to(port)
    assert line_to(str(port)) is line_to(str(tmp_path / "by-id"))
    assert line_to(str(port)) is not line_to(str(tmp_path / "other"))


def test_a_port_that_another_device_has_got_is_another_line(tmp_path):
    port, by_id = tmp_path / "ttyACM0", tmp_path / "by-id"
    port.touch()
    by_id.symlink_to(port)
    before = line_to(str(by_id))
    by_id.unlink()  # it was unplugged, and what was plugged in then has its number
    after = line_to(str(port))
    assert after is not before and after.port == str(port) and line_to(str(port)) is after


def test_the_last_closes_it():
    shared = line_to(PORT)
    with pytest.raises(LinkError, match="is not open"):
        shared.link  # noqa: B018
    first, second = shared.open(), shared.open()
    assert first is second and Link.opened == 1
    shared.close()
    assert Link.opened == 1 and shared.link is first
    shared.close()
    shared.close()
    assert Link.opened == 0


def test_a_robot_knows_that_a_human_may_drive(tmp_path, transmitter):
    rover = Rover(RoverConfig(port=PORT, calibration_dir=tmp_path))
    assert list(rover._line.transmitters) == [transmitter]
    transmitter.connect()
    transmitter.get_action()
    assert rover._line.take_humans_action() and not rover._line.take_humans_action()


def test_a_policys_episode_waits_for_the_robots_human():
    shared, waits = line_to(PORT), []
    wait_for_humans()
    shared.before_drive = lambda: waits.append(1)
    wait_for_humans()
    assert waits == [1]
