"""The robot by itself: what LeRobot may ask of it, and what it refuses. On a stand-in for the Arduino."""

import math
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_rover import Rover, RoverConfig, RoverTransmitter, RoverTransmitterConfig, ride
from lerobot_robot_rover.line import FEATURES, named
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.car.servo_link import LinkError
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.errors import CameraError, DriveFault, ParamsError, PolicyError
from tests.helpers.needs import Late, real_time, until

GO = {"steering": 0.2, "throttle": 0.15}


def jpegs(blue=0):
    """Pictures of a sensor's noise, black or blue."""
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 12, (160, 320, 3), np.uint8) for _ in range(40)]
    for picture in pictures:
        picture[:, :160, 0] += blue
    return [cv2.imencode(".jpg", picture)[1].tobytes() for picture in pictures]


def turn(rover, action=GO, seconds=0.0):
    """LeRobot's loop. Gives the last observation. Raises Late if it was itself late, for which a car rightly stops."""
    end, sent = time.monotonic() + seconds, math.inf
    while True:
        observation = rover.get_observation()
        if time.monotonic() - sent > 0.8 * ride.HOLD_S:
            raise Late("an observation took too long")
        rover.send_action(action)
        sent = time.monotonic()
        if sent >= end:
            return observation
        time.sleep(1 / 60)


@pytest.fixture
def patient(monkeypatch):
    """LeRobot's loop may be late: for tests of something else, where this machine is what is late."""
    monkeypatch.setattr("lerobot_robot_rover.ride.HOLD_S", 1.0)


def connect(on):
    """Connect a bench's robot, and return it once its camera runs."""
    on.robot.connect()
    until(lambda: on.feed.written > 1)
    on.board.pulses()
    return on.robot


def test_lerobot_makes_it_of_its_config(tmp_path):
    rover = make_robot_from_config(RoverConfig(width=64, height=36, calibration_dir=tmp_path))
    assert isinstance(rover, Rover) and rover.is_calibrated and not rover.is_connected
    assert rover.observation_features == {**FEATURES, "cam_front": (36, 64, 3)}
    assert rover.action_features == FEATURES and list(rover.cameras) == ["cam_front"]
    for ask in (rover.get_observation, lambda: rover.send_action(GO), rover.disconnect):
        with pytest.raises(DeviceNotConnectedError):
            ask()
    with pytest.raises(ParamsError):
        Rover(RoverConfig(calibration_dir=tmp_path, throttle_limit=1.5))


def test_connecting_waits_for_the_gesture_and_a_failure_closes_all(bench, monkeypatch):
    waited = []
    monkeypatch.setattr("lerobot_robot_rover.rover.arm_when_ready", lambda *given: waited.append(given))
    for options, error in (({"camera": "/dev/none"}, CameraError), ({"port": "/dev/none"}, LinkError)):
        with bench(**options) as on, pytest.raises(error):
            on.robot.connect()
        assert not on.robot.is_connected and not waited
    with bench() as on:
        on.robot.connect()
        assert len(waited) == 1
        with pytest.raises(DeviceAlreadyConnectedError):
            on.robot.connect()
        assert on.board._state == "M"  # nothing is armed by connecting
        on.robot.disconnect()
        on.robot.connect()


def test_an_observation_is_what_the_features_say(bench):
    with bench() as on:
        rover = connect(on)
        on.feed.show(*jpegs(blue=180))
        before = rover.get_observation()
        picture = before["cam_front"]
        assert [before[name] for name in FEATURES] == [0.0, 0.0] and set(before) == set(rover.observation_features)
        assert picture.shape == (48, 96, 3) and picture.dtype == np.uint8 and picture.flags.c_contiguous
        until(lambda: rover.get_observation()["cam_front"].mean((0, 1))[2] > 60)  # RGB
        assert rover.get_observation()["cam_front"].mean((0, 1))[0] < 60


@pytest.mark.slow
@real_time
def test_actions_are_on_the_pins_in_the_next_state_and_in_the_log(bench, patient):
    with bench(throttle_limit=0.1) as on:
        rover = connect(on)
        observation = turn(rover, seconds=0.5)
        assert [observation[name] for name in FEATURES] == [0.2, 0.1]  # the throttle is cut at the limit
        assert rover.send_action({"steering": 1.1, "throttle": 0.9}) == named(1.0, 0.1)
        until(lambda: turn(rover) and on.board._pins[1] == PwmCalibration().throttle.pulse_us(0.1))
        assert rover._link.latest().cap_us <= 180  # and what the Arduino would give is lowered
        rover.disconnect()
        assert on.board._state == "S" and on.board._reason in "nt"
        texts = [event.text for event in read_log(on.log).events]
        assert "armed" in texts and any(text.startswith("neutral: stopped") for text in texts)


def test_an_action_that_must_not_drive_a_car(bench):
    with bench() as on:
        rover = connect(on)
        rover.get_observation()
        wrong = [named(*values) for values in ((math.nan, 0.1), (1.5, 0.1), (0.0, -0.5), (None, 0.1), (10**400, 0.1))]
        for action in (*wrong, {"steering": 0.0}, {**GO, "gripper": 1.0}):
            with pytest.raises(PolicyError):
                rover.send_action(action)
        assert on.board._state == "M" and not [e for e in on.board.pulses() if e.pin == "throttle"]


@pytest.mark.slow
@real_time
def test_without_actions_the_car_stops_and_takes_another_gesture(bench):
    with bench() as on:
        rover, board = connect(on), on.board
        turn(rover, seconds=0.2)
        until(lambda: board._state == "S")
        assert board._reason == "n"  # by the host, before the Arduino had to
        rover.get_observation()
        assert board._state == "S"  # looking arms nothing
        turn(rover, seconds=0.2)  # this human has always just wiggled
        assert board._state == "A"
        rover.get_observation()
        until(lambda: board._state == "S")
        for _ in range(2):  # an action that comes too late arms nothing
            with pytest.raises(DriveFault):
                rover.send_action(GO)
        assert board._state == "S"


def at_a_wall():
    picture, rng = np.full((160, 320, 3), 100, np.uint8), np.random.default_rng(1)
    picture[:50, :100] = 30
    return [picture + rng.integers(0, 12, picture.shape, np.uint8) for _ in range(40)]


@pytest.mark.slow
@real_time
@pytest.mark.parametrize(
    ("happens", "error"),
    [
        (lambda board, feed: board._enter("M", "h"), DriveFault),
        (lambda board, feed: feed.close(), (DriveFault, CameraError)),
        (lambda board, feed: feed.show(*at_a_wall()), DriveFault),
    ],
    ids=["takeover", "unplugged", "stuck"],
)
def test_faults_of_a_drive_end_it(bench, happens, error, patient):
    with bench() as on:
        rover = connect(on)
        turn(rover, seconds=0.4)
        happens(on.board, on.feed)
        with pytest.raises(error):
            turn(rover, seconds=3)
        until(lambda: rover._ride is None or rover._ride.over)
        for ask in (rover.get_observation, lambda: rover.send_action(GO)):
            with pytest.raises((DriveFault, CameraError)):
                ask()
        assert on.board._state != "A"


@pytest.mark.parametrize("when", ["black", "too old", "none"])
def test_a_picture_by_which_nobody_may_drive_arms_nothing(bench, when):
    with bench() as on:
        rover = connect(on)
        rover.get_observation()
        if when == "too old":
            rover._captured_s -= 5
            assert rover.send_action(GO) == named(0.0, 0.0)
        elif when == "none":
            on.feed.show()
            with pytest.raises(CameraError):
                for _ in range(3):
                    rover.get_observation()
        else:
            on.feed.show(*jpegs())
            until(lambda: rover._camera.latest().mean < 8)
            with pytest.raises(CameraError):
                rover.send_action(GO)
        assert on.board._state == "M"


@pytest.mark.slow
@real_time
def test_what_the_human_does_is_not_sent_and_ends_a_drive(bench):
    with bench() as on:
        port, folder, board = on.board.port, on.folder, on.board
        transmitter = RoverTransmitter(RoverTransmitterConfig(port=port, calibration_dir=folder))
        rover = connect(on)
        transmitter.connect()
        for _ in range(5):
            rover.get_observation()
            sticks = transmitter.get_action()
            assert rover.send_action(sticks) == sticks == pytest.approx(named(0.0, 0.0), abs=1e-3)
        assert board._state == "M"
        turn(rover, seconds=0.2)  # the same loop, by a policy
        assert board._state == "A"
        rover.get_observation()
        rover.send_action(transmitter.get_action())  # and again the human: a reset between episodes
        assert board._state == "S"
        rover.disconnect()
        assert transmitter.get_action() == sticks  # the port is open as long as one of the two needs it
        transmitter.disconnect()


@pytest.mark.parametrize(
    ("strategy", "multiplier", "teleop", "word"),
    [
        ("Base", 3, None, "--interpolation_multiplier=1"),
        ("Episodic", 1, None, "--strategy.reset_to_initial_position=false"),
        ("Episodic", 1, "rover_transmitter", "--strategy.smooth_handover=false"),
        ("DAggerStrategyConfig", 1, "rover_transmitter", "rover drive --record"),
    ],
)
def test_what_an_arm_does_is_refused_before_anything_is_opened(tmp_path, strategy, multiplier, teleop, word):
    """LeRobot's classes are known by their names, and the config by its variable's."""
    moves = {"smooth_handover": True, "reset_to_initial_position": True} if strategy == "Episodic" else {}
    strategy = type(strategy, (), moves)()
    config = type("RolloutConfig", (SimpleNamespace,), {})
    cfg = config(strategy=strategy, interpolation_multiplier=multiplier, teleop=teleop)
    rover = Rover(RoverConfig(port="/dev/nothing", calibration_dir=tmp_path))
    with pytest.raises(ParamsError, match=word):
        rover.connect()
    assert cfg.strategy is strategy
