"""What a recording becomes, whoever wrote it: samples by episode, where they are from, and what was wrong.

`episodes` reads our own recordings and `lerobot_dataset` LeRobot's; behind them nobody asks which of the two it was.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car import Car
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.picture import PictureError, read_jpeg
from rover_lib.onboard.recording import CHANNELS, HUMAN, POLICY
from rover_lib.onboard.stage import sha256_of

OTHER_RATE = 0.2  # of the usual time between two frames

ACTION_NAMES = CHANNELS
CAMERA = "observation.images."  # what LeRobot puts before a camera's name


@dataclass(frozen=True)
class Source:
    """Where recordings are, and what a user says of a dataset that does not say it itself.

    action_names: in the order of its numbers, and of its state's where that is unnamed too. cameras: those that the
    policy looks through, in its order.
    """

    path: Path
    action_names: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()

    @classmethod
    def of(cls, path: "Path | str | Source", action_names: str = "", camera: str = "") -> "Source":
        """action_names, camera: with commas between, as on a command line. A source stays what it is."""
        if isinstance(path, Source):
            return path
        names, cameras = (tuple(n.strip() for n in said.split(",") if n.strip()) for said in (action_names, camera))
        return cls(Path(path), names, cameras)

    @classmethod
    def loaded(cls, given: Mapping[str, Any], elsewhere: Path | str | None = None) -> "Source":
        """What a run loaded, or other recordings, read as those were. given: the params of its load.json."""
        return cls.of(elsewhere or given["episodes"], given.get("action_names", ""), given.get("camera", ""))


@dataclass(frozen=True)
class Layout:
    """Which cameras and which numbers the samples have.

    rate_hz: frames a second, None where a recording says nothing of it. state_order, action_order: the file's columns,
    in the order of the names; a car's are always [steering, throttle] here, in whatever order they were recorded.
    """

    cameras: tuple[str, ...] = ("the car's",)
    state_names: tuple[str, ...] = ACTION_NAMES
    action_names: tuple[str, ...] = ACTION_NAMES
    rate_hz: float | None = None
    state_order: tuple[int, ...] = (0, 1)
    action_order: tuple[int, ...] = (0, 1)

    def words(self) -> str:
        """A line in which users should find their own car."""

        def columns(names: tuple[str, ...], order: tuple[int, ...]) -> str:
            swapped = list(order) != sorted(order)
            return ", ".join(f"{n} (column {i})" if swapped else n for n, i in zip(names, order, strict=True))

        rate = f", {self.rate_hz:g} frames a second" if self.rate_hz else ""
        state, action = columns(self.state_names, self.state_order), columns(self.action_names, self.action_order)
        cameras = f"camera{'s' if len(self.cameras) > 1 else ''}: {', '.join(self.cameras)}"
        return f"{cameras}; state: {state}; action: {action}{rate}"


@dataclass(frozen=True)
class Fault:
    """Something wrong in a recording: `count` times `kind` in `file` (relative to the root), with the first
    in words.
    """

    file: str
    kind: str
    count: int
    note: str


@dataclass(frozen=True, eq=False)
class Sample:
    """One training or calibration pair.

    time_s: seconds since the episode's first frame. state: (S,) float32, in our recordings the previous frame's
    [steering, throttle]. chunk: (chunk, A) float32, this frame's action and the following ones. is_pad: (chunk,)
    bool, True past the end. driver: who drove at this frame, one of onboard.recording.DRIVERS. car: whose actions they
    are.
    """

    episode: str
    frame_path: Path  # the file that holds the picture, alone or among others
    time_s: float
    state: np.ndarray
    chunk: np.ndarray
    is_pad: np.ndarray
    row: int  # of the frame: in its episode, or in the whole of a LeRobotDataset
    driver: str = HUMAN
    car: Car = field(default_factory=Car)

    @property
    def frame_name(self) -> str:
        """What to call the picture within its episode."""
        return self.frame_path.name

    def frame_bgr(self) -> np.ndarray:
        """The picture, (h, w, 3) uint8 BGR. Raises EpisodeError if it is gone, or no whole JPEG of a camera's size."""
        try:
            return read_jpeg(self.frame_path)
        except OSError as e:
            raise EpisodeError(
                f"{self.frame_path}: cannot be read ({e.strerror})", remedy="restore it or load again"
            ) from None
        except PictureError as e:
            raise EpisodeError(
                f"{self.frame_path}: {e.what}", found=e.found, remedy="delete it or record the episode again"
            ) from None


def car_of(samples: Iterable[Any]) -> Car:
    """The car that samples were recorded with; Car() for observations that come from no recording.

    Raises EpisodeError for samples of cars that drive differently: the same action means another pulse on each.
    """
    cars: list[Car] = []
    for car in {id(s.car): s.car for s in samples if isinstance(s, Sample)}.values():  # an episode's samples share one
        if not any(car.drives_like(other) for other in cars):
            cars.append(car)
    if len(cars) > 1:
        names = ", ".join(sorted(car.name for car in cars))
        raise EpisodeError("the recordings are of several cars", found=names, remedy="use those of one car")
    return cars[0] if cars else Car()


def frame_rate_hz(samples: Sequence[Sample]) -> float | None:
    """Frames a second of one episode, by the usual time between two of its samples; None where there are not two."""
    if len(samples) < 2:
        return None
    step_s = float(np.median(np.diff([s.time_s for s in samples]) / np.diff([s.row for s in samples])))
    return 1 / step_s if step_s > 0 else None


def is_another_rate(found_hz: float | None, rate_hz: float) -> bool:
    """Whether an episode of found_hz frames a second was not recorded at rate_hz. A plan's steps are frames: of 15 a
    second, a car that takes 30 would do in half the time what the human did.
    """
    return found_hz is not None and abs(rate_hz / found_hz - 1) > OTHER_RATE


@dataclass(frozen=True, eq=False)
class Episode:
    """One drive. frames and controls: how many were listed; duration_s: first to last frame.

    outcome: one of onboard.recording.OUTCOMES, None where none was noted.
    """

    id: str
    path: Path
    label: str
    duration_s: float
    frames: int
    controls: int
    samples: tuple[Sample, ...]
    files: tuple[Path, ...]  # that the numbers came from
    outcome: str | None = None

    @cached_property
    def by_policy(self) -> bool:
        """Whether a policy drove in it, so that what a human did there are corrections."""
        return any(sample.driver == POLICY for sample in self.samples)


@dataclass(frozen=True, eq=False)
class Recordings:
    """All usable episodes below `root`, and what was wrong with the rest."""

    root: Path
    episodes: tuple[Episode, ...]
    faults: tuple[Fault, ...]
    source: Source
    layout: Layout = Layout()

    @property
    def samples(self) -> tuple[Sample, ...]:
        """Every episode's samples, in order."""
        return tuple(s for e in self.episodes for s in e.samples)

    def action_range(self) -> dict[str, tuple[float, float]]:
        """Smallest and largest recorded value of each action: what errors are given as a share of."""
        actions = np.concatenate([s.chunk for s in self.samples])  # padding repeats values that are in it anyway
        return {
            n: (float(actions[:, i].min()), float(actions[:, i].max())) for i, n in enumerate(self.layout.action_names)
        }

    def driven_by_pct(self) -> dict[str, float]:
        """Who drove, one of onboard.recording.DRIVERS, at how many percent of the samples."""
        count = len(self.samples)
        return {who: round(100 * n / count, 1) for who, n in self._counted(s.driver for s in self.samples).items()}

    @staticmethod
    def _counted(words: Iterable[str]) -> dict[str, int]:
        return dict(sorted(Counter(words).items()))

    def hashes(self) -> dict[str, str]:
        """SHA-256 of every file that the samples came from, by its path relative to `root`.

        Raises EpisodeError for one that cannot be read any more.
        """
        files = {path: None for e in self.episodes for path in (*e.files, *(s.frame_path for s in e.samples))}
        hashes = {}
        for path in files:
            try:
                hashes[relative(path, self.root)] = sha256_of(path)
            except OSError as e:
                raise EpisodeError(f"{path}: cannot be read any more ({e.strerror})", remedy="load again") from None
        return hashes

    def summary(self) -> dict[str, Any]:
        """Counts, ranges and faults as plain JSON types, for load.json."""
        return {
            "episodes": len(self.episodes),
            "frames": sum(e.frames for e in self.episodes),
            "controls": sum(e.controls for e in self.episodes),
            "samples": len(self.samples),
            "duration_s": sum(e.duration_s for e in self.episodes),
            "layout": self.layout.words(),
            "labels": sorted({e.label for e in self.episodes}),
            "outcomes": self._counted(e.outcome or "not labelled" for e in self.episodes),
            "driven_by_pct": self.driven_by_pct(),
            "action_range": {name: list(ends) for name, ends in self.action_range().items()},
            "faults": [{"file": f.file, "kind": f.kind, "count": f.count, "note": f.note} for f in self.faults],
        }


def camera_names(keys: Iterable[str]) -> dict[str, str]:
    """The LeRobot features of cameras, by what a policy calls them.

    Such features begin in one of two ways, which is left out; not where two would then have one name, as
    observation.image and observation.images.image.
    """
    keys = list(keys)
    # one of the two: a camera may itself be called observation.image, where we wrote the policy
    names = {key.removeprefix(CAMERA if key.startswith(CAMERA) else "observation."): key for key in keys}
    return names if len(names) == len(keys) else {key: key for key in keys}


def relative(path: Path, root: Path) -> str:
    """A file's path as reports name it."""
    try:
        return path.relative_to(root).as_posix()
    except ValueError:
        return path.name
