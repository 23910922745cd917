"""The balloon world in a view: one world after the other, in a time that keeps to the clock where this machine can.

    open_view(..., shown=Simulation("runs/demo/policy_static.pt"))

The car's own loop drives, on a virtual clock, as in `drives`. On a busy machine the simulation's time goes slower; a
real car would have to be stopped.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2

from balloon_world.drives import SEED, NoLog, TimedCar
from balloon_world.level import EASY, LEVELS, level_named
from balloon_world.world import RATE_HZ, World
from rover_lib.onboard.artifact.manifest import ONNX_SUFFIX
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import Policy, load_policy

if TYPE_CHECKING:
    from rover_lib.onboard.view.server import View

PLAN_S = 0.1  # what a plan takes, in the simulation's time: about what a Pi may need for one of the real car's size
PICTURE_S = 1 / 15  # between two pictures, by the clock
HOLD_S = 1.5  # between two worlds
# Threads wait for each other by spinning. Beside other busy programs, two needed 400 ms of processor for a plan of the
# demo's that one computes in 4. The first number is what counts: XNNPACK's pool keeps it for as long as a process runs.
THREADS = 1
MODES = {"static": "INT8", "mixed": "mixed INT8", "fp32": "FP32"}  # that can be chosen on the page, as it calls them
SIDES = {"push left": 1, "push right": -1}  # what the page of a simulation, and no other, can do to the car
SCRIPT = Path(__file__).with_name("simulation.js").read_bytes()
SAID = {
    "hit": "hit!",
    "left": "missed it",
    "bumped": "drove into it",
    "timeout": "out of time",
    "stopped": "stopped",
    "taken over": "stopped",
}

Post = Callable[[dict[str, Any], bytes], object]  # a message as in feed.py, and a JPEG


class Simulation:
    """Drives an artifact through balloon worlds, for a view; what was chosen on its page arrives by `ask`.

    Whoever watches can push the car off its way. A drive with pushes is counted apart from the undisturbed ones.

    artifact: as policy_<mode>; the run's other modes, which lie beside it, can be chosen on the page. title: the
    page's; "": the name of the artifact's folder. level: of the first worlds; the page can choose another.
    Raises what load_policy() raises.
    """

    script = SCRIPT  # for the page

    def __init__(self, artifact: Path | str, title: str = "", level: str = EASY.name):
        artifact = Path(artifact)
        self._title = title or artifact.parent.name
        suffix = ONNX_SUFFIX if artifact.name.endswith(ONNX_SUFFIX) else artifact.suffix
        paths = {mode: artifact.with_name(f"policy_{mode}{suffix}") for mode in MODES}
        self._paths = {MODES[mode]: path for mode, path in paths.items() if path.is_file()}
        if artifact not in self._paths.values():
            self._paths = {artifact.name: artifact}
        self._wanted = next(name for name, path in self._paths.items() if path == artifact)
        self._policies: dict[str, Policy] = {self._wanted: load_policy(artifact, threads=THREADS)}
        self.car = self._policies[self._wanted].car
        self._level = level_named(level)
        # of each level: hits and all of the undisturbed drives, and of those in which somebody pushed the car
        self._results = {name: {policy: [0, 0] for policy in self._paths} for name in LEVELS}
        self._pushed = {name: [0, 0] for name in LEVELS}
        self._seed = SEED
        cv2.setNumThreads(THREADS)
        self._closing = threading.Event()
        self._next = threading.Event()
        self._held = False
        self._driving: PacedCar | None = None

    async def show(self, view: "View") -> None:
        """Drive in a thread until this is cancelled. While the view has not taken a picture, no other one follows."""
        loop = asyncio.get_running_loop()
        ready = threading.Event()
        ready.set()

        def give(head: dict[str, Any], picture: bytes) -> None:
            view.show(head, picture)
            ready.set()

        def post(head: dict[str, Any], picture: bytes) -> None:
            if ready.is_set() and not self._closing.is_set():
                ready.clear()
                with contextlib.suppress(RuntimeError):  # the view has just ended
                    loop.call_soon_threadsafe(give, head, picture)

        try:
            await asyncio.to_thread(self.run, post)
        finally:
            self._closing.set()
            self.ask("stop")

    def ask(self, request: str) -> None:
        """Do what the page asks for, and ignore all else.

        That is "stop", "next", a push, "drive <name>" of another mode, or "level <name>".
        """
        if request in SIDES:
            if self._driving:
                self._driving.push(SIDES[request])
            return
        name = request.removeprefix("drive ")
        level = request.removeprefix("level ")
        if request != "stop" and request != "next" and name not in self._paths and level not in LEVELS:
            return
        self._held = request == "stop"
        if name in self._paths:
            self._wanted = name
        if level in LEVELS:
            self._level = LEVELS[level]
        if self._driving:
            self._seed += request == "next" and not self._driving.world.done  # another policy gets the same world
            self._driving.stop.set()
        if request != "stop":
            self._next.set()

    def run(self, post: Post, worlds: int | None = None) -> None:
        """Drive through `worlds` worlds, None: until the view has ended. post: takes each picture."""
        settings = Settings.of(params()["drive"])
        count = 0
        while not self._closing.is_set() and count != worlds:
            name = self._wanted
            level = self._level
            if name not in self._policies:
                self._policies[name] = load_policy(self._paths[name], threads=THREADS)
            world = World(self._seed, left=self.car.left, level=level)  # as in run_trials: older recordings turned left
            car = self._driving = PacedCar(world, self._policies[name], lambda car: post(*self._seen(car)))
            self._next.clear()
            outcome = car.drive(settings, car.log).outcome
            count += 1
            if car.world.done or not car.stop.is_set():  # what somebody interrupted counts for nobody
                result = self._pushed[level.name] if car.pushes else self._results[level.name][name]
                result[0] += car.world.hit
                result[1] += 1
                self._seed += 1
            self._wait(car, outcome, post)

    def _wait(self, car: "PacedCar", outcome: str, post: Post) -> None:
        """Show how a drive ended, until the next one is asked for; unless somebody stopped it, for a moment only."""
        end_s = time.monotonic() + HOLD_S
        while not self._closing.is_set() and (self._held or time.monotonic() < end_s):
            head, picture = self._seen(car)
            text = "stopped here; nobody drives" if self._held else SAID[outcome]
            neutral = self.car.pwm.neutral()
            pins = [neutral.steering_us, neutral.throttle_us]
            post(head | {"phase": "ended", "text": text, "tick": None, "pins": pins, "who": "S"}, picture)
            if self._next.wait(0.3):
                return

    def _seen(self, car: "PacedCar") -> tuple[dict[str, Any], bytes]:
        """What the page shows of a car now: a message as in feed.py, with `world` for what only a simulation knows."""
        world = car.world
        row = car.log.row
        plan = car.newest()
        frame = car.world.render()
        head: dict[str, Any] = {
            "phase": "driving", "text": "", "title": f"{self._title}: {self._wanted}, balloon world",
            "sent_s": car.clock(), "missing": "", "who": "A", "why": "simulated", "events": [], "machine": {},
            "missed": 0, "hz": RATE_HZ, "late_most_ms": 0.0, "tick": row and row._asdict(),
            "pins": row and [row.steering_us, row.throttle_us], "frame": round(car.clock() * RATE_HZ),
            "captured_s": time.monotonic(), "size": [frame.shape[1], frame.shape[0]],
        }  # fmt: skip
        if plan:
            rate_hz = car.policy.rate_hz
            head["plan"] = {"captured_s": plan.captured_s, "rate_hz": rate_hz, "actions": plan.actions.tolist()}
        head["world"] = {
            "seed": world.seed,
            "level": world.level.name,
            "levels": list(LEVELS),
            "pushed": self._pushed[world.level.name],
            "results": self._results[world.level.name],
            "drives": self._wanted,
            "path": [[round(s.x_m, 2), round(s.y_m, 2)] for s in (*world.trajectory[::3], world.state)],
            "balloon": [world.balloon.x_m, world.balloon.y_m],
        }
        return head, cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()


class PacedCar(TimedCar):
    """A car in a world whose time goes as fast as the clock, or slower. show: called for each picture to be shown."""

    def __init__(self, world: World, policy: Any, show: Callable[["PacedCar"], object]):
        self.log = NoLog()
        self._show = show
        self.pushes = 0
        self._due_s = self._shown_s = time.monotonic()
        super().__init__(world, policy, PLAN_S)

    def push(self, side: int) -> None:
        """Push the car once, unless its drive has ended. side: as in World.push()."""
        if not self.world.done:
            self.world.push(side)
            self.pushes += 1

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        self._due_s += seconds
        now_s = time.monotonic()
        if now_s < self._due_s:
            time.sleep(self._due_s - now_s)
        else:
            self._due_s = now_s  # what this machine could not do in time is not caught up: time has been slower
        now_s = time.monotonic()
        # every second tick at most: where time is slow already, pictures in between would make it slower still
        if now_s - self._shown_s >= PICTURE_S and round(self.clock() * RATE_HZ) % 2 == 0:
            self._shown_s = now_s
            self._show(self)
