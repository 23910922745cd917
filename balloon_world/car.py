"""Run the balloon world as a virtual car: a process with a camera to read and a serial port, which runs in real time.

It is driven by the same code as the real car, onboard's Camera and ServoLink. The pulses on the pins of its Arduino
move it; that Arduino is the real firmware in simavr, or a stand-in. The process imports neither torch nor LeRobot.
"""

import contextlib
import errno
import fcntl
import importlib
import json
import math
import os
import select
import shutil
import signal
import struct
import sys
import tempfile
import termios
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from balloon_world.child_process import Child
from balloon_world.record import JPEG_QUALITY
from balloon_world.world import FRAME_HEIGHT, FRAME_WIDTH, RATE_HZ, World
from rover_lib.onboard.car.car import this_car
from rover_lib.onboard.car.pwm import NEUTRAL
from rover_lib.onboard.errors import TrainingError

HOLD_S = 0.6  # three plans; a car whose picture stands for 1.5 s of throttle counts as stuck
STANDSTILL_S = 0.5  # if the machine stopped for longer than this, the world stopped too for the time beyond it
NOISE = 3  # the noise's grey levels, 0 to 2; with noise, two frames of a car that stands still are never the same
PIPE_BYTES = 1 << 20  # room for a whole frame
NICE = 5  # the code that drives the car goes first; the camera may be late
PRIORITY = 1  # of real-time scheduling, below that of the loop that drives the car
START_S = 60.0  # a busy machine needs long to import everything
ANSWER_S = 5.0
STAND_IN = "balloon_world.simulated_arduino:StandIn"


class FramePipe:
    """The writing end of a FIFO of MJPEG. It never waits: while the reader has not taken a frame, others are refused.

    path: of the FIFO, which is made if it does not exist.
    """

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self._fd = -1
        with contextlib.suppress(FileExistsError):
            os.mkfifo(self.path)

    @property
    def ready(self) -> bool:
        """Whether somebody has it open for reading and has taken everything that was written."""
        if self._fd < 0:
            try:
                self._fd = os.open(self.path, os.O_WRONLY | os.O_NONBLOCK)
            except OSError as error:
                if error.errno in (errno.ENXIO, errno.ENOENT):
                    return False
                raise
            fcntl.fcntl(self._fd, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        poller = select.poll()
        poller.register(self._fd, select.POLLOUT)
        if any(events & select.POLLERR for _, events in poller.poll(0)):
            self.close()  # the reader has left; the next one starts with a new frame
            return False
        return struct.unpack("i", fcntl.ioctl(self._fd, termios.FIONREAD, bytes(4)))[0] == 0

    def write(self, jpeg: bytes) -> bool:
        """Write a frame of at most 1 MiB if the reader is ready; return whether it was."""
        if not self.ready:
            return False
        try:
            return os.write(self._fd, jpeg) == len(jpeg)
        except (BlockingIOError, BrokenPipeError):
            return False

    def close(self) -> None:
        """Close the pipe, so that the reader comes to the end of the file, "unplugged". The next write reopens it."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def jpeg_of(picture: bytes | np.ndarray) -> bytes:
    """Compress a frame, (h, w, 3) uint8 BGR, to a JPEG. Bytes are taken for a JPEG and returned as they are."""
    if isinstance(picture, bytes):
        return picture
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


class CameraFeed:
    """A simulated camera: a thread that writes pictures into a FIFO at a fixed rate.

    path: of the FIFO, which is made if it does not exist. written: how many frames so far.
    """

    def __init__(self, path: Path | str, *pictures: bytes | np.ndarray, rate_hz: float = 30.0):
        self.written = 0
        self._pipe = FramePipe(path)
        self._period_s = 1 / rate_hz
        self._closing = threading.Event()
        self.show(*pictures)
        self._thread = threading.Thread(target=self._run, name=f"camera feed {path}", daemon=True)
        self._thread.start()

    def __enter__(self) -> "CameraFeed":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def show(self, *pictures: bytes | np.ndarray) -> None:
        """Show these pictures in turn from the next frame on: JPEGs, or frames (h, w, 3) uint8 BGR.

        Of one picture, the camera is frozen; of none, it stays plugged in but sends nothing.
        """
        self._pictures = tuple(jpeg_of(picture) for picture in pictures)

    def close(self) -> None:
        """Unplug the camera; a new feed on the same path plugs it in again."""
        self._closing.set()
        self._thread.join()
        self._pipe.close()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._closing.wait(max(0.0, due - time.monotonic())):
            due = max(due + self._period_s, time.monotonic() - self._period_s)
            pictures = self._pictures
            # Go on to the next picture only once this one was written: a slow reader shall see all of them.
            if pictures and self._pipe.write(pictures[self.written % len(pictures)]):
                self.written += 1


class VirtualCar:
    """A process in which a car drives through balloon worlds in real time, one after the other, from `seed` on.

    camera: the path of a FIFO of MJPEG, for a Camera. port: of its Arduino, for a ServoLink. pid: of the process.

    The first world begins when the pins first ask for motion. After each world the car stands in the next one and is
    held there for HOLD_S, so that it is let go with a plan for what it sees. The process ends when this one does.
    """

    def __init__(self, *, seed: int = 10_000, board: str = STAND_IN) -> None:
        """Start the process.

        board: 'module:function' that makes the car's Arduino in that process, a context manager with a port and
        pulses() as StandIn has. Raises TrainingError if the process does not start, as with a negative seed.
        """
        self._folder = Path(tempfile.mkdtemp(prefix="rover-car-"))
        self.camera = str(self._folder / "camera")
        self._talking = threading.Lock()
        self._answers = b""
        options = {"seed": seed, "board": board, "folder": str(self._folder), "parent": os.getpid()}
        command = (sys.executable, "-m", "balloon_world.car", json.dumps(options))
        env = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}  # where the board's module is
        self._process = Child("the virtual car", *command, error=TrainingError, talks=True, env=env)
        self.pid = self._process.pid
        try:
            self.port: str = self._answer(START_S)["port"]
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "VirtualCar":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def summary(self) -> dict[str, Any]:
        """Ask the process for what the car has done, for up to a frame's time: hits, trials and camera_late.

        camera_late: how many pictures were left out, because this machine was too slow. Raises TrainingError if the
        process has ended.
        """
        with self._talking:
            self._process.send_line("summary")
            return self._answer(ANSWER_S)

    @staticmethod
    def shown(artifact: Path) -> Any:
        """What a view shows of an artifact in this world: a Simulation, which is no drive of this car."""
        from balloon_world.show import Simulation

        return Simulation(artifact)

    def close(self) -> None:
        """End the process. Raises nothing."""
        self._process.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _answer(self, within_s: float) -> dict[str, Any]:
        deadline = time.monotonic() + within_s
        while b"\n" not in self._answers:
            if time.monotonic() > deadline:
                raise TrainingError("the virtual car did not answer", remedy="is this machine too busy?")
            self._answers += self._process.read(0.1)
        line, _, self._answers = self._answers.partition(b"\n")
        return json.loads(line)


class _Car:
    """A car that the pulses on a board's pins drive through one world after the other."""

    def __init__(self, board: Any, seed: int):
        self._board = board
        self._pwm = this_car().pwm
        self._action = dict(zip(("steering", "throttle"), NEUTRAL, strict=True))
        self._held_ticks = math.inf  # until the pins first ask for motion
        self.world = World(seed)
        self.hits = self.trials = 0

    def tick(self) -> None:
        """Drive for a frame's time by the newest pulses; the car stands where a reset has ended them."""
        for event in self._board.pulses():
            if event.kind == "reset":
                self._action = dict(zip(self._action, NEUTRAL, strict=True))
            elif event.kind == "pulse":
                # By the nominal period: the first pulse after a reset has none, and a servo only measures the pulse.
                self._action[event.pin] = self._pwm.channel(event.pin).action(event.pulse_us) or 0.0
                waits = self._held_ticks == math.inf and event.pin == "throttle"
                if waits and self._pwm.throttle.moves(event.pulse_us):
                    self._held_ticks = 0
        if self._held_ticks > 0:
            self._held_ticks -= 1
            return
        self.world.step(self._action["steering"], self._action["throttle"])
        if self.world.done:
            self.hits += self.world.hit
            self.trials += 1
            self.world = World(self.world.seed + 1)
            self._held_ticks = round(HOLD_S * RATE_HZ)


def _run(car: _Car, pipe: FramePipe, parent: int) -> None:
    """Move the car and write frames at absolute deadlines, until the parent closes standard input or has ended."""
    late = 0
    rng = np.random.default_rng()
    due = time.monotonic()
    # Standard input alone does not tell that the parent has ended: another child of it may hold the other end open.
    while os.getppid() == parent:
        while select.select([0], [], [], max(0.0, due - time.monotonic()))[0]:
            request = os.read(0, 4096)
            if not request:
                return
            for _ in range(request.count(b"\n")):
                print(json.dumps({"hits": car.hits, "trials": car.trials, "camera_late": late}), flush=True)
        car.tick()
        if pipe.ready:  # what nobody would see is not drawn
            noise = rng.integers(0, NOISE, (FRAME_HEIGHT, FRAME_WIDTH, 3), np.uint8)
            pipe.write(jpeg_of(cv2.add(car.world.render(), noise)))
        due = max(due + 1 / RATE_HZ, time.monotonic() - STANDSTILL_S)
        while due < time.monotonic():
            car.tick()
            due += 1 / RATE_HZ
            late += 1


def main() -> None:
    """Run the process that VirtualCar starts."""
    options = json.loads(sys.argv[1])
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    # A real car does not wait for this machine, so neither should this one. Only root may ask for that.
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    try:
        module, _, name = options["board"].partition(":")
        board: Any = getattr(importlib.import_module(module), name)()
        with board, contextlib.closing(FramePipe(Path(options["folder"]) / "camera")) as pipe:
            # This concerns only the present thread: the stand-in's thread and the emulator's process keep their turn.
            os.nice(NICE)
            print(json.dumps({"port": board.port}), flush=True)
            _run(_Car(board, options["seed"]), pipe, options["parent"])
    finally:
        shutil.rmtree(options["folder"], ignore_errors=True)  # in case the parent was killed and cannot do it


if __name__ == "__main__":
    main()
