"""Drive policies through balloon worlds in virtual time: with late plans, pushes, decoys, and somebody who takes over.

    driven = drive_in(policy, World(10_000, shoves=4), latency_s=0.15, settings=settings)
    outcomes = drive_missing(artifact, questions, one_drive, "drives.jsonl", progress)

The car's own loop drives: `onboard.drive.loop.drive` with its PolicyPilot, on a virtual clock. Only the camera and the
planner's thread are replaced. Nothing waits, and no result depends on how fast this machine is.
"""

import json
import math
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from balloon_world.level import EASY, Level
from balloon_world.world import RATE_HZ, World
from rover_lib.onboard.car.camera import Frame
from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.drive.loop import Until, drive
from rover_lib.onboard.drive.pilot import Order, PolicyPilot
from rover_lib.onboard.drive.plan import OFF, Commanded, Plan, Settings
from rover_lib.onboard.errors import DriveFault, TrainingError
from rover_lib.onboard.policy.load import Policy, load_policy
from rover_lib.onboard.stage import plain
from rover_lib.workshop.judge.pairs import Z
from rover_lib.workshop.progress import Progress, silent

ROUNDING = 1e-6  # how far times may be rounded, in ticks
SEED = 10_000  # of the first world that judges a policy

K = TypeVar("K")
V = TypeVar("V")
Watch = Callable[[Order], bool]


@dataclass(frozen=True)
class WorldDrive:
    """A drive through a world.

    outcome: a World's, 'stopped' if a plan became too old to drive by or a place was unfamiliar, or
    'taken over'. orders: what was commanded at each tick.
    """

    outcome: str
    orders: list[Order]


class NoLog:
    """A flight log that keeps nothing but the last tick's row."""

    start_s = 0.0
    row: Any = None

    def tick(self, row: Any) -> None:
        self.row = row

    def event(self, text: str, *, level: int = 0) -> None: ...


class TimedCar:
    """A world, and the loop's camera, planner, clock and sleep in it: only sleep() moves the time on.

    The car is held until the first plan is there, like the car of `rover drive --world`.
    """

    wanted_hz = RATE_HZ
    draws = False  # whether latest() shows the loop what is to be seen; if not, no car looks stuck

    def __init__(self, world: World, policy: Any, latency_s: float):
        self.world = world
        self.policy = policy
        self.stop = threading.Event()
        self.command: Order | None = None
        self.plans: list[Plan] = []
        self._latency_s = latency_s
        self._commanded = Commanded()
        self._tick = 0
        self._looked_at = -1  # the tick of the last frame that was planned from
        self._coming: Plan | None = None
        self._think(ROUNDING)

    def drive(self, settings: Settings, log: Any, watch: Watch | None = None) -> WorldDrive:
        """Drive by the car's own loop until the world ends or `stop` is set."""
        settings = settings if self.draws else replace(settings, stuck_s=0.0)
        pilot = WorldPilot(self, self._commanded, settings, self.policy.rate_hz, watch)
        try:
            drive(pilot, None, log, rate_hz=RATE_HZ, until=Until(stop=self.stop), clock=self.clock, sleep=self.sleep)
        except DriveFault as fault:
            if fault.__cause__:  # the policy failed; without a cause, a plan had become too old
                raise fault.__cause__ from None
            return WorldDrive("stopped", pilot.orders)
        return WorldDrive(self.world.outcome or "taken over", pilot.orders)

    def clock(self) -> float:
        return self._tick / RATE_HZ

    def sleep(self, seconds: float) -> None:
        for _ in range(round(seconds * RATE_HZ)):
            self._think(self._tick + 1 - ROUNDING)
            if self.command:
                self.world.step(self.command.steering, self.command.throttle, 1 / RATE_HZ)
                if self.world.done:
                    return self.stop.set()
            self._tick += 1
            self._think(self._tick + ROUNDING)

    def latest(self) -> Frame:
        # The loop only asks whether the camera is frozen or black, so nothing needs to be drawn for it.
        return Frame(np.empty((0, 0, 3), np.uint8), self.clock(), self._tick + 1, 0, 255.0, 255.0)

    @property
    def asking_s(self) -> float:
        return self.clock() - (self._coming.ready_s - self._latency_s) if self._coming else 0.0

    def newest(self) -> Plan | None:
        return self.plans[-1] if self.plans else None

    def wait(self, timeout_s: float) -> Plan | None:
        while not self.plans:
            self.sleep(1 / RATE_HZ)
        return self.newest()

    def _think(self, until_tick: float) -> None:
        """Do what Planner's thread does up to `until_tick`: when a plan is ready, begin one from the newest frame."""
        now_s = self.clock()
        while True:
            if self._coming:
                if self._coming.ready_s * RATE_HZ > until_tick:
                    return
                self.plans.append(self._coming)
                now_s = max(now_s, self._coming.ready_s)
                self._coming = None
            if self._looked_at == self._tick:
                return  # the planner waits for another frame
            self._looked_at = self._tick
            state = self._commanded.state(self.clock(), self.policy.rate_hz)
            actions = self.policy.predict_unclipped(self.world.render(), state)
            strange = getattr(self.policy, "strange", None)
            ready_s = now_s + self._latency_s
            self._coming = Plan(len(self.plans) + 1, self.clock(), ready_s, actions, strange=strange)


class WorldPilot(PolicyPilot):
    """A pilot whose orders move the virtual car and are kept. watch: see `drive_in`."""

    def __init__(self, car: TimedCar, commanded: Commanded, settings: Settings, rate_hz: float, watch: Watch | None):
        camera_and_planner: Any = car
        super().__init__(camera_and_planner, camera_and_planner, commanded, settings, rate_hz)
        self.orders: list[Order] = []
        self._car = car
        self._watch = watch

    def sent(self, at_s: float, order: Order) -> None:
        super().sent(at_s, order)
        self._car.command = order
        self.orders.append(order)
        if self._watch and self._watch(order):
            self._car.stop.set()  # the drive ends after this tick


def drive_in(policy: Any, world: World, latency_s: float, settings: Settings, watch: Watch | None = None) -> WorldDrive:
    """Drive through a world until it has ended.

    policy: an artifact's Policy, or anything else with `rate_hz` and `predict_unclipped`. latency_s: from taking the
    newest frame to having its plan; with 0 the plan is there within the same tick. watch: called with every order
    before the car moves by it; if it returns true, somebody takes over and the drive ends after that tick.
    Raises PolicyError for a plan that no car may be driven by, and TrainingError for a latency below 0.
    """
    if latency_s < 0:
        raise TrainingError("a latency must be at least 0 s", found=latency_s)
    car = TimedCar(world, policy, latency_s)
    # What is judged is how the policy drives, not where it would have been stopped as unfamiliar.
    return car.drive(replace(settings, unfamiliar=OFF), NoLog(), watch)


def everywhere(artifact: Path, questions: Sequence[K], do: Callable[[Policy, K], V]) -> Iterator[tuple[K, V]]:
    """Call do(policy, question) for each question on a thread for each core; yield (question, answer) when ready.

    Each thread loads the policy for itself, to be run by that thread alone: once torch has a second thread, it spins
    between inferences, which costs several times what it gains for a small policy. Answers do not depend on it.
    """
    own = threading.local()

    def one(question: K) -> tuple[K, V]:
        if not hasattr(own, "policy"):
            own.policy = load_policy(artifact, threads=1)
        return question, do(own.policy, question)

    with ThreadPoolExecutor(min(os.cpu_count() or 1, len(questions))) as pool:
        running = [pool.submit(one, question) for question in questions]
        try:
            for future in as_completed(running):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a file, less what a process that was killed has left of one."""
    rows = []
    for line in path.read_text().splitlines() if path.is_file() else ():
        with suppress(ValueError):
            rows.append(json.loads(line))
    return rows


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Add a row to a file, after whatever a killed process left of the last one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write("\n" + json.dumps(plain(row)) + "\n")


def drive_missing(
    artifact: Path,
    questions: Sequence[tuple[str, int]],
    one: Callable[[Policy, tuple[str, int]], Mapping[str, Any]],
    path: Path,
    progress: Progress = silent,
    desc: str = "driving",
) -> dict[tuple[str, int], dict[str, Any]]:
    """Return a row for each (how, seed) that is asked for. one: makes the drive, and returns what its row says of it.

    Rows that are in the file are not driven again, and each new one is there as soon as its drive has ended.
    """
    rows = {(row["how"], row["seed"]): row for row in read_rows(path)}
    missing = [question for question in questions if question not in rows]
    if missing:
        answers = everywhere(artifact, missing, one)
        for (kind, seed), row in progress(answers, desc=desc, total=len(missing)):
            rows[kind, seed] = {"how": kind, "seed": seed, **row}
            append_row(path, rows[kind, seed])
    return {question: rows[question] for question in questions}


def count_hits(outcomes: Sequence[str], key: str = "hits_wilson") -> dict[str, Any]:
    """Return hits, trials, Wilson's 95 % interval and the missed seeds of outcomes in the worlds from SEED on."""
    missed = [seed for seed, outcome in enumerate(outcomes, SEED) if outcome != "hit"]
    hits = len(outcomes) - len(missed)
    low, high = wilson_interval(hits, len(outcomes))
    return {"hits": hits, "trials": len(outcomes), f"{key}_low": low, f"{key}_high": high, "missed": missed}


def judge(
    artifact: Path,
    worlds: Mapping[str, int],
    one: Callable[[Policy, str, int], str],
    path: Path,
    progress: Progress,
    name: str,
) -> dict[str, list[str]]:
    """Return the outcomes of drives in the worlds from SEED on, for each way to drive. worlds: their number, by way.

    one: drives a policy in that way through the world of a seed. path: keeps what was driven, see `drive_missing`.
    """

    def row(policy: Policy, question: tuple[str, int]) -> dict[str, Any]:
        return {"outcome": one(policy, *question)}

    questions: list[tuple[str, int]] = []
    for kind, count in worlds.items():
        questions += [(kind, SEED + i) for i in range(count)]
    rows = drive_missing(artifact, questions, row, path, progress, f"driving {name}")
    return {kind: [rows[kind, SEED + i]["outcome"] for i in range(count)] for kind, count in worlds.items()}


@dataclass(frozen=True)
class TrialReport:
    """How a policy drove. hit: in each world, by its seed.

    paths: in each world where the car was at each tick, (ticks, 2) metres ahead and to the left of its start.
    balloons: where each world's balloon is, the same way.
    """

    hits: int
    trials: int
    hit: tuple[bool, ...]
    paths: tuple[np.ndarray, ...] = ()
    balloons: tuple[tuple[float, float], ...] = ()


def wilson_interval(hits: int, trials: int, z: float = Z) -> tuple[float, float]:
    """Return the interval in which the true share of hits lies, by Wilson's score (95 % with the default z)."""
    share = hits / trials
    centre = share + z * z / (2 * trials)
    half = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


def run_trials(
    policy: Any,
    worlds: int = 40,
    seed: int = SEED,
    replan_every: int = 8,
    progress: Progress = silent,
    level: Level = EASY,
) -> TrialReport:
    """Drive through `worlds` worlds of a level with the seeds from `seed` on, in closed loop at 30 Hz.

    policy: an artifact's Policy, or anything else with `chunk` and `predict_chunk`. replan_every: how many actions of
    each chunk are driven before the policy sees the next frame; its state is the action commanded before, neutral at
    the start.
    Raises TrainingError for parameters outside their ranges, and plans of a wrong shape or that are not finite.
    """
    if worlds < 1 or not 1 <= replan_every <= policy.chunk:
        problem = f"trials need at least 1 world, and replan_every from 1 to {policy.chunk}"
        raise TrainingError(problem, found=f"{worlds} and {replan_every}")
    car = getattr(policy, "car", None)
    side = car.left if isinstance(car, Car) else None  # of older recordings, whose car turned left
    seeds = progress(range(seed, seed + worlds), desc="driving", total=worlds)
    hit = list[bool]()
    paths = list[np.ndarray]()
    balloons = list[tuple[float, float]]()
    for world_seed in seeds:
        world = World(world_seed, left=side, level=level)
        _drive_to_end(policy, world, replan_every)
        hit.append(world.hit)
        paths.append(path_of(world))
        balloons.append((world.balloon.x_m, world.balloon.y_m))
    return TrialReport(sum(hit), worlds, tuple(hit), tuple(paths), tuple(balloons))


def path_of(world: World) -> np.ndarray:
    """Where the car was at each tick, (ticks, 2) metres ahead and to the left of its start."""
    return np.array([(state.x_m, state.y_m) for state in world.trajectory])


def run_trials_of(policies: Mapping[str, Any], worlds: int = 40, **options: Any) -> dict[str, TrialReport]:
    """Do `run_trials` for several policies at once, on a thread for each core, with the same results."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        running = {name: pool.submit(run_trials, policy, worlds, **options) for name, policy in policies.items()}
        return {name: trial.result() for name, trial in running.items()}


def _drive_to_end(policy: Any, world: World, replan_every: int) -> None:
    state: np.ndarray = np.zeros(2, np.float32)
    while not world.done:
        chunk = np.asarray(policy.predict_chunk(world.render(), state))
        if chunk.ndim != 2 or chunk.shape[0] < replan_every or chunk.shape[1] != 2 or not np.isfinite(chunk).all():
            shape = f"{chunk.shape} in world {world.seed}"
            raise TrainingError("the policy must plan finite (steps, 2) actions", found=shape)
        for steering, throttle in chunk[:replan_every]:
            world.step(float(np.clip(steering, -1, 1)), float(np.clip(throttle, 0, 1)))
            state = np.array([steering, throttle], np.float32)
            if world.done:
                break


def car_in_key() -> dict[str, Any]:
    """What a key says of the car that drives or limits actions: its car.yml, nothing for the one without a car.yml."""
    car = this_car()
    return {} if car.drives_like(Car()) else {"car": car.description()}
