"""Drive a policy through balloon worlds that it has not seen, and count the hits."""

import math
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from balloon_world.world import World
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import TrainingError
from rover_lib.workshop.progress import Progress, silent


@dataclass(frozen=True)
class TrialReport:
    """How a policy drove. wilson: 95 % interval of the share of hits. hit: in each world, by its seed."""

    hits: int
    trials: int
    wilson: tuple[float, float]
    hit: tuple[bool, ...]


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
    car = getattr(policy, "car", None)
    left = car.left if isinstance(car, Car) else None  # of older recordings, whose car turned left
    seeds = progress(range(seed, seed + worlds), desc="driving", total=worlds)
    hit = tuple(_hits(policy, World(world_seed, left=left), replan_every) for world_seed in seeds)
    return TrialReport(sum(hit), worlds, wilson_interval(sum(hit), worlds), hit)


def run_trials_of(policies: Mapping[str, Any], worlds: int = 40, **options: Any) -> dict[str, TrialReport]:
    """Do `run_trials` for several policies at once, on a thread for each core, with the same results."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        running = {name: pool.submit(run_trials, policy, worlds, **options) for name, policy in policies.items()}
        return {name: trial.result() for name, trial in running.items()}


def _hits(policy: Any, world: World, replan_every: int) -> bool:
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
    return world.hit
