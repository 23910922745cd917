"""A rover for LeRobot without a car: a camera of noise, and a stand-in for the Arduino."""

import contextlib
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from balloon_world.car import CameraFeed
from balloon_world.simulated_arduino import StandIn
from lab.driving.policy import make_artifact, pictures


@pytest.fixture(scope="session")
def noise():
    """Pictures of a living camera."""
    return pictures()


@pytest.fixture(scope="session")
def artifact(tmp_path_factory):
    """A constant one, whose process starts fast."""
    path = tmp_path_factory.mktemp("constant") / "policy_fp32.pt"
    make_artifact(path, camera="cam_front")
    return path


@dataclass
class Bench:
    """A robot that is not connected yet, the camera that it will see by, and its Arduino. log: the drive's."""

    robot: object
    feed: CameraFeed
    board: object
    folder: Path

    @property
    def log(self):
        return self.folder / "flight.log"


@pytest.fixture
def bench(tmp_path, noise):
    """bench(**options of RoverConfig): a context with a Bench, each time with everything of its own."""
    from lerobot_robot_rover import Rover, RoverConfig

    @contextlib.contextmanager
    def make(**options):
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        with CameraFeed(folder / "camera", *noise) as feed, contextlib.ExitStack() as stack:
            board = stack.enter_context(StandIn())
            given = {"width": 96, "height": 48, "log": folder / "flight.log", "port": board.port}
            given |= {"camera": str(folder / "camera"), "calibration_dir": folder} | options
            robot = Rover(RoverConfig(**given))
            stack.callback(lambda: robot.is_connected and robot.disconnect())
            yield Bench(robot, feed, board, folder)

    return make
