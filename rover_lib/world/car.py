"""The balloon world as a car of its own: a camera to read, a port to talk to, a process that nobody steps.

Whoever drives it uses what drives the real car, onboard's Camera and ServoLink. What moves it are the pulses on the
pins of its Arduino: the real firmware in simavr, or a stand-in. It needs neither torch nor LeRobot, so that it starts
in a second and stays small.
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

from rover_lib.onboard.car import this_car
from rover_lib.onboard.errors import WorldError
from rover_lib.onboard.pwm import NEUTRAL
from rover_lib.world.child import Child
from rover_lib.world.record import JPEG_QUALITY
from rover_lib.world.standin import PinEvent
from rover_lib.world.trial import Trajectory, wilson_interval
from rover_lib.world.world import FRAME_HEIGHT, FRAME_WIDTH, World

HOLD_S = 1.0
STEPS_PER_S = 100  # of the physics, at least
KEEP_DRIVES = 8
KEEP_OUTCOMES = 1000
STANDSTILL_S = 0.5  # a machine that stopped for longer has stopped the world too
NOISE = 3  # grey levels of the camera's noise: two frames of a car that stands still are never the same
SHIFTS = 256  # of the noise, in either direction: enough that the same one hardly comes again
PIPE_BYTES = 1 << 20  # a frame fits in whole
NICE = 5  # what drives goes first; a camera may be late
PRIORITY = 1  # of real time, below the loop that drives it
START_S = 60.0  # a busy machine takes its time to import all that
ANSWER_S = 5.0
STAND_IN = "rover_lib.world.standin:StandIn"


class FramePipe:
    """The writing end of a FIFO of MJPEG. Never waits: one frame is on its way at a time, others find no room.

    path: the FIFO, made if it is not there.
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
        """Whether the reader took what was written."""
        if self._fd < 0:
            return True
        return struct.unpack("i", fcntl.ioctl(self._fd, termios.FIONREAD, bytes(4)))[0] == 0

    def write(self, jpeg: bytes) -> bool:
        """Writes a frame, at most 1 MiB, if somebody reads and took the one before. Whether it did."""
        if not self.read or not self.empty:
            return False
        try:
            return os.write(self._fd, jpeg) == len(jpeg)
        except (BlockingIOError, BrokenPipeError):
            return False

    def close(self) -> None:
        """The reader comes to the end of the file, "unplugged"; the next write opens it anew."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def jpeg_of(picture: bytes | np.ndarray) -> bytes:
    """A frame, (h, w, 3) uint8 BGR, as JPEG; bytes are taken for one."""
    if isinstance(picture, bytes):
        return picture
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


class CameraFeed:
    """A camera without a camera: a thread that writes pictures into a FIFO, at a rate.

    path: the FIFO, made if it is not there. pictures: JPEGs, or frames (h, w, 3) uint8 BGR, shown in turn and over
    again; a single one is the same frame again and again. written, dropped: frames, so far; dropped are those for which
    the reader was too slow. late_s: may be set; the delay of each frame after it was due.
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
        """Changes the pictures, from the next frame on; ends freeze, pause and black. None: nothing is written."""
        self._pictures = tuple(jpeg_of(picture) for picture in pictures)
        self._frozen = self._paused = False

    def freeze(self) -> None:
        """The same frame again and again, until show()."""
        self._frozen = True

    def black(self) -> None:
        """Black frames, until show()."""
        self.show(np.zeros((FRAME_HEIGHT, FRAME_WIDTH, 3), np.uint8))

    def pause(self) -> None:
        """Nothing comes any more, but the camera stays plugged in, until show()."""
        self._paused = True

    def close(self) -> None:
        """Unplugged: the reader comes to the end of the file. A new feed on the same path plugs it in again."""
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
                    # The next one when this one was taken: a slow reader would see the same few again and again.
                    if self._pipe.write(pictures[(self._next + moves) % len(pictures)]):
                        self._next += moves
                        self.written += 1
                    else:
                        self.dropped += 1


@dataclass(frozen=True)
class Drive:
    """One world, driven to its end. outcome: 'hit', 'left' or 'timeout'. nearest_m: camera to balloon, at its least.

    released_s: time.monotonic() at which the car was let go. trajectory: one point per 1 / rate_hz from then on.
    """

    seed: int
    outcome: str
    released_s: float
    duration_s: float
    nearest_m: float
    trajectory: Trajectory


@dataclass(frozen=True)
class CarReport:
    """What became of a virtual car so far.

    hits, trials: of the worlds that have ended. wilson: 95 % interval of the share of hits, None before the first.
    outcomes: (seed, outcome) of the last 1000 worlds. drives: the last 8. frames: written to the camera; dropped: those
    that its reader was too slow for; late: those that this machine was too slow for.
    Of the world that it is in now, its seed, whether the car is held, distance and bearing (positive to the left) of
    the balloon, and the speed. finished: all the worlds that were asked for have ended.
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
    """A car in balloon worlds of seeds from `seed` on, one after the other, in real time, in a process of its own.

    camera: path of a FIFO of MJPEG, for a Camera. port: of its Arduino, for a ServoLink. pid: of the process.

    The first world begins when the pins first ask for motion. A world ends by a hit, past the balloon ('left'), or
    after 8 s. Then the car stands in the next one, and is held for hold_s, so that a plan for what it sees now is in
    force when it is let go. worlds: after that many it stays where it is; None: it goes on.
    It ends with this process, at the latest a frame later.
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
        """board: module:function that makes the car's Arduino in its process, with a port and pulses() as StandIn has.

        rate_hz: of the camera. nice: of the process. Raises WorldError for numbers that make no drive or if the process
        does not start.
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
            *(sys.executable, "-m", "rover_lib.world.car", json.dumps(options)),
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
        """Raises WorldError if its process has ended. Costs nothing."""
        self._process.check()

    def report(self) -> CarReport:
        """What became of it so far; waits for a frame's time. Raises WorldError if its process is gone or hangs."""
        with self._talking:
            self._asked += 1
            self._process.send_line(f"report {self._asked}")
            while (answer := self._answer(ANSWER_S))["asked"] != self._asked:
                pass  # an answer that came too late
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
        """What a drive's report has of it: hits, trials, camera_late. Raises as report()."""
        report = self.report()
        return {"hits": report.hits, "trials": report.trials, "camera_late": report.late}

    def close(self) -> None:
        """Ends it. Raises nothing."""
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


# ---- in the process


class Board(Protocol):
    """A virtual car's Arduino: a context manager with the port to drive it by, and what its pins did."""

    port: str

    def __enter__(self) -> "Board": ...
    def __exit__(self, *exc: object) -> None: ...
    def pulses(self) -> list[PinEvent]:
        """What happened on the pins since the last call."""


class _Pins:
    """What the servo pins ask for, over time."""

    def __init__(self, board: Board):
        self._board = board
        self._calibration = this_car().pwm
        self._coming: deque[PinEvent] = deque()
        self._action = dict(zip(("steering", "throttle"), NEUTRAL, strict=True))
        self.asked_for_motion = False

    def collect(self) -> None:
        self._coming.extend(event for event in self._board.pulses() if event.kind in ("pulse", "reset"))

    def action(self, at_s: float) -> tuple[float, float]:
        """(steering, throttle) that the last whole pulses before a time stand for; no pulses are neutral."""
        while self._coming and self._coming[0].end_s <= at_s:
            event = self._coming.popleft()
            if event.kind == "reset":
                self._action = dict(zip(self._action, NEUTRAL, strict=True))
            else:
                # By the nominal period: the first pulse after a reset has none, and the servo measures the pulse.
                self._action[event.pin] = self._calibration.channel(event.pin).action(event.pulse_us) or 0.0
                self.asked_for_motion |= event.pin == "throttle" and self._calibration.throttle.moves(event.pulse_us)
        return self._action["steering"], self._action["throttle"]


class _Car:
    """The worlds, one after the other, moved by the pins."""

    def __init__(self, pins: _Pins, seed: int, rate_hz: float, worlds: int | None, hold_s: float):
        self._pins = pins
        self._steps_per_frame = math.ceil(STEPS_PER_S / rate_hz)
        self._dt = 1 / (rate_hz * self._steps_per_frame)
        self._worlds, self._hold_s = worlds, hold_s
        self.world = World(seed)
        self._now = time.monotonic()  # up to which it was moved
        self._release_s = self._released_s = math.inf
        self.held = True
        self.finished = False
        self.hits = self.trials = 0
        self.outcomes: deque[tuple[int, str]] = deque(maxlen=KEEP_OUTCOMES)
        self.drives: deque[dict[str, Any]] = deque(maxlen=KEEP_DRIVES)

    def move(self, until_s: float) -> None:
        """Catches up with the time."""
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
    """The noise of a camera's sensor: crops of one larger picture of it, which is cheap."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng()
        shape = (FRAME_HEIGHT + SHIFTS, FRAME_WIDTH + SHIFTS, 3)
        self._noise = self._rng.integers(0, NOISE, shape, np.uint8)

    def see(self, frame: np.ndarray) -> np.ndarray:
        row, column = self._rng.integers(0, SHIFTS, 2)
        return cv2.add(frame, self._noise[row : row + FRAME_HEIGHT, column : column + FRAME_WIDTH])


def _run(car: _Car, pipe: FramePipe, rate_hz: float, parent: int) -> None:
    """Frames at absolute deadlines, until the parent has had enough or is gone."""
    frames = dropped = late = 0
    sensor = _Sensor()
    asked = b""
    due = time.monotonic()
    while os.getppid() == parent:  # another child of it may hold the other end of standard input open
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
            # Nothing is drawn that nobody would see.
            if pipe.empty and pipe.write(jpeg_of(sensor.see(car.world.render()))):
                frames += 1
            else:
                dropped += 1
        due += 1 / rate_hz
        while due < time.monotonic():
            due += 1 / rate_hz
            late += 1


def main() -> None:
    """What VirtualCar starts."""
    options = json.loads(sys.argv[1])
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    with contextlib.suppress(OSError):  # a real car does not wait for this machine; for root only
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    try:
        module, _, name = options["board"].partition(":")
        board: Board = getattr(importlib.import_module(module), name)()
        with board, contextlib.closing(FramePipe(options["camera"])) as pipe:
            # Of this thread only: the stand-in's, like the emulator's process, keeps its turn.
            os.nice(options["nice"])
            rate_hz = options["rate_hz"]
            car = _Car(_Pins(board), options["seed"], rate_hz, options["worlds"], options["hold_s"])
            print(json.dumps({"port": board.port}), flush=True)
            _run(car, pipe, rate_hz, options["parent"])
    finally:
        shutil.rmtree(options["folder"], ignore_errors=True)  # a parent that was killed cannot


if __name__ == "__main__":
    main()
