"""Which way the cars of recordings steer, episode by episode, and which pictures are mirrored."""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from rover_lib.onboard.recording.turning import LEAST_SPREAD, SURE, Turning, measure_turning
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Episode, Recordings, pick_evenly


@dataclass(frozen=True)
class Sides:
    """What several recordings say together. side: None if they are not sure. said: what their car's file says."""

    turnings: tuple[Turning, ...]
    said: str | None = None

    @property
    def side(self) -> str | None:
        # Each says little if it is short; together they may be sure.
        signed = [
            math.copysign(t.sure, t.correlation) for t in self.turnings if t.correlation and t.spread >= LEAST_SPREAD
        ]
        together = sum(signed) / math.sqrt(len(signed)) if signed else 0.0
        return None if abs(together) < SURE else "right" if together < 0 else "left"

    @property
    def mirrored(self) -> list[str]:
        """The episodes whose pictures, or steering, are mirrored beside most of the others'."""
        return [t.episode for t in self.turnings if self.side and t.side not in (None, self.side)]

    @property
    def denied(self) -> bool:
        """Whether the pictures show another side than the car's file says, as if all of them were mirrored."""
        return self.said is not None and self.side not in (None, self.said)

    def words(self) -> str:
        """Say it in one line; empty without a recording."""
        agree = sum(t.side == self.side for t in self.turnings if t.side)
        if not self.turnings:
            return ""
        if self.side is None:
            return f"which side positive steering turns to: {len(self.turnings)} episodes show too little to be sure"
        text = f"positive steering turns {self.side}, as the pictures of {agree} of {len(self.turnings)} episodes show"
        if self.denied:
            text += f", and their car's file says {self.said}: is the camera's picture mirrored?"
        return f"{text}; mirrored: {', '.join(self.mirrored)}" if self.mirrored else text


def measure_sides(recordings: Recordings, progress: Progress = silent, most: int | None = None) -> Sides:
    """Measure each episode, or at most `most` of them, evenly chosen; none of what is no car with one camera."""
    layout = recordings.layout
    if layout.action_names != ACTION_NAMES or len(layout.cameras) > 1:
        return Sides(())
    episodes = pick_evenly(recordings.episodes, most or len(recordings.episodes))

    def measure(e: Episode) -> Turning:
        return measure_turning(e.id, np.array([s.chunk[0, 0] for s in e.samples], float), e.samples)

    # OpenCV releases the interpreter's lock, so threads help.
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        turnings = tuple(progress(pool.map(measure, episodes), desc="which way it steers", total=len(episodes)))
    said = {s.car.positive for e in episodes for s in e.samples}
    # A LeRobotDataset, which states its rate, has no car's file.
    return Sides(turnings, said.pop() if len(said) == 1 and layout.rate_hz is None else None)
