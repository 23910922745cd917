"""The robot by itself: what LeRobot may ask of it, and what it refuses. On a stand-in for the Arduino."""

import math
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from needs import real_time, simavr, until

from balloon_world.simulated_arduino import REST_US
from lab.arduino.emulator import NICE, EmulatedArduino
from lab.driving.policy import PLAIN, pictures
from lerobot_robot_rover import Rover, RoverConfig, RoverTransmitter, RoverTransmitterConfig
from lerobot_robot_rover.line import FEATURES, named
from lerobot_robot_rover.ride import HOLD_S, Ride
from rover_lib.onboard.car.camera import CameraError
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.car.servo_link import LinkError, State
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.errors import DriveFault, ParamsError, PolicyError, TakenOver

GO = {"steering": 0.2, "throttle": 0.15}
SENT = PwmCalibration().pulses(0.2, 0.15)
DARK = pictures(PLAIN, level=0)


def turn(rover, action=GO, seconds=0.0):
    """LeRobot's loop: an observation, an action, and the rest of its thirtieth. Gives the last observation."""
    end = time.monotonic() + seconds
    while True:
        observation = rover.get_observation()
        rover.send_action(action)
        if time.monotonic() >= end:
            return observation
        time.sleep(1 / 60)


@pytest.fixture
def patient(monkeypatch):
    """LeRobot's loop may be late: for tests of something else, where this machine is what is late."""
    monkeypatch.setattr("lerobot_robot_rover.ride.HOLD_S", 1.0)


def on_pins(board, pin):
    return [event.pulse_us for event in board.pulses() if event.pin == pin]


def one_sentence(error):
    text = str(error.value)
    assert "\n" not in text and not text.endswith(".") and len(text) < 500
    return True


# ---- without devices


def test_lerobot_makes_it_of_its_config(tmp_path):
    rover = make_robot_from_config(RoverConfig(calibration_dir=tmp_path))
    assert isinstance(rover, Rover) and rover.robot_type == "rover" and rover.is_calibrated and not rover.is_connected


def test_features_are_the_datasets(tmp_path):
    rover = Rover(RoverConfig(width=64, height=36, calibration_dir=tmp_path))
    assert rover.observation_features == {**FEATURES, "cam_front": (36, 64, 3)}
    assert rover.action_features == FEATURES
    assert list(rover.cameras) == ["cam_front"]


@pytest.mark.parametrize("wrong", [{"width": 0}, {"camera_name": "my camera"}])
def test_a_config_that_makes_no_sense(wrong):
    with pytest.raises(ParamsError) as error:
        RoverConfig(**wrong)
    assert one_sentence(error)


def test_a_throttle_limit_that_makes_no_sense(tmp_path):
    with pytest.raises(ParamsError, match="throttle_limit must be in"):
        Rover(RoverConfig(throttle_limit=1.5, calibration_dir=tmp_path))


def test_nothing_works_before_connect(tmp_path):
    rover = Rover(RoverConfig(calibration_dir=tmp_path))
    for ask in (rover.get_observation, lambda: rover.send_action(GO), rover.disconnect):
        with pytest.raises(DeviceNotConnectedError, match=r"is not connected: connect\(\) first"):
            ask()


def test_recorded_pictures_are_no_camera_unless_somebody_says_so(make_rover, standin):
    rover, _ = make_rover(standin.port, film=False)
    with pytest.raises(CameraError, match="recorded pictures know nothing") as error:
        rover.connect()
    assert one_sentence(error) and not rover.is_connected


def test_no_camera_and_no_arduino_are_told_apart(make_rover, standin, tmp_path):
    rover, _ = make_rover(standin.port, camera=str(tmp_path / "none"))
    with pytest.raises(CameraError, match="no such camera"):
        rover.connect()
    rover, _ = make_rover(str(tmp_path / "none"))
    with pytest.raises(LinkError, match="cannot be opened") as error:
        rover.connect()
    assert one_sentence(error) and not rover.is_connected
    rover, _ = make_rover(standin.port)
    rover.connect()  # nothing of the failed one has kept the camera


# ---- connected


@pytest.fixture
def rover(make_rover, standin):
    robot, feed = make_rover(standin.port)
    robot.feed = feed
    robot.connect()
    until(lambda: feed.written > 1)
    standin.pulses()
    yield robot
    if robot.is_connected:
        robot.disconnect()


def test_connected_once(rover, standin):
    assert rover.is_connected
    with pytest.raises(DeviceAlreadyConnectedError, match="connected already"):
        rover.connect()
    assert standin._state == "M"  # nothing is armed by connecting
    rover.disconnect()
    assert not rover.is_connected
    with pytest.raises(DeviceNotConnectedError):
        rover.disconnect()
    rover.connect()


def test_an_observation_is_what_the_features_say(rover):
    before = rover.get_observation()
    assert [before[name] for name in FEATURES] == [0.0, 0.0]
    picture = before["cam_front"]
    assert picture.shape == (48, 96, 3) and picture.dtype == np.uint8 and picture.flags.c_contiguous
    red, blue = picture[:12, :24, 0].mean(), picture[:12, :24, 2].mean()
    assert abs(red - blue) < 5 and set(before) == set(rover.observation_features)
    assert not np.array_equal(rover.get_observation()["cam_front"], picture)  # each picture once


def test_colours_are_rgb(make_rover, standin):
    import cv2

    rover, feed = make_rover(standin.port)
    rng = np.random.default_rng(0)
    blue = [rng.integers(0, 40, (160, 320, 3), np.uint8) for _ in range(40)]
    for picture in blue:
        picture[:, ::2, 0] += 180
        picture[:, 1::2, 0] += 150
    feed.show(*[cv2.imencode(".jpg", picture)[1].tobytes() for picture in blue])
    rover.connect()
    means = rover.get_observation()["cam_front"].mean((0, 1))
    assert means[2] > 100 > means[0]


@pytest.mark.slow
@real_time
def test_actions_are_on_the_pins_and_the_next_state(make_rover, standin, patient):
    rover, _ = make_rover(standin.port)
    rover.connect()
    standin.pulses()
    try:
        observation = turn(rover, seconds=0.5)
        assert [observation[name] for name in FEATURES] == [0.2, 0.15]
        assert on_pins(standin, "steering")[-1] == SENT.steering_us and on_pins(standin, "throttle") == []
    finally:
        rover.disconnect()
    assert standin._state == "S" and standin._reason in "nt"


@pytest.mark.slow
@real_time
def test_a_throttle_above_the_limit_is_cut(make_rover, standin):
    rover, _ = make_rover(standin.port, throttle_limit=0.1)
    rover.connect()
    try:
        rover.get_observation()
        assert rover.send_action({"steering": 1.1, "throttle": 0.9}) == named(1.0, 0.1)
        until(lambda: standin._pins[1] == PwmCalibration().throttle.pulse_us(0.1))
        assert rover._link.latest().cap_us <= 180  # and what the Arduino would give is lowered
    finally:
        rover.disconnect()


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        ({"steering": math.nan, "throttle": 0.1}, "is not finite"),
        ({"steering": 0.0, "throttle": math.inf}, "is not finite"),
        ({"steering": 1.5, "throttle": 0.1}, "outside the range of a servo"),
        ({"steering": 0.0, "throttle": -0.5}, "outside the range of a servo"),
        ({"steering": 0.0}, "is steering and throttle"),
        ({"steering": 0.0, "throttle": 0.1, "gripper": 1.0}, "is steering and throttle"),
        ({"steering": "left", "throttle": 0.1}, "must be of numbers"),
        ({"steering": None, "throttle": 0.1}, "must be of numbers"),
        ({"steering": 10**400, "throttle": 0.1}, "must be of numbers"),
    ],
)
def test_an_action_that_must_not_drive_a_car(rover, standin, action, sentence):
    rover.get_observation()
    with pytest.raises(PolicyError, match=sentence) as error:
        rover.send_action(action)
    assert one_sentence(error) and standin._state == "M" and on_pins(standin, "throttle") == []


@pytest.mark.slow
@real_time
def test_without_actions_the_car_stops_and_takes_another_gesture(make_rover, standin):
    rover, _ = make_rover(standin.port)
    rover.connect()
    try:
        turn(rover, seconds=0.2)
        until(lambda: standin._state == "S")
        assert standin._reason == "n"  # by the host, before the Arduino had to
        observation = rover.get_observation()
        assert [observation[name] for name in FEATURES] == [0.0, 0.0]
        assert standin._state == "S"  # looking arms nothing
        turn(rover, seconds=0.2)  # this human has always just wiggled
        assert standin._state == "A"
    finally:
        rover.disconnect()


@pytest.mark.slow
@real_time
def test_an_action_that_comes_too_late_ends_it(make_rover, standin):
    rover, _ = make_rover(standin.port)
    rover.connect()
    try:
        turn(rover, seconds=0.2)
        rover.get_observation()
        until(lambda: standin._state == "S")
        for _ in range(2):  # nothing is armed again
            with pytest.raises(DriveFault, match=r"gave no action for \d+ ms, .* `rover drive`"):
                rover.send_action(GO)
        assert standin._state == "S"
    finally:
        rover.disconnect()


@pytest.mark.slow
@real_time
@pytest.mark.parametrize(
    ("happens", "error", "sentence"),
    [
        (lambda board, feed: board._enter("M", "h"), TakenOver, "the human took over"),
        (lambda board, feed: board._enter("S", "s"), DriveFault, "signal was lost"),
        (lambda board, feed: board._reset(), DriveFault, "was reset"),
        (lambda board, feed: feed.freeze(), DriveFault, "frozen"),
        (lambda board, feed: feed.show(*DARK), DriveFault, "black"),
        (lambda board, feed: feed.close(), DriveFault, "ended after"),
    ],
    ids=["takeover", "signal", "reset", "frozen", "black", "unplugged"],
)
def test_what_a_drive_detects_is_detected(make_rover, standin, happens, error, sentence, patient):
    rover, feed = make_rover(standin.port)
    rover.connect()
    try:
        turn(rover, seconds=0.4)
        happens(standin, feed)
        with pytest.raises((error, CameraError), match=sentence):
            turn(rover, seconds=3)
        until(lambda: rover._ride is None or rover._ride.over)
        assert standin._state != "A"
        for ask in (rover.get_observation, lambda: rover.send_action(GO)):
            with pytest.raises((error, CameraError)):
                ask()
        assert standin._state != "A"
    finally:
        rover.disconnect()


@pytest.mark.slow
@real_time
def test_the_flight_log_has_it(make_rover, standin, tmp_path, patient):
    rover, _ = make_rover(standin.port)
    rover.connect()
    turn(rover, seconds=0.3)
    rover.disconnect()
    flight = read_log(tmp_path / "flight.log")
    texts = [event.text for event in flight.events]
    assert any("has no deadlines" in text for text in texts) and "armed" in " ".join(texts)
    assert any(text.startswith("neutral: stopped") for text in texts)


@pytest.mark.parametrize("when", ["before arming", "without a drive"])
def test_a_black_picture_arms_nothing(rover, standin, when):
    if when == "before arming":
        rover.get_observation()
    rover.feed.show(*DARK)
    until(lambda: rover._camera.latest().mean < 8)
    with pytest.raises(CameraError, match="black"):
        if when == "before arming":
            rover.send_action(GO)
        else:
            for _ in range(10):
                rover.get_observation()
    assert standin._state == "M"


def test_a_picture_that_is_too_old_arms_nothing(rover, standin):
    rover.get_observation()
    rover._captured_s -= 5
    assert rover.send_action(GO) == named(0.0, 0.0)
    assert standin._state == "M"


def test_no_picture_no_observation(rover):
    rover.get_observation()
    rover.feed.pause()
    with pytest.raises(CameraError, match=r"no new frame for 0.2 s"):
        for _ in range(3):
            rover.get_observation()


# ---- and a human


@pytest.mark.slow
@real_time
def test_what_the_human_does_is_not_sent_and_ends_a_drive(make_rover, standin, tmp_path):
    transmitter = RoverTransmitter(RoverTransmitterConfig(port=standin.port, calibration_dir=tmp_path))
    rover, _ = make_rover(standin.port)
    rover.connect()
    transmitter.connect()
    try:
        for _ in range(5):
            rover.get_observation()
            sticks = transmitter.get_action()
            assert rover.send_action(sticks) == sticks == pytest.approx(named(0.0, 0.0), abs=1e-3)
        assert standin._state == "M"
        turn(rover, seconds=0.2)  # the same loop, by a policy
        assert standin._state == "A"
        rover.get_observation()
        rover.send_action(transmitter.get_action())  # and again the human: a reset between episodes
        assert standin._state == "S"
        rover.disconnect()
        assert transmitter.get_action() == sticks  # the port is open as long as one of the two needs it
    finally:
        transmitter.disconnect()


@pytest.mark.emulated
@pytest.mark.slow
@simavr
def test_connecting_waits_for_the_gesture_and_says_what_is_missing(make_rover):
    with EmulatedArduino(every_pulse=False, nice=NICE) as board:
        rover, _ = make_rover(board.port)

        def said(words):
            log = getattr(rover, "_log", None)
            return bool(log) and any(words in event.text for event in log.recent)

        def human():
            until(lambda: said("switch the transmitter on"))
            board.transmitter(*REST_US)
            until(lambda: said("move the steering stick"))
            assert not rover.is_connected
            board.wiggle()

        hand = threading.Thread(target=human)
        hand.start()
        rover.connect()
        hand.join()
        assert said("move the steering stick")
        assert rover.is_connected and rover._link.latest().state is State.MANUAL
        rover.disconnect()


# ---- how long an action holds, by a clock of our own


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


def test_an_action_holds_for_a_tenth_of_a_second():
    clock = Clock()
    ride = Ride(None, None, Settings(), None, clock=clock)  # type: ignore[arg-type]
    ride._given_s = clock.now_s
    clock.now_s += HOLD_S - 0.001
    assert ride._late() is None
    ride.put(0.1, 0.1)
    clock.now_s += HOLD_S - 0.001
    assert ride._late() is None
    clock.now_s += 0.002
    assert ride._late() == "no action came from LeRobot for 100 ms"
    assert HOLD_S + 1 / 50 < 0.15  # neutral goes out before the Arduino would stop by itself


# ---- lerobot-rollout, of LeRobot 0.6


class DAggerStrategyConfig(SimpleNamespace):
    """Known by its name."""


class RolloutConfig(SimpleNamespace):
    """Known by its name, and by that of the variable in which LeRobot's functions have it."""

    def __init__(self, strategy, **options):
        usual = {"interpolation_multiplier": 1, "teleop": None, "return_to_initial_position": True}
        super().__init__(strategy=strategy, **usual | options)


EPISODIC = {"smooth_handover": True, "reset_to_initial_position": True}


@pytest.mark.parametrize(
    ("strategy", "options", "says"),
    [
        ({}, {"interpolation_multiplier": 3}, "--interpolation_multiplier=1"),
        (EPISODIC, {}, "--strategy.reset_to_initial_position=false"),
        (EPISODIC, {"teleop": "rover_transmitter"}, "--strategy.smooth_handover=false"),
    ],
)
def test_what_an_arm_does_is_refused_before_anything_is_opened(tmp_path, strategy, options, says):
    cfg = RolloutConfig(SimpleNamespace(**strategy), **options)
    rover = Rover(RoverConfig(port="/dev/nothing", calibration_dir=tmp_path))
    with pytest.raises(ParamsError, match=f"; {says}$") as error:
        rover.connect()
    assert one_sentence(error) and cfg.strategy


@pytest.mark.slow
@real_time
def test_daggers_pause_stops_the_car_and_a_takeover_is_a_correction(make_rover, standin, tmp_path, patient):
    cfg = RolloutConfig(DAggerStrategyConfig(record_autonomous=False, smooth_handover=False), teleop="transmitter")
    rover, _ = make_rover(standin.port)
    rover.connect()
    transmitter = RoverTransmitter(RoverTransmitterConfig(port=standin.port, calibration_dir=tmp_path))
    transmitter.connect()
    try:
        rover.get_observation()
        rover.send_action(dict(GO))
        assert standin._state == "A"
        held = dict(GO)
        for _ in range(3):  # the pause: one and the same action again and again
            rover.get_observation()
            state = rover.send_action(held)
        assert standin._state in "MS" and state == named(0.0, 0.0)
        rover.get_observation()
        sticks = transmitter.get_action()
        for _ in range(2):  # the correction, and the pause after it
            assert rover.send_action(sticks) in (sticks, named(0.0, 0.0))
            rover.get_observation()
        assert standin._state in "MS"
        rover.send_action(dict(GO))
        assert standin._state == "A"
        standin._enter("M", "h")
        for _ in range(30):  # LeRobot's loop does not know of it yet
            rover.get_observation()
            rover.send_action(dict(GO))
        assert standin._state not in "A" and "record a correction" in (tmp_path / "flight.log").read_text()
        assert cfg.strategy.smooth_handover is False
    finally:
        transmitter.disconnect()
