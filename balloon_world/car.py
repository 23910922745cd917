"""Run the balloon world as a virtual car: a process with a camera to read and a serial port, which runs in real time.

It is driven by the same code as the real car, onboard's Camera and ServoLink. The pulses on the pins of its Arduino
move it; that Arduino is the real firmware in simavr, or a stand-in. The process imports neither torch nor LeRobot, so
that it starts in a second and needs little memory.
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
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from balloon_world.child_process import Child
from balloon_world.record import JPEG_QUALITY
from balloon_world.simulated_arduino import PinEvent
from balloon_world.trial import Trajectory, wilson_interval
from balloon_world.world import FRAME_HEIGHT, FRAME_WIDTH, World
from rover_lib.onboard.car.car import this_car
from rover_lib.onboard.car.pwm import NEUTRAL
from rover_lib.onboard.errors import WorldError

HOLD_S = 1.0
STEPS_PER_S = 100  # steps of the physics a second, at least
KEEP_DRIVES = 8
KEEP_OUTCOMES = 1000
STANDSTILL_S = 0.5  # if the machine stopped for longer than this, the world stopped too for the time beyond it
NOISE = 3  # the noise's grey levels, 0 to 2; with noise, two frames of a car that stands still are never the same
SHIFTS = 256  # by how many pixels the noise may be shifted, in both directions, so that one shift rarely comes again
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
    def read(self) -> bool:
        """Whether somebody has it open for reading."""
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
        return True

    @property
    def empty(self) -> bool:
        """Whether the reader has taken everything that was written."""
        if self._fd < 0:
            return True
        return struct.unpack("i", fcntl.ioctl(self._fd, termios.FIONREAD, bytes(4)))[0] == 0

    def write(self, jpeg: bytes) -> bool:
        """Write a frame of at most 1 MiB if a reader is there and has taken the previous one; return whether it did."""
        if not self.read or not self.empty:
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

    path: of the FIFO, which is made if it does not exist. pictures: JPEGs, or frames (h, w, 3) uint8 BGR. They are
    shown in turn, then again from the first; with a single one, every frame is the same. written, dropped: how many
    frames so far were written, or dropped because the reader was too slow. late_s: how long after its due time each
    frame is written; you may set it.
    """

    def __init__(self, path: Path | str, *pictures: bytes | np.ndarray, rate_hz: float = 30.0):
        self.written = self.dropped = 0
        self.late_s = 0.0
        self._pipe = FramePipe(path)
        self._period_s = 1 / rate_hz
        self._pictures: tuple[bytes, ...] = ()
        self._next = -1
        self._frozen = self._paused = False
        self._closing = threading.Event()
        self.show(*pictures)
        self._thread = threading.Thread(target=self._run, name=f"camera feed {path}", daemon=True)
        self._thread.start()

    def __enter__(self) -> "CameraFeed":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def show(self, *pictures: bytes | np.ndarray) -> None:
        """Show these pictures from the next frame on, and end freeze(), pause() and black().

        Without pictures nothing is written.
        """
        self._pictures = tuple(jpeg_of(picture) for picture in pictures)
        self._frozen = self._paused = False

    def freeze(self) -> None:
        """Repeat the same frame until show()."""
        self._frozen = True

    def black(self) -> None:
        """Show black frames until show()."""
        self.show(np.zeros((FRAME_HEIGHT, FRAME_WIDTH, 3), np.uint8))

    def pause(self) -> None:
        """Write no frames until show(), as a camera that stays plugged in but sends nothing."""
        self._paused = True

    def close(self) -> None:
        """Unplug the camera: the reader comes to the end of the file. A new feed on the same path plugs it in again."""
        self._closing.set()
        self._thread.join()
        self._pipe.close()

    def _run(self) -> None:
        waiting: deque[tuple[float, tuple[bytes, ...], bool]] = deque()
        due = time.monotonic()
        while not self._closing.wait(max(0.0, due - time.monotonic())):
            due = max(due + self._period_s, time.monotonic() - self._period_s)
            pictures = self._pictures
            if pictures and not self._paused:
                waiting.append((time.monotonic() + self.late_s, pictures, not self._frozen))
            while waiting and waiting[0][0] <= time.monotonic():
                _, pictures, moves = waiting.popleft()
                if self._pipe.read:
                    # Go on to the next picture only once this one was written. If refused pictures were skipped, a
                    # slow reader would see only the same few of them.
                    if self._pipe.write(pictures[(self._next + moves) % len(pictures)]):
                        self._next += moves
                        self.written += 1
                    else:
                        self.dropped += 1


@dataclass(frozen=True)
class Drive:
    """One world, driven to its end.

    outcome: 'hit', 'left' or 'timeout'. nearest_m: the least distance between camera and balloon.
    released_s: time.monotonic() when the car was let go. trajectory: from then on, a point for each frame of the camera
    (every 1 / rate_hz seconds), and the last one.
    """

    seed: int
    outcome: str
    released_s: float
    duration_s: float
    nearest_m: float
    trajectory: Trajectory


@dataclass(frozen=True)
class CarReport:
    """What a virtual car has done so far.

    trials, hits: how many worlds have ended, and how many of them with a hit. wilson: the 95 % interval of the share of
    hits, None before the first world has ended. outcomes: (seed, outcome) of the last 1000 worlds. drives: the last 8.
    frames: how many were written to the camera; dropped: how many were not, because the reader was too slow;
    late: how many were left out, because this machine was too slow.
    seed, held, distance_m, bearing_rad and speed_mps describe the present world: its seed, whether the car is held, the
    balloon's distance and bearing (positive to the left), and the car's speed. finished: whether all the worlds that
    were asked for have ended.
    """

    hits: int
    trials: int
    wilson: tuple[float, float] | None
    outcomes: list[tuple[int, str]]
    drives: list[Drive]
    frames: int
    dropped: int
    late: int
    seed: int
    held: bool
    distance_m: float
    bearing_rad: float
    speed_mps: float
    finished: bool


class VirtualCar:
    """A process in which a car drives through balloon worlds in real time, one after the other, from `seed` on.

    camera: the path of a FIFO of MJPEG, for a Camera. port: of its Arduino, for a ServoLink. pid: of the process.

    The first world begins when the pins first ask for motion. A world ends when the car hits the balloon, passes it or
    leaves the arena ('left'), or after 8 s. Then the car stands in the next world and is held there for hold_s, so that
    it is let go with a plan for what it sees there. worlds: after how many worlds the car stays where it is; None: it
    never does. The process ends when this process ends, at most a frame later.
    """

    def __init__(
        self,
        *,
        seed: int = 10_000,
        board: str = STAND_IN,
        rate_hz: float = 30.0,
        worlds: int | None = None,
        hold_s: float = HOLD_S,
        nice: int = NICE,
    ):
        """Start the process.

        board: 'module:function' that makes the car's Arduino in that process, with a port and pulses() as StandIn has.
        rate_hz: of the camera. nice: of the thread that moves the car and draws. Raises WorldError for numbers outside
        their ranges, or if the process does not start.
        """
        if seed < 0 or not 1 <= rate_hz <= 120 or hold_s < 0 or (worlds is not None and worlds < 1):
            raise WorldError(
                "a car needs a seed from 0, 1 to 120 frames per second, at least 1 world and a hold from 0 s",
                found=f"{seed}, {rate_hz}, {worlds} and {hold_s}",
            )
        self._folder = Path(tempfile.mkdtemp(prefix="rover-car-"))
        self.camera = str(self._folder / "camera")
        self._talking = threading.Lock()
        self._answers = b""
        self._asked = 0
        options = {
            "seed": seed,
            "board": board,
            "rate_hz": rate_hz,
            "worlds": worlds,
            "hold_s": hold_s,
            "nice": nice,
            "folder": str(self._folder),
            "camera": self.camera,
            "parent": os.getpid(),
        }
        self._process = Child(
            "the virtual car",
            *(sys.executable, "-m", "balloon_world.car", json.dumps(options)),
            error=WorldError,
            talks=True,
            env={"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},  # where the board's module is
        )
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

    def check(self) -> None:
        """Raise WorldError if the process has ended. Costs almost nothing."""
        self._process.check()

    def report(self) -> CarReport:
        """Ask the process what the car has done so far, which takes up to a frame's time.

        Raises WorldError if the process has ended or hangs.
        """
        with self._talking:
            self._asked += 1
            self._process.send_line(f"report {self._asked}")
            while (answer := self._answer(ANSWER_S))["asked"] != self._asked:
                pass  # this answers an earlier call, which did not wait long enough
        report = answer["report"]
        drives = []
        for drive in report.pop("drives"):
            track, balloon_xy_m = np.array(drive.pop("track")), tuple(drive.pop("balloon_xy_m"))
            x_m, y_m, steering, throttle = track.T
            drives.append(Drive(**drive, trajectory=Trajectory(x_m, y_m, steering, throttle, balloon_xy_m)))
        outcomes = [(seed, outcome) for seed, outcome in report.pop("outcomes")]
        wilson = wilson_interval(report["hits"], report["trials"]) if report["trials"] else None
        return CarReport(wilson=wilson, outcomes=outcomes, drives=drives, **report)

    def summary(self) -> dict[str, Any]:
        """Return what the report of a drive says about this car: hits, trials and camera_late. Raises as report()."""
        report = self.report()
        return {"hits": report.hits, "trials": report.trials, "camera_late": report.late}

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
            data = self._process.read(max(0.0, deadline - time.monotonic()))
            if not data:
                raise WorldError(
                    f"the virtual car did not answer within {within_s:g} s", remedy="is this machine too busy?"
                )
            self._answers += data
        line, _, self._answers = self._answers.partition(b"\n")
        return json.loads(line)


# ---- what runs in the process


class Board(Protocol):
    """A virtual car's Arduino: a context manager that knows its serial port and what happened on its pins."""

    port: str

    def __enter__(self) -> "Board": ...
    def __exit__(self, *exc: object) -> None: ...
    def pulses(self) -> list[PinEvent]:
        """Return what happened on the pins since the last call."""


class _Pins:
    """Which actions the pulses on the servo pins stand for, over time."""

    def __init__(self, board: Board):
        self._board = board
        self._calibration = this_car().pwm
        self._coming: deque[PinEvent] = deque()
        self._action = dict(zip(("steering", "throttle"), NEUTRAL, strict=True))
        self.asked_for_motion = False

    def collect(self) -> None:
        self._coming.extend(event for event in self._board.pulses() if event.kind in ("pulse", "reset"))

    def action(self, at_s: float) -> tuple[float, float]:
        """Return the (steering, throttle) of the last pulses that had ended by at_s; neutral if there were none."""
        while self._coming and self._coming[0].end_s <= at_s:
            event = self._coming.popleft()
            if event.kind == "reset":
                self._action = dict(zip(self._action, NEUTRAL, strict=True))
            else:
                # Computed with the nominal period: the first pulse after a reset has no period, and a servo only
                # measures the pulse.
                self._action[event.pin] = self._calibration.channel(event.pin).action(event.pulse_us) or 0.0
                self.asked_for_motion |= event.pin == "throttle" and self._calibration.throttle.moves(event.pulse_us)
        return self._action["steering"], self._action["throttle"]


class _Car:
    """A car that the pins drive through one world after the other."""

    def __init__(self, pins: _Pins, seed: int, rate_hz: float, worlds: int | None, hold_s: float):
        self._pins = pins
        self._steps_per_frame = math.ceil(STEPS_PER_S / rate_hz)
        self._dt = 1 / (rate_hz * self._steps_per_frame)
        self._worlds, self._hold_s = worlds, hold_s
        self.world = World(seed)
        self._now = time.monotonic()  # the time up to which the car was moved
        self._release_s = self._released_s = math.inf
        self.held = True
        self.finished = False
        self.hits = self.trials = 0
        self.outcomes: deque[tuple[int, str]] = deque(maxlen=KEEP_OUTCOMES)
        self.drives: deque[dict[str, Any]] = deque(maxlen=KEEP_DRIVES)

    def move(self, until_s: float) -> None:
        """Move the car on to the time until_s."""
        if until_s - self._now > STANDSTILL_S:
            self._now = until_s - STANDSTILL_S
        self._pins.collect()
        while self._now + self._dt <= until_s:
            self._step()
            self._now += self._dt

    def _step(self) -> None:
        action = self._pins.action(self._now)
        if self.held:
            if self.trials == 0 and self._pins.asked_for_motion:
                self._release_s = self._now
            if self.finished or self._now < self._release_s:
                return
            self.held, self._released_s = False, self._now
        self.world.step(*action, self._dt)
        if self.world.done:
            self._end()

    def _end(self) -> None:
        world, track = self.world, self.world.trajectory
        balloon = world.balloon.x_m, world.balloon.y_m
        self.trials += 1
        self.hits += world.hit
        self.outcomes.append((world.seed, str(world.outcome)))
        points = [*track[: -1 : self._steps_per_frame], track[-1]]
        self.drives.append(
            {
                "seed": world.seed,
                "outcome": world.outcome,
                "released_s": self._released_s,
                "duration_s": world.state.time_s,
                "nearest_m": min(math.hypot(s.x_m - balloon[0], s.y_m - balloon[1]) for s in track),
                "balloon_xy_m": balloon,
                "track": [
                    [round(x, 4) for x in (s.x_m, s.y_m, s.steering_command, s.throttle_command)] for s in points
                ],
            }
        )
        self.held = True
        self.finished = self.trials == self._worlds
        if not self.finished:
            self.world = World(world.seed + 1)
            self._release_s = self._now + self._hold_s

    def report(self) -> dict[str, Any]:
        distance_m, bearing_rad = self.world.balloon_seen()
        return {
            "hits": self.hits,
            "trials": self.trials,
            "outcomes": list(self.outcomes),
            "drives": list(self.drives),
            "seed": self.world.seed,
            "held": self.held,
            "distance_m": distance_m,
            "bearing_rad": bearing_rad,
            "speed_mps": self.world.state.speed_mps,
            "finished": self.finished,
        }


class _Sensor:
    """The noise of a camera's sensor. Each frame gets a crop of one larger picture of noise, which is cheap."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng()
        shape = (FRAME_HEIGHT + SHIFTS, FRAME_WIDTH + SHIFTS, 3)
        self._noise = self._rng.integers(0, NOISE, shape, np.uint8)

    def see(self, frame: np.ndarray) -> np.ndarray:
        row, column = self._rng.integers(0, SHIFTS, 2)
        return cv2.add(frame, self._noise[row : row + FRAME_HEIGHT, column : column + FRAME_WIDTH])


def _run(car: _Car, pipe: FramePipe, rate_hz: float, parent: int) -> None:
    """Move the car and write frames at absolute deadlines, until the parent closes standard input or has ended."""
    frames = dropped = late = 0
    sensor = _Sensor()
    asked = b""
    due = time.monotonic()
    # Standard input alone does not tell that the parent has ended: another child of it may hold the other end open.
    while os.getppid() == parent:
        while select.select([0], [], [], max(0.0, due - time.monotonic()))[0]:
            data = os.read(0, 4096)
            if not data:
                return
            *lines, asked = (asked + data).split(b"\n")
            for line in lines:
                report = car.report() | {"frames": frames, "dropped": dropped, "late": late}
                print(json.dumps({"asked": int(line.split()[1]), "report": report}), flush=True)
        car.move(due)
        if pipe.read:
            # Do not draw what nobody would see.
            if pipe.empty and pipe.write(jpeg_of(sensor.see(car.world.render()))):
                frames += 1
            else:
                dropped += 1
        due += 1 / rate_hz
        while due < time.monotonic():
            due += 1 / rate_hz
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
        board: Board = getattr(importlib.import_module(module), name)()
        with board, contextlib.closing(FramePipe(options["camera"])) as pipe:
            # This concerns only the present thread: the stand-in's thread and the emulator's process keep their turn.
            os.nice(options["nice"])
            rate_hz = options["rate_hz"]
            car = _Car(_Pins(board), options["seed"], rate_hz, options["worlds"], options["hold_s"])
            print(json.dumps({"port": board.port}), flush=True)
            _run(car, pipe, rate_hz, options["parent"])
    finally:
        shutil.rmtree(options["folder"], ignore_errors=True)  # in case the parent was killed and cannot do it


if __name__ == "__main__":
    main()
