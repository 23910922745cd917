"""Find recordings that are the same drive, whatever they are called: a copy in both parts of a split judges nothing.

Their actions say which two may be the same, and some of their pictures whether they are. So a copy is found that was
encoded anew, renamed, cut or lacks some rows; and drives of a keyboard, whose actions repeat, are told apart.
Pieces of one session at different times are never the same, and what cannot differ shows nothing: nearly black pictures
agree with all others like them, and those of a standing car with each other.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import chain

import cv2
import numpy as np

from rover_lib.workshop.recordings.samples import Episode, Sample, by_camera, pick_evenly

RUN = 4  # consecutive actions that are compared at once
STEPS = (1, 2, 3, 4, 5)  # a copy may have only every fifth row
DIGITS = 2  # of an action; somebody may have rounded them
SHARED = 0.3  # the share of an episode's runs that makes it a suspect, and of its compared pictures that differ
COMPARED = 8
SEEN = (16, 9)  # pictures of a suspect, and the size to which they are scaled down
ALIKE = 4.0  # grey levels, on average over a picture; encoding anew changes less, and a car that moves more
OF_CONTRAST = 0.1  # at most this share of the mean distance from a picture's mean
CORRELATED = 0.98  # or so similar, whatever their brightness: a car that moved for five frames has 0.72 to 0.975
MOST_ALIKE = 50  # episodes with the same run; it then tells nothing


def find_copies(episodes: Sequence[Episode]) -> list[tuple[Episode, Episode]]:
    """Return each episode that is the same drive as another, at least as long one, with that one."""
    scaled = lru_cache(1000)(scaled_down)
    having: defaultdict[bytes, list[tuple[int, int]]] = defaultdict(list)
    copies = []
    for i in sorted(range(len(episodes)), key=lambda i: (-len(episodes[i].samples), i)):
        runs = _runs(episodes[i])
        shared: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        for run, k in runs.items():
            for other, there in having[run]:
                shared[other].append((k, there))
        suspects = []
        for other, pairs in shared.items():
            if len(pairs) >= SHARED * len(runs) and not _follow(episodes[i], episodes[other]):
                suspects.append((episodes[other], pairs))
        same = next((other for other, pairs in suspects if look_alike(episodes[i], other, pairs, scaled)), None)
        if same is not None:
            copies.append((episodes[i], same))
            continue
        for run, k in chain.from_iterable(_runs(episodes[i], step).items() for step in STEPS):
            if len(having[run]) < MOST_ALIKE:
                having[run].append((i, k))
    return copies


def _runs(episode: Episode, step: int = 1) -> dict[bytes, int]:
    """Each run of actions, `step` samples apart, that are not all the same, and the sample where it first begins.

    Without such runs, all single ones: then also their place must be the same.
    """
    rounded = np.array([sample.chunk[0] for sample in episode.samples]).round(DIGITS) + 0.0  # -0 is 0
    actions = [action.tobytes() for action in rounded]
    runs: dict[bytes, int] = {}
    for k in range(len(actions) - (RUN - 1) * step):
        run = actions[k : k + RUN * step : step]
        if run != run[:1] * RUN:
            runs.setdefault(b"".join(run), k)
    return runs or {action + str(k).encode(): k for k, action in enumerate(actions)}


def _follow(episode: Episode, other: Episode) -> bool:
    """Whether they are pieces of one session, one after the other."""
    first, second = sorted((episode, other), key=lambda e: e.begin_s)
    together = episode.session != "" and episode.session == other.session
    return together and first.begin_s + first.duration_s < second.begin_s


def look_alike(
    episode: Episode, other: Episode, pairs: list[tuple[int, int]], scaled: Callable[[Sample], np.ndarray]
) -> bool:
    """Whether most pictures at the same actions are the same, and could differ. pairs: a sample of each."""
    sampled = pick_evenly(sorted(pairs), COMPARED)
    different = 0
    for k, there in sampled:
        different += not _is_same(scaled(episode.samples[k]), scaled(other.samples[there]))
        if different > SHARED * len(sampled):
            return False
    ours = [scaled(episode.samples[k]) for k, _ in sampled]
    if np.ptp([s.chunk[0] for s in episode.samples], axis=0).any() or not all(_is_same(ours[0], a) for a in ours):
        return True
    # The car stands, as it may have on another day: but noise never repeats.
    return all(np.array_equal(a, scaled(other.samples[there])) for a, (_, there) in zip(ours, sampled, strict=True))


def _is_same(a: np.ndarray, b: np.ndarray) -> bool:
    contrast = np.abs(a - a.mean()).mean()
    if np.abs(a - b).mean() < min(ALIKE, OF_CONTRAST * contrast):
        return True
    a = a - a.mean()
    b = b - b.mean()
    return float((a * b).sum()) > CORRELATED * float(np.linalg.norm(a) * np.linalg.norm(b))


def pictures_change(episode: Episode) -> bool:
    """Whether some pictures of an episode differ."""
    first, *others = (scaled_down(sample) for sample in pick_evenly(episode.samples, COMPARED))
    return not all(_is_same(first, other) for other in others)


def scaled_down(sample: Sample) -> np.ndarray:
    """The picture in few pixels; of several cameras, one beside the other."""
    frames = by_camera(sample.frame_bgr(SEEN[0]), "").values()
    return np.stack([cv2.resize(f, SEEN, interpolation=cv2.INTER_AREA).astype(np.float32) for f in frames])
