"""The virtual car: driven by the link that drives the real one, seen through a pipe of JPEGs."""

import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import cv2
import needs
import numpy as np
import pytest
from needs import ended, until

from balloon_world.car import HOLD_S, STAND_IN, VirtualCar, _Car
from balloon_world.simulated_arduino import PinEvent
from balloon_world.world import World
from lab.arduino.emulator import BOARD
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.errors import TrainingError

BOARDS = [
    pytest.param(STAND_IN, id="stand-in"),
    pytest.param(BOARD, marks=[pytest.mark.emulated, needs.simavr], id="firmware"),
]
AHEAD = 21783  # a world with its balloon 1.83 m straight ahead
THROTTLE = 0.2


class Eye:
    """Reads a FIFO of JPEGs as a camera's reader does."""

    def __init__(self, path):
        self.jpegs, self.ended, self._closing = [], False, False
        self._path = path
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        with Path(self._path).open("rb", buffering=0) as pipe:
            rest = b""
            while not self._closing:
                data = pipe.read(1 << 16)
                if not data:
                    self.ended = True
                    return
                rest += data
                while (end := rest.find(b"\xff\xd9")) >= 0:
                    self.jpegs.append(rest[: end + 2])
                    rest = rest[end + 2 :]

    def frames(self, count):
        """The next `count` frames."""
        first = len(self.jpegs)
        until(lambda: len(self.jpegs) >= first + count)
        return [cv2.imdecode(np.frombuffer(j, np.uint8), cv2.IMREAD_COLOR) for j in self.jpegs[first : first + count]]

    def close(self):
        self._closing = True
        self._thread.join(2)


def arm(link):
    until(lambda: link.latest().missing == "-")
    link.arm()


def drive(link, action, condition):
    pulses = link.calibration.pulses(*action)
    needs.keep_sending(lambda: link.send(pulses.steering_us, pulses.throttle_us), condition=condition)


@pytest.mark.slow
@pytest.mark.parametrize("board", BOARDS)
@needs.real_time
def test_the_whole_chain_hits_a_balloon(board):
    with VirtualCar(seed=AHEAD, board=board, hold_s=0.4) as car, ServoLink(car.port) as link:
        eye = Eye(car.camera)
        still = eye.frames(2)
        assert still[0].shape == (360, 640, 3)
        before = np.abs(still[0].astype(float) - World(AHEAD).render()).mean()
        assert before < 4  # it sees that world, but for JPEG and noise
        assert not np.array_equal(*still)
        assert (car.report().held, car.report().outcomes) == (True, [])
        arm(link)
        drive(link, (0.0, 0.0), lambda: len(eye.jpegs) > 15)
        assert car.report().held  # nobody asked for motion yet
        drive(link, (0.0, THROTTLE), lambda: len(car.report().outcomes) == 1)
        report = car.report()
        assert (report.hits, report.outcomes, report.seed, report.held) == (1, [[AHEAD, "hit"]], AHEAD + 1, True)
        # The next world: held for a time, then let go with what is commanded.
        drive(link, (0.0, THROTTLE), lambda: not car.report().held)
        drive(link, (0.0, THROTTLE), lambda: car.report().speed_mps > 1)
        # Nobody drives: the car stops by itself.
        until(lambda: car.report().speed_mps < 0.05 or car.report().held)
        assert link.latest().why == "stopped: no valid command for 150 ms"
        eye.close()


def test_when_its_process_dies():
    with VirtualCar() as car:
        eye = Eye(car.camera)
        eye.frames(1)
        os.kill(car.pid, signal.SIGKILL)
        with pytest.raises(TrainingError, match=r"has ended \(exit status -9"):
            car.report()
        until(lambda: eye.ended)  # unplugged
    with pytest.raises(TrainingError, match="was closed"):
        car.report()


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


# ---- the worlds, without a process: what the pins ask for, and what is kept


class Board:
    """Pins that do what they are told."""

    def __init__(self, *events):
        self.events = list(events)

    def pulses(self):
        events, self.events = self.events, []
        return events


def pulses(steering_us, throttle_us):
    return [PinEvent(0, "pulse", "steering", steering_us, 0.0), PinEvent(0, "pulse", "throttle", throttle_us, 0.0)]


def test_the_newest_pulses_drive_world_after_world_and_a_reset_ends_them():
    board = Board()
    car = _Car(board, 5, HOLD_S)
    car.tick()
    assert car.report(0).held and car.world.state.time_s == 0  # nobody asked for motion yet
    board.events = [*pulses(1456, 120), *pulses(2012, 711)]
    car.tick()
    state = car.world.state
    assert (state.steering_command, state.throttle_command) == pytest.approx((1, 1), abs=0.002)
    board.events = [PinEvent(3.0, "reset", "", 0, 0)]
    car.tick()
    assert (car.world.state.steering_command, car.world.state.throttle_command) == (0, 0)
    board.events = pulses(2012, 711)
    while len(car.outcomes) < 3:
        car.tick()
    report = car.report(0)
    assert [seed for seed, _ in report.outcomes] == [5, 6, 7] and report.held and report.seed == 8
    for _ in range(round(30 * HOLD_S)):
        assert car.world.state.time_s == 0
        car.tick()
    car.tick()
    assert car.world.state.time_s > 0 and car.world.seed == 8
