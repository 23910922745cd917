"""Record an expert's drives through balloon worlds as episodes in the user's format."""

import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from balloon_world import world as world_module
from balloon_world.level import EASY, HARD, Level, level_in_key
from balloon_world.world import FRAME_HEIGHT, FRAME_WIDTH, RATE_HZ, World, expert
from rover_lib.onboard.car import pwm as pwm_module
from rover_lib.onboard.car.car import this_car
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US
from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.recording import episode as recording
from rover_lib.onboard.recording.episode import About, EpisodeWriter
from rover_lib.workshop.cache import key_of
from rover_lib.workshop.progress import Progress, silent

LABEL = "hit red balloon"
JPEG_QUALITY = 85
PORT = "playground"  # of its Arduino
# Without shoves the expert never shows how to come back on course, and the policy never learns it.
SHOVES = {EASY: 2, HARD: 4}
MARKER = ".recorded.json"
# An invented time, so that a seed's recording has the same bytes every time.
FIRST_DRIVE = datetime(2025, 1, 1, 12, tzinfo=UTC)
BETWEEN_DRIVES = timedelta(seconds=30)
FIRST_WORLD = 1_000_000  # far from the worlds that trials drive in
CONTROL_LATENCY_S = 0.004  # how long after its frame a control arrives over the serial line


def record_episodes(
    out_dir: Path | str, count: int = 80, seed: int = 0, progress: Progress = silent, level: Level = EASY
) -> Path:
    """Let the expert drive through `count` worlds, with shoves that it corrects; record an episode folder per drive.

    out_dir: appears complete or not at all; if it already holds the same recording, it is left as it is. One that
    another version recorded, and nobody has touched since, is replaced. level: of the worlds.
    Returns out_dir. On one machine the same count and seed give the same bytes.
    Raises TrainingError for a negative seed, or an out_dir with something else in it.
    """
    out_dir = Path(out_dir)
    names = {episode_name(_start_of(index, seed)) for index in range(count)}
    made_of = {"count": count, "seed": seed, "jpeg_quality": JPEG_QUALITY, "cv2": cv2.__version__}
    made_of |= {"shoves": SHOVES[level], "car": this_car().description(), **level_in_key(level)}
    key = key_of(made_of, world_module, recording, pwm_module, sys.modules[__name__])
    if out_dir.exists() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        if _marker_of(out_dir).get("key") == key:
            return out_dir
        if not _is_untouched(out_dir, names | {MARKER}):
            raise TrainingError(f"{out_dir}: exists and is not this recording", remedy="name another folder")
    # OpenCV releases the interpreter's lock while it draws and compresses, so threads help.
    with build_folder(out_dir) as new, ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        drives = pool.map(lambda index: record_drive(new, index, seed, level), range(count))
        hits = sum(progress(drives, desc="recording", total=count))
        (new / MARKER).write_text(json.dumps({"key": key, "count": count, "seed": seed, "hits": hits}) + "\n")
        if out_dir.exists() and not any(out_dir.iterdir()):
            out_dir.rmdir()  # the recording takes its place whole
    return out_dir


def _marker_of(folder: Path) -> dict[str, Any]:
    try:
        return dict(json.loads((folder / MARKER).read_text()))
    except (OSError, ValueError, TypeError):
        return {}


def _is_untouched(folder: Path, names: set[str]) -> bool:
    """Whether a recording has these names and no others, and no file that is newer than its marker."""
    if not _marker_of(folder) or {path.name for path in folder.iterdir()} != names:
        return False
    marked_ns = (folder / MARKER).stat().st_mtime_ns
    return all(path.stat().st_mtime_ns <= marked_ns for path in folder.rglob("*") if path.is_file())


def record_drive(folder: Path, index: int, seed: int, level: Level = EASY) -> bool:
    """Record drive number `index` of a seed into folder/episode_YYYYMMDD_HHMMSS; return whether it hit the balloon."""
    world = World(FIRST_WORLD * (seed + 1) + index, shoves=SHOVES[level], level=level)
    with WorldEpisode(folder, _start_of(index, seed), world) as episode:
        while not world.done:
            # The car drives by what the recording says: the action as the Arduino measures it.
            world.step(*episode.tick(*expert(world)))
    return world.hit


def _start_of(index: int, seed: int) -> datetime:
    return FIRST_DRIVE + timedelta(days=seed) + index * BETWEEN_DRIVES


def episode_name(start: datetime) -> str:
    """Return the name of the folder of a drive that began at `start`."""
    return f"episode_{start:%Y%m%d_%H%M%S}"


class WorldEpisode:
    """Record a drive in a world into folder/episode_YYYYMMDD_HHMMSS, named by its start.

    A context manager; the folder appears when it is left without an error. Raises EpisodeError as EpisodeWriter does.
    """

    def __init__(self, folder: Path, start: datetime, world: World):
        car = this_car()
        self._world = world
        self._pwm = car.pwm
        self._start_s = start.timestamp()
        self._periods = [_round_us(c.period_us) for c in (self._pwm.steering, self._pwm.throttle)]
        description = About(LABEL, fps=RATE_HZ, start_time_s=self._start_s, arduino_port=PORT, car=car)
        size = FRAME_WIDTH, FRAME_HEIGHT
        self.writer = EpisodeWriter(
            folder / episode_name(start), description, resolution=size, jpeg_quality=JPEG_QUALITY
        )
        self.writer.metadata["steering_positive"] = car.positive

    def __enter__(self) -> "WorldEpisode":
        self.writer.open()
        return self

    def __exit__(self, *error: Any) -> None:
        self.writer.__exit__(*error)

    def tick(self, steering: float, throttle: float, **extra: Any) -> tuple[float, float]:
        """Record what the camera sees now and what is commanded.

        extra: further columns of the control. Returns (steering, throttle) as the Arduino would measure them.
        """
        t_s = self._world.state.time_s
        self.writer.frame(self._start_s + t_s, self._world.render())
        pulses = self._pwm.pulses(steering, throttle)
        pulses_us = _round_us(pulses.steering_us), _round_us(pulses.throttle_us)
        at_s = self._start_s + t_s + CONTROL_LATENCY_S
        self.writer.control(at_s, round(1000 * t_s), *pulses_us, *self._periods, **extra)
        sent_steering, sent_throttle = self._pwm.actions(*pulses_us, *self._periods)
        assert sent_steering is not None and sent_throttle is not None, "what is commanded is measurable"
        return sent_steering, sent_throttle


def _round_us(pulse_us: float) -> int:
    """Round a pulse to the steps of the Arduino's timer."""
    return int(np.round(pulse_us / ARDUINO_STEP_US)) * ARDUINO_STEP_US
