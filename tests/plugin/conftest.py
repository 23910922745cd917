"""A rover for LeRobot without a car: a camera of noise, and a stand-in for the Arduino."""

import contextlib

import pytest

from balloon_world.car import CameraFeed
from balloon_world.simulated_arduino import StandIn
from lab.driving.policy import PLAIN, pictures


@pytest.fixture(scope="session")
def noise():
    """Pictures of a living camera."""
    return pictures(PLAIN)


@pytest.fixture
def make_rover(tmp_path, noise):
    """make_rover(port, **options): a robot, not connected, and the camera that it will see by."""
    from lerobot_robot_rover import Rover, RoverConfig

    with contextlib.ExitStack() as stack:
        feed = stack.enter_context(CameraFeed(tmp_path / "camera", *noise))

        made = []

        def make(port, **options):
            for earlier in made:  # of an attempt that was spoilt: it holds the log
                if earlier.is_connected:
                    earlier.disconnect()
            given = {"film": True, "width": 96, "height": 48, "log": tmp_path / "flight.log"} | options
            camera = given.pop("camera", str(tmp_path / "camera"))
            rover = Rover(RoverConfig(port=port, camera=camera, calibration_dir=tmp_path, **given))
            made.append(rover)
            stack.callback(lambda: rover.is_connected and rover.disconnect())
            return rover, feed

        yield make


@pytest.fixture
def standin():
    with StandIn() as board:
        yield board
