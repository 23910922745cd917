"""Is a stuck car stopped, and no other? `python -m research.stuck OUTPUT RUN_OR_ARTIFACT [RECORDINGS]`.

The loop of `rover drive`, in virtual time, drives a policy through unseen balloon worlds: freely, and against a wall.
Recordings are watched as they were driven, and in kinds of light: driving, and standing at one of their pictures.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from balloon_world.drives import NoLog, TimedCar, everywhere
from balloon_world.world import RATE_HZ, World
from rover_lib.onboard.car.camera import Frame
from rover_lib.onboard.drive.motion import EVERY_S, MOVED, Motion, cells_of, difference
from rover_lib.onboard.drive.plan import OFF, Settings
from rover_lib.onboard.errors import DriveFault
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import Policy
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import Sample

SEED, LATENCY_S, WITHIN_S = 40_000, 0.15, 2.0
NOISE = 3  # grey levels of the camera's, as balloon_world/car.py has
Light = tuple[float | None, float, float]  # a picture's mean (None: as it is), its noise, and a lamp's flicker
LIGHTS: dict[str, Light] = {
    **{f"mean {mean}, noise {noise}": (mean, noise, 0.0) for mean in (180, 60, 40, 25, 16, 10) for noise in (2, 4, 8)},
    **{f"flickers by {share:.0%}": (None, 2.0, share) for share in (0.05, 0.1, 0.2, 0.3)},
    "mean 25, noise 8, flickers by 10%": (25, 8.0, 0.1),
}
ROWS_S, STAND_PICTURES = 0.025, 20  # time in which a camera reads its rows; 2 s


class _Walled(World):
    """A world with a wall that the car drives into at wall_s: from then on it stands, and its clock runs on."""

    def __init__(self, seed: int, wall_s: float):
        super().__init__(seed)
        self._wall_s = wall_s

    def step(self, steering: float, throttle: float, dt: float = 1 / RATE_HZ) -> None:
        before = self.state
        super().step(steering, throttle, dt)
        if before.time_s >= self._wall_s:
            self.state = replace(before, time_s=self.state.time_s, speed_mps=0.0)


class _SeeingCar(TimedCar):
    """A timed car whose camera shows the loop what is to be seen, with noise, ten times a second."""

    draws = True
    _frame: Frame | None = None

    def latest(self) -> Frame:
        blind = super().latest()
        if self._frame is None or blind.captured_s - self._frame.captured_s >= EVERY_S - 1e-6:
            noise = np.random.default_rng(blind.number).integers(0, NOISE, (360, 640, 3), np.uint8)
            self._frame = replace(blind, image=cv2.add(self.world.render(), noise))
        return replace(blind, image=self._frame.image, captured_s=self._frame.captured_s)


def drive_stuck(policy: Policy, asked: tuple[str, int]) -> tuple[str, float]:
    """Drive once; return how it ended, and how long after the wall (s). asked: "good" or "wall", and the seed."""
    kind, seed = asked
    wall_s = 0.5 + (seed % 10) / 10 if kind == "wall" else 1e9
    car = _SeeingCar(_Walled(seed, wall_s), policy, LATENCY_S)
    outcome = car.drive(Settings.of(params()["drive"], unfamiliar=OFF), NoLog()).outcome
    return outcome, car.world.state.time_s - wall_s


def watch_recording(samples: Sequence[Sample], stuck_s: float) -> dict[str, Any]:
    """Watch what was recorded: whether a car would have been stopped, and its longest throttle without motion."""
    motion, longest_s = Motion(stuck_s), 0.0
    for i, sample in enumerate(samples):
        try:
            motion.watch(Frame(sample.frame_bgr(), sample.time_s, i, 0, 100.0, 40.0), float(sample.chunk[0, 1]))
        except DriveFault:
            return {"stopped": True, "longest_still_s": stuck_s}
        longest_s = max(longest_s, motion.still_s)
    return {"stopped": False, "longest_still_s": round(longest_s, 2)}


def in_light(image: np.ndarray, light: Light, at_s: float, rng: Any) -> np.ndarray:
    """Return a picture of 640x480 as a camera would give it in that light, (480, 640, 3) uint8, after JPEG."""
    mean, noise, flicker = light
    lit = cv2.resize(image, (640, 480), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    lit *= mean / max(float(lit.mean()), 1.0) if mean else 1.0
    row_s = at_s + np.arange(480) / 480 * ROWS_S
    lit *= (1 + flicker * np.sin(2 * np.pi * 100 * row_s))[:, None, None].astype(np.float32)
    lit += noise * rng.standard_normal(lit.shape, np.float32)
    packed = cv2.imencode(".jpg", np.clip(lit, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR))


def watch_in_light(samples: Sequence[Sample], light: Light) -> tuple[float, float]:
    """Return the largest difference that a standing car sees in 2 s, and the least that a driving one sees in 0.5 s."""
    rng, times_s = np.random.default_rng(0), [sample.time_s for sample in samples]
    at_s = np.arange(times_s[0], times_s[-1], EVERY_S)[:STAND_PICTURES].tolist()
    pictures = [samples[int(np.abs(np.subtract(times_s, t)).argmin())].frame_bgr() for t in at_s]
    drives = [cells_of(in_light(image, light, 1.003 * t, rng)) for t, image in zip(at_s, pictures, strict=True)]
    stands = [cells_of(in_light(pictures[len(pictures) // 2], light, 1.003 * t, rng)) for t in at_s]
    differences = [max(difference(now, drives[i]) for now in drives[i + 1 : i + 6]) for i in range(len(drives) - 5)]
    return max(difference(now, stands[0]) for now in stands[1:]), min(differences)


def study(artifact: Path, recordings: Path | None, walls: int = 50, good: int = 200) -> dict[str, Any]:
    """Return the metrics of stage `stuck`. artifact: drives. recordings: a folder of recordings, or None."""
    cv2.setNumThreads(1)
    questions = [("wall", SEED + i) for i in range(walls)] + [("good", SEED + i) for i in range(good)]
    endings = dict(everywhere(artifact, questions, drive_stuck))
    after_s = [s for key, (outcome, s) in sorted(endings.items()) if key[0] == "wall" and outcome == "stopped"]
    outcomes = [outcome for (kind, _), (outcome, _) in endings.items() if kind == "good"]
    metrics: dict[str, Any] = {
        "walls": walls,
        "walls_stopped_in_time": sum(s <= WITHIN_S for s in after_s),
        "wall_to_stop_max_s": max(after_s, default=None),
        "good_drives": good,
        "good_stopped": outcomes.count("stopped"),
        "good_hits": outcomes.count("hit"),
        "moved_limit": MOVED,
    }
    episodes = load_recordings(recordings).episodes if recordings else ()
    for episode in episodes:
        metrics[episode.path.name] = watch_recording(episode.samples, params()["drive"]["stuck_s"])
    if episodes:
        metrics["lights"] = {}
        for name, light in LIGHTS.items():
            stands, drives = zip(*(watch_in_light(e.samples, light) for e in episodes), strict=True)
            metrics["lights"][name] = {"standing_most": round(max(stands), 2), "driving_least": round(min(drives), 2)}
    return metrics


if __name__ == "__main__":
    output, run_dir, *more = map(Path, sys.argv[1:])
    metrics = study(run_dir if run_dir.is_file() else run_dir / "policy_static.pt", more[0] if more else None)
    write_stage(output, "stuck", params={"stuck_s": params()["drive"]["stuck_s"]}, metrics=metrics)
