"""Does a policy stop where it has seen nothing like it, and only there? `python -m research.strange OUTPUT`.

Drives through unseen balloon worlds in closed loop and virtual time. From CHANGE_S on something may be strange; the
drive goes on to its end, so that its outcome is known, and whether the car would have been stopped before.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np

from balloon_world.drives import NoLog, TimedCar, drive_missing, wilson_interval
from balloon_world.level import EASY
from balloon_world.record import SHOVES
from balloon_world.world import HORIZON_ROW as WALL
from balloon_world.world import RATE_HZ, World
from rover_lib.onboard.cli import FILE, show
from rover_lib.onboard.drive.plan import OFF, Settings, Smoother
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import Policy, load_policy
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop.progress import Progress, silent, terminal_bar
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import Episode

SEED = 30_000  # of the first world: not of those on which the scores were chosen
OTHER = 20_000  # from a world's seed to that of the world whose look or pictures it gets
CHANGE_S, LATE_S = 0.5, 0.1  # LATE_S: of a plan, as on a Pi 5
BEFORE_S, AFTER_S = 0.5, 1.0  # a stop is in time 0.5 s before the car passes the balloon, or within 1 s of the change
TURNED_RAD, BLUR_PX, HUE, DUSK = math.radians(15), 15, 40, 0.3
GOOD = ("driven", "pushed")
ASIDE_RAD = 0.48  # 99 % of recorded pictures have the balloon nearer to the middle; the edge is at 0.67
ROOM = "another room's pictures"  # where there are recordings of one
BESIDE = ("a film of another world", "mirrored", "a wall like a floor")  # of which nothing is promised


def _turned(world: "StrangeWorld", frame: np.ndarray) -> np.ndarray:
    side, state = 1 if world.seed % 2 else -1, world.state
    world.state = replace(state, heading_rad=state.heading_rad + side * TURNED_RAD)
    frame, world.state = World.render(world), state
    return frame


def _hue(world: World, frame: np.ndarray) -> np.ndarray:
    hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
    hsv[..., 0] = (hsv[..., 0].astype(int) + HUE) % 180
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)


def _look(world: "StrangeWorld", frame: np.ndarray) -> np.ndarray:
    other = world.other
    other.state, other.balloon, other.distractors = world.state, world.balloon, world.distractors
    return other.render()


def _room(world: "StrangeWorld", frame: np.ndarray) -> np.ndarray:
    samples = world.rooms[world.seed % len(world.rooms)].samples
    return samples[round(world.state.time_s * RATE_HZ) % len(samples)].frame_bgr()


def _film(world: "StrangeWorld", frame: np.ndarray) -> np.ndarray:
    world.other.state = replace(world.other.state, x_m=0.5 * world.state.time_s)  # moves, but not with the car
    return world.other.render()


HOW = {
    "camera turned": _turned,
    "half covered": lambda world, frame: cv2.rectangle(frame, (0, 0), (319, 359), (30, 35, 50), cv2.FILLED),
    "blurred": lambda world, frame: cv2.GaussianBlur(frame, (0, 0), BLUR_PX),
    "dusk": lambda world, frame: (frame * DUSK).astype(np.uint8),
    "hue": _hue,
    "another world's look": _look,
    ROOM: _room,
    "a film of another world": _film,
    "mirrored": lambda world, frame: np.ascontiguousarray(frame[:, ::-1]),
    "a wall like a floor": lambda world, frame: np.concatenate([frame[2 * WALL - 1 : WALL - 1 : -1], frame[WALL:]]),
}


class StrangeWorld(World):
    """A world that is strange in one way, a name of HOW, from CHANGE_S on."""

    def __init__(self, seed: int, how: str, rooms: Sequence[Episode] = ()):
        super().__init__(seed)
        self._how, self.other, self.rooms = how, World(seed + OTHER), rooms

    def render(self) -> np.ndarray:
        frame = super().render()
        return frame if self.state.time_s < CHANGE_S else HOW[self._how](self, frame)


def judge_strangeness(
    run_dir: Path, worlds: int, each: int, real: Path | None, kept: Path, progress: Progress = silent
) -> dict[str, Any]:
    """Drive what is not among the rows of the file `kept`, and return the metrics of stage `strange`.

    run_dir: a run. worlds: good drives of each kind. each: drives of each strangeness.
    real: recordings from elsewhere. Raises RoverError for a run whose artifacts have no threshold.
    """
    cv2.setNumThreads(1)
    artifact = run_dir / "policy_static.pt"
    policy = load_policy(artifact, threads=1)
    if "familiar" not in policy.manifest:
        raise RoverError(f"{artifact}: tells nothing unfamiliar", remedy="record more drives, see quantize.json")
    rooms = load_recordings(real, policy.chunk, params()["calibration"]["sync_s"]).episodes if real else ()

    def one(policy: Policy, question: tuple[str, int]) -> dict[str, Any]:
        kind, seed = question
        if kind in HOW:
            return _drive(policy, StrangeWorld(seed, kind, rooms))
        return _drive(policy, World(seed, SHOVES[EASY] * (kind == "pushed")))

    strange = [kind for kind in HOW if rooms or kind != ROOM]
    counts = dict.fromkeys(GOOD, worlds) | dict.fromkeys(strange, each)
    questions = [(kind, SEED + i) for kind, count in counts.items() for i in range(count)]
    drives = drive_missing(artifact, questions, one, kept, progress)
    rows = {kind: [row | _told(row) for key, row in drives.items() if key[0] == kind] for kind in counts}
    failed = [row for kind in strange if kind not in BESIDE for row in rows[kind] if row["outcome"] != "hit"]
    return {
        "threshold_drives": policy.manifest["familiar"]["drives"],
        "good_stopped": {kind: _share([row["stopped"] for row in rows[kind]]) for kind in GOOD},
        "strange": {kind: _judge(rows[kind]) for kind in strange},
        "failed_in_time": _share([row["in_time"] for row in failed]),
        "pushed_aside": _share([row["stopped"] for row in rows["pushed"] if row["aside_rad"] > ASIDE_RAD]),
        "rooms": {episode.path.name: _of_recording(policy, episode) for episode in rooms},
    }


def _drive(policy: Policy, world: World) -> dict[str, Any]:
    """Drive to the end, whatever is unfamiliar. The lists have a value for each plan, smoothed."""
    car = TimedCar(world, policy, LATE_S)
    outcome = car.drive(Settings.of(params()["drive"], unfamiliar=OFF), NoLog()).outcome
    places = list[tuple[float, float]]()
    for state in world.trajectory:
        world.state = state
        places.append(world.balloon_seen())
    away_m, aside_rad = zip(*places, strict=True)
    row = {"outcome": outcome, "passed_s": world.trajectory[int(np.argmin(away_m))].time_s}
    row |= {"aside_rad": max(map(abs, aside_rad)), "s": [plan.ready_s for plan in car.plans]}
    smoother = Smoother()
    return row | {"strange": [smoother.add(plan.strange or 0.0) for plan in car.plans]}


def _unfamiliar(policy: Policy, frame: np.ndarray, state: np.ndarray) -> float:
    policy.predict_unclipped(frame, state)
    return policy.strange or 0.0


def _told(row: Mapping[str, Any]) -> dict[str, bool]:
    """Say whether a drive would have been stopped, and whether in time."""
    latest_s = max(CHANGE_S + AFTER_S, row["passed_s"] - BEFORE_S)
    in_time = any(value >= 1 and s <= latest_s for s, value in zip(row["s"], row["strange"], strict=False))
    return {"stopped": max(row["strange"]) >= 1, "in_time": in_time}


def _share(those: Sequence[bool]) -> dict[str, Any]:
    """Count, with the 95 % interval of the share."""
    low, high = wilson_interval(sum(those), len(those)) if those else (None, None)
    return {"count": sum(those), "of": len(those), "low": low, "high": high}


def _judge(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    failed = [row["in_time"] for row in rows if row["outcome"] != "hit"]
    stopped = sum(row["stopped"] for row in rows)
    return {"drives": len(rows), "stopped": stopped, "failed": len(failed), "in_time": sum(failed)}


def _of_recording(policy: Policy, episode: Episode) -> dict[str, Any]:
    """Say when a recording would have stopped the car, in seconds from its first picture, and how much of it would."""
    samples = episode.samples[:: round(LATE_S * RATE_HZ)]
    smoother = Smoother()
    strange = [smoother.add(_unfamiliar(policy, sample.frame_bgr(), sample.state)) for sample in samples]
    at_s = [sample.time_s - samples[0].time_s for sample, score in zip(samples, strange, strict=True) if score >= 1]
    return {"unfamiliar_s": min(at_s, default=None), "unfamiliar_share": len(at_s) / len(samples)}


@click.command()
@click.argument("output", type=FILE)
@click.option("--demo", type=FILE, default="runs/demo", show_default=True, help="A run, whose static artifact drives.")
@click.option("--worlds", type=click.IntRange(min=1), default=200, show_default=True, help="Good drives of each kind.")
@click.option("--each", type=click.IntRange(min=1), default=60, show_default=True, help="Drives of each strangeness.")
@click.option("--real", type=FILE, help="Recordings of another room, to be unfamiliar.")
def main(output: Path, demo: Path, worlds: int, each: int, real: Path | None) -> None:
    """Make the balloon world strange, and see whether the policy stops in time, and only then. Writes OUTPUT as JSON.

    Drives that were made are kept beside OUTPUT, and not made again.
    """
    metrics = judge_strangeness(demo, worlds, each, real, output.with_suffix(".jsonl"), terminal_bar())
    write_stage(output, "strange", params={"worlds": worlds, "each": each}, metrics=metrics)
    show(metrics, False)


if __name__ == "__main__":
    main()
