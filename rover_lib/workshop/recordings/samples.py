"""The common form of our recordings and LeRobot's: samples, and the episodes that have them."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.picture import read_jpeg
from rover_lib.onboard.errors import CameraError, EpisodeError
from rover_lib.onboard.recording.episode import CHANNELS, HUMAN, POLICY
from rover_lib.onboard.stage import sha256_of
from rover_lib.workshop.recordings.faults import HANDLED, SHOW_NOTHING, Fault, relative
from rover_lib.workshop.recordings.source import Source

NEARLY_WHOLE = 0.02  # the share by which a rate may be rounded; 4.35 Hz as 4 made plans 8 % slower
OTHER_RATE = 0.2  # an episode whose rate differs by more than this share has another rate
LEAST_RATED = 10  # frames; fewer do not show a rate

ACTION_NAMES = CHANNELS


@dataclass(frozen=True)
class Layout:
    """Which cameras and which numbers the samples have.

    rate_hz, and image_sizes, (height, width) of each camera: None and empty where the recordings do not state them.
    state_order, action_order: for each name, its column in the file. A car's names are always [steering, throttle].
    """

    cameras: tuple[str, ...] = ("the car's",)
    state_names: tuple[str, ...] = ACTION_NAMES
    action_names: tuple[str, ...] = ACTION_NAMES
    rate_hz: float | None = None
    state_order: tuple[int, ...] = (0, 1)
    action_order: tuple[int, ...] = (0, 1)
    image_sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict, compare=False)
    has_state: bool = True  # else no state is recorded, and it is the last action

    def words(self) -> str:
        """Describe the layout in one line, in which users should recognise their own car."""

        def columns(names: tuple[str, ...], order: tuple[int, ...]) -> str:
            swapped = list(order) != sorted(order)
            return ", ".join(f"{n} (column {i})" if swapped else n for n, i in zip(names, order, strict=True))

        rate = f", {self.rate_hz:g} frames a second" if self.rate_hz else ""
        action = columns(self.action_names, self.action_order)
        state = columns(self.state_names, self.state_order)
        if not self.has_state:
            state = f"none recorded, taken as the last action, {state}"
        cameras = f"camera{'s' if len(self.cameras) > 1 else ''}: {', '.join(self.cameras)}"
        return f"{cameras}; state: {state}; action: {action}{rate}"


@dataclass(frozen=True, eq=False)
class Sample:
    """One training or calibration pair.

    time_s: seconds since the episode's first frame. state: (S,) float32, in our recordings the previous frame's
    [steering, throttle]. chunk: (chunk, A) float32, this frame's action and the following ones. is_pad: (chunk,)
    bool, True past the end. driver: who drove at this frame, one of onboard.recording.DRIVERS. car: the car that was
    driven. pulses_us: the recorded pulses of this frame's action; None if the recording has only actions.
    """

    episode: str
    frame_path: Path  # the file that holds the picture, alone or among others
    time_s: float
    state: np.ndarray
    chunk: np.ndarray
    is_pad: np.ndarray
    row: int  # the frame's number in its episode, or in the whole of a LeRobotDataset
    driver: str = HUMAN
    car: Car = field(default_factory=Car)
    pulses_us: tuple[float, float] | None = None
    mirrored: bool = False  # turn the picture over, as it is mirrored beside the other recordings'
    block: str = ""  # which block of a long drive it is in, see blocks.py; "" where whole episodes are parted

    @property
    def frame_name(self) -> str:
        return self.frame_path.name

    def turned(self, frame: np.ndarray) -> np.ndarray:
        """The picture as it is, or turned over if it is mirrored."""
        return np.ascontiguousarray(frame[:, ::-1]) if self.mirrored else frame

    def frame_bgr(self, least: int = 0) -> np.ndarray:
        """Read the picture: (h, w, 3) uint8 BGR; least: as of read_jpeg. Raises EpisodeError if it is gone or torn."""
        try:
            return self.turned(read_jpeg(self.frame_path, least))
        except OSError as e:
            problem = f"{self.frame_path}: cannot be read ({e.strerror})"
            raise EpisodeError(problem, remedy="restore it or load again") from None
        except CameraError as e:
            remedy = "delete it or record the episode again"
            raise EpisodeError(f"{self.frame_path}: {e.what}", found=e.found, remedy=remedy) from None


def by_camera(frame: Any, name: str) -> Mapping[str, np.ndarray]:
    """Return pictures by their cameras' names. frame: such pictures, or that of the only camera, called `name`."""
    return frame if isinstance(frame, Mapping) else {name: frame}


def block_of(sample: Any) -> str:
    """The name of what is parted and drawn as a whole, as its samples are alike: a block, or else the episode."""
    return sample.block or sample.episode


def car_of(samples: Iterable[Any]) -> Car:
    """The car of recorded samples; Car() for other observations. Raises EpisodeError if it is several."""
    cars: list[Car] = []
    for car in {id(s.car): s.car for s in samples if isinstance(s, Sample)}.values():  # an episode's samples share one
        if not any(car.drives_like(other) for other in cars):
            cars.append(car)
    if len(cars) > 1:
        difference = cars[0].unlike(cars[1])
        raise EpisodeError("the recordings are of several cars", found=difference, remedy="use those of one car")
    return cars[0] if cars else Car()


def frame_rate_hz(samples: Sequence[Sample]) -> float | None:
    """Return one episode's frames per second, by the median step; None without two samples at two times."""
    if len(samples) < 2:
        return None
    step_s = float(np.median(np.diff([s.time_s for s in samples]) / np.diff([s.row for s in samples])))
    return 1 / step_s if step_s > 0 else None


def round_rate_hz(found_hz: float) -> float:
    """Return a rate above 0 as an int, as LeRobot's datasets have it, unless plans would last longer or shorter."""
    whole_hz = max(round(found_hz), 1)
    return whole_hz if abs(whole_hz / found_hz - 1) <= NEARLY_WHOLE else round(found_hz, 3)


def is_another_rate(found_hz: float | None, rate_hz: float) -> bool:
    """Whether an episode with found_hz frames a second has another rate than rate_hz: a plan's step is a frame."""
    return found_hz is not None and abs(rate_hz / found_hz - 1) > OTHER_RATE


@dataclass(frozen=True, eq=False)
class Episode:
    """One drive.

    duration_s: from the first to the last frame. frames, controls: how many the recording lists.
    formulas: by channel, that of its actions before they were recomputed from the pulses. session: what it is a piece
    of, "" if it is whole; begin_s: where its first frame lies in that, in seconds.
    """

    id: str
    path: Path
    label: str
    duration_s: float
    frames: int
    controls: int
    samples: tuple[Sample, ...]
    files: tuple[Path, ...]  # those that the numbers came from
    formulas: Mapping[str, str] = field(default_factory=dict)
    corrects: bool = False  # whether a human intervened in it: lerobot-rollout can leave out what the policy drove
    session: str = ""
    begin_s: float = 0.0

    @property
    def place(self) -> Path:
        """Where faults find it: its folder, or its name in the files of several."""
        return self.path if self.path.name == self.id else self.path / self.id

    @cached_property
    def by_policy(self) -> bool:
        """Whether a policy drove in it, so that what a human did in it was a correction."""
        return self.corrects or any(sample.driver == POLICY for sample in self.samples)


@dataclass(frozen=True, eq=False)
class Recordings:
    """All usable episodes below `root`, and every fault that was found.

    blocks: the names of the blocks of each place, such as each tub of a folder; () where whole episodes are parted.
    kind: what they are, a key of onboard.kinds.CALLED.
    """

    root: Path
    episodes: tuple[Episode, ...]
    faults: tuple[Fault, ...]
    source: Source
    layout: Layout = Layout()
    blocks: tuple[tuple[str, ...], ...] = ()
    kind: str = "recordings"

    @property
    def samples(self) -> tuple[Sample, ...]:
        """Every episode's samples, in order."""
        return tuple(chain.from_iterable(e.samples for e in self.episodes))

    def action_range(self) -> dict[str, tuple[float, float]]:
        """Smallest and largest recorded value of each action. Errors are given as a share of this range."""
        actions = np.concatenate([s.chunk for s in self.samples])  # padding repeats values that are in it anyway
        ends = zip(actions.min(0).tolist(), actions.max(0).tolist(), strict=True)
        return dict(zip(self.layout.action_names, ends, strict=True))

    def recomputed(self) -> str:
        """Say which actions were recomputed from their pulses, in one sentence; empty if none were."""
        changed = [e for e in self.episodes if e.formulas]
        if not changed:
            return ""
        pairs = chain.from_iterable(e.formulas.items() for e in changed)
        formulas = ", ".join(sorted({f"{name} = {formula}" for name, formula in pairs}))
        count = f"{len(changed)} of {len(self.episodes)} episodes"
        return f"the actions of {count} were recomputed from their pulses, as they follow another formula: {formulas}"

    def faults_by_kind(self) -> dict[str, dict[str, int]]:
        """How often each kind of fault was found, by what was done about it, one of HANDLED."""
        counts: dict[str, Counter[str]] = {handled: Counter() for handled in HANDLED}
        for fault in self.faults:
            counts[fault.handled][fault.kind] += fault.count
        return {handled: dict(kinds.most_common()) for handled, kinds in counts.items() if kinds}

    def cautions(self) -> list[str]:
        """A sentence for each kind of fault, or action but a held throttle, that makes a policy drive badly."""
        by_kind: dict[str, list[Fault]] = {}
        for fault in self.faults:
            if re.fullmatch(f"{SHOW_NOTHING}|other_state", fault.kind):
                by_kind.setdefault(fault.kind, []).append(fault)
        sentences = []
        for first, *others in by_kind.values():
            more = f" and {len(others)} more" if others else ""
            sentences.append(f"{first.file}{more}: {first.note}")
        for name, (low, high) in self.action_range().items():
            if low == high and name != ACTION_NAMES[1]:
                sentences.append(f"{name} is {low + 0.0:g} throughout: no policy can learn it here, or be judged on it")
        return sentences

    def hashes(self) -> dict[str, str]:
        """SHA-256 of every file of the samples, by its path relative to `root`. Raises EpisodeError if one is gone."""
        files: dict[Path, None] = {}  # in order
        for episode in self.episodes:
            files |= dict.fromkeys(episode.files)
            files |= dict.fromkeys(sample.frame_path for sample in episode.samples)
        try:
            return {relative(path, self.root): sha256_of(path) for path in files}
        except OSError as e:
            raise EpisodeError(f"{e.filename}: cannot be read any more ({e.strerror})", remedy="load again") from None

    def summary(self) -> dict[str, Any]:
        """Return counts, ranges and faults in plain JSON types, for load.json."""
        drivers = Counter(s.driver for s in self.samples)
        return {
            "episodes": len(self.episodes),
            "frames": sum(e.frames for e in self.episodes),
            "controls": sum(e.controls for e in self.episodes),
            "samples": len(self.samples),
            "duration_s": sum(e.duration_s for e in self.episodes),
            "kind": self.kind,
            "throttle": self.source.throttle,
            "layout": self.layout.words(),
            "blocks": sum(map(len, self.blocks)),  # 0 where whole episodes are parted
            "labels": sorted({e.label for e in self.episodes}),
            "driven_by_pct": {who: round(100 * n / len(self.samples), 1) for who, n in sorted(drivers.items())},
            "action_range": {name: list(ends) for name, ends in self.action_range().items()},
            "recomputed": self.recomputed(),
            "cautions": self.cautions(),
            "faults_by_kind": self.faults_by_kind(),
            "faults": [vars(f) for f in self.faults],
        }


def following(actions: np.ndarray, chunk: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the chunk of each of a part's actions, (n, A) -> (n, chunk, A), and its padding, (n, chunk) bool.

    A chunk has the action itself and the following ones; past the end, the last one again.
    """
    n = len(actions)
    index = np.arange(n)[:, None] + np.arange(chunk)
    return actions[np.minimum(index, n - 1)], index >= n


def stack_chunks(samples: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return what was done at n samples, (n, C, A), and which of its steps are padding, (n, C) bool."""
    return np.stack([s.chunk for s in samples]), np.stack([s.is_pad for s in samples])


def pick_evenly(samples: Sequence[Any], at_most: int) -> tuple[Any, ...]:
    """Return at most `at_most` of the samples, evenly spaced, first and last among them."""
    if len(samples) <= at_most:
        return tuple(samples)
    return tuple(samples[i] for i in np.linspace(0, len(samples) - 1, at_most).round().astype(int))
