"""Drive a policy through balloon worlds that it has not seen, and count the hits."""

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from balloon_world.world import World
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.drive.pilot import Order
from rover_lib.onboard.errors import TrainingError
from rover_lib.workshop.progress import Progress, silent


@dataclass(frozen=True)
class Trajectory:
    """A drive as seen from above: (n,) arrays of positions in metres and of commanded actions.

    balloon_xy_m: the balloon's (x, y).
    """

    x_m: np.ndarray
    y_m: np.ndarray
    steering: np.ndarray
    throttle: np.ndarray
    balloon_xy_m: tuple[float, float]

    @classmethod
    def of(cls, world: World) -> "Trajectory":
        """Return everything that was driven in a world so far."""
        track = np.array([(s.x_m, s.y_m, s.steering_command, s.throttle_command) for s in world.trajectory])
        x_m, y_m, steering, throttle = track.T
        return cls(x_m, y_m, steering, throttle, (world.balloon.x_m, world.balloon.y_m))


@dataclass(frozen=True)
class Driven:
    """A drive through a world.

    outcome: 'hit', 'left', 'timeout', and for `drives.drive_in` 'stopped' if a plan became too old to drive by, or
    'taken over'. trajectory: one point per tick. orders: what was commanded at each tick, for `drive_in` alone.
    """

    outcome: str
    duration_s: float
    trajectory: Trajectory
    orders: Sequence[Order] = ()

    @property
    def hit(self) -> bool:
        return self.outcome == "hit"


@dataclass(frozen=True)
class TrialReport:
    """How a policy drove. wilson: 95 % interval of the share of hits."""

    hits: int
    trials: int
    wilson: tuple[float, float]
    per_world: list[Driven]


def wilson_interval(hits: int, trials: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Return the interval in which the true share of hits lies, by Wilson's score (95 % with the default z)."""
    share = hits / trials
    centre = share + z * z / (2 * trials)
    half = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


def run_trials(
    policy: Any,
    worlds: int = 40,
    seed: int = 10_000,
    replan_every: int = 8,
    progress: Progress = silent,
) -> TrialReport:
    """Drive through `worlds` worlds with the seeds from `seed` on, in closed loop at 30 Hz.

    policy: an artifact's Policy, or anything else with `chunk` and `predict_chunk`. replan_every: how many actions of
    each chunk are driven before the policy sees the next frame; its state is the action commanded before, neutral at
    the start.
    Raises TrainingError for parameters outside their ranges, and plans of a wrong shape or that are not finite.
    """
    if worlds < 1 or not 1 <= replan_every <= policy.chunk:
        what = f"trials need at least 1 world, and replan_every from 1 to {policy.chunk}"
        raise TrainingError(what, found=f"{worlds} and {replan_every}")
    results: list[Driven] = []
    car = getattr(policy, "car", None)
    left = car.left if isinstance(car, Car) else None  # of older recordings, whose car turned left
    for world_seed in progress(range(seed, seed + worlds), desc="driving", total=worlds):
        results.append(_drive(policy, World(world_seed, left=left), replan_every))
    hits = sum(r.hit for r in results)
    return TrialReport(hits, worlds, wilson_interval(hits, worlds), results)


def run_trials_of(policies: Mapping[str, Any], worlds: int = 40, **options: Any) -> dict[str, TrialReport]:
    """Do `run_trials` for several policies at once, on a thread for each core, with the same results."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        running = {name: pool.submit(run_trials, policy, worlds, **options) for name, policy in policies.items()}
        return {name: trial.result() for name, trial in running.items()}


def _drive(policy: Any, world: World, replan_every: int) -> Driven:
    state: np.ndarray = np.zeros(2, np.float32)
    while not world.done:
        chunk = np.asarray(policy.predict_chunk(world.render(), state))
        if chunk.ndim != 2 or chunk.shape[0] < replan_every or chunk.shape[1] != 2 or not np.isfinite(chunk).all():
            found = f"{chunk.shape} in world {world.seed}"
            raise TrainingError("the policy must plan finite (steps, 2) actions", found=found)
        for steering, throttle in chunk[:replan_every]:
            world.step(float(np.clip(steering, -1, 1)), float(np.clip(throttle, 0, 1)))
            state = np.array([steering, throttle], np.float32)
            if world.done:
                break
    return Driven(str(world.outcome), world.state.time_s, Trajectory.of(world))
