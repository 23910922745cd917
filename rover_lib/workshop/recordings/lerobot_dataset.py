"""Read a LeRobotDataset of version 2 or 3, with images or video, and check it before it is used.

What its numbers mean is read from the names of its features, or said by the user, and never guessed. Only tables that
meta/ names and columns that are used are read, so what Macs, pandas, notebooks and annotators leave there does no harm.
"""

import io
import json
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.car.picture import check_jpeg, decode_jpeg
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import CameraError, CarError, EpisodeError
from rover_lib.onboard.kinds import refuse_pointer
from rover_lib.onboard.policy.load import action_limits
from rover_lib.onboard.recording.episode import HUMAN, POLICY
from rover_lib.onboard.stage import read_plain
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.controls import Faults
from rover_lib.workshop.recordings.copies import leave_out_copies
from rover_lib.workshop.recordings.names import ACTION, STATE, name_numbers, name_states
from rover_lib.workshop.recordings.samples import (
    ACTION_NAMES,
    Episode,
    Layout,
    Recordings,
    Sample,
    Source,
    camera_names,
)
from rover_lib.workshop.untrusted import (
    JSON_BYTES,
    check_encoded,
    check_inside,
    check_table,
    check_video,
    limited_memory,
    quote,
    quote_all,
    read_json,
)

INFO = Path("meta/info.json")
INFO_BYTES = 5_000_000  # LeRobot's: some kB
MOST_FEATURES = 200  # an arm with six cameras has 20
PICTURE_PIXELS = 4608 * 2592  # at most: a Pi camera's largest
BACKEND = "pyav"  # needs no FFmpeg on the machine, as torchcodec does
TOLERANCE_S = 1e-4  # LeRobot's, between a frame's time and that of a picture in its video
ALSO = {STATE: "state", ACTION: "actions"}  # openpi's words for the same
NUMBERS = ("timestamp", "frame_index", "episode_index", "index")
TASK = "task_index"
STATS = "meta/episodes_stats.jsonl"  # of version 2.1
INTERVENTION = "intervention"  # as lerobot-rollout writes it: in this frame a human had taken over from a policy
REPORT = "rover_export.json"  # beside a dataset of our own; of each episode it says:
DRIVEN_BY = "driven_by"  # who drove where nobody intervened
CAR = "car"  # and of them all, the content of their car.yml
UNEVEN = 0.1  # the time between two frames may differ by this share
JPEG = b"\xff\xd8"
OURS = re.compile(r"file-\d+\.parquet")  # among "._file-000.parquet" and "file-000-checkpoint.parquet"


def _broken(what: str, found: object = None) -> EpisodeError:
    """The error of a dataset that no LeRobot wrote so, for the caller to raise."""
    return EpisodeError(f"{what}: a broken dataset", found=found, remedy="copy the whole dataset again")


def is_dataset(root: Path) -> bool:
    """Whether a folder is a LeRobotDataset, of whatever version."""
    return (root / INFO).is_file()


@dataclass(frozen=True, eq=False)
class _Camera:
    """One camera. size: (height, width). paths: each row's file. times_s: when its picture is shown in a video.

    rows: else all rows, from which Hugging Face's library reads one picture without its table's others.
    """

    key: str
    size: tuple[int, int]
    paths: Sequence[Path]
    times_s: Sequence[float] = ()
    rows: Any = None

    def encoded(self, row: int) -> bytes:
        """The bytes of a picture in a table; none if there is none, or it is in a video."""
        return ((self.rows[row][self.key] if self.rows else None) or {}).get("bytes") or b""

    def is_torn(self, row: int) -> bool:
        """Whether a picture is a torn JPEG, of which most decoders make a picture."""
        data = self.encoded(row)
        try:
            return data.startswith(JPEG) and not check_jpeg(data)
        except CameraError:
            return True

    def read_bgr(self, row: int) -> np.ndarray:
        """Read a picture, (h, w, 3) uint8 BGR. Raises EpisodeError, CameraError and what decoders raise."""
        where = f"{self.paths[row]}: its frame {row} of '{self.key}'"
        if not self.rows:
            from lerobot.datasets.video_utils import decode_video_frames

            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # torchvision warns of the decoder
                shown = decode_video_frames(self.paths[row], [self.times_s[row]], TOLERANCE_S, BACKEND)[0]
            # (3, h, w) float32 in [0, 1]. Dividing a uint8 by 255 and multiplying by 255 again is exact.
            rgb = (shown * 255).round().byte().permute(1, 2, 0).numpy()
        else:
            from PIL import Image

            data = self.encoded(row)
            check_encoded(where, {"bytes": data}, self.size)
            rgb = decode_jpeg(data)[..., ::-1] if data.startswith(JPEG) else np.asarray(Image.open(io.BytesIO(data)))
        if rgb.shape != (*self.size, 3):
            raise _broken(f"{where} has another shape than {self.size} in {INFO}", rgb.shape)
        return np.ascontiguousarray(rgb[..., ::-1])


@dataclass(frozen=True, eq=False)
class LerobotSample(Sample):
    """A sample whose picture is one of many in `frame_path`, a parquet or mp4 file (that of the first camera).

    cameras: by the policy's names.
    """

    cameras: Mapping[str, _Camera] = field(kw_only=True)

    @property
    def frame_name(self) -> str:
        return f"frame {self.row}"

    def frame_bgr(self) -> Any:
        """Read the picture, (h, w, 3) uint8 BGR; of several cameras, a dict by their names.

        Raises EpisodeError if it cannot be decoded, or has another size than the others.
        """
        with _as_episode_error(f"{self.frame_path}: its frame {self.row} cannot be decoded"), limited_memory():
            frames = {name: camera.read_bgr(self.row) for name, camera in self.cameras.items()}
        return frames if len(frames) > 1 else self.turned(next(iter(frames.values())))


@dataclass(frozen=True)
class _Entry:
    """What meta/ says of an episode. ends: its first row and the next one's, None in version 2.

    videos: by its camera's key, the file and from when to when in it, in seconds.
    """

    number: int
    length: int
    ends: tuple[int | None, int | None]
    data: Path
    videos: Mapping[str, tuple[Path, float, float]]


def load_dataset(source: Source, chunk: int, progress: Progress = silent) -> Recordings:
    """Read a LeRobotDataset's folder.

    chunk: actions per sample, padded at an episode's end with its last one. Each frame is a sample, with the state that
    was recorded with it, or the action before. A human drove; if the dataset marks interventions, in the marked frames,
    and a policy in all others, unless our own export says otherwise. Raises EpisodeError for another version, damaged
    or missing files, numbers that no rover can have, and if nothing says which camera and which numbers are the car's.
    """
    root = source.path
    info = _read_info(root)
    layout, keys = _layout(root, info, source)
    faults = Faults(root)
    with _as_episode_error(f"{root}: cannot be read"):
        with limited_memory():
            entries = _read_entries(root, info)
            files = _check_files(root, info["features"], entries, [key for key, _ in keys.values()])
        with limited_memory(3 * sum(path.stat().st_size for path in files)):
            columns = _columns(files, info["features"], layout)
            starts = _check_frames(root, info["fps"], entries, columns, faults)
            cameras = {
                name: _camera(root, info, key, size, entries, columns["timestamp"])
                for name, (key, size) in keys.items()
            }
            drivers, car = _read_export(root, len(starts), INTERVENTION in columns, faults)
            _check_numbers(root, columns, layout, car)
            # A camera's pictures are of one kind, and a torn PNG is never decoded.
            in_jpeg = [camera for camera in cameras.values() if camera.encoded(0).startswith(JPEG)]
            torn = {row for camera in in_jpeg for row in range(len(columns["index"])) if camera.is_torn(row)}
    faults.add(root, "broken_jpeg", "pictures that are torn or damaged", len(torn))
    if str(info["codebase_version"]).startswith("v2.1") and not (root / STATS).exists():
        faults.add(root / STATS, "no_statistics", f"{STATS} is missing: LeRobot's converter to version 3 would fail")
    tasks = _read_tasks(root)
    episodes = []
    for entry in progress(entries, desc="reading episodes", total=len(entries)):
        episode = _episode(root, entry, tasks, cameras, columns, torn, chunk, drivers[entry.number], car)
        episodes += [episode] if episode.samples else []
    last = {e.samples[-1].frame_path: e.samples[-1] for e in episodes}
    for sample in last.values():  # the last picture of each file, because a file that was cut lacks its end
        sample.frame_bgr()
    return Recordings(root, leave_out_copies(episodes, faults), faults.listed(), source, layout)


def _read_export(root: Path, episodes: int, marked: bool, faults: Faults) -> tuple[list[str], Car]:
    """Return who drove in each episode where nobody intervened, and whose car; a fault if REPORT is of other episodes.

    marked: whether the dataset marks interventions.
    """
    drivers, car = [POLICY if marked else HUMAN] * episodes, this_car()
    if not (root / REPORT).is_file():
        return drivers, car
    try:
        report = read_json(root / REPORT, INFO_BYTES)
        car = Car.of(report[CAR], "the exported car")  # right also if somebody has removed episodes since
        said = report[DRIVEN_BY]
        if len(said) != episodes or not set(said) <= {POLICY, HUMAN}:
            raise ValueError(f"it is of {len(said)} episodes, here are {episodes}, or has unknown words")
    except (OSError, ValueError, TypeError, KeyError, CarError) as e:
        faults.add(root / REPORT, "another_export", f"not used: {quote(str(e))}")
        return drivers, car
    return said, car


def _read_info(root: Path) -> dict[str, Any]:
    """Read meta/info.json. Raises EpisodeError."""
    path = root / INFO
    refuse_pointer(path, EpisodeError)
    try:
        info = read_json(path, INFO_BYTES)
    except (OSError, ValueError) as e:
        raise _broken(f"{path}: not readable as JSON ({quote(str(e))})") from None
    version = str(info.get("codebase_version")) if isinstance(info, dict) else "without a version"
    if not version.startswith(("v2", "v3")):
        remedy = "convert it to v2.1 by a LeRobot of that time, or use a newer version of this"
        raise EpisodeError(f"{root}: a LeRobotDataset {quote(version)}, only v2 and v3 are read", remedy=remedy)
    features, fps = info.get("features"), info.get("fps")
    try:
        right = len(features) <= MOST_FEATURES and not any("/" in name for name in features)
        shapes = [feature.get("shape") or () for feature in features.values()]
        right = right and all(is_whole(n, 1, 10_000) for shape in shapes for n in shape)
        paths = [Path(str(info.get(name))) for name in ("data_path", "video_path")]
        right = right and not any(path.is_absolute() or ".." in path.parts for path in paths)
    except (AttributeError, TypeError, KeyError):
        right = False
    if not right or not is_number(fps, 0, 1000) or not fps:
        raise _broken(f"{path}: lacks frames per second, or plain features with a dtype and a shape", quote(fps))
    if not features:
        also = f", and {STATS} is missing" if version == "v2.1" and not (root / STATS).exists() else ""
        raise _broken(f"{path}: names no features{also}")
    for key, other in ALSO.items():
        column = other if key not in features and other in features else key
        if column in features:
            features[key] = features[column] | {"column": column}
    return info


def _layout(
    root: Path, info: Mapping[str, Any], source: Source
) -> tuple[Layout, dict[str, tuple[str, tuple[int, int]]]]:
    """Find the names and columns of states and actions, and the cameras: by name the key and (height, width)."""
    features = info["features"]
    keys = camera_names(k for k, f in features.items() if f.get("dtype") in ("image", "video"))
    if not keys:
        raise EpisodeError(f"{root}: has no camera", found=quote_all(features), remedy="record one that sees")
    names = source.cameras or (tuple(keys) if len(keys) == 1 else ())
    missing = [name for name in names if name not in keys]
    if missing or not names or len(set(names)) < len(names):
        what = f"has no camera {quote(missing[0])}" if missing else f"has {len(keys)} cameras"
        remedy = "say once each what the policy looks through: --camera NAME, with commas between several"
        raise EpisodeError(f"{root}: {what}", found=quote_all(keys), remedy=remedy)
    cameras = {name: (keys[name], _picture_size(root, keys[name], features[keys[name]])) for name in names}
    for key in (STATE, ACTION):
        if key == STATE and key not in features:
            continue  # then it is the last action
        row = features.get(key, {})  # LeRobot makes 1 of 0.3 where it says bool
        if len(row.get("shape") or ()) != 1 or not str(row.get("dtype")).startswith(("float", "int", "uint")):
            what = f"{root}: its '{key}' is missing or not a row of numbers"
            raise EpisodeError(what, found=quote_all(features), remedy=f"record one, or name its column '{key}'")
    sizes = {name: size for name, (_, size) in cameras.items()}
    actions, action_order = name_numbers(root, features, ACTION, source.action_names)
    states, state_order, has_state = actions, action_order, STATE in features
    if has_state:
        states, state_order = name_states(root, features, source.action_names)
    return Layout(names, states, actions, float(info["fps"]), state_order, action_order, sizes, has_state), cameras


def _picture_size(root: Path, key: str, feature: Mapping[str, Any]) -> tuple[int, int]:
    shape, kind = list(feature["shape"]), feature.get("info")
    depth = isinstance(kind, dict) and (kind.get("is_depth_map") or kind.get("video.is_depth_map"))
    if depth or len(shape) != 3 or 3 not in (shape[0], shape[2]):
        remedy = "choose another: --camera NAME"
        raise EpisodeError(f"{root}: '{key}' is not a colour camera", found=shape, remedy=remedy)
    # The colours come last or first.
    height, width = shape[1:] if shape[0] <= 4 < shape[2] else shape[:2]
    if height * width > PICTURE_PIXELS:
        raise EpisodeError(f"{root}: '{key}' has pictures of {width}x{height}", remedy="scale them down")
    return height, width


def _read_entries(root: Path, info: Mapping[str, Any]) -> list[_Entry]:
    """Read what meta/ says of the episodes, by their number."""
    if info["codebase_version"].startswith("v2"):
        rows = _json_lines(root / "meta/episodes.jsonl")
    else:
        tables = sorted(path for path in root.glob("meta/episodes/*/*") if OURS.fullmatch(path.name))
        if not tables:
            raise _broken(f"{root}: has no meta/episodes/*/*.parquet")
        rows = [row for path in tables for row in _read_table(root, path, "(?!stats/).*").to_pylist()]
    return sorted((_entry(root, info, row) for row in rows), key=lambda entry: entry.number)


def _entry(root: Path, info: Mapping[str, Any], row: Mapping[str, Any]) -> _Entry:
    """Version 2 has files of each episode, and version 3 files that its tables name."""
    number, length = row["episode_index"], row["length"]
    own = {"episode_index": number, "episode_chunk": number // info.get("chunks_size", 1000)}

    def path_of(template: str, where: str, **more: str) -> Path:
        parts = {part: row[f"{where}/{part}"] for part in ("chunk_index", "file_index") if f"{where}/{part}" in row}
        return root / info[template].format(**own, **parts, **more)

    videos = {}
    for key, feature in info["features"].items():
        if feature.get("dtype") == "video":
            file, first_s = f"videos/{key}", row.get(f"videos/{key}/from_timestamp", 0.0)
            last_s = row.get(f"videos/{key}/to_timestamp", length / info["fps"])
            videos[key] = path_of("video_path", file, video_key=key), first_s, last_s
    ends = row.get("dataset_from_index"), row.get("dataset_to_index")
    return _Entry(number, length, ends, path_of("data_path", "data"), videos)


def _json_lines(path: Path) -> list[dict[str, Any]]:
    refuse_pointer(path, EpisodeError)
    return [json.loads(line) for line in read_plain(path, JSON_BYTES).splitlines() if line.strip()]


def _read_tasks(root: Path) -> dict[int, str]:
    """Return each task's words by its number; none where no file says them."""
    try:
        if (lines := root / "meta/tasks.jsonl").is_file():
            return {row[TASK]: str(row["task"]) for row in _json_lines(lines)}
        rows = _read_table(root, root / "meta/tasks.parquet").to_pylist()
        # pandas writes the words as its index, others as a column
        words = next(name for name in ("task", "__index_level_0__") if name in rows[0])
        return {row[TASK]: str(row[words]) for row in rows}
    except Exception:  # of parquet's many types; a label changes nothing that is computed
        return {}


def _read_table(root: Path, path: Path, columns: str = ".*") -> Any:
    """The columns of a table whose names match. Raises EpisodeError for what is no table."""
    from pyarrow import parquet

    check_inside(root, path)
    refuse_pointer(path, EpisodeError)
    with _as_episode_error(f"{path}: cannot be read"):
        names = [name for name in check_table(path) if re.fullmatch(columns, name)]
        return parquet.ParquetFile(path).read(columns=names)


def _check_files(
    root: Path, features: Mapping[str, Any], entries: Sequence[_Entry], cameras: Sequence[str]
) -> list[Path]:
    """Return the tables of frames, in the order of their rows.

    Raises EpisodeError for files that are not there, lead elsewhere or are Git LFS's, and for tables without a column
    that is read.
    """
    files = list(dict.fromkeys(entry.data for entry in entries))
    videos = dict.fromkeys(path for entry in entries for key, (path, *_) in entry.videos.items() if key in cameras)
    for path in (*files, *videos):
        if not path.is_file():
            raise _broken(f"{root}: has no {path.relative_to(root)}")
        check_inside(root, path)
        refuse_pointer(path, EpisodeError)
    used = {*_keys(features).values(), *(key for key in cameras if features[key]["dtype"] == "image")}
    for path in files:
        with _as_episode_error(f"{path}: cannot be read"):
            missing = used - {*check_table(path)}
        if missing:
            raise _broken(f"{path}: its columns are not those of {INFO}", quote_all(sorted(missing)))
    return files


def _keys(features: Mapping[str, Any]) -> dict[str, str]:
    """The columns of numbers that are read, by LeRobot's keys of them."""
    others = [key for key in (STATE, ACTION, TASK, INTERVENTION) if key in features]
    return {key: key for key in NUMBERS} | {key: features[key].get("column", key) for key in others}


def _camera(
    root: Path, info: Mapping[str, Any], key: str, size: tuple[int, int], entries: Sequence[_Entry], times_s: np.ndarray
) -> _Camera:
    """Find each row's picture of a camera. times_s: each row's in its episode."""
    if info["features"][key]["dtype"] == "video":
        _check_videos(root, info["fps"], key, size, entries)
        paths = [entry.videos[key][0] for entry in entries for _ in range(entry.length)]
        first_s = [entry.videos[key][1] for entry in entries for _ in range(entry.length)]
        return _Camera(key, size, paths, (np.array(first_s) + times_s).tolist())
    from datasets import Dataset, Features, Image
    from lerobot.utils.utils import SuppressProgressBars

    paths = [entry.data for entry in entries for _ in range(entry.length)]
    with SuppressProgressBars():
        kept = Features({key: Image(decode=False)})
        rows = Dataset.from_parquet([str(path) for path in dict.fromkeys(paths)], columns=[key], features=kept)
    return _Camera(key, size, paths, rows=rows)


def _check_videos(root: Path, fps: float, key: str, size: tuple[int, int], entries: Sequence[_Entry]) -> None:
    """Raise EpisodeError unless each video has the camera's size, and each episode a part of its own, of its length.

    The merge of LeRobot 0.4.0 wrote times by which an episode is shown another one's pictures.
    """
    shown = [entry.videos[key] for entry in entries]
    for file in sorted({path for path, _, _ in shown}):
        with _as_episode_error(f"{file}: cannot be decoded"):
            check_video(file, size)
    wrong = {
        i for i, (_, first_s, last_s) in enumerate(shown) if abs((last_s - first_s) * fps - entries[i].length) >= 1
    }
    for i, after in pairwise(sorted(range(len(shown)), key=lambda i: shown[i][:2])):
        if shown[i][0] == shown[after][0] and shown[i][2] > shown[after][1] + 0.5 / fps:
            wrong.add(after)
    if wrong:
        found = f"episode {min(wrong)}, and {len(wrong) - 1} more, have another part of a video than their frames"
        remedy = "merge the original datasets again with a newer LeRobot (lerobot-edit-dataset), or copy it again"
        raise EpisodeError(f"{root}: meta/episodes does not fit the videos", found=found, remedy=remedy)


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


def _columns(files: Sequence[Path], features: Mapping[str, Any], layout: Layout) -> dict[str, np.ndarray]:
    """All frames' numbers, in their order: state (n, S) and action (n, A) float32 by the layout's names, and times."""
    from pyarrow import parquet

    keys = _keys(features)
    tables = [parquet.ParquetFile(path).read(columns=list(keys.values())) for path in files]
    columns = {
        key: np.concatenate([_numbers(table.column(column)) for table in tables]) for key, column in keys.items()
    }
    for key, order in ((STATE, layout.state_order), (ACTION, layout.action_order)):
        if key in columns:
            columns[key] = np.ascontiguousarray(columns[key].astype(np.float32)[:, list(order)])
    if STATE not in columns:  # as in our own recordings, it is the action before
        columns[STATE] = np.roll(columns[ACTION], 1, axis=0)
        columns[STATE][columns["frame_index"].ravel() == 0] = 0
    return {key: values if key in (STATE, ACTION) else values.ravel() for key, values in columns.items()}


def _numbers(column: Any) -> np.ndarray:
    """A table's column as (rows, numbers). Raises ValueError for rows of different lengths, and missing ones."""
    from pyarrow import compute, types

    if types.is_nested(column.type):
        if len(compute.unique(compute.list_value_length(column))) > 1 or column.null_count:
            raise ValueError("rows of different lengths")
        return compute.list_flatten(column).to_numpy().reshape(len(column), -1)
    return column.to_numpy().reshape(len(column), -1)


def _check_numbers(root: Path, columns: Mapping[str, np.ndarray], layout: Layout, car: Car) -> None:
    """Raise EpisodeError for states and actions that are not finite, and for actions beyond what the car can do."""
    for key, labels in ((STATE, layout.state_names), (ACTION, layout.action_names)):
        lows, highs = action_limits(labels, car)
        for i, name in enumerate(labels):
            # A state of these names is what the car is told when it drives: its last action.
            low, high = (lows[i], highs[i]) if key == ACTION or labels == ACTION_NAMES else (-np.inf, np.inf)
            values = columns[key][:, i]
            # written so that NaN is wrong
            wrong = np.flatnonzero(~(np.isfinite(values) & (values >= low) & (values <= high)))
            if len(wrong):
                what = f"{root}: {name} of '{key}' is {values[wrong[0]]:g} in {len(wrong)} frames from {wrong[0]} on"
                remedy = "are names (--action-names) and units right? if the car reverses, say reverse_us in car.yml"
                raise EpisodeError(f"{what}, a rover's lies from {low:g} to {high:g}", remedy=remedy)


def _check_frames(
    root: Path, fps: float, entries: Sequence[_Entry], columns: Mapping[str, np.ndarray], faults: Faults
) -> np.ndarray:
    """Return the row at which each episode starts.

    Raises EpisodeError for rows that are not the frames in their order, each once, and of the lengths in meta/, and for
    frames that do not come `fps` times a second from 0 s on.
    """
    number, times_s = columns["episode_index"], columns["timestamp"].astype(np.float64)
    starts, rows = np.flatnonzero(np.diff(number, prepend=-1)), np.arange(len(number))
    lengths = np.diff([*starts, len(number)])
    within = rows - np.repeat(starts, lengths)
    ordered = np.array_equal(columns["index"], rows) and np.array_equal(columns["frame_index"], within)
    said = np.array([[entry.number, entry.length] for entry in entries]).reshape(-1, 2)
    if not ordered or not np.array_equal(said, np.stack([np.arange(len(starts)), lengths], 1)):
        raise _broken(f"{root}: meta/episodes and the frames in data, or their order, do not belong together")
    firsts = np.cumsum(lengths) - lengths
    scrambled = [e for e in entries if e.ends not in ((None, None), (firsts[e.number], firsts[e.number] + e.length))]
    note = "dataset_from_index and _to_index of an early converter: convert it again by a newer LeRobot to train there"
    faults.add(root / "meta/episodes", "scrambled_index", note, len(scrambled))
    steps = np.where(within > 0, np.diff(times_s, prepend=0.0), times_s + 1 / fps) * fps  # of a first frame, from 0 s
    if len(odd := steps[~(np.abs(steps - 1) <= np.where(within > 0, UNEVEN, 1))]):  # so that NaN counts as odd
        what = f"{root}: {INFO} says {fps:g} frames a second, but {len(odd)} frames come at another rate"
        found = f"{odd[0] / fps:.4f} s after the one before"
        raise EpisodeError(what, found=found, remedy="correct the rate, or record again")
    return starts


def _episode(
    root: Path,
    entry: _Entry,
    tasks: Mapping[int, str],
    cameras: Mapping[str, _Camera],
    columns: Mapping[str, np.ndarray],
    torn: set[int],
    chunk: int,
    driver: str,
    car: Car,
) -> Episode:
    rows = np.flatnonzero(columns["episode_index"] == entry.number)
    n, name = len(rows), f"episode_{entry.number:06d}"
    camera = next(iter(cameras.values()))
    index = np.arange(n)[:, None] + np.arange(chunk)
    actions, pads = columns[ACTION][rows], index >= n
    chunks = actions[np.minimum(index, n - 1)]
    taken_over = columns[INTERVENTION][rows].astype(bool) if INTERVENTION in columns else np.zeros(n, bool)
    samples = tuple(
        LerobotSample(
            episode=name,
            frame_path=camera.paths[row],
            time_s=float(columns["timestamp"][row] - columns["timestamp"][rows[0]]),
            state=columns[STATE][row].copy(),
            chunk=chunks[k].copy(),
            is_pad=pads[k].copy(),
            cameras=cameras,
            row=row,
            driver=HUMAN if taken_over[k] else driver,
            car=car,
        )
        for k, row in enumerate(rows.tolist())
        if row not in torn
    )
    files = [entry.videos[c.key][0] for c in cameras.values() if c.key in entry.videos]
    return Episode(
        id=name,
        path=root,
        label=tasks.get(int(columns[TASK][rows[0]]), "") if TASK in columns else "",
        duration_s=float(columns["timestamp"][rows[-1]] - columns["timestamp"][rows[0]]),
        frames=n,
        controls=n,
        samples=samples,
        files=(root / INFO, entry.data, *files),
        corrects=bool(taken_over.any()),
    )


def lerobot_train(dataset: Path | str) -> str:
    """Return the command of LeRobot's own that trains an ACT on a LeRobotDataset."""
    return (
        f"lerobot-train --dataset.repo_id=local/drives --dataset.root={dataset} --policy.type=act "
        "--policy.push_to_hub=false --policy.chunk_size=32 --policy.n_action_steps=32 --output_dir=trained"
    )
