"""gymnasium's CarRacing-v3 as a world to record and to drive in, with the physics and the tracks as they are.

    python -m research.car_racing WORK OUTPUT.json [TRACKS]  # needs: pip install gymnasium box2d pygame

records DRIVES drives of a scripted driver into WORK, trains a policy and makes its artifacts by `rover train` and
`rover run`, and drives FP32 and static along the same tracks. What is in WORK is not made again.

Its own picture takes 20 ms or more, so what it shows is drawn here, 128x72 and from above: the road, the car, its speed
as a bar. A drive ends with its time, or once the car's middle is half a road's width beside the road.
"""

import json
import math
import subprocess
import sys
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from gymnasium.envs.box2d.car_dynamics import Car
from gymnasium.envs.box2d.car_racing import TRACK_DETAIL_STEP, TRACK_WIDTH, CarRacing

from balloon_world.drives import drive_missing
from balloon_world.record import FIRST_DRIVE, episode_name
from rover_lib.onboard.car.car import this_car
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US
from rover_lib.onboard.recording.episode import About, EpisodeWriter
from rover_lib.onboard.stage import plain, sha256_of, write_stage

RATE_HZ, TIMEOUT_S, LEFT_M = 25.0, 8.0, 1.5 * TRACK_WIDTH
WIDTH, HEIGHT, PX_PER_M, CAR_ROW = 128, 72, 1.6, 58
GRASS, CAR_COLOUR, BAR = (102, 204, 102), (0, 0, 204), (255, 255, 255)  # BGR
TOP_SPEED = 50.0  # of the bar
SHOVE, SHOVE_TICKS = 0.3, 5  # somebody pulls the wheel
DRIVES, SEED, REPLAN, DRAWS = 100, 10_000, 8, 10_000


class _Unseen(CarRacing):  # type: ignore[misc]
    """The environment without its own pictures."""

    def _render(self, mode: str) -> None: ...


class Track:
    """One drive along a track. seed: determines it, and the pulls at its wheel. `score` is in metres."""

    def __init__(self, seed: int, shoves: int = 0, timeout_s: float = TIMEOUT_S):
        self._env: Any = _Unseen(lap_complete_percent=1.0)
        self._env.reset(seed=seed)
        self._line = np.array([(x, y) for _, _, x, y in self._env.track])
        self._angles = np.unwrap([beta for _, beta, _, _ in self._env.track])
        self._quads = np.array([quad for quad, _ in self._env.road_poly])
        self._colours = [tuple(float(c) for c in colour) for _, colour in self._env.road_poly]
        self._ticks = RATE_HZ * timeout_s
        rng = np.random.default_rng([seed, 25])
        self._shoves = {int(t): rng.choice([-1, 1]) for t in rng.uniform(20, self._ticks, shoves)}
        self.restart()

    def restart(self) -> "Track":
        """Put the car on the start again."""
        if self._env.car:
            self._env.car.destroy()
        self._env.car = Car(self._env.world, *self._env.track[0][1:4])
        self._at, self.score, self.ticks, self.done = 0, 0.0, 0, False
        return self

    def _seen(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) metres to the car's right and ahead of it."""
        hull = self._env.car.hull
        cos, sin = math.cos(hull.angle), math.sin(hull.angle)
        return (points - np.array(hull.position)) @ np.array([[cos, -sin], [sin, cos]])

    @property
    def speed(self) -> float:
        return float(self._env.car.hull.linearVelocity.length)

    def step(self, steering: float, throttle: float) -> None:
        """Drive for a tick. Positive steering turns right; throttle above a half is gas, below it brakes."""
        action = np.array([steering, max(0.0, 2 * throttle - 1), max(0.0, 1 - 2 * throttle)])
        for start, side in self._shoves.items():
            action[0] += side * SHOVE * (start <= self.ticks < start + SHOVE_TICKS)
        for _ in range(2):  # its physics has 50 Hz
            self._env.step(action)
        self.ticks += 1
        near = np.arange(self._at, self._at + 12) % len(self._line)
        away = np.linalg.norm(self._line[near] - np.array(self._env.car.hull.position), axis=1)
        self._at += int(away.argmin())
        self.score = self._at * TRACK_DETAIL_STEP
        self.done = away.min() > LEFT_M or self.ticks >= self._ticks or self._at >= len(self._line) - 1

    def expert(self) -> tuple[float, float]:
        """Return what a good driver does now: pure pursuit of the road's middle, slower where it turns."""
        right, ahead = self._seen(self._line[(self._at + 3 + round(0.12 * self.speed)) % len(self._line)])
        coming = self._angles[min(self._at + 16, len(self._line) - 1)] - self._angles[self._at]
        target = np.clip(64 - 60 * abs(coming), 23, 64)
        throttle = np.clip(0.5 + 0.04 * (target - self.speed), 0.2, 0.87)
        return float(np.clip(1.2 * math.atan2(right, ahead), -1, 1)), float(throttle)

    def render(self) -> np.ndarray:
        """(72, 128, 3) uint8 BGR, from above, the car's front up."""
        frame = np.full((HEIGHT, WIDTH, 3), GRASS, np.uint8)
        quads = self._seen(self._quads)
        px = np.stack([WIDTH / 2 + PX_PER_M * quads[..., 0], CAR_ROW - PX_PER_M * quads[..., 1]], -1)
        near = np.abs(px - (WIDTH / 2, HEIGHT / 2)).max((1, 2)) < WIDTH
        fixed = np.round(px * 16).astype(np.int32)
        for i in np.flatnonzero(near):
            cv2.fillConvexPoly(frame, fixed[i], self._colours[i], shift=4)
        cv2.rectangle(frame, (WIDTH // 2 - 2, CAR_ROW - 4), (WIDTH // 2 + 2, CAR_ROW + 4), CAR_COLOUR, -1)
        cv2.line(frame, (0, HEIGHT - 2), (round(WIDTH * min(1.0, self.speed / TOP_SPEED)), HEIGHT - 2), BAR, 2)
        return frame


def record_drive(folder: Path, index: int, seed: int) -> None:
    """Record the driver's drive number `index` of a seed as an episode in `folder`, with pulls at the wheel."""
    car = this_car()
    start = FIRST_DRIVE + timedelta(days=seed, seconds=30 * index)
    periods = [round(c.period_us / ARDUINO_STEP_US) * ARDUINO_STEP_US for c in (car.pwm.steering, car.pwm.throttle)]
    about = About("follow the road", fps=RATE_HZ, start_time_s=start.timestamp(), car=car)
    track = Track(1_000_000 * (seed + 1) + index, shoves=4)
    with EpisodeWriter(folder / episode_name(start), about, resolution=(WIDTH, HEIGHT)) as episode:
        while not track.done:
            at_s = start.timestamp() + track.ticks / RATE_HZ
            pulses = car.pwm.pulses(*track.expert())
            us = [round(p / ARDUINO_STEP_US) * ARDUINO_STEP_US for p in (pulses.steering_us, pulses.throttle_us)]
            episode.frame(at_s, track.render())
            episode.control(at_s + 0.004, round(1000 * track.ticks / RATE_HZ), *us, *periods)
            steering, throttle = car.pwm.actions(*us, *periods)
            track.step(float(steering or 0), float(throttle or 0))


def metres(track: Track, plan: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> float:
    """Drive along a track by the first REPLAN actions of each plan; return how far the car got."""
    state = np.zeros(2, np.float32)
    while not track.done:
        for steering, throttle in plan(track.render(), state)[:REPLAN]:
            state = np.array([np.clip(steering, -1, 1), np.clip(throttle, 0, 1)], np.float32)
            track.step(*map(float, state))
            if track.done:
                break
    return track.score


def compare(fp32_m: np.ndarray, static_m: np.ndarray) -> dict[str, float]:
    """Return what static loses of FP32's mean metres, in %, with the 95 % interval of a bootstrap over tracks."""
    drawn = np.random.default_rng(0).integers(0, len(fp32_m), (DRAWS, len(fp32_m)))
    lost_pct = 100 * (1 - static_m[drawn].mean(1) / fp32_m[drawn].mean(1))
    low, high = np.percentile(lost_pct, [2.5, 97.5])
    return {"lost_pct": 100 * (1 - static_m.mean() / fp32_m.mean()), "low_pct": low, "high_pct": high}


def main(work: Path, output: Path, tracks: int = 100) -> None:
    """Record, train, export and drive, as far as it is not done, and write the stage to `output`."""
    episodes, checkpoint, run = work / "episodes", work / "best_model.pth", work / "racing"
    for index in range(DRIVES):
        if not (episodes / episode_name(FIRST_DRIVE + timedelta(seconds=30 * index))).exists():
            record_drive(episodes, index, 0)
    rover = [sys.executable, "-m", "rover_lib.cli"]
    if not checkpoint.exists():
        subprocess.run([*rover, "train", str(episodes), str(checkpoint), "--backbone", "none"], check=True)
    if not (run / "run.json").exists():
        words = [*rover, "run", str(checkpoint), str(episodes), "--name", run.name, "--runs-dir", str(work)]
        subprocess.run([*words, "-p", "modes", "[static]"], check=False)  # its gates may say no, and it drives here
    metres_by = {}
    for mode in ("fp32", "static"):
        artifact = run / f"policy_{mode}.pt"

        def one(policy: Any, question: tuple[str, int]) -> dict[str, float]:
            return {"metres": metres(Track(question[1]), policy.predict_chunk)}

        questions = [(sha256_of(artifact), SEED + i) for i in range(tracks)]
        rows = drive_missing(artifact, questions, one, work / "drives.jsonl")
        metres_by[mode] = np.array([rows[question]["metres"] for question in questions])
    driver = []
    for seed in range(SEED, SEED + tracks):
        track = Track(seed)
        while not track.done:
            track.step(*track.expert())
        driver.append(track.score)
    metres_by["driver"] = np.array(driver)
    metrics = {f"{name}_m": lengths.mean() for name, lengths in metres_by.items()}
    metrics |= compare(metres_by["fp32"], metres_by["static"])
    settings = {"tracks": tracks, "seed": SEED, "drives": DRIVES, "replan_every": REPLAN, "timeout_s": TIMEOUT_S}
    write_stage(output, "racing", params=settings, metrics=metrics, inputs={checkpoint.name: sha256_of(checkpoint)})
    print(json.dumps(plain(metrics), indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
