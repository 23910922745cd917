"""How late may a plan be? Drives through balloon worlds in virtual time, where an inference takes as long as it is told.

    report = run_latencies([policy], [Condition(0.0, settings), Condition(0.15, settings)], worlds=40)

The very loop of the car drives: `onboard.drive.drive` with its PolicyPilot, its clock and sleep being virtual. What
stands in are the camera and the planner's thread. Nothing waits, and nothing depends on how fast this machine is.
"""

import copy
import gc
import math
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rover_lib.onboard.camera import Frame
from rover_lib.onboard.drive import DriveFault, Order, PolicyPilot, drive
from rover_lib.onboard.errors import WorldError
from rover_lib.onboard.plan import Commanded, Plan, Settings
from rover_lib.playground.trial import Trajectory, wilson_interval
from rover_lib.playground.world import RATE_HZ, CarState, World

LATENCY_MOST_S = 5.0  # the loop waits 10 s for a first plan
ROUNDING = 1e-6  # of times, in ticks


class Plans(Protocol):
    """What can be driven: an artifact's Policy, or anything with this one."""

    def predict_unclipped(self, frame_bgr: np.ndarray, state: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class Condition:
    """What a drive is driven with. latency_s: from a look at the newest frame to the plan, 0: within the same tick."""

    latency_s: float
    settings: Settings

    def __post_init__(self):
        if not 0 <= self.latency_s <= LATENCY_MOST_S:
            raise WorldError(f"a latency must be 0 to {LATENCY_MOST_S:g} s, found {self.latency_s}")


@dataclass(frozen=True)
class LateDrive:
    """One world's drive. outcome: 'hit', 'left', 'timeout', or 'stopped' if a plan became too old to drive by.

    nearest_m: camera to balloon, at its least. trajectory: one point per tick. orders: what was commanded, at each
    tick. plans: all that there were, and where the car was when each of them looked.
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
    """Of one condition. wilson: 95 % interval of the share of hits."""

    condition: Condition
    hits: int
    trials: int
    wilson: tuple[float, float]
    per_world: list[LateDrive]

    def summary(self) -> dict[str, Any]:
        """For JSON."""
        ages_ms = 1e3 * np.array([o.age_s for d in self.per_world for o in d.orders])
        outcomes = [d.outcome for d in self.per_world]
        times_s = [d.duration_s for d in self.per_world if d.outcome == "hit"]
        at = {p: float(np.percentile(ages_ms, p)) if len(ages_ms) else None for p in (50, 95, 100)}
        return {
            "latency_ms": round(1e3 * self.condition.latency_s, 3),
            "compensate": self.condition.settings.compensate,
            "ensemble": self.condition.settings.ensemble,
            "hits": self.hits,
            "trials": self.trials,
            "hits_wilson_low": self.wilson[0],
            "hits_wilson_high": self.wilson[1],
            **{o: outcomes.count(o) for o in ("left", "timeout", "stopped")},
            "plan_age_p50_ms": at[50],
            "plan_age_p95_ms": at[95],
            "plan_age_max_ms": at[100],
            "time_to_hit_p50_s": float(np.median(times_s)) if times_s else None,
        }


class _Car:
    """A world, and what looks at it: the loop's camera, planner, clock and sleep, of which only sleep() moves the time.

    Frames come at the ticks. The car is held until the first plan is there, as that of `rover drive --world` is.
    """

    wanted_hz = RATE_HZ

    def __init__(self, world: World, policy: Plans, latency_s: float, commanded: Commanded):
        self.world, self.stop = world, threading.Event()
        self.command: Order | None = None
        self.plans: list[tuple[Plan, CarState]] = []
        self._policy, self._latency_s, self._commanded = policy, latency_s, commanded
        self._tick, self._looked_at = 0, -1
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
        # The loop only asks whether the camera is frozen or black: nothing is drawn for it.
        return Frame(np.empty((0, 0, 3), np.uint8), self.clock(), self._tick + 1, 0, 255.0)

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
        """What Planner's thread does until then: a plan is there, and at once it looks at the newest frame."""
        now_s = self.clock()
        while True:
            if self._coming:
                plan = self._coming[0]
                if plan.ready_s * RATE_HZ > until_tick:
                    return
                self.plans.append(self._coming)
                now_s, self._coming = max(now_s, plan.ready_s), None
            if self._looked_at == self._tick:
                return  # it waits for another frame
            self._looked_at = self._tick
            state = self._commanded.state(self.clock(), RATE_HZ)
            actions = self._policy.predict_unclipped(self.world.render(), state)
            plan = Plan(len(self.plans) + 1, self.clock(), now_s + self._latency_s, actions)
            self._coming = plan, self.world.state


class _Pilot(PolicyPilot):
    """Whose orders move the car, and are kept."""

    def __init__(self, car: _Car, commanded: Commanded, settings: Settings):
        super().__init__(car, car, commanded, settings, RATE_HZ)
        self.orders: list[Order] = []
        self._car = car

    def sent(self, at_s: float, order: Order) -> None:
        super().sent(at_s, order)
        self._car.command = order
        self.orders.append(order)


class _NoLog:
    """In a flight log's place."""

    start_s = 0.0

    def tick(self, row: Any) -> None: ...

    def event(self, text: str, **fields: Any) -> None: ...


def drive_late(policy: Plans, seed: int, condition: Condition) -> LateDrive:
    """One drive through the world of that seed. Raises DriveFault for plans that no car may be driven by."""
    commanded = Commanded()
    car = _Car(World(seed), policy, condition.latency_s, commanded)
    pilot = _Pilot(car, commanded, condition.settings)
    try:
        drive(pilot, None, rate_hz=RATE_HZ, log=_NoLog(), stop=car.stop, clock=car.clock, sleep=car.sleep)
        outcome = car.world.outcome
    except DriveFault:
        outcome = "stopped"
    world, track = car.world, car.world.trajectory
    balloon = world.balloon.x_m, world.balloon.y_m
    names = "x_m", "y_m", "steering_command", "throttle_command"
    trajectory = Trajectory(*(np.array([getattr(s, name) for s in track]) for name in names), balloon)
    nearest_m = float(np.hypot(trajectory.x_m - balloon[0], trajectory.y_m - balloon[1]).min())
    return LateDrive(seed, outcome, world.state.time_s, nearest_m, trajectory, pilot.orders, car.plans)


def run_latencies(
    policies: Sequence[Plans],
    conditions: Sequence[Condition],
    worlds: int = 40,
    seed: int = 10_000,
    progress: Callable[..., Iterable] | None = None,
) -> list[LatencyReport]:
    """Drive through `worlds` worlds, of seeds from `seed` on, under each condition; reports in their order.

    policies: the same one, once for each thread that drives: results do not depend on how many there are.
    progress: called like tqdm.tqdm(iterable, desc=, total=), or None.
    Raises WorldError for parameters that make no trial, RoverError for what a policy raises.
    """
    if worlds < 1 or seed < 0 or not policies:
        raise WorldError(f"drives need a policy, at least 1 world and a seed from 0, found {worlds} and {seed}")
    free: queue.SimpleQueue[Plans] = queue.SimpleQueue()
    for policy in policies:
        free.put(policy)

    def one(condition: Condition, world_seed: int) -> LateDrive:
        policy = free.get()
        try:
            return drive_late(policy, world_seed, condition)
        finally:
            free.put(policy)

    with _interpreter_as_before(), ThreadPoolExecutor(len(policies)) as pool:
        running = [[pool.submit(one, c, s) for s in range(seed, seed + worlds)] for c in conditions]
        every = [future for futures in running for future in futures]
        try:
            done = as_completed(every)
            for future in progress(done, desc="driving", total=len(every)) if progress else done:
                future.result()
        finally:
            pool.shutdown(cancel_futures=True)
        drives = [[future.result() for future in futures] for futures in running]
    hits = [sum(d.outcome == "hit" for d in found) for found in drives]
    return [
        LatencyReport(c, n, worlds, wilson_interval(n, worlds), found)
        for c, n, found in zip(conditions, hits, drives, strict=True)
    ]


@contextmanager
def _interpreter_as_before() -> Iterator[None]:
    """The loop tunes the interpreter for a car; who measures goes on afterwards."""
    before = sys.getswitchinterval()
    try:
        yield
    finally:
        sys.setswitchinterval(before)
        gc.unfreeze()
