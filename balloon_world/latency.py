"""How late may a plan be? Drive through balloon worlds in virtual time, with an inference as slow as you choose.

    reports = run_latencies([policy], [Condition(0.0, settings), Condition(0.15, settings)], worlds=40)

The car's own loop drives: `onboard.drive.loop.drive` with its PolicyPilot, on a virtual clock. Only the camera and the
planner's thread are replaced. Nothing waits, and no result depends on how fast this machine is.
"""

import copy
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from balloon_world.side_by_side import everywhere, load_for_cores
from balloon_world.trial import Trajectory, wilson_interval
from balloon_world.world import RATE_HZ, CarState, World
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.car.camera import Frame
from rover_lib.onboard.drive.loop import Until, drive
from rover_lib.onboard.drive.pilot import Order, PolicyPilot
from rover_lib.onboard.drive.plan import Commanded, Plan, Settings
from rover_lib.onboard.errors import DriveFault, WorldError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import find_stage, write_stage
from rover_lib.workshop.progress import Progress, silent

if TYPE_CHECKING:
    from rover_lib.workshop.notebook_table import Table

LATENCY_MOST_S = 5.0
ROUNDING = 1e-6  # how far times may be rounded, in ticks
ENSEMBLE = 0.01  # LeRobot's coefficient
JUDGED_MS = 150.0
SEED = 10_000


class Plans(Protocol):
    """What can drive: an artifact's Policy, or anything else with these two. rate_hz: of a plan's actions."""

    rate_hz: float

    def predict_unclipped(self, frame_bgr: np.ndarray, state: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class Condition:
    """The circumstances of a drive.

    latency_s: from taking the newest frame to having its plan; with 0 the plan is there within the same tick.
    pushes, decoys: World's shoves and decoys.
    """

    latency_s: float
    settings: Settings
    pushes: int = 0
    decoys: int = 0

    def __post_init__(self):
        if not 0 <= self.latency_s <= LATENCY_MOST_S:
            raise WorldError(f"a latency must be 0 to {LATENCY_MOST_S:g} s", found=self.latency_s)


@dataclass(frozen=True)
class LateDrive:
    """The drive in one world. outcome: 'hit', 'left', 'timeout', or 'stopped' if a plan became too old to drive by.

    nearest_m: the least distance between camera and balloon. trajectory: one point per tick. orders: what was commanded
    at each tick. plans: all plans, each with the car's state when its frame was taken.
    """

    seed: int
    outcome: str
    duration_s: float
    nearest_m: float
    trajectory: Trajectory
    orders: list[Order]
    plans: list[tuple[Plan, CarState]]


@dataclass(frozen=True)
class LatencyReport:
    """All drives under one condition. wilson: 95 % interval of the share of hits."""

    condition: Condition
    hits: int
    trials: int
    wilson: tuple[float, float]
    per_world: list[LateDrive]

    def summary(self) -> dict[str, Any]:
        """Return the counts and times for JSON."""
        ages_ms = 1e3 * np.array([o.age_s for d in self.per_world for o in d.orders])
        outcomes = [d.outcome for d in self.per_world]
        times_s = [d.duration_s for d in self.per_world if d.outcome == "hit"]
        at = {p: round(float(np.percentile(ages_ms, p)), 3) if len(ages_ms) else None for p in (0, 50, 95, 100)}
        return {
            "latency_ms": round(1e3 * self.condition.latency_s, 3),
            "pushes": self.condition.pushes,
            "compensate": self.condition.settings.compensate,
            "ensemble": self.condition.settings.ensemble,
            "hits": self.hits,
            "trials": self.trials,
            "hits_wilson_low": self.wilson[0],
            "hits_wilson_high": self.wilson[1],
            **{o: outcomes.count(o) for o in ("left", "timeout", "stopped")},
            "plan_age_min_ms": at[0],
            "plan_age_p50_ms": at[50],
            "plan_age_p95_ms": at[95],
            "plan_age_max_ms": at[100],
            "time_to_hit_p50_s": float(np.median(times_s)) if times_s else None,
        }


Watch = Callable[[Order], bool]


class TimedCar:
    """A world, and the loop's camera, planner, clock and sleep in it. Only sleep() moves the time on.

    Frames come at the ticks. The car is held until the first plan is there, like the car of `rover drive --world`.
    """

    wanted_hz = RATE_HZ

    def __init__(self, world: World, policy: Plans, latency_s: float, commanded: Commanded):
        self.world, self.stop = world, threading.Event()
        self.command: Order | None = None
        self.plans: list[tuple[Plan, CarState]] = []
        self._policy, self._latency_s, self._commanded = policy, latency_s, commanded
        self._tick, self._looked_at = 0, -1  # the present tick, and the tick of the last frame that was planned from
        self._coming: tuple[Plan, CarState] | None = None
        self._think(ROUNDING)

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
        return self.clock() - (self._coming[0].ready_s - self._latency_s) if self._coming else 0.0

    def newest(self) -> Plan | None:
        return self.plans[-1][0] if self.plans else None

    def wait(self, timeout_s: float) -> Plan | None:
        while not self.plans:
            self.sleep(1 / RATE_HZ)
        return self.newest()

    def _think(self, until_tick: float) -> None:
        """Do what Planner's thread does up to `until_tick`: when a plan is ready, begin one from the newest frame."""
        now_s = self.clock()
        while True:
            if self._coming:
                plan = self._coming[0]
                if plan.ready_s * RATE_HZ > until_tick:
                    return
                self.plans.append(self._coming)
                now_s, self._coming = max(now_s, plan.ready_s), None
            if self._looked_at == self._tick:
                return  # the planner waits for another frame
            self._looked_at = self._tick
            state = self._commanded.state(self.clock(), self._policy.rate_hz)
            actions = self._policy.predict_unclipped(self.world.render(), state)
            plan = Plan(len(self.plans) + 1, self.clock(), now_s + self._latency_s, actions)
            self._coming = plan, self.world.state


class WorldPilot(PolicyPilot):
    """A pilot whose orders move the virtual car and are kept. watch: see `drive_in`."""

    def __init__(self, car: TimedCar, commanded: Commanded, settings: Settings, rate_hz: float, watch: Watch | None):
        camera_and_planner: Any = car
        super().__init__(camera_and_planner, camera_and_planner, commanded, settings, rate_hz)
        self.orders: list[Order] = []
        self._car, self._watch = car, watch

    def sent(self, at_s: float, order: Order) -> None:
        super().sent(at_s, order)
        self._car.command = order
        self.orders.append(order)
        if self._watch and self._watch(order):
            self._car.stop.set()  # the drive ends after this tick


class NoLog:
    """A flight log that keeps nothing."""

    start_s = 0.0

    def tick(self, row: Any) -> None: ...

    def event(self, text: str, **fields: Any) -> None: ...


@dataclass(frozen=True)
class Driven:
    """How a policy drove in a world. All fields are as LateDrive's, but the outcome may also be 'taken over'."""

    outcome: str
    orders: list[Order]
    plans: list[tuple[Plan, CarState]]


def drive_in(policy: Plans, world: World, condition: Condition, watch: Watch | None = None) -> Driven:
    """Drive through a world until it has ended, with the condition's latency and settings.

    Pushes and decoys are those of the world, not the condition's. watch: called with every order when it is sent,
    before the car moves by it; if it returns true, somebody takes over and the drive ends after that tick. Raises
    PolicyError for a plan that no car may be driven by.
    """
    commanded = Commanded()
    car = TimedCar(world, policy, condition.latency_s, commanded)
    pilot = WorldPilot(car, commanded, condition.settings, policy.rate_hz, watch)
    try:
        drive(pilot, None, NoLog(), rate_hz=RATE_HZ, until=Until(stop=car.stop), clock=car.clock, sleep=car.sleep)
        outcome = str(world.outcome) if world.done else "taken over"
    except DriveFault as fault:
        if fault.__cause__:  # the policy failed; without a cause, a plan had become too old
            raise fault.__cause__ from None
        outcome = "stopped"
    return Driven(outcome, pilot.orders, car.plans)


def drive_late(policy: Plans, seed: int, condition: Condition) -> LateDrive:
    """Drive through the world of that seed. Raises PolicyError for a plan that no car may be driven by."""
    world = World(seed, condition.pushes, condition.decoys)
    driven = drive_in(policy, world, condition)
    path = Trajectory.of(world)
    balloon_x_m, balloon_y_m = path.balloon_xy_m
    nearest_m = float(np.hypot(path.x_m - balloon_x_m, path.y_m - balloon_y_m).min())
    return LateDrive(seed, driven.outcome, world.state.time_s, nearest_m, path, driven.orders, driven.plans)


def run_latencies(
    policies: Sequence[Plans],
    conditions: Sequence[Condition],
    worlds: int = 40,
    seed: int = SEED,
    progress: Progress = silent,
) -> list[LatencyReport]:
    """Drive through `worlds` worlds with the seeds from `seed` on under each condition; return a report for each.

    policies: the same policy, loaded once for each thread that drives. Results do not depend on how many there are.
    Raises WorldError if there is no policy, no world, or the seed is negative, and RoverError for what a policy raises.
    """
    if worlds < 1 or seed < 0 or not policies:
        raise WorldError("drives need a policy, at least 1 world and a seed from 0", found=f"{worlds} and {seed}")
    asked = [(i, s) for i in range(len(conditions)) for s in range(seed, seed + worlds)]
    driven = everywhere(policies, asked, lambda policy, at: drive_late(policy, at[1], conditions[at[0]]))
    drives = dict(progress(driven, desc="driving", total=len(asked)))
    reports = []
    for i, condition in enumerate(conditions):
        per_world = [drives[i, s] for s in range(seed, seed + worlds)]
        hits = sum(d.outcome == "hit" for d in per_world)
        reports.append(LatencyReport(condition, hits, worlds, wilson_interval(hits, worlds), per_world))
    return reports


def beside_path(drive: LateDrive, other: LateDrive) -> float:
    """Return how far a drive's path is from another one's at most, in metres. Times do not matter, only places."""
    a, b = drive.trajectory, other.trajectory
    return float(np.hypot(a.x_m[:, None] - b.x_m, a.y_m[:, None] - b.y_m).min(1).max())


def from_above(drive: LateDrive, condition: Condition) -> dict[str, Any]:
    """Return a drive and its plans for a figure, in JSON's types and metres.

    A plan's path is that of the world's own car, which follows the plan, unpushed, from where its frame was taken.
    """

    def path(x_m: Iterable[float], y_m: Iterable[float]) -> dict[str, list[float]]:
        return {"x_m": [round(float(x), 3) for x in x_m], "y_m": [round(float(y), 3) for y in y_m]}

    world, plans = World(drive.seed), []
    for plan, looked_from in drive.plans:
        ghost = copy.copy(world)
        ghost.state, ghost.trajectory = looked_from, [looked_from]
        for steering, throttle in plan.actions:
            if not ghost.done:
                ghost.step(float(steering), float(throttle))
        plans.append(path((s.x_m for s in ghost.trajectory), (s.y_m for s in ghost.trajectory)))
    return {
        "latency_ms": round(1e3 * condition.latency_s, 3),
        "compensate": condition.settings.compensate,
        "seed": drive.seed,
        "outcome": drive.outcome,
        "balloon_xy_m": list(drive.trajectory.balloon_xy_m),
        **path(drive.trajectory.x_m, drive.trajectory.y_m),
        "plans": plans,
    }


def measure_latencies(
    run_dir: Path | str,
    *,
    worlds: int,
    latencies_ms: Sequence[float],
    pushes: int = 0,
    pushed_latencies_ms: Sequence[float] = (),
    shown_ms: float | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure how a run's static policy drives when its plans are late; write and return drive.json, stage 'drive'.

    It drives at each of latencies_ms with and without compensation, other settings being those of params.yml's section
    `drive`; at each of pushed_latencies_ms the same way, with `pushes` pushes in each world; and at the first latency
    with LeRobot's temporal ensembling. shown_ms: for this latency, keep the world in which the drives with and without
    compensation differ most, with their plans.
    A drive.json that was made of the same policy and parameters is read, not made again.
    Sets torch to one thread, as worlds are driven in parallel. Raises WorldError if there is no policy or no latency.
    """
    run_dir, p = Path(run_dir), params()
    from rover_lib.workshop.judge.compare import GATED  # imports torch, which a view of another engine's artifact lacks

    artifact, path = run_dir / f"policy_{GATED}.pt", run_dir / "drive.json"
    if not artifact.is_file():
        raise WorldError(f"{artifact}: not there", remedy="run notebooks 01 to 03, or `make demo`, first")
    if not latencies_ms:
        raise WorldError("there is no latency to drive with", remedy="give at least one, say latencies_ms=[0]")
    limit = p["gates"]["hits_lost_at_150_ms"]
    given = {
        "worlds": worlds,
        "seed": SEED,
        "latencies_ms": latencies_ms,
        "pushes": pushes,
        "pushed_latencies_ms": pushed_latencies_ms,
        "shown_ms": shown_ms,
        "drive": p["drive"],
        "hits_lost_at_150_ms": limit,
    }
    inputs = {artifact.name: content_hash(artifact)}  # unchanged if the same policy is exported again
    if there := find_stage(path, "drive", params=given, inputs=inputs):
        return there
    settings = Settings.of(p["drive"])
    conditions = []
    for ms, count in [(ms, 0) for ms in latencies_ms] + [(ms, pushes) for ms in pushed_latencies_ms]:
        conditions.append(Condition(ms / 1e3, replace(settings, compensate=True), count))
        if ms:  # a plan that takes no time leaves nothing to compensate
            conditions.append(Condition(ms / 1e3, replace(settings, compensate=False), count))
    conditions.append(Condition(latencies_ms[0] / 1e3, replace(settings, ensemble=ENSEMBLE)))
    policies = load_for_cores(artifact, worlds * len(conditions))
    reports = run_latencies(policies, conditions, worlds, progress=progress)
    first: dict[int, LatencyReport] = {}  # for each number of pushes, the report of its first latency, compensated
    rows = []
    for report in reports:
        base = first.setdefault(report.condition.pushes, report)
        aside_cm = [1e2 * beside_path(d, b) for d, b in zip(report.per_world, base.per_world, strict=True)]
        rows.append(report.summary() | {f"aside_p{q}_cm": float(np.percentile(aside_cm, q)) for q in (50, 90)})
    metrics = {
        "policy": {"chunk": policies[0].chunk, "rate_hz": policies[0].rate_hz},
        "rows": rows,
        "gates": gates(rows, limit),
        "from_above": _choose_shown(reports, shown_ms),
    }
    return write_stage(path, "drive", params=given, metrics=metrics, inputs=inputs)


def _choose_shown(reports: Sequence[LatencyReport], shown_ms: float | None) -> list[dict[str, Any]]:
    """Return, for one latency, the world in which the drives with and without compensation differ most."""
    pair = [
        r
        for r in reports
        if not (r.condition.pushes or r.condition.settings.ensemble) and r.condition.latency_s * 1e3 == shown_ms
    ]
    if not pair:
        return []
    i = max(range(pair[0].trials), key=lambda i: beside_path(pair[0].per_world[i], pair[-1].per_world[i]))
    return [from_above(r.per_world[i], r.condition) for r in pair]


def gates(rows: Sequence[Mapping[str, Any]], limit: int) -> list[dict[str, Any]]:
    """Judge what params.yml promises for late plans: how many hits are lost at 150 ms, compensated, compared with 0 ms.

    rows: of drive.json.
    """

    def hits(latency_ms: float) -> int | None:
        for row in rows:
            if row["latency_ms"] == latency_ms and row["compensate"] and not row["pushes"] and row["ensemble"] is None:
                return row["hits"]
        return None

    before, late = hits(0.0), hits(JUDGED_MS)
    lost = None if before is None or late is None else before - late
    from rover_lib.workshop.judge.compare import GATED, gate

    return [gate(f"{GATED} hits lost at {JUDGED_MS:g} ms", lost, "<=", limit)]


def table(content: Mapping[str, Any]) -> "Table":
    """Show the content of drive.json as a table."""
    rows = []
    for r in content["metrics"]["rows"]:
        how = [f"{r['pushes']} pushes"] if r["pushes"] else ["left alone"]
        how += [] if r["compensate"] else ["not compensated"]
        how += ["ensembling"] if r["ensemble"] is not None else []
        age = "-" if r["plan_age_p95_ms"] is None else f"{r['plan_age_p95_ms']:.0f} ms"
        hits = f"{r['hits']} of {r['trials']}"
        rows.append((", ".join(how), f"{r['latency_ms']:g} ms", age, hits, str(r["stopped"])))
    notes, verdict = [], {True: "pass", False: "FAIL", None: "not measured"}
    for g in content["metrics"]["gates"]:
        notes.append(f"{g['gate']}: {g['found']}, at most {g['limit']}: {verdict[g['passed']]}")
    from rover_lib.workshop.notebook_table import Table

    return Table(("", "latency", "plan age, p95", "hits", "stopped"), rows, notes=notes)
