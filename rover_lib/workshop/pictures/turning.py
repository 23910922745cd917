"""Which way the cars of recordings steer, drive by drive, which pictures are mirrored, and which are late.

Steering is correlated with the horizontal shift of the pictures' upper part between frames (optical flow), at the delay
with the strongest correlation, which is judged as one of far fewer, independent frames (Bartlett's formula).
"""

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain, pairwise
from typing import Any

import cv2
import numpy as np

from rover_lib.onboard.errors import EpisodeError
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Episode, Recordings, Sample, pick_evenly

WIDTH, UPPER = 96, 0.6  # pixels of the examined pictures; the share of their rows above the floor
STEP = 2  # frames from one examined picture to the next
POINTS = 80
WINDOW = (11, 11)
LEAST_POINTS = 8
LONGEST_DELAY_S = 0.4
SMOOTH = 5  # examined pictures
LEAST_PAIRS = 25
LEAST_SPREAD = 0.05  # standard deviation of steering, of full; with less, other motion decides the correlation
SURE = 2.2  # standard errors from no correlation
MOST_PAIRS = 1000  # of a drive, of its longest pieces: two minutes are enough for any
# Pictures show a turn USUAL_S after its steering in twelve public tubs and the demo, within 0.1 s.
DELAYS_S, USUAL_S = np.arange(-10, 21) / 10, 0.2
ON_TIME_S = 0.45  # from the usual delay
SURE_OF_DELAY = 5.0  # standard errors
CLOSE_S = 0.25  # between the examined pictures; farther apart ones do not tell a delay
WEAK = 0.6  # at a usual delay, of the strongest correlation: an oscillating steering agrees with later pictures too


@dataclass(frozen=True)
class Turning:
    """correlation: of steering with the shift of the background to the right. sure: its standard errors from 0.

    episode: its name, or that of the session that it is a piece of. spread: the standard deviation of steering, a share
    of full. pieces: the names of all its episodes. by_delay: at each of DELAYS_S, the standard errors from 0, negative
    where the correlation is; empty if that was not measured.
    """

    episode: str
    correlation: float | None
    sure: float
    spread: float
    pieces: tuple[str, ...] = ()
    by_delay: tuple[float, ...] = ()

    @property
    def side(self) -> str | None:
        """The side that positive steering turns to: "right" or "left"; None if too little shows it."""
        if self.correlation is None or self.spread < LEAST_SPREAD or self.sure < SURE:
            return None
        return "right" if self.correlation < 0 else "left"

    def words(self) -> str:
        if self.spread < LEAST_SPREAD:
            return f"{self.episode}: steers too little to tell which way (spread {self.spread:.2f} of {LEAST_SPREAD})"
        if self.correlation is None:
            return f"{self.episode}: too few pictures that move to tell which way it steers"
        correlation = f"correlation {self.correlation:+.2f}, {self.sure:.1f} standard errors"
        words = f"positive steering is {self.side}" if self.side else "not sure"
        return f"{self.episode}: {words} ({correlation}, steering spread {self.spread:.2f})"


@dataclass(frozen=True)
class Sides:
    """What several recordings say together. side: None if they are not sure. said: what their car's file says."""

    turnings: tuple[Turning, ...]
    said: str | None = None

    @property
    def side(self) -> str | None:
        # Each says little if it is short; together they may be sure.
        steered = [t for t in self.turnings if t.spread >= LEAST_SPREAD]
        signed = [math.copysign(t.sure, t.correlation) for t in steered if t.correlation]
        together = sum(signed) / math.sqrt(len(signed)) if signed else 0.0
        if abs(together) < SURE:
            return None
        return "right" if together < 0 else "left"

    @property
    def mirrored(self) -> list[str]:
        """The episodes whose pictures, or steering, are mirrored beside most of the others'."""
        if not self.side:
            return []
        others = [t.pieces for t in self.turnings if t.side not in (None, self.side)]
        return list(chain.from_iterable(others))

    @property
    def late_s(self) -> float | None:
        """By how much the pictures of all are later than the actions, negative if earlier; None if they are not."""
        measured = [t.by_delay for t in self.turnings if t.by_delay and t.spread >= LEAST_SPREAD]
        if not measured:
            return None
        together = np.abs(np.sum(measured, axis=0)) / math.sqrt(len(measured))
        strongest = int(together.argmax())
        usual = np.abs(DELAYS_S - USUAL_S) <= ON_TIME_S
        if usual[strongest] or together[strongest] < SURE_OF_DELAY:
            return None
        if together[usual].max() > WEAK * together[strongest]:
            return None
        return float(DELAYS_S[strongest]) - USUAL_S

    def lateness(self) -> str:
        """Say by how much the pictures are later or earlier than the actions, and what to do; empty if they are not."""
        late_s = self.late_s
        if late_s is None:
            return ""
        word = "later" if late_s > 0 else "earlier"
        seen = f"the pictures are some {abs(late_s):.1f} s {word} than the actions, as the car's turns show"
        return f"{seen}: record both by one clock"

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
    """Measure each drive, or at most `most` of them, evenly chosen; none of what is no car with one camera."""
    layout = recordings.layout
    if layout.action_names != ACTION_NAMES or len(layout.cameras) > 1:
        return Sides(())
    sessions: dict[str, list[Episode]] = {}
    for episode in recordings.episodes:  # the camera stays as it is while a session lasts
        sessions.setdefault(episode.session or episode.id, []).append(episode)
    drives = pick_evenly(list(sessions.values()), most or len(sessions))
    # OpenCV releases the interpreter's lock, so threads help.
    with ThreadPoolExecutor(min(16, os.cpu_count() or 1)) as pool:
        turnings = tuple(progress(pool.map(measure_turning, drives), desc="which way it steers", total=len(drives)))
    sides = {e.samples[0].car.positive for e in chain.from_iterable(drives)}
    # A LeRobotDataset, which states its rate, has no car's file.
    return Sides(turnings, sides.pop() if len(sides) == 1 and layout.rate_hz is None else None)


def with_late(recordings: Recordings, sides: Sides) -> Recordings:
    """Return the recordings, with a fault if their pictures are later or earlier than the actions."""
    if not (note := sides.lateness()):
        return recordings
    faults = Faults(recordings.root)
    faults.add(recordings.root, "late_pictures", note, len(recordings.samples))
    return replace(recordings, faults=(*recordings.faults, *faults.listed()))


def measure_turning(drive: Sequence[Episode]) -> Turning:
    """Measure one drive of one camera, by its longest pieces."""
    pieces = list[Sequence[Sample]]()
    budget = STEP * MOST_PAIRS
    for episode in sorted(drive, key=lambda e: -len(e.samples)):
        begin = max(0, len(episode.samples) - budget) // 2
        pieces.append(episode.samples[begin : begin + budget])
        budget -= len(pieces[-1])
        if budget < STEP * LEAST_PAIRS:
            break
    steering = np.array([s.chunk[0, 0] for s in chain.from_iterable(pieces)], float)
    names = tuple(e.id for e in drive)
    best = Turning(drive[0].session or names[0], None, 0.0, float(steering.std()), names)
    if best.spread < LEAST_SPREAD / 2:
        return best  # and no picture has to be read
    try:
        shifts = [_shifts(samples) for samples in pieces]
    except EpisodeError:
        return best
    shift = np.concatenate([of for _, of in shifts])
    if len(shift) < LEAST_PAIRS:
        return best
    shift = _smooth(shift)
    recorded = [(np.array([s.time_s for s in of]), np.array([s.chunk[0, 0] for s in of], float)) for of in pieces]

    def correlate(delay_s: float) -> tuple[float, float]:
        """Return how the shift correlates with the steering `delay_s` earlier, and its standard errors from 0."""
        steered = []
        for (every_s, actions), (times_s, _) in zip(recorded, shifts, strict=True):
            steered.append(np.interp(times_s - delay_s, every_s, actions))
        return _correlation(_smooth(np.concatenate(steered)), shift) or (0.0, 0.0)

    for delay_s in np.linspace(0, LONGEST_DELAY_S, 7):
        correlation, sure = correlate(delay_s)
        if sure > best.sure:
            best = replace(best, correlation=correlation, sure=sure)
    if np.median(np.diff(np.concatenate([times_s for times_s, _ in shifts]))) > CLOSE_S:
        return best
    by_delay = [math.copysign(sure, correlation) for correlation, sure in map(correlate, DELAYS_S)]
    return replace(best, by_delay=tuple(by_delay))


def _shifts(samples: Sequence[Sample]) -> tuple[np.ndarray, np.ndarray]:
    """Return when two pictures were compared, in seconds, and how fast the background moved right, in pixels/s."""
    times_s = []
    shifts = []
    grey = lru_cache(1)(_grey)  # the second picture of a pair is the first one of the next
    for first, second in pairwise(samples[::STEP]):
        if second.row - first.row == STEP and (shift := _shift(grey(first), grey(second))) is not None:
            times_s.append((first.time_s + second.time_s) / 2)
            shifts.append(shift / (second.time_s - first.time_s))
    return np.array(times_s), np.array(shifts)


def _grey(sample: Sample) -> np.ndarray:
    grey = cv2.cvtColor(sample.frame_bgr(WIDTH), cv2.COLOR_BGR2GRAY)
    height = round(WIDTH * grey.shape[0] / grey.shape[1])
    return cv2.resize(grey, (WIDTH, height), interpolation=cv2.INTER_AREA)


def _shift(before: np.ndarray, after: np.ndarray) -> float | None:
    points = cv2.goodFeaturesToTrack(before[: round(UPPER * len(before))], POINTS, 0.01, 3)
    if points is None:
        return None
    flow: Any = cv2.calcOpticalFlowPyrLK  # OpenCV's types do not know that it finds where to begin
    there, status, _ = flow(before, after, points, None, winSize=WINDOW, maxLevel=3)
    back, again, _ = flow(after, before, there, None, winSize=WINDOW, maxLevel=3)
    good = (status[:, 0] == 1) & (again[:, 0] == 1) & (np.abs(back - points).max((1, 2)) < 0.5)
    return float(np.median((there - points)[good, 0, 0])) if good.sum() >= LEAST_POINTS else None


def _smooth(values: np.ndarray) -> np.ndarray:
    kernel = np.ones(SMOOTH)
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")


def _correlation(x: np.ndarray, y: np.ndarray) -> tuple[float, float] | None:
    """Return the correlation of two series, and how many standard errors it is from 0; None if one does not vary."""
    x = x - x.mean()
    y = y - y.mean()
    n = len(x)
    norm = math.sqrt((x @ x) * (y @ y))
    if norm < 1e-9:
        return None
    r = float(x @ y) / norm
    lags = np.arange(1, n // 2)
    together = float((1 - lags / n) @ (_autocovariance(x)[lags] * _autocovariance(y)[lags])) / norm**2
    independent = min(max(n / max(1 + 2 * together, 1), 4), n)
    return r, math.atanh(min(abs(r), 0.999)) * math.sqrt(independent - 3)


def _autocovariance(x: np.ndarray) -> np.ndarray:
    """Return the sum of x[k:] * x[:-k] for each lag k, (n,), by Fourier's transform: one by one takes a second."""
    return np.fft.irfft(np.abs(np.fft.rfft(x, 2 * len(x))) ** 2, 2 * len(x))[: len(x)]
