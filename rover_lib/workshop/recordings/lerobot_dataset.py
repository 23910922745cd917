"""Read a LeRobotDataset of version 2 or 3, with images or video, and check it before it is used.

What its numbers mean is read from the names of its features, or said by the user, and never guessed. Only tables that
meta/ names and columns that are used are read, so what Macs, pandas, notebooks and annotators leave there does no harm.
"""

import io
import json
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import CarError, EpisodeError
from rover_lib.onboard.kinds import refuse_pointer
from rover_lib.onboard.policy.load import action_limits
from rover_lib.onboard.recording.episode import CHANNELS, HUMAN, POLICY
from rover_lib.onboard.stage import read_plain
from rover_lib.workshop import untrusted
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.blocks import name_long_drives
from rover_lib.workshop.recordings.controls import note_one_sided
from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.recordings.names import ACTION, STATE, camera_names, name_numbers, name_states
from rover_lib.workshop.recordings.samples import Episode, Layout, Recordings, Sample, following
from rover_lib.workshop.recordings.source import Source
from rover_lib.workshop.recordings.twins import leave_out_copies
from rover_lib.workshop.states import OTHER_STATE, explain_state, last_actions
from rover_lib.workshop.untrusted import limited_memory, quote, quote_all
from rover_lib.workshop.videos import match_pictures

INFO = Path("meta/info.json")
INFO_BYTES = 5_000_000  # LeRobot's: some kB
MOST_FEATURES = 200  # an arm with six cameras has 20
PICTURE_PIXELS = 4608 * 2592  # at most: a Pi camera's largest
BACKEND = "pyav"  # needs no FFmpeg on the machine, as torchcodec does
TOLERANCE_S = 1e-4  # LeRobot's, between a frame's time and that of a picture in its video
OFF = 0.25  # of the time between two pictures; farther from any, it is not known which one was meant
NUMBERS = ("timestamp", "frame_index", "episode_index")
STATS = "meta/episodes_stats.jsonl"  # of version 2.1
INTERVENTION = "intervention"  # as lerobot-rollout writes it: in this frame a human had taken over from a policy
REPORT = "rover_export.json"  # beside a dataset of our own; of each episode it says:
ALSO = {  # other people's words for the same
    STATE: ("state", "states", "observation.states", "observations.state"),
    ACTION: ("actions",),
    INTERVENTION: ("complementary_info.is_intervention",),
}
STATES = "state|joint|qpos|proprio"  # in other names of a state
DRIVEN_BY = "driven_by"  # who drove where nobody intervened
CAR = "car"  # and of them all, the content of their car.yml
UNEVEN = 0.1  # the time between two frames may differ by this share
DERIVE_STATE = "to train, rover export-dataset writes it so"
WRITE_ANEW = "copy it whole, or let LeRobot write it anew"
BATCH = 256  # pictures that are read at once
OURS = re.compile(r"file-\d+\.parquet")  # among "._file-000.parquet" and "file-000-checkpoint.parquet"


def _broken(what: str, found: object = None) -> EpisodeError:
    """The error of a dataset that no LeRobot wrote so, for the caller to raise."""
    return EpisodeError(f"{what}: a broken dataset", found=found, remedy=WRITE_ANEW)


@dataclass(frozen=True, eq=False)
class _Camera:
    """One camera. size: (height, width). paths: each row's file. times_s: when its picture is shown in a video.

    torn: rows whose picture in a video is. rows: else all rows, from which Hugging Face's library reads one picture
    without its table's others.
    """

    key: str
    size: tuple[int, int]
    paths: Sequence[Path]
    times_s: Sequence[float] = ()
    rows: Any = None
    torn: frozenset[int] = frozenset()

    def find_unusable(self, faults: Faults) -> set[int]:
        """Return the rows whose pictures are not there, torn, or not in colours; the fault says why the first is not.

        Most decoders make a picture of a torn one. Of videos, the last picture of each is decoded: one that was cut
        lacks its end.
        """
        if self.rows is None:
            for row in {path: row for row, path in enumerate(self.paths)}.values():
                with _as_episode_error(f"{self.paths[row]}: cannot be decoded"):
                    if row not in self.torn:
                        self.read_bgr(row)
            if self.torn:
                note = f"the picture of '{self.key}' in row {min(self.torn)} is torn, or one it needs: copy it again"
                faults.add(self.paths[min(self.torn)], "broken_picture", note, len(self.torn))
            return {*self.torn}
        problems: list[str] = []
        for batch in self.rows.iter(BATCH):
            encoded = [(picture or {}).get("bytes") or b"" for picture in batch[self.key]]
            problems += [untrusted.check_encoded(data, self.size) for data in encoded]
        unusable = [row for row, why in enumerate(problems) if why]
        if unusable:
            remedy = "" if len(unusable) < len(problems) else f"; correct {INFO}, or write the pictures anew as RGB"
            note = f"the picture of '{self.key}' in row {unusable[0]}: {problems[unusable[0]]}{remedy}"
            faults.add(self.paths[unusable[0]], "broken_picture", note, len(unusable))
        return {*unusable}

    def read_bgr(self, row: int) -> np.ndarray:
        """Read a picture, (h, w, 3) uint8 BGR. Raises EpisodeError and what decoders raise."""
        if self.rows is None:
            from lerobot.datasets.video_utils import decode_video_frames

            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # torchvision warns of the decoder
                picture = decode_video_frames(self.paths[row], [self.times_s[row]], TOLERANCE_S, BACKEND)[0]
            # (3, h, w) float32 in [0, 1]. Dividing a uint8 by 255 and multiplying by 255 again is exact.
            rgb = (picture * 255).round().byte().permute(1, 2, 0).numpy()
        else:
            from PIL import Image, ImageOps

            encoded = Image.open(io.BytesIO(self.rows[row][self.key]["bytes"]), formats=untrusted.FORMATS)
            rgb = np.asarray(ImageOps.exif_transpose(encoded))  # as LeRobot turns it
        if rgb.shape != (*self.size, 3):
            raise _broken(f"{self.paths[row]}: its frame {row} has another shape than {self.size} in {INFO}", rgb.shape)
        return np.ascontiguousarray(rgb[..., ::-1])


@dataclass(frozen=True, eq=False)
class LerobotSample(Sample):
    """A sample whose picture is one of many in `frame_path`, a parquet or mp4 file (that of the first camera)."""

    cameras: Mapping[str, _Camera] = field(kw_only=True)  # by the policy's names

    @property
    def frame_name(self) -> str:
        return f"frame {self.row}"

    def frame_bgr(self, least: int = 0) -> Any:
        """Read the picture, as Sample does; of several cameras, a dict by their names. Raises EpisodeError likewise."""
        with _as_episode_error(f"{self.frame_path}: its frame {self.row} cannot be decoded"), limited_memory():
            frames = {name: camera.read_bgr(self.row) for name, camera in self.cameras.items()}
        return frames if len(frames) > 1 else self.turned(next(iter(frames.values())))


def load_dataset(source: Source, chunk: int, progress: Progress = silent) -> Recordings:
    """Read a LeRobotDataset's folder.

    chunk: actions per sample, padded at an episode's end with its last one. Each frame is a sample, with the state that
    was recorded with it, or the action before. A human drove; if the dataset marks interventions, in the marked frames,
    and a policy in all others, unless our own export says otherwise. Raises EpisodeError for another version, damaged
    or missing files, numbers that no rover can have, and if nothing says which camera and which numbers are the car's.
    """
    import lerobot.utils.utils  # noqa: F401  # torch, which it imports, takes more memory than a table may

    dataset = _Dataset(source)
    faults = dataset.faults
    with _as_episode_error(f"{dataset.root}: cannot be read"):
        with limited_memory():
            files = dataset.read_meta()
        with limited_memory(3 * sum(path.stat().st_size for path in files if path.is_file())):
            dataset.read_frames(files)
    listed = progress(dataset.entries, desc="reading episodes", total=len(dataset.entries))
    episodes = [episode for row in listed if (episode := dataset.episode(row, chunk)).samples]
    if not episodes:
        raise faults.nothing_usable("no usable sample", WRITE_ANEW)
    if dataset.layout.action_names == CHANNELS:
        note_one_sided(episodes, faults)
    own, blocks = name_long_drives(leave_out_copies(episodes, faults))
    return Recordings(dataset.root, own, faults.listed(), source, dataset.layout, blocks, "dataset")


class _Dataset:
    """What a dataset's folder holds. layout, keys: of its cameras, by their names. entries: meta/'s, by their numbers.

    columns: all frames' numbers by LeRobot's keys, in their order: states (n, S) and actions (n, A), float32 and by the
    layout's names, others (n,). unusable: rows without a whole picture.
    """

    def __init__(self, source: Source):
        self.root = source.path
        self.faults = Faults(self.root)
        self.info = _read_info(self.root)
        self.features = self.info["features"]
        self.fps = float(self.info["fps"])
        self.layout, self.keys = _layout(self.root, self.info, source)
        self.columns: dict[str, np.ndarray] = {}

    def read_meta(self) -> list[Path]:
        """Read what meta/ says of the episodes, and return the tables of frames, in the order of their rows."""
        if self.info["codebase_version"].removeprefix("v").startswith("2"):
            _check_file(self.root, lines := self.root / "meta/episodes.jsonl")
            rows = [json.loads(line) for line in read_plain(lines, untrusted.JSON_BYTES).splitlines() if line.strip()]
        else:
            tables = sorted(path for path in self.root.glob("meta/episodes/[!.]*/*") if OURS.fullmatch(path.name))
            if not tables:
                raise _broken(f"{self.root}: has no meta/episodes/*/*.parquet")
            rows = []
            for path in tables:
                rows += _read_table(self.root, path, "(?!stats/).*").to_pylist()
        self.entries = sorted(rows, key=lambda row: row["episode_index"])
        return list(dict.fromkeys(map(self._file, self.entries)))

    def _file(self, row: Mapping[str, Any], camera: str = "") -> Path:
        """The file of an episode's frames, or its video: version 2 has one of each episode, version 3 names it."""
        folder = f"videos/{camera}" if camera else "data"
        number = row["episode_index"]
        parts = {part: row[f"{folder}/{part}"] for part in ("chunk_index", "file_index") if f"{folder}/{part}" in row}
        own = {"episode_index": number, "episode_chunk": number // self.info.get("chunks_size", 1000)}
        return self.root / self.info["video_path" if camera else "data_path"].format(**own, **parts, video_key=camera)

    def _shown(self, row: Mapping[str, Any], camera: str) -> tuple[Path, float, float]:
        """The video of an episode, and from when to when in it that is shown, in seconds."""
        first_s = row.get(f"videos/{camera}/from_timestamp", 0.0)
        last_s = row.get(f"videos/{camera}/to_timestamp", row["length"] / self.fps)
        return self._file(row, camera), first_s, last_s

    def read_frames(self, files: Sequence[Path]) -> None:
        """Read and check the frames' numbers, and find their pictures."""
        keys = {key: key for key in NUMBERS} | {k: self.features[k]["column"] for k in ALSO if k in self.features}
        images = [key for key in self.keys.values() if self.features[key]["dtype"] == "image"]
        pattern = "|".join(map(re.escape, keys.values()))
        needed = {*keys.values(), *images}
        tables = [_read_table(self.root, path, pattern, needed) for path in files]
        for key, column in keys.items():
            values = np.concatenate([_numbers(table.column(column)) for table in tables])
            order = {STATE: self.layout.state_order, ACTION: self.layout.action_order}.get(key)
            if order and values.shape[1] != len(order):
                problem = f"{self.root}: '{key}' has {len(order)} numbers in {INFO} and {values.shape[1]} in the tables"
                raise EpisodeError(problem, remedy="correct its shape and names")
            self.columns[key] = values.astype(np.float32)[:, list(order)] if order else values.ravel()
        before = last_actions(self.columns[ACTION], self.columns["frame_index"] == 0)
        self.columns.setdefault(STATE, before)  # as in our own recordings
        self._check_order()
        self._check_state(before)
        self._check_times()
        drivers, self.car = _read_export(self.root, len(self.entries), INTERVENTION in keys, self.faults)
        self.drivers = {row["episode_index"]: driver for row, driver in zip(self.entries, drivers, strict=True)}
        self._check_numbers()
        self.cameras = {name: self._camera(key, self.layout.image_sizes[name]) for name, key in self.keys.items()}
        self.unusable = set().union(*(camera.find_unusable(self.faults) for camera in self.cameras.values()))

    def _check_order(self) -> None:
        """Raise EpisodeError for rows that are not the frames of meta/ in their order, each once; note other counts."""
        number = self.columns["episode_index"]
        starts = np.flatnonzero(np.diff(number, prepend=-1))
        lengths = np.diff([*starts, len(number)])
        within = np.arange(len(number)) - np.repeat(starts, lengths)
        index = np.array([[row["episode_index"], row["length"]] for row in self.entries]).reshape(-1, 2)
        whole = np.array_equal(index, np.stack([number[starts], lengths], 1))
        here = f"{len(starts)} episodes of {len(number)} frames"
        if not whole or not np.array_equal(self.columns["frame_index"], within):
            actual = f"{len(index)} episodes of {index[:, 1].sum()} frames, and {here} or in another order"
            raise _broken(f"{self.root}: meta/episodes and the frames in data do not belong together", actual)
        counts = self.info.get("total_episodes", len(starts)), self.info.get("total_frames", len(number))
        note = f"{quote(counts[0])} episodes of {quote(counts[1])} frames, and here are {here}: a part?"
        self.faults.add(self.root / INFO, "another_total", note, counts != (len(starts), len(number)))
        ends = [(row.get("dataset_from_index"), row.get("dataset_to_index")) for row in self.entries]
        right = zip(starts.tolist(), (starts + lengths).tolist(), strict=True)
        scrambled = sum(end_pair not in ((None, None), here) for end_pair, here in zip(ends, right, strict=True))
        note = "dataset_from_index and _to_index of an early converter: convert it again by a newer LeRobot to train"
        self.faults.add(self.root / "meta/episodes", "scrambled_index", note, scrambled)

    def _check_state(self, before: np.ndarray) -> None:
        """Let a state of a car's names be the action before, which the car gives, where it was recorded as another."""
        if self.layout.state_names != CHANNELS or self.layout.action_names != CHANNELS:
            return
        for number in np.unique(self.columns["episode_index"]):
            rows = self.columns["episode_index"] == number
            words = explain_state(self.columns[STATE][rows], self.columns[ACTION][rows], CHANNELS)
            if words:
                self.columns[STATE][rows] = before[rows]
                note = f"its state is not the last action, which a car gives and is taken: {words}; {DERIVE_STATE}"
                self.faults.add(self.root / INFO, OTHER_STATE, note)

    def _check_times(self) -> None:
        """Let episodes begin with 0 s. Raises EpisodeError for frames that do not come `fps` times a second."""
        times_s = self.columns["timestamp"].astype(np.float64)
        first = self.columns["frame_index"] == 0
        usual = float(np.median(np.diff(times_s, prepend=0)[~first])) * self.fps if not first.all() else 1.0
        for unit, word in ((1e3, "ms"), (1e6, "us"), (1e9, "ns")):
            if abs(usual / unit - 1) <= UNEVEN:
                times_s /= unit
                self.faults.add(self.root / "data", "other_units", f"its timestamps are in {word}")
        begin_s = times_s[np.flatnonzero(first)[np.cumsum(first) - 1]]
        times_s = self.columns["timestamp"] = np.where(np.abs(begin_s) * self.fps > 1, times_s - begin_s, times_s)
        steps = np.diff(times_s, prepend=0)[~first] * self.fps
        if len(odd := steps[~(np.abs(steps - 1) <= UNEVEN)]):  # so that NaN counts as odd
            text = f"{self.root}: {INFO} says {self.fps:g} frames a second, but {len(odd)} frames come at another rate"
            actual = f"{odd[0] / self.fps:.4f} s after the one before"
            raise EpisodeError(text, found=actual, remedy="correct the rate, or record again")

    def _check_numbers(self) -> None:
        """Raise EpisodeError for states and actions beyond what the car can do."""
        for key, labels in ((ACTION, self.layout.action_names), (STATE, self.layout.state_names)):
            if key == STATE and labels != CHANNELS:
                continue  # a state of these names is what the car is told when it drives: its last action
            limits = action_limits(labels, self.car)
            for name, values, low, high in zip(labels, self.columns[key].T, *limits, strict=True):
                if len(wrong := np.flatnonzero((values < low) | (values > high))):
                    text = f"{name} of '{key}' is {values[wrong[0]]:g} in {len(wrong)} frames from {wrong[0]} on"
                    remedy = "are names (--action-names) and units right? if it reverses, say reverse_us in car.yml"
                    raise EpisodeError(f"{self.root}: {text}, a rover's lies from {low:g} to {high:g}", remedy=remedy)

    def _camera(self, key: str, size: tuple[int, int]) -> _Camera:
        """Find each row's picture of a camera."""
        if self.features[key]["dtype"] == "video":
            self._check_videos(key, size)
            return self._video_camera(key, size)
        from datasets import Dataset, Features, Image
        from lerobot.utils.utils import SuppressProgressBars

        paths: list[Path] = []
        for row in self.entries:
            paths += [self._file(row)] * row["length"]
        with SuppressProgressBars():
            undecoded = Features({key: Image(decode=False)})
            rows = Dataset.from_parquet([str(path) for path in dict.fromkeys(paths)], columns=[key], features=undecoded)
        return _Camera(key, size, paths, rows=rows)

    def _video_camera(self, key: str, size: tuple[int, int]) -> _Camera:
        """Find each row's picture in a video. Raises EpisodeError for times at which a video shows none."""
        parts: list[tuple[Path, float, float, Mapping[str, Any]]] = []
        for row in self.entries:
            parts += [(*self._shown(row, key), row)] * row["length"]
        times_s = np.array([first_s for _, first_s, *_ in parts]) + self.columns["timestamp"]
        torn = np.zeros(len(parts), bool)
        for path in dict.fromkeys(path for path, *_ in parts):
            rows = np.array([k for k, part in enumerate(parts) if part[0] == path])
            with _as_episode_error(f"{path}: cannot be decoded"):
                times_s[rows], off_s, torn[rows] = match_pictures(path, times_s[rows], self.fps, TOLERANCE_S)
            numbers = np.array([parts[k][3]["episode_index"] for k in rows])
            for number in np.unique(numbers[off_s > TOLERANCE_S]):
                most_s = float(off_s[numbers == number].max())
                note = f"episode {number}: from_timestamp is {1000 * most_s:.2g} ms off the pictures in {path.name}"
                if most_s * self.fps > OFF:
                    remedy = "correct it in meta/episodes, or merge the original datasets again with a newer LeRobot"
                    raise EpisodeError(f"{self.root}: {note}", found=f"{self.fps:g} a second", remedy=remedy)
                note += "; the nearest are taken, and LeRobot's training would refuse them: correct it in meta/episodes"
                self.faults.add(self.root / "meta/episodes", "other_times", note)
        paths = [path for path, *_ in parts]
        return _Camera(key, size, paths, times_s.tolist(), torn=frozenset(np.flatnonzero(torn).tolist()))

    def _check_videos(self, key: str, size: tuple[int, int]) -> None:
        """Raise EpisodeError unless each video has the camera's size, and each episode a part of it, of its length.

        The merge of LeRobot 0.4.0 wrote times by which an episode is shown another one's pictures.
        """
        parts = [(*self._shown(row, key), row["episode_index"], row["length"]) for row in self.entries]
        for file in dict.fromkeys(path for path, *_ in parts):
            _check_file(self.root, file)
            with _as_episode_error(f"{file}: cannot be decoded"):
                untrusted.check_video(file, size)
        wrong = {number for _, begin, end, number, n in parts if abs((end - begin) * self.fps - n) >= 1}
        for before, after in pairwise(sorted(parts, key=lambda part: part[:2])):
            if before[0] == after[0] and before[2] > after[1] + 0.5 / self.fps:
                wrong.add(after[3])
        if wrong:
            actual = f"episode {min(wrong)}, and {len(wrong) - 1} more, have another part of a video than their frames"
            remedy = "merge the original datasets again with a newer LeRobot (lerobot-edit-dataset), or copy it again"
            raise EpisodeError(f"{self.root}: meta/episodes does not fit the videos", found=actual, remedy=remedy)

    def episode(self, entry: Mapping[str, Any], chunk: int) -> Episode:
        """Make samples of an episode's frames; none, and a fault, if a number is missing."""
        number = entry["episode_index"]
        rows = np.flatnonzero(self.columns["episode_index"] == number)
        columns = {key: values[rows] for key, values in self.columns.items()}
        n = len(rows)
        name = f"episode_{number:06d}"
        chunks, pads = following(columns[ACTION], chunk)
        taken_over = columns.get(INTERVENTION, np.zeros(n)).astype(bool)
        times_s = columns["timestamp"] - columns["timestamp"][0]
        finite = np.isfinite(columns[ACTION]).all() and np.isfinite(columns[STATE]).all()
        self.faults.add(self.root / name, "not_finite", "a number of its states or actions is missing", not finite)
        camera = next(iter(self.cameras.values()))
        samples = list[Sample]()
        for k, row in enumerate(rows.tolist()):
            if finite and row not in self.unusable:
                driver = HUMAN if taken_over[k] else self.drivers[number]
                numbers = columns[STATE][k], chunks[k], pads[k]
                source = name, camera.paths[row], float(times_s[k])
                samples.append(LerobotSample(*source, *numbers, row, driver, self.car, cameras=self.cameras))
        videos = [self._file(entry, key) for key in self.keys.values() if self.features[key]["dtype"] == "video"]
        files = (self.root / INFO, self._file(entry), *videos)
        label = str((entry.get("tasks") or [""])[0])
        corrects = bool(taken_over.any())
        return Episode(name, self.root, label, float(times_s[-1]), n, n, tuple(samples), files, corrects=corrects)


def _read_export(root: Path, episodes: int, marked: bool, faults: Faults) -> tuple[list[str], Car]:
    """Return who drove in each episode where nobody intervened, as a dataset may have `marked`, and whose car."""
    drivers = [POLICY if marked else HUMAN] * episodes
    car = this_car()
    if (root / REPORT).is_file():
        try:
            report = untrusted.read_json(root / REPORT, INFO_BYTES)
            car = Car.of(report[CAR], "the exported car")  # right also if somebody has removed episodes since
            driver = report[DRIVEN_BY]
            if len(driver) != episodes or not set(driver) <= {POLICY, HUMAN}:
                raise ValueError(f"it is of {len(driver)} episodes, here are {episodes}, or has unknown words")
            drivers = driver
        except (OSError, ValueError, TypeError, KeyError, CarError) as e:
            faults.add(root / REPORT, "another_export", f"not used: {quote(str(e))}")
    return drivers, car


def _read_info(root: Path) -> dict[str, Any]:
    """Read meta/info.json. Raises EpisodeError."""
    path = root / INFO
    refuse_pointer(path, EpisodeError)
    with _as_episode_error(f"{path}: not readable as JSON"):
        info: Any = untrusted.read_json(path, INFO_BYTES)
    if not isinstance(info, dict) or not info.keys() & {"codebase_version", "data_path", "total_frames"}:
        remedy = "give a LeRobotDataset, donkeycar's tub, or a folder of episodes"
        problem = f"{root}: another program's {INFO}, not that of a LeRobotDataset"
        raise EpisodeError(problem, found=quote_all(info) if isinstance(info, dict) else quote(info), remedy=remedy)
    version = str(info.get("codebase_version", "without a version"))
    if not version.removeprefix("v").startswith(("2", "3")):
        remedy = "convert it to v2.1 by a LeRobot of that time, or use a newer version of this"
        raise EpisodeError(f"{root}: a LeRobotDataset {quote(version)}, only v2 and v3 are read", remedy=remedy)
    features: Any = info.get("features")
    fps = info.get("fps")
    try:
        shapes = [feature.get("shape") or () for feature in features.values()]
        right = all(is_whole(n, 1, 10_000) for n in chain.from_iterable(shapes))
        right = right and 0 < len(features) <= MOST_FEATURES and isinstance(info.get("data_path"), str)
    except (AttributeError, TypeError, KeyError):
        right = False
    if not right or not is_number(fps, 0, 1000) or not fps:
        also = f", and {STATS} is missing" if version == "v2.1" and not (root / STATS).exists() else ""
        problem = f"{path}: lacks a data_path, frames per second, or features with dtype and shape{also}"
        raise _broken(problem, quote(fps))
    for key, alternatives in ALSO.items():
        if column := next((name for name in (key, *alternatives) if name in features), None):
            features[key] = features[column] | {"column": column}
    return info


def _layout(root: Path, info: Mapping[str, Any], source: Source) -> tuple[Layout, dict[str, str]]:
    """Find the names and columns of states and actions, and the cameras: by name the key."""
    features = info["features"]
    keys = camera_names(k for k, f in features.items() if f.get("dtype") in ("image", "video"))
    if not keys:
        remedy = f"if one of these is a camera's, call its dtype 'image' or 'video' in {INFO}, else record with one"
        raise EpisodeError(f"{root}: has no camera", found=quote_all(features), remedy=remedy)
    names = source.cameras or (tuple(keys) if len(keys) == 1 else ())
    missing = [name for name in names if name not in keys]
    if missing or not names or len(set(names)) < len(names):
        text = f"has no camera {quote(missing[0])}" if missing else f"has {len(keys)} cameras"
        remedy = "name once each what the policy looks through: --camera NAME, with commas between several"
        raise EpisodeError(f"{root}: {text}", found=quote_all(keys), remedy=remedy)
    sizes = {name: _picture_size(root, keys[name], features[keys[name]]) for name in names}
    has_state = STATE in features
    names_passed = source.action_names  # without one it is the last action
    if not has_state and (similar := [k for k in features if re.search(STATES, k) and "environment" not in k]):
        remedy = f"if it is the state, call it '{STATE}' in {INFO} and in the tables, else remove it"
        raise EpisodeError(f"{root}: has no '{STATE}'", found=quote_all(similar), remedy=remedy)
    for key in (STATE, ACTION) if has_state else (ACTION,):
        row = features.get(key, {})  # LeRobot makes 1 of 0.3 where it says bool
        if len(row.get("shape") or ()) != 1 or not str(row.get("dtype")).startswith(("float", "int", "uint")):
            text = f"{root}: its '{key}' is missing or not a row of numbers"
            raise EpisodeError(text, found=quote_all(features), remedy=f"call it '{key}' in {INFO} and in the tables")
    actions, action_order = name_numbers(root, features, ACTION, names_passed)
    states, state_order = name_states(root, features, names_passed) if has_state else (actions, action_order)
    layout = Layout(names, states, actions, float(info["fps"]), state_order, action_order, sizes, has_state)
    return layout, {name: keys[name] for name in names}


def _picture_size(root: Path, key: str, feature: Mapping[str, Any]) -> tuple[int, int]:
    shape = list(feature["shape"])
    kind = feature.get("info")
    depth = isinstance(kind, dict) and (kind.get("is_depth_map") or kind.get("video.is_depth_map"))
    if depth or len(shape) != 3 or 3 not in (shape[0], shape[2]):
        remedy = "choose another: --camera NAME, or record with one in colours"
        raise EpisodeError(f"{root}: '{key}' is not a colour camera", found=shape, remedy=remedy)
    # The colours come last or first.
    height, width = shape[1:] if shape[0] <= 4 < shape[2] else shape[:2]
    if height * width > PICTURE_PIXELS:
        raise EpisodeError(f"{root}: '{key}' has pictures of {width}x{height}", remedy="scale them down")
    return height, width


def _check_file(root: Path, path: Path) -> None:
    """Raise EpisodeError for a file that leads elsewhere, is not there or is Git LFS's."""
    untrusted.check_inside(root, path)
    if not path.is_file():
        raise _broken(f"{root}: has no {path.relative_to(root)}")
    refuse_pointer(path, EpisodeError)


def _read_table(root: Path, path: Path, columns: str, needed: Iterable[str] = ()) -> Any:
    """The columns of a table whose names match. Raises EpisodeError for what is no table or lacks a `needed` one."""
    from pyarrow import parquet

    _check_file(root, path)
    with _as_episode_error(f"{path}: cannot be read"):
        names = untrusted.check_table(path)
        if missing := {*needed} - {*names}:
            raise _broken(f"{path}: its columns are not those of {INFO}", quote_all(sorted(missing)))
        return parquet.ParquetFile(path).read(columns=[name for name in names if re.fullmatch(columns, name)])


def _numbers(column: Any) -> np.ndarray:
    """A table's column as (rows, numbers). Raises ValueError for rows of different lengths, and missing ones."""
    from pyarrow import compute, types

    nested = types.is_nested(column.type)
    if nested and (len(compute.unique(compute.list_value_length(column))) > 1 or column.null_count):
        raise ValueError("rows of different lengths")
    return (compute.list_flatten(column) if nested else column).to_numpy().reshape(len(column), -1)


@contextmanager
def _as_episode_error(what: str) -> Iterator[None]:
    """Turn any error of a loader inside the block into an EpisodeError of one sentence. what: what went wrong."""
    try:
        yield
    except EpisodeError:
        raise
    except Exception as e:  # parquet, mp4, datasets and LeRobot each raise types of their own
        cause = e.__cause__ or e  # datasets wraps pyarrow's error
        raise _broken(f"{what} ({type(cause).__name__}: {' '.join(str(cause).split())[:160]})") from None
