"""The virtual car: driven by the link that drives the real one, seen through a pipe of JPEGs."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from balloon_world.car import HOLD_S, STAND_IN, VirtualCar, _Car
from balloon_world.simulated_arduino import PinEvent
from balloon_world.world import World
from lab.arduino.emulator import BOARD
from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.errors import CameraError, TrainingError
from tests.helpers import needs
from tests.helpers.needs import ended, until

BOARDS = [
    pytest.param(STAND_IN, id="stand-in"),
    pytest.param(BOARD, marks=[pytest.mark.emulated, needs.simavr], id="firmware"),
]
AHEAD = 21783  # a world with its balloon 1.83 m straight ahead
THROTTLE = 0.2


def drive(link, throttle, condition):
    pulses = link.calibration.pulses(0.0, throttle)
    needs.keep_sending(lambda: link.send(pulses.steering_us, pulses.throttle_us), condition=condition)


@pytest.mark.slow
@pytest.mark.parametrize("board", BOARDS)
@needs.real_time
def test_the_whole_chain_hits_a_balloon(board):
    with VirtualCar(seed=AHEAD, board=board) as car, ServoLink(car.port) as link, Camera(car.camera) as camera:
        until(lambda: link.latest().missing == "-")
        link.arm()
        drive(link, 0.0, lambda: camera.frames > 15)
        frame = camera.latest()  # nobody asked for motion yet: it sees the start, but for JPEG and a sensor's noise
        assert np.abs(frame.image.astype(float) - World(AHEAD).render()).mean() < 4 and frame.repeats == 0
        drive(link, THROTTLE, lambda: car.summary()["trials"] == 1)
        assert car.summary()["hits"] == 1


def test_when_its_process_dies():
    with VirtualCar() as car, Camera(car.camera) as camera:
        os.kill(car.pid, signal.SIGKILL)
        with pytest.raises(TrainingError, match=r"has ended \(exit status -9"):
            car.summary()
        with pytest.raises(CameraError):  # unplugged
            until(lambda: camera.latest() is None)
    with pytest.raises(TrainingError, match="was closed"):
        car.summary()


def test_it_ends_with_its_parent():
    """Also where a sister that was forked keeps the pipe open."""
    program = (
        "import os, time; from balloon_world.car import VirtualCar; car = VirtualCar()\n"
        "if os.fork() == 0: time.sleep(5); os._exit(0)\n"
        "print(car.pid, car.camera, flush=True); time.sleep(30)"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, start_new_session=True)
    try:
        pid, camera = parent.stdout.readline().split()
        assert Path(camera.decode()).exists()
        parent.kill()
        parent.wait()
        until(lambda: ended(int(pid)))
        assert not Path(camera.decode()).parent.exists()
    finally:
        with suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)
        parent.stdout.close()


def pulses(steering_us, throttle_us):
    return [PinEvent(0, "pulse", "steering", steering_us, 0.0), PinEvent(0, "pulse", "throttle", throttle_us, 0.0)]


def test_the_newest_pulses_drive_world_after_world_and_a_reset_ends_them():
    events = []
    car = _Car(SimpleNamespace(pulses=lambda: events), 5)
    car.tick()
    assert car.world.state.time_s == 0  # nobody asked for motion yet
    events[:] = [*pulses(1456, 120), *pulses(2012, 711)]
    car.tick()
    state = car.world.state
    assert (state.steering_command, state.throttle_command) == pytest.approx((1, 1), abs=0.002)
    events[:] = [PinEvent(3.0, "reset", "", 0, 0)]
    car.tick()
    assert (car.world.state.steering_command, car.world.state.throttle_command) == (0, 0)
    events[:] = pulses(2012, 711)
    while car.trials < 3:
        car.tick()
    assert car.world.seed == 8 and car.hits < 3
    for _ in range(round(30 * HOLD_S)):
        assert car.world.state.time_s == 0
        car.tick()
    car.tick()
    assert car.world.state.time_s > 0 and car.world.seed == 8
