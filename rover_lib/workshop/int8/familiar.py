"""What is familiar to a policy: fitted on recorded pictures, with a threshold from whole drives that it never saw.

    drives = Drives.of(loaded.parts)
    familiar, described = fit(drives, embed)

The threshold is split conformal prediction: the largest score, smoothed as on the rover, of n drives that neither
trained the policy nor fitted the scores. Of new drives like them, one in n + 1 goes beyond it, whatever the scores are;
with the MARGIN fewer do. Where blocks of long drives are held out, stretches of these are counted.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from rover_lib.onboard.drive.plan import Smoother
from rover_lib.onboard.policy.familiar import Familiar
from rover_lib.workshop.recordings.episodes import Split
from rover_lib.workshop.recordings.samples import Sample, block_of, frame_rate_hz, pick_evenly

DIRECTIONS = 64  # the demo's drives that failed were stopped a little more often than with 32
KNOWN_FRAMES = 640  # ten for each direction
FEWEST_DRIVES = 19  # one in 20 good drives is 5 %
MOST_DRIVES = 39  # one in 40; more would only raise the threshold
# The largest of 20 drives is partly chance: of draws from 200 recorded ones of the demo, 16 % let more than 5 % of good
# drives go beyond it, with this margin 9 %; all failing drives that were stopped still are.
MARGIN = 1.1
LEAST_STRETCH = 4  # pictures in a stretch of a block
EVERY_S = 0.1  # between the pictures of a drive, as between a Pi's plans
SHOWN = 6  # pictures
BETWEEN = 0.95  # of the interval of a rate


@dataclass(frozen=True)
class Drives:
    """What familiarity is fitted on: pictures of the drives that calibrate, and whole drives of the other two parts.

    each: what the unseen are, in words. warnings: why there is no threshold; [] if there is one.
    """

    known: tuple[Sample, ...]
    unseen: dict[str, tuple[Sample, ...]]
    each: str = "drives"

    @classmethod
    def of(cls, parts: Split) -> "Drives":
        """Take some frames of the calibration part, and every EVERY_S a frame of the others' whole drives."""
        names = {block_of(s) for s in parts.calibration}
        drives = dict[str, list[Sample]]()
        unit = "drives"
        for sample in (*parts.choosing, *parts.held_out):
            if block_of(sample) not in names:  # else a part of a drive, where few were parted along time
                drives.setdefault(block_of(sample), []).append(sample)
        if any(of[0].block for of in drives.values()):
            drives = _stretches(drives)
            lengths_s = [len(of) / _rate_hz(of) for of in drives.values()]
            unit = f"stretches of {np.median(lengths_s):.2g} s, of the same track and hour,"
        sampled = {name: drives[name] for name in pick_evenly(list(drives), MOST_DRIVES)}
        unseen = {name: tuple(of[:: max(1, round(_rate_hz(of) * EVERY_S))]) for name, of in sampled.items()}
        return cls(pick_evenly(parts.calibration, KNOWN_FRAMES), unseen, unit)

    @property
    def samples(self) -> tuple[Sample, ...]:
        return (*self.known, *chain.from_iterable(self.unseen.values()))

    @property
    def warnings(self) -> list[str]:
        if len(self.unseen) >= FEWEST_DRIVES:
            return []
        text = f"{len(self.unseen)} {self.each} are held out, and {FEWEST_DRIVES} are needed to tell what is unfamiliar"
        return [f"{text}: nothing stops this policy where it has seen nothing like it"]


def _rate_hz(samples: list[Sample]) -> float:
    """The frames per second of the first of the episodes in a drive or a stretch."""
    return frame_rate_hz([s for s in samples if s.episode == samples[0].episode]) or 1.0


def _stretches(blocks: dict[str, list[Sample]]) -> dict[str, list[Sample]]:
    """Cut each block into equally many stretches, as many as are needed, and none of too few pictures."""
    count = -(-FEWEST_DRIVES // len(blocks))
    stretches = {}
    for name, of in blocks.items():
        parts = max(1, min(count, len(of) // LEAST_STRETCH))
        for i, rows in enumerate(np.array_split(np.arange(len(of)), parts)):
            stretches[f"{name}, part {i + 1}"] = [of[k] for k in rows]
    return stretches


def fit(drives: Drives, embed: Callable[[Sample], np.ndarray]) -> tuple[Familiar, dict[str, Any]]:
    """Return what is familiar, and what quantize.json says of it.

    embed: returns a sample's embedding, (D,) float32. Described are the largest score of each unseen drive, as a share
    of the threshold, the rate of good drives that the threshold stops, and the pictures that are least familiar.
    """
    embeddings = np.stack([embed(sample) for sample in drives.known])
    mean = embeddings.mean(0)
    _, sizes, rows = np.linalg.svd(embeddings - mean, full_matrices=False)
    directions = min(DIRECTIONS, (len(sizes) + 1) // 2)
    spread = np.maximum(sizes / len(embeddings) ** 0.5, 1e-6 * max(float(sizes[0]), 1e-6))[:directions]
    familiar = Familiar(mean, rows[:directions], spread.astype(np.float32), np.ones(2, np.float32))
    # Both scores in their own unit, from drives that do not set the threshold
    unit = np.quantile(familiar.scores(embeddings), 0.99, axis=0).clip(1e-6)
    familiar.limits = unit.astype(np.float32)
    scores = {name: familiar.strange(np.stack([embed(s) for s in of])) for name, of in drives.unseen.items()}
    threshold = MARGIN * max(map(largest_smoothed, scores.values()))
    familiar.limits = (unit * threshold).astype(np.float32)
    shares = {name: largest_smoothed(of) / threshold for name, of in scores.items()}
    # The share of new drives above the largest of n has a Beta(1, n) distribution; this is its interval.
    low, high = (1 - share ** (1 / len(shares)) for share in ((1 + BETWEEN) / 2, (1 - BETWEEN) / 2))
    smallest = []
    for name in sorted(shares, key=lambda name: -shares[name])[:SHOWN]:
        sample = drives.unseen[name][int(scores[name].argmax())]
        place = {"episode": sample.episode, "row": sample.row, "frame": sample.frame_name}
        smallest.append(place | {"strange": shares[name]})
    rate = {"stopped_pct": 100 / (len(shares) + 1), "stopped_low_pct": 100 * low, "stopped_high_pct": 100 * high}
    return familiar, {"drives": len(shares), "each": drives.each, **rate, "largest": shares, "least": smallest}


def largest_smoothed(scores: np.ndarray) -> float:
    """Return the largest score of a drive's pictures, (n,), after the smoothing that the rover does."""
    return max(map(Smoother().add, scores.tolist()))
