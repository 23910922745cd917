"""Run `rover drive` in a virtual world: the real link, camera class, plans, pilot and loop, without their threads.

Code that waits lets the world go on. Only the port, the camera's driver and the policy are replaced.
"""

import contextlib
import functools
import math
import os
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from lab.driving.virtual import DROPPING, FRAME_MS, GONE, LOST, SILENT, STUCK, Killed, Planned, World
from rover_lib.onboard.car import gamepad
from rover_lib.onboard.car.camera import Camera, check_shape
from rover_lib.onboard.car.protocol import Hello, Telemetry
from rover_lib.onboard.car.servo_link import LinkError, ServoLink
from rover_lib.onboard.drive.feed import Feed
from rover_lib.onboard.drive.inference import Planner
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.drive.pilot import Order, PolicyPilot
from rover_lib.onboard.drive.plan import Commanded, Plan, Settings
from rover_lib.onboard.drive.service import Request, Service
from rover_lib.onboard.drive.session import Arming, DriveOptions, Session
from rover_lib.onboard.errors import PolicyError, RoverError, sentence_of
from rover_lib.onboard.params import params

RATE_HZ = 30.0
PLAN = (0.2, 0.15)  # steering, one way and the other, and throttle
LIMIT_MS, HEARTBEAT_MS = 1500, 600  # those of a service's drive, if it has them
GO_MS, BRAKE_MS = 1200, 600  # how long the policy goes and brakes, in turn
NO_VIEW = Path("/nowhere/view")
NOISE = np.random.default_rng(1).integers(0, 4, (72, 128, 3), np.uint8)  # of a camera, moved in each picture
SIZE = (128, 72)  # of the camera's pictures, and of those that the policy has seen: width, height


class _Waiting:
    """Replaces a threading.Condition: code that waits lets the world go on."""

    def __init__(self, world: World):
        self._world = world

    def __enter__(self) -> None: ...

    def __exit__(self, *exc: object) -> None: ...

    def notify_all(self) -> None: ...

    def wait_for(self, predicate: Callable[[], Any], timeout: float) -> Any:
        end_s = self._world.clock() + timeout
        while not (result := predicate()) and self._world.clock() < end_s:
            self._world.sleep(0.001)
        return result


class VirtualPad(gamepad.Gamepad):
    """The real Gamepad, which reads what the world's hand does from two pipes.

    As from the kernel, only changes come as events, and none of the time before it was opened.
    """

    FULL = 32767

    def __init__(self, world: World):
        self._world = world
        (pad, self._to_pad), (motion, self._to_motion) = os.pipe(), os.pipe()
        for end in (pad, motion):
            os.set_blocking(end, False)
        super().__init__("virtual", pad, motion, read=self._where)
        self._known: tuple[bool, list[int]] = False, list(world.hand.sticks)  # what its events need not tell
        self._dropped = False

    def close(self) -> None:
        super().close()
        self._pull_out()

    def sticks(self, now_s: float | None = None) -> tuple[float, float] | None:
        hand = self._world.hand
        if hand.pad == GONE:
            self._pull_out()
        elif hand.pad == SILENT:
            self._known = False, []
        elif self._to_pad >= 0:
            self._send(self._to_motion, gamepad.ABS, 0, self._world.now_ms)
            self._tell(hand.receiver != LOST, list(hand.sticks))
        return super().sticks(self._world.clock())

    def _where(self, fd: int, axis: int) -> tuple[int, int, int]:
        car = self._world.car
        steering, throttle = car.pwm.actions(*self._world.hand.sticks)
        x = -car.left * (steering or 0.0) if axis == gamepad.STEERING else -(throttle or 0.0) / car.cap
        way = gamepad.DEAD + (1 - gamepad.DEAD) * min(abs(x), 1.0) if x else 0.0
        return round(math.copysign(way, x) * self.FULL), -self.FULL, self.FULL

    def _tell(self, held: bool, sticks_us: list[int]) -> None:
        if self._world.hand.pad == DROPPING:
            self._dropped = True
            return
        was_held, before_us = self._known
        if self._dropped:  # what the kernel's full buffer leaves of it: nobody knows how old it is
            self._send(self._to_pad, gamepad.SYN, gamepad.DROPPED, 0)
        for i, axis in enumerate(gamepad.AXES):
            if sticks_us[i : i + 1] != before_us[i : i + 1] and not self._dropped:
                self._send(self._to_pad, gamepad.ABS, axis, self._where(-1, axis)[0])
        if was_held != held:
            age_s = 1.0 if self._world.hand.pad == STUCK else 0.0
            self._send(self._to_pad, gamepad.KEY, gamepad.BTN_L1, int(held), age_s)
        if self._dropped:
            self._send(self._to_pad, gamepad.SYN, 0, 0)
        self._known, self._dropped = (held, sticks_us), False

    def _send(self, end: int, kind: int, code: int, value: int, age_s: float = 0.0) -> None:
        at_s = self._world.clock() - age_s
        os.write(end, gamepad.EVENT.pack(int(at_s), int(at_s % 1 * 1e6), kind, code, value))

    def _pull_out(self) -> None:
        for end in {self._to_pad, self._to_motion} - {-1}:
            os.close(end)
        self._to_pad = self._to_motion = -1


class VirtualLink(ServoLink):
    """A ServoLink whose port, reader and gamepad belong to the world."""

    def __init__(self, world: World):
        super().__init__("the virtual port", car=world.car, clock=world.clock)
        self._world = world
        self._heard = cast(Any, _Waiting(world))

    def open(self) -> Hello:
        self._world.port = self
        if self._world.unplugged:
            self._world.port = None
            raise LinkError(f"{self.port}: cannot be opened", remedy="is the Arduino plugged in?")
        self._serial = cast(Any, self)
        hello = self._wait_for_hello()
        self._tell_car(hello)
        if self.car.human == "gamepad":
            self._gamepad = VirtualPad(self._world)
        return hello

    def _release(self) -> None:
        self._serial = self._world.port = None
        if self._gamepad:
            self._gamepad.close()

    def _write(self, line: bytes) -> None:
        try:
            self._world.write(line)
        except BlockingIOError:
            raise LinkError(f"{self.port}: the port took no data, its buffer is full") from None
        except OSError as error:
            raise self._fail(f"{self.port}: writing failed ({error})") from error

    def unplug(self) -> None:
        self._fail(f"{self.port}: reading failed")

    def hear(self, data: bytes) -> None:
        now_s = self._clock()
        for line in data.split(b"\n"):
            if line:
                self._hear(line, now_s)
        if self._gamepad:
            self._relay(self._gamepad, now_s)


@functools.cache
def scenery() -> list[np.ndarray]:
    """Return the pictures of a drive, (72, 128, 3) uint8 BGR, no two of them alike."""
    rng = np.random.default_rng(0)
    wide = rng.integers(30, 220, (9, 40, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    return [
        np.clip(wide[:, i : i + 128] + rng.integers(-3, 4, (72, 128, 3)), 0, 255).astype(np.uint8) for i in range(150)
    ]


class Eyes:
    """The real Camera, whose thread runs only while the world gives it a picture."""

    def __init__(self, world: World):
        self._world = world
        self.camera = Camera("the virtual camera", clock=world.clock)
        self.camera._changed = cast(Any, _Waiting(world))
        self.content: dict[int, int] = {}  # by a frame's number, when (ms) its scene was really to be seen
        self._shown = 0  # pictures of a film
        self._seen_ms = -1_000_000
        self._given, self._idle = queue.Queue[Any](), queue.Queue[None]()
        self._over = False
        self._thread = threading.Thread(target=self.camera._read, args=(self._pictures(),), daemon=True)
        self._thread.start()
        self._idle.get()
        self._due_ms = float(world.now_ms)
        self.on_frame: Callable[[], None] = lambda: None
        self._tick()

    def _pictures(self) -> Iterator[tuple[np.ndarray, float | None]]:
        try:
            self._idle.put(None)
            while picture := self._given.get():
                yield picture
                self._idle.put(None)
        finally:
            self._over = True
            self._idle.put(None)

    def _give(self, picture: tuple[np.ndarray, float] | None) -> None:
        if not self._over:
            self._given.put(picture)
            self._idle.get()
        if self._over:
            self._thread.join()

    def unplug(self) -> None:
        """Let the camera's reader come to the end of its pictures."""
        self._give(None)

    def close(self) -> None:
        self.camera._closing.set()
        self.unplug()
        self.on_frame = lambda: None

    def _tick(self) -> None:
        world = self._world
        if self._over:
            return
        self._due_ms += FRAME_MS
        world.at(round(self._due_ms), self._tick)
        lens = world.lens
        seen_ms = world.now_ms - lens.late_ms
        if lens.silent or world.paused_until_ms > world.now_ms or seen_ms <= self._seen_ms:
            return  # the last: pictures have become late, and the next one is still on its way
        self._seen_ms = seen_ms
        content_ms = seen_ms if lens.frozen_ms is None else lens.frozen_ms
        shown_ms, stands_ms = content_ms, lens.stands_ms if lens.frozen_ms is None else None
        if stands_ms is not None:
            shown_ms = min(content_ms, stands_ms)
        scene = scenery()[round(shown_ms / FRAME_MS) % len(scenery())]
        if stands_ms is not None:
            scene = cv2.add(scene, np.roll(NOISE, world.now_ms, 1))
        if lens.black:
            scene = (scene - scene.min()) // 64 + world.now_ms % 2
        picture = lens.film[self._shown % len(lens.film)] if lens.film else scene
        self._shown += bool(lens.film)
        world.seen.frames.append((world.now_ms, lens.black))
        # The driver of a frozen camera still gives each picture a new time stamp.
        self._give((picture, (seen_ms - world.suspended_ms) / 1e3))
        self.content.setdefault(self.camera.frames, content_ms)
        self.on_frame()


class VirtualPlanner(Planner):
    """A Planner without its thread, whose plans take virtual time."""

    def __init__(self, world: World, eyes: Eyes, commanded: Commanded):
        self._world, self._eyes = world, eyes
        self._thinking = False
        self._looked_at = 0
        self._number = 0
        self.content: dict[int, int] = {}  # by a plan's number, when (ms) its picture's scene was really to be seen
        never = cast(Any, None)  # the thread that asks for predictions is never started here
        super().__init__(eyes.camera, never, commanded, limits=world.car.limits, clock=world.clock)
        self._news = cast(Any, _Waiting(world))
        eyes.on_frame = self._look

    def _look(self) -> None:
        """Begin a plan from the newest frame, as the thread does as soon as it is free."""
        if self._thinking or self._failure:
            return
        try:
            frame = self._camera.latest()
            if frame is None or frame.number <= self._looked_at:
                return
            self._looked_at = frame.number
            self._commanded.state(frame.captured_s, RATE_HZ)
            self._thinking, self._asked_s = True, self._clock()
            world, mind = self._world, self._world.mind
            throttle = PLAN[1] if world.now_ms % (GO_MS + BRAKE_MS) < GO_MS else 0.0
            steering = PLAN[0] if world.now_ms // 700 % 2 else -PLAN[0]
            actions = np.tile([steering, throttle if mind.throttle is None else mind.throttle], (32, 1))
            if mind.does in ("nan", "wild"):
                actions[:] = {"nan": np.nan, "wild": 5.0}[mind.does]
            content_ms = self._eyes.content[frame.number]
            world.at(world.now_ms + mind.latency_ms, lambda: self._answer(frame.captured_s, content_ms, actions))
        except Exception as error:
            self._fail(error)

    def _answer(self, captured_s: float, content_ms: int, actions: np.ndarray) -> None:
        world = self._world
        if world.paused_until_ms > world.now_ms:
            return world.at(world.paused_until_ms, lambda: self._answer(captured_s, content_ms, actions))
        self._thinking, self._asked_s = False, None
        steering, throttle = actions[0].tolist()
        bad = bool(world.mind.does == "raise" or not np.isfinite(throttle) or throttle > 1)
        world.seen.plans.append(Planned(world.now_ms, steering, throttle, bad))
        try:
            if world.mind.does == "raise":
                raise PolicyError("the policy was told to fail")
            self._number += 1
            self._plan = Plan(self._number, captured_s, self._clock(), actions, self._limits)
            self.content[self._number] = content_ms
        except Exception as error:
            return self._fail(error)
        self._look()

    def _fail(self, error: Exception) -> None:
        self._failure = error if isinstance(error, RoverError) else PolicyError(f"the policy failed ({error})")


class _Pilot(PolicyPilot):
    """A pilot that tells the world how old the picture behind each order is, and whose host may go mad."""

    world: World
    planner: VirtualPlanner

    def order(self, now_s: float) -> Order:
        order = super().order(now_s)
        self.world.content_ms, self.world.planned = self.planner.content[order.plan], not self.world.mad_us
        if self.world.mad_us:
            order = replace(order, throttle_us=self.world.mad_us)
        return order


class _Stop(threading.Event):
    """An event whose waiting lets the world go on."""

    def __init__(self, world: World):
        super().__init__()
        self._world = world

    def wait(self, timeout: float | None = None) -> bool:
        self._world.sleep(timeout or 0.0)
        return self.is_set()


class _Log:
    """In the place of a flight log. recent, machine: for the view's feed."""

    def __init__(self, world: World):
        self._world = world
        self.start_s = world.clock()
        self.recent: deque[Any] = deque()

    @property
    def machine(self) -> dict[str, Any]:
        return {"t_s": self._world.clock() - self.start_s, "throttled": self._world.throttled}

    def tick(self, row: Any) -> None: ...

    def event(self, text: str, **fields: Any) -> None:
        self._world.seen.log.append((self._world.now_ms, text))


class _Feed(Feed):
    """A feed whose view says stop once, and keeps that for whoever asks next: also while the car is being armed."""

    world: World

    def over(self) -> str | None:
        is_stopped, self.world.view_stop = self.world.view_stop, False
        return "stopped from the view (127.0.0.1)" if is_stopped else None


class _Session(Session):
    """The session of `rover drive`, which tells the world what the host is doing."""

    process: "Process"

    def make_pilot(self) -> PolicyPilot:
        world, planner = self.process.world, self.process.planner
        args = self.camera, planner, self.commanded, self.settings, RATE_HZ
        pilot = _Pilot(*args, calibration=world.car.pwm)
        pilot.world, pilot.planner = world, planner
        return pilot

    def attempt(self, arming: Arming) -> Telemetry | None:
        try:
            telemetry = super().attempt(arming)
        except RoverError as error:
            self.log.event(f"not armed: {error}")
            raise
        self.process.armed()
        return telemetry


class Process:
    """`rover drive` from its start to its end, run in the present process. Its parts are attributes, to be broken.

    service, terminal, limited, heartbeat: see Story; ask() is an operator's request. session: what it drives by.
    """

    def __init__(
        self, world: World, service: bool, terminal: bool = False, limited: bool = False, heartbeat: bool = False
    ):
        self.world, self.stopped, self._terminal = world, _Stop(world), terminal
        self.report, self.log = Report(), cast(Any, _Log(world))
        self._operators = Service(self.report, self.stopped, clock=world.boottime)
        self._operators._turn = cast(Any, _Waiting(world))
        self._limits = Request(LIMIT_MS / 1e3 if limited else None, HEARTBEAT_MS / 1e3 if heartbeat else None)
        world.seen.asked_most_ms = 2000 if service else 31_000
        world.alive = True
        self.eyes, commanded = Eyes(world), Commanded()
        self.planner = VirtualPlanner(world, self.eyes, commanded)
        self._feed = _Feed(NO_VIEW, self.log, "virtual", clock=world.clock, sleep=world.sleep)
        self._feed.world = world
        self.session = _Session(
            DriveOptions(Path("virtual"), hz=RATE_HZ, asked_s=world.boottime()), Settings.of(params()["drive"]),
            self.report, self.log, self._feed, None, self.eyes.camera, self.planner, commanded, RATE_HZ, "virtual",
            service=self._operators if service else None, terminal=terminal, boost=contextlib.nullcontext,
            clock=world.clock, sleep=world.sleep, now=world.boottime,
        )  # fmt: skip
        self.session.process = self
        if not service:
            world.seen.asked.append(world.now_ms)

    def ask(self) -> None:
        """Let the operator ask to arm the car."""
        self.world.seen.asked.append(self.world.now_ms)
        self._operators.ask(self._operators._ticket, self.world.boottime(), self._limits)

    def stop(self, how: str) -> None:
        """End the drive by a signal, or by the view."""
        self.world.seen.stops.append((self.world.now_ms, 0))
        if how == "signal":
            self.stopped.set()
        else:
            self.world.view_stop = True

    def armed(self) -> None:
        """Take note that the car was armed: what ends this drive is due from now on."""
        world = self.world
        if self.session.service and self._limits.max_seconds:
            world.seen.stops.append((world.now_ms + LIMIT_MS, world.now_ms))
        if self.session.service and self._limits.heartbeat_s:
            world.at(world.now_ms + 1, functools.partial(self._beat, world.now_ms))

    def _beat(self, armed_ms: int) -> None:
        """Let the operator's heartbeats come until they are gone."""
        world = self.world
        if world.operator_gone:
            return world.seen.stops.append((round(self._operators._heard_s * 1e3) + HEARTBEAT_MS, armed_ms))
        self._operators._heard_s = world.boottime()
        world.at(world.now_ms + HEARTBEAT_MS // 3, lambda: self._beat(armed_ms))

    def run(self) -> None:
        """Run until it ends. Raises nothing."""
        world, session = self.world, self.session
        error: BaseException | None = None
        try:
            with contextlib.ExitStack() as stack:
                with self._told():
                    session.link = stack.enter_context(VirtualLink(world))
                    if frame := session.camera.latest():
                        check_shape(session.camera.source, frame.image, SIZE)
                    session.drive(self.stopped)
                while session.service and not self.stopped.is_set():
                    with self._told():
                        session.drive(self.stopped, said=self.report.ended)
        except (Killed, Exception) as raised:
            error = raised
        finally:
            world.seen.errors.append((world.now_ms, error))
            world.paused_until_ms = world.now_ms
            world.failing = None
            self.eyes.close()
            self._feed.close()

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """Note a drive's begin, end and closing sentence."""
        world, begin_ms = self.world, self.world.now_ms
        try:
            yield
        except Exception as error:
            self.report.ended = self.report.ended or sentence_of(error)
            raise
        finally:
            world.seen.drives.append((begin_ms, world.now_ms, self.report.ended if world.alive else None))
