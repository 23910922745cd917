"""Read a LeRobotDataset v3, with images or video, by LeRobot's own loader, and check it before it is used.

    recordings = load_dataset(Source(Path("my_dataset"), ("throttle", "steering")), chunk=32)

The meaning of its numbers is read from the names of its features, or given by the user if they have no names. It is
never guessed: if throttle and steering were swapped, training, calibration and comparison would not notice.
"""

import codecs
import io
import json
import math
import struct
import warnings
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import CarError, EpisodeError
from rover_lib.onboard.kinds import refuse_pointer
from rover_lib.onboard.policy.load import action_limits
from rover_lib.onboard.recording.episode import HIT, HUMAN, MISSED, POLICY
from rover_lib.workshop import hub
from rover_lib.workshop.lerobot_moved import conversion
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import (
    ACTION_NAMES,
    Episode,
    Fault,
    Layout,
    Recordings,
    Sample,
    Source,
    camera_names,
)
from rover_lib.workshop.untrusted import quote, quote_all

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

INFO = Path("meta/info.json")
INFO_BYTES = 5_000_000  # LeRobot's: some kB
BACKEND = "pyav"  # needs no FFmpeg on the machine, as torchcodec does
STATE, ACTION = "observation.state", "action"
NUMBERS = (STATE, ACTION, "timestamp", "frame_index", "episode_index", "index", "task_index")
INTERVENTION = "intervention"  # as lerobot-rollout writes it: in this frame a human had taken over from a policy
SUCCESS = "next.success"
REPORT = "rover_export.json"  # beside a dataset of our own; of each episode it says:
DRIVEN_BY, OUTCOMES = ("driven_by", "outcomes")  # who drove where nobody intervened; what the drive came to, or null
CAR = "car"  # and of them all, the content of their car.yml
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
TEMPLATES = {"data_path": f"data/{FILE}.parquet", "video_path": f"videos/{{video_key}}/{FILE}.mp4"}  # of LeRobot
# What a small file may claim to hold: frames for which there are bytes, and numbers and pixels that fit in memory.
FRAMES_FREE, FRAME_BYTES = 20_000, 20
MOST_VALUES, MOST_PIXELS = 20_000_000, 20_000_000
UNPACKED_FREE, PICTURES_FREE, UNPACKED_TIMES = 100_000_000, 1_000_000, 4
COPY_AGAIN = "copy the whole dataset again"
TOLERANCE_S = 1e-4  # LeRobot's tolerance_s
UNEVEN = 0.1  # the time between two frames may differ by this share


def _broken(what: str, found: object = None) -> EpisodeError:
    """The error of a dataset that no LeRobot wrote so, for the caller to raise."""
    return EpisodeError(what, found=found, remedy=COPY_AGAIN)


def is_dataset(root: Path) -> bool:
    """Whether a folder is a LeRobotDataset, of whatever version."""
    return (root / INFO).is_file()


@dataclass(frozen=True)
class _Camera:
    """name: what the policy calls the camera. key: what the dataset calls it. size: (height, width)."""

    name: str
    key: str
    size: tuple[int, int]


@dataclass(frozen=True, eq=False)
class _Pictures:
    """The cameras of a dataset that a policy looks through, opened once for all of its samples."""

    dataset: "LeRobotDataset"
    cameras: tuple[_Camera, ...]

    def frames_bgr(self, row: int, path: Path) -> dict[str, np.ndarray]:
        """Read one frame's pictures by the cameras' names, (h, w, 3) uint8 BGR each."""
        with _said_of(path, f"its frame {row} cannot be decoded"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torchvision warns of the decoder that LeRobot has chosen
            for camera in self.cameras:
                self._check_size(camera, self._size(camera, row), row, path)  # a bomb is not decoded
            item = self.dataset[row]
            # Each is (3, h, w) float32 in [0, 1]. Dividing a uint8 by 255 and multiplying by 255 again is exact.
            pixels = [(item[camera.key] * 255).round().byte().permute(1, 2, 0).numpy() for camera in self.cameras]
        frames = {}
        for camera, frame in zip(self.cameras, pixels, strict=True):
            self._check_size(camera, frame.shape, row, path)
            frames[camera.name] = np.ascontiguousarray(frame[..., ::-1])
        return frames

    def _size(self, camera: _Camera, row: int) -> tuple[int, ...]:
        """Return the shape that a picture's header gives; for a video, what it should be."""
        from PIL import Image

        if camera.key in self.dataset.meta.video_keys:
            return *camera.size, 3
        packed = self.dataset.hf_dataset.data.column(camera.key)[row]["bytes"].as_py()
        with Image.open(io.BytesIO(packed)) as image:
            return *image.size[::-1], 3

    @staticmethod
    def _check_size(camera: _Camera, shape: tuple[int, ...], row: int, path: Path) -> None:
        if shape != (*camera.size, 3):
            raise EpisodeError(
                f"{path}: its frame {row} of '{camera.key}' has another shape than meta/info.json says, "
                f"{(*camera.size, 3)}",
                found=shape,
                remedy="record pictures of one size, in colour, in one dataset",
            )


@dataclass(frozen=True, eq=False)
class LerobotSample(Sample):
    """A sample whose picture is one of many in `frame_path`, a parquet or mp4 file (that of the first camera)."""

    pictures: _Pictures = field(kw_only=True)

    @property
    def frame_name(self) -> str:
        return f"frame {self.row}"

    def frame_bgr(self) -> Any:
        """Read the picture, (h, w, 3) uint8 BGR, by LeRobot's loader; of several cameras, a dict by their names.

        Raises EpisodeError if it cannot be decoded.
        """
        frames = self.pictures.frames_bgr(self.row, self.frame_path)
        return frames if len(frames) > 1 else self.turned(next(iter(frames.values())))


def load_dataset(source: Source, chunk: int, progress: Progress = silent) -> Recordings:
    """Read a LeRobotDataset v3 folder.

    chunk: actions per sample, padded at an episode's end with its last one. Each frame is a sample, with the state that
    was recorded with it. If the dataset marks interventions, a human drove in the marked frames and a policy in all
    others, unless our own export says otherwise; if it marks none, a human drove. Raises EpisodeError, in one sentence,
    for another version, for damaged or missing files, for numbers that no rover can have, and if nothing says which
    camera and which numbers are the car's.
    """
    root = source.path
    info = _read_info(root)
    layout, cameras = _layout(root, info, source)
    _check_files(root, info)
    _check_tables(root, info["features"], {*NUMBERS, INTERVENTION, SUCCESS, *(camera.key for camera in cameras)})
    dataset, of_videos = _open_local(root)
    _check_pictures(root, dataset, cameras)
    columns = _columns(root, dataset, layout)
    pictures = _Pictures(dataset, cameras)
    _check_rate(root, columns, float(info["fps"]))
    number = columns["episode_index"]
    _check_tables_fit(root, dataset, columns)
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    _check_order(root, columns, starts, info, video=any(c.key in dataset.meta.video_keys for c in cameras))
    exported, faults = _read_export(root, len(starts), INTERVENTION in columns)
    _check_numbers(root, columns, layout, exported.car)
    episodes = []
    parts = np.split(np.arange(len(number)), starts[1:])
    for i, rows in enumerate(progress(parts, desc="reading episodes", total=len(starts))):
        who, outcome = exported.drivers[i], exported.outcomes[i]
        episodes.append(_episode(root, pictures, columns, rows, chunk, exported.car, who, outcome))
    last = {e.samples[-1].frame_path: e.samples[-1] for e in episodes}
    for sample in last.values():  # the last picture of each file, because a file that was cut lacks its end
        sample.frame_bgr()
    odd = _odd_stats(dataset.meta.stats, columns, layout, [camera.key for camera in cameras])
    return Recordings(root, tuple(episodes), (*faults, *of_videos, *odd), source, layout)


def _odd_stats(stats: Any, columns: Mapping[str, np.ndarray], layout: Layout, keys: Iterable[str]) -> Iterator[Fault]:
    """Yield a fault for statistics by which LeRobot's trainer would normalise wrongly. We compute our own."""
    odd = []
    for key, order in ((STATE, layout.state_order), (ACTION, layout.action_order)):
        said, values = (stats or {}).get(key) or {}, columns[key].astype(np.float64)
        right = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        within = 1e-3 + 0.01 * (right["max"] - right["min"]).max()
        for name, expected in right.items():
            try:
                found = np.asarray(said[name], np.float64)[list(order)]
                fits = found.shape == expected.shape and len(said[name]) == len(expected)
            except (ValueError, TypeError, KeyError, IndexError):
                fits = False
            if not (fits and (np.abs(found - expected) <= within).all()):  # written so that NaN does not fit
                odd.append(f"{key}'s {name}")
    for key in keys:
        said = (stats or {}).get(key) or {}
        for name in ("mean", "std"):  # of some frames only; LeRobot's trainer takes ImageNet's unless told otherwise
            with suppress(ValueError, TypeError, AttributeError):
                found = np.asarray(said.get(name, 0.5), np.float64)
                odd += [f"{key}'s {name}"] * (not ((found >= 0) & (found <= 1)).all())
    if odd:
        note = f"{odd[0]} is not that of the frames, and lerobot-train would normalise by it; compute them again"
        yield Fault("meta/stats.json", "odd_statistics", len(odd), note)


@dataclass(frozen=True)
class _Exported:
    """What our own export says of a dataset.

    drivers: for each episode, who drove where nobody intervened. outcomes: for each episode, None if not labelled.
    car: the car whose actions the dataset has.
    """

    drivers: list[str]
    outcomes: list[str | None]
    car: Car


def _read_export(root: Path, episodes: int, marked: bool) -> tuple[_Exported, tuple[Fault, ...]]:
    """Read our own export's REPORT. Return what it says, and the faults found in it.

    If there is no REPORT, or one for other episodes (a fault), the result has what is known without it. LeRobot's
    datasets do not say which car they are of, so without a REPORT it is this machine's. marked: whether the dataset
    marks interventions.
    """
    default = _Exported([POLICY if marked else HUMAN] * episodes, [None] * episodes, this_car())
    path = root / REPORT
    if not path.is_file():
        return default, ()
    try:
        if path.stat().st_size > INFO_BYTES:
            raise ValueError("it is larger than any that rover export-dataset writes")
        report = json.loads(path.read_bytes())
        if CAR in report:  # right also if somebody has removed episodes since, with LeRobot's tools
            default = replace(default, car=Car.of(report[CAR], "the exported car"))
        if DRIVEN_BY not in report:  # of before there were takeovers
            return default, ()
        driven_by, outcomes = report[DRIVEN_BY], report[OUTCOMES]
        if not len(driven_by) == len(outcomes) == episodes:
            raise ValueError(f"it is of {len(driven_by)} episodes, here are {episodes}")
        if not set(driven_by) <= {POLICY, HUMAN} or not set(outcomes) <= {None, HIT, MISSED}:
            raise ValueError("it names who drove, or what it came to, by unknown words")
    except (OSError, ValueError, RecursionError, TypeError, KeyError, CarError) as e:
        return default, (Fault(REPORT, "another_export", 1, f"not used: {quote(str(e))}"),)
    return replace(default, drivers=driven_by, outcomes=outcomes), ()


def fetch_dataset(source: Source) -> Source:
    """Fetch a dataset of the Hub, and return the same source with its local folder.

    The version is checked first, before gigabytes are fetched.
    """
    given = source.path, "dataset", EpisodeError
    _read_info(hub.fetch(*given, files=("meta/*",)), hub_id=str(source.path).partition("@")[0])
    return replace(source, path=hub.fetch(*given))


def _read_info(root: Path, hub_id: str = "") -> dict[str, Any]:
    """Read meta/info.json. hub_id: user/name if the dataset is on the Hub. Raises EpisodeError."""
    path = root / INFO
    try:
        if path.stat().st_size > INFO_BYTES:
            raise _broken(f"{path}: is larger than any that LeRobot writes")
        refuse_pointer(path, EpisodeError)
        content = path.read_bytes()
        info = json.loads(content)
        if content.startswith(codecs.BOM_UTF8):
            raise EpisodeError(
                f"{path}: begins with a byte order mark, which LeRobot does not read", remedy="save it without one"
            )
    except (OSError, ValueError, RecursionError) as e:
        raise _broken(f"{path}: not readable as JSON ({quote(str(e))})") from None
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not isinstance(version, str) or not version.startswith("v"):
        raise _broken(f"{path}: does not name a version of LeRobot's format", quote(version))
    if version.startswith("v2.1"):
        where = " and give the folder below ~/.cache/huggingface/lerobot that it names" if hub_id else ""
        raise EpisodeError(
            f"{root}: a LeRobotDataset v2.1, only v3 is read",
            remedy=f"convert it once by LeRobot's own `{conversion(root, hub_id)}`{where}",
        )
    if version.startswith(("v1", "v2")):
        raise EpisodeError(
            f"{root}: a LeRobotDataset {quote(version)}, only v3 is read",
            remedy="convert it to v2.1 by a LeRobot of that time, and then as its documentation says",
        )
    if not version.startswith("v3"):
        raise EpisodeError(
            f"{root}: a LeRobotDataset {quote(version)}, only v3 is known here", remedy="use a newer version of this"
        )
    if not isinstance(info.get("data_path"), str):
        raise _broken(f"{path}: has no 'data_path'", quote_all(info))
    features, fps = info.get("features"), info.get("fps")
    if not is_number(fps, 0, 1000) or not fps:
        raise _broken(f"{path}: does not give a number of frames per second", quote(fps))
    if not isinstance(features, dict) or not all(_is_feature(f) for f in features.values()):
        raise _broken(f"{path}: its features are not objects with a dtype and a shape")
    return info


def _is_feature(feature: Any) -> bool:
    shape = feature.get("shape") if isinstance(feature, dict) else None
    return isinstance(shape, list) and all(is_whole(n, 1, 10_000) for n in shape)


def _layout(root: Path, info: Mapping[str, Any], source: Source) -> tuple[Layout, tuple[_Camera, ...]]:
    """Find the cameras that the policy looks through, and the names and columns of states and actions."""
    features = info["features"]
    keys = camera_names(k for k, f in features.items() if f.get("dtype") in ("image", "video"))
    if not keys:
        raise EpisodeError(f"{root}: has no camera", found=quote_all(features), remedy="record one that sees")
    names = source.cameras or (tuple(keys) if len(keys) == 1 else ())
    missing = [name for name in names if name not in keys]
    if missing or not names:
        what = f"has no camera {quote(missing[0])}" if missing else f"has {len(keys)} cameras"
        remedy = "say what the policy looks through: --camera NAME, with commas between several"
        raise EpisodeError(f"{root}: {what}", found=quote_all(keys), remedy=remedy)
    if len(set(names)) < len(names):
        raise EpisodeError(
            f"{root}: a camera is given twice", found=quote_all(names), remedy="name each once: --camera"
        )
    cameras = tuple(_Camera(name, keys[name], _picture_size(root, keys[name], features[keys[name]])) for name in names)
    for key in (STATE, ACTION):
        if key not in features or len(features[key]["shape"]) != 1:
            found = features[key]["shape"] if key in features else quote_all(features)
            what = f"{root}: its '{key}' is missing or not a row of numbers"
            raise EpisodeError(what, found=found, remedy="record one")
        if not str(features[key].get("dtype")).startswith(("float", "int", "uint")):  # LeRobot makes 1 of 0.3 for bool
            raise _broken(f"{root}: its '{key}' are no numbers by {INFO}", quote(features[key].get("dtype")))
    actions, action_order = _name_numbers(root, features, ACTION, source.action_names)
    states, state_order = _name_numbers(root, features, STATE, _state_names(features, source.action_names))
    sizes = {camera.name: camera.size for camera in cameras}
    return Layout(names, states, actions, float(info["fps"]), state_order, action_order, sizes), cameras


def _state_names(features: Mapping[str, Any], said: tuple[str, ...]) -> tuple[str, ...]:
    """Return the state's own names.

    If it has none, or the same as the dataset gives its actions, return the user's names of the actions.
    """
    own = _names(features[STATE])
    if own and not (said and own == _names(features[ACTION])):
        return own
    (size,) = features[STATE]["shape"]
    if said and size != len(said):  # such numbers are not actions, and their names matter nowhere
        return tuple(f"state_{i}" for i in range(size))
    return said


def _name_numbers(
    root: Path, features: Mapping[str, Any], key: str, said: tuple[str, ...]
) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return the names of a feature's numbers, and their columns: [steering, throttle] for a car, else as they lie."""
    (size,) = features[key]["shape"]
    names = said or _names(features[key])
    if not names:
        example = ACTION_NAMES if size == len(ACTION_NAMES) else [f"joint_{i}" for i in range(1, size + 1)]
        raise EpisodeError(
            f"{root}: '{key}' does not name its {size} numbers",
            found=quote(features[key].get("names")),
            remedy=f"name them in the order of the numbers: --action-names {','.join(example)}",
        )
    if len(names) != size or len(set(names)) != size:
        raise EpisodeError(
            f"{root}: '{key}' has {size} numbers, their names are {quote_all(names)}",
            remedy="name each once: --action-names with commas between",
        )
    if set(names) == set(ACTION_NAMES):
        return ACTION_NAMES, tuple(names.index(name) for name in ACTION_NAMES)
    return names, tuple(range(size))


def _names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names in a feature, in any of the forms that LeRobot's users write; () if there are none."""
    names = feature.get("names")
    if isinstance(names, dict) and names and all(type(v) is int for v in names.values()):
        if len(set(names.values())) < len(names):
            return ()  # two names for one column
        names = sorted(names, key=names.__getitem__)  # in the order of their columns
    elif isinstance(names, dict) and len(names) == 1:
        return _names({"names": next(iter(names.values()))})  # {"motors": [...]}
    if isinstance(names, list) and names and all(isinstance(n, str) for n in names):
        bare = tuple(name.removesuffix(".vel") for name in names)  # as our plugin's are in LeRobot 0.6
        return bare if set(bare) == set(ACTION_NAMES) else tuple(names)
    return ()


def _picture_size(root: Path, key: str, feature: Mapping[str, Any]) -> tuple[int, int]:
    shape, kind = list(feature["shape"]), feature.get("info")
    if isinstance(kind, dict) and (kind.get("is_depth_map") or kind.get("video.is_depth_map")):
        shape = [*shape[:2], "distances"]
    elif len(shape) == 3 and 3 in (shape[0], shape[2]) and math.prod(shape) <= 3 * MOST_PIXELS:
        return (shape[0], shape[1]) if shape[2] == 3 else (shape[1], shape[2])
    raise EpisodeError(f"{root}: '{key}' is not a colour camera", found=shape, remedy="choose another: --camera NAME")


def _check_files(root: Path, info: Mapping[str, Any]) -> None:
    """Raise EpisodeError for files that are none, and for tables that claim to hold more than their bytes can.

    This comes before LeRobot opens anything: it would wait for a pipe, and unpack whatever a table claims.
    """
    from pyarrow import parquet

    for key, template in TEMPLATES.items():
        if info.get(key, template) not in (template, None):
            raise EpisodeError(
                f"{root}: its {key} is not LeRobot's", found=quote(info[key]), remedy=f"write {template}"
            )
    size = 0
    files = [path for folder in ("meta", "data", "videos") for path in (root / folder).rglob("*")]
    for path in files:
        if path.is_dir() and path.is_symlink():  # rglob does not look into it, but LeRobot does
            raise EpisodeError(f"{path}: a link to a folder", remedy="put the files themselves there")
        if not path.is_dir() and not path.is_file():
            raise _broken(f"{path}: not a plain file")
        size += path.stat().st_size
        refuse_pointer(path, EpisodeError)
        if path.suffix == ".json" and path.stat().st_size > INFO_BYTES:
            raise _broken(f"{path}: is larger than any that LeRobot writes")
    rows = values = unpacked = 0
    for path in (path for path in files if path.suffix == ".parquet"):
        with _said_of(path, "LeRobot cannot read it"):
            footer = parquet.read_metadata(path)
        groups = [footer.row_group(i) for i in range(footer.num_row_groups)]
        columns = [group.column(i) for group in groups for i in range(group.num_columns)]
        rows += footer.num_rows
        values += sum(column.num_values for column in columns)
        unpacked += sum(column.total_uncompressed_size for column in columns)
        pictures = (column for column in columns if column.physical_type == "BYTE_ARRAY")
        for column in pictures:  # which are compressed already; one that is packed once may be there in every row
            if column.total_uncompressed_size > PICTURES_FREE + UNPACKED_TIMES * column.total_compressed_size:
                raise EpisodeError(f"{path}: its {quote(column.path_in_schema)} unpacks to far more than its size")
    most = FRAMES_FREE + size // FRAME_BYTES, MOST_VALUES, UNPACKED_FREE + UNPACKED_TIMES * size
    for what, found, limit in zip(("rows", "values", "bytes"), (rows, values, unpacked), most, strict=True):
        if found > limit:
            raise EpisodeError(f"{root}: its tables claim {found:,} {what}, more than files of {size:,} bytes can hold")


def _check_pictures(root: Path, dataset: "LeRobotDataset", cameras: tuple[_Camera, ...]) -> None:
    """Raise EpisodeError for pictures of other sizes, or not in the dataset's own tables: a path may lead anywhere."""
    from pyarrow import compute

    for camera in cameras:
        if camera.key in dataset.meta.video_keys:
            continue
        row = 0
        for chunk in dataset.hf_dataset.data.column(camera.key).chunks:
            packed = chunk.field("bytes")
            if chunk.null_count or packed.null_count:
                raise _broken(f"{root}: pictures of '{camera.key}' are not in its tables, but named by a path")
            for head in compute.binary_slice(packed, 0, 26).to_pylist():
                if head.startswith(b"\x89PNG"):  # as LeRobot writes them; others are seen when read
                    width, height, _, kind = struct.unpack(">IIBB", head[16:])
                    shape = (height, width, {0: 1, 3: 1, 4: 2, 6: 4}.get(kind, 3))
                    _Pictures._check_size(camera, shape, row, root)
                row += 1


def _check_tables(root: Path, features: Mapping[str, Any], read: Set[str]) -> None:
    """Raise EpisodeError for missing tables, and for tables of frames without a column that is read.

    LeRobot's loader would fill such a column with nothing, so that, for example, an intervention would lose its mark.
    """
    from pyarrow import parquet  # imported here, so that our own recordings do not wait for it

    if old := [*root.glob("data/*/episode_*.parquet"), *root.glob("videos/*/*/episode_*.mp4")]:
        raise EpisodeError(
            f"{root}: {INFO} says v3, and {old[0].relative_to(root)} is of v2.1",
            remedy="it was converted by half: convert the original again, into an empty folder",
        )
    for pattern in ("meta/tasks.parquet", "meta/episodes/*/*.parquet", "data/*/*.parquet"):
        if not list(root.glob(pattern)):
            raise _broken(f"{root}: has no {pattern}")
    wanted = [name for name, feature in features.items() if name in read and feature.get("dtype") != "video"]
    for path in sorted(root.glob("data/*/*.parquet")):
        with _said_of(path, "LeRobot cannot read it"):
            columns = parquet.read_schema(path).names
        if missing := [name for name in wanted if name not in columns]:
            raise _broken(f"{path}: has no column {quote_all(missing)}", quote_all(columns))
        if unknown := [name for name in columns if name not in features]:
            raise _broken(f"{path}: has columns that {INFO} does not know: {quote_all(unknown)}")


def _open_local(root: Path) -> tuple["LeRobotDataset", list[Fault]]:
    """Open a local folder by LeRobot's own loader, and return the faults of its videos with it.

    The loader would fetch missing files; here they are an error.
    """
    # Imported here, because it takes seconds, and our own recordings do not need it.
    from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata

    class Local(LeRobotDataset):
        def download(self, download_videos: bool = True) -> None:
            raise FileNotFoundError("frames of some of its episodes are not there")

    given = {"repo_id": f"local/{root.resolve().name}", "root": root, "revision": "local"}
    faults = []
    with _said_of(root, "LeRobot cannot read it"):
        meta = LeRobotDatasetMetadata(**given)
        if meta.total_episodes != len(meta.episodes):  # LeRobot would list as many as the file claims
            raise _broken(
                f"{root}: {INFO} says {quote(meta.total_episodes)} episodes", f"{len(meta.episodes)} in meta/episodes"
            )
        for key in meta.video_keys:
            for number in range(meta.total_episodes):
                if not (video := root / meta.get_video_file_path(number, key)).is_file():
                    raise _broken(f"{video}: not there")
            faults += _check_video_times(root, meta, key)
        return Local(**given, video_backend=BACKEND), faults


def _check_video_times(root: Path, meta: Any, key: str) -> list[Fault]:
    """Raise EpisodeError unless each episode has a part of a video of its own, as long as the episode.

    Return a fault for each video with more frames than its episodes. The merge of LeRobot 0.4.0 wrote times by which an
    episode is shown another one's pictures.
    """
    import av  # here, because our own recordings do not need it

    names = ("length", *(f"videos/{key}/{name}" for name in ("from_timestamp", "to_timestamp")))
    length, first_s, last_s = (np.asarray(meta.episodes[name], np.float64) for name in names)
    frame_s = 1 / meta.fps
    files: dict[Path, list[int]] = {}
    faults = []
    for number in range(meta.total_episodes):
        files.setdefault(root / meta.get_video_file_path(number, key), []).append(number)
    wrong = {
        int(n): "is not as long as it" for n in np.flatnonzero(~(abs(last_s - first_s - length * frame_s) < frame_s))
    }
    for video, numbers in files.items():
        with av.open(video) as opened:
            stream = opened.streams.video[0]
            end_s = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else np.inf
            frames, rate = stream.frames, float(stream.average_rate or meta.fps)
            with suppress(av.FFmpegError):  # a damaged one is told when its last picture is read
                turned = next((frame.rotation for frame in opened.decode(stream)), 0)
                if turned:
                    raise EpisodeError(
                        f"{video}: says that it is to be shown turned by {turned} degrees, which some decoders do",
                        remedy="encode it as it is to be seen, and train on that",
                    )
        used = int(length[numbers].sum())
        if 0 < frames < used or rate < (1 - UNEVEN) * meta.fps:
            raise _broken(
                f"{video}: has {frames} frames, {rate:.4g} a second", f"{used} frames of {meta.fps:g} a second in data"
            )
        if frames > used:
            note = f"has {frames} frames, {used} of them in data: those are read, by their times"
            faults.append(Fault(str(video.relative_to(root)), "more_frames", frames - used, note))
        numbers.sort(key=first_s.__getitem__)
        for number, after in zip(numbers, [*numbers[1:], None], strict=True):
            if after is not None and last_s[number] > first_s[after] + frame_s / 2:
                wrong[after] = f"overlaps that of episode {number}"
            if last_s[number] > end_s + frame_s or first_s[number] < 0:
                wrong[number] = f"ends after the video, which has {end_s:.2f} s"
    unused = sorted(set((root / "videos" / key).rglob("*.mp4")) - set(files))
    if wrong or unused:
        number, what = min(wrong.items(), default=(-1, ""))
        raise EpisodeError(
            f"{root}: meta/episodes does not fit the videos of {quote(key)}",
            found=f"{unused[0].relative_to(root)}, which no episode uses"
            if number < 0
            else f"{len(wrong)} of {len(length)} episodes; the part of episode {number} {what}",
            remedy="merge the original datasets again with a newer LeRobot (lerobot-edit-dataset), or copy it again",
        )
    return faults


@contextmanager
def _said_of(path: Path, what: str) -> Iterator[None]:
    """Turn any error of a loader inside the block into an EpisodeError of one sentence. what: what went wrong."""
    try:
        yield
    except EpisodeError:
        raise
    except Exception as e:  # parquet, mp4, datasets and LeRobot each raise types of their own
        cause = e.__cause__ or e  # datasets wraps pyarrow's error
        reason = " ".join(str(cause).split())[:160]
        text = f"{type(cause).__name__}: {reason}" if reason else type(cause).__name__
        error = _broken(f"{path}: {what} ({text})")
        if "FrameTimestampError" in text:  # of a film whose frames do not come at one rate
            error.remedy = "encode it again with a frame at each of the dataset's times, i / fps"
        raise error from None


def _columns(root: Path, dataset: "LeRobotDataset", layout: Layout) -> dict[str, np.ndarray]:
    """All frames' numbers, in their order: state (n, S) and action (n, A) float32 by the layout's names, and times."""
    marks = [key for key in (INTERVENTION, SUCCESS) if key in dataset.meta.features]
    for key in marks:
        feature = dataset.meta.features[key]
        if feature["dtype"] != "bool" or list(feature["shape"]) != [1]:
            found = f"{quote(feature['dtype'])} of shape {list(feature['shape'])}"
            raise EpisodeError(
                f"{root}: its '{key}' is not a yes or no for each frame",
                found=found,
                remedy=f"write it as bool of shape [1], or under another name: '{key}' says who drove, or how it ended",
            )
    with _said_of(root, "its numbers cannot be read"):
        columns = dataset.hf_dataset.select_columns([*NUMBERS, *marks]).with_format("numpy")[:]
        for key in marks:
            columns[key] = np.asarray(columns[key]).reshape(len(columns["timestamp"])).astype(bool)
        for key, order in ((STATE, layout.state_order), (ACTION, layout.action_order)):
            rows = np.stack(list(columns[key])).astype(np.float32).reshape(len(columns[key]), -1)
            columns[key] = np.ascontiguousarray(rows[:, list(order)])
    return columns


def _check_numbers(root: Path, columns: Mapping[str, np.ndarray], layout: Layout, car: Car) -> None:
    """Raise EpisodeError for states and actions that are not finite, and for actions beyond what the car can do."""
    for key, labels in ((STATE, layout.state_names), (ACTION, layout.action_names)):
        lows, highs = action_limits(labels, car)
        for i, name in enumerate(labels):
            # A state of these names is what the car is told when it drives: its last action.
            low, high = (lows[i], highs[i]) if key == ACTION or labels == ACTION_NAMES else (-np.inf, np.inf)
            values = columns[key][:, i]
            if broken := np.flatnonzero(~np.isfinite(values)).tolist():
                raise EpisodeError(
                    f"{root}: {name} of '{key}' is {values[broken[0]]:g} in frame {broken[0]} and {len(broken) - 1} "
                    "more, which cannot have been recorded",
                    remedy="leave those episodes out (lerobot-edit-dataset can), or record them again",
                )
            if wrong := np.flatnonzero((values < low) | (values > high)).tolist():
                reverse = name == "throttle" and low == 0 and values.min() >= -1 and values.max() <= high
                raise EpisodeError(
                    f"{root}: {name} of '{key}' is {values[wrong[0]]:g} in frame {wrong[0]} and {len(wrong) - 1} more, "
                    f"a rover's lies from {low:g} to {high:g}",
                    remedy="if that car reverses, say so in a car.yml (reverse_us, docs/build.md) and put it here"
                    if reverse
                    else "are the names in the right order (--action-names), and the numbers in our units?",
                )


def _check_rate(root: Path, columns: Mapping[str, np.ndarray], fps: float) -> None:
    """Raise EpisodeError for frames that do not come `fps` times a second: a plan's steps would last another time."""
    times_s, number = columns["timestamp"].astype(np.float64), columns["episode_index"]
    steps_s = np.diff(times_s)[number[1:] == number[:-1]]
    if len(odd := steps_s[~(np.abs(steps_s * fps - 1) <= UNEVEN)]):  # written so that NaN counts as odd
        raise EpisodeError(
            f"{root}: meta/info.json says {fps:g} frames a second, but {len(odd)} frames come at another rate",
            found=f"{odd[0]:.4f} s after the one before",
            remedy="correct the rate, or record again",
        )


def _check_tables_fit(root: Path, dataset: "LeRobotDataset", columns: Mapping[str, np.ndarray]) -> None:
    """Raise EpisodeError if the tables of episodes and of tasks do not fit the frames.

    LeRobot finds an episode's pictures, and a frame's task, by the table's row of that number, whatever the row is for.
    """
    number, task = columns["episode_index"], columns["task_index"]
    with _said_of(root, "its table of episodes cannot be read"):
        names = ("episode_index", "length", "dataset_from_index", "dataset_to_index")
        table = dataset.meta.episodes.select_columns(list(names)).with_format("numpy")[:]
        index, lengths, first, end = (np.asarray(table[name]) for name in names)
        # Their sum is checked first, because np.repeat makes as many numbers.
        agree = np.array_equal(index, np.arange(len(index))) and lengths.sum() == len(number)
        agree = agree and np.array_equal(number, np.repeat(index, lengths))
    if not agree:
        raise _broken(
            f"{root}: meta/episodes and the frames in data do not belong together",
            f"{len(index)} episodes of {lengths.sum()} frames beside {len(np.unique(number))} of {len(number)}",
        )
    ends = np.cumsum(lengths)  # LeRobot repeats a plan's last action from there on
    if len(wrong := np.flatnonzero((end != ends) | (first != ends - lengths))):
        n = int(wrong[0])
        raise _broken(
            f"{root}: meta/episodes gives episode {n} the frames {first[n]} to {end[n]}",
            f"{ends[n] - lengths[n]} to {ends[n]} in data",
        )
    with _said_of(root, "its table of tasks cannot be read"):
        rows, tasks = list(dataset.meta.tasks["task_index"]), list(dataset.meta.tasks.index)
    if rows != list(range(len(rows))) or not set(task.tolist()) <= set(rows) or not {str} >= set(map(type, tasks)):
        table = quote_all(f"{n}: {t}" for n, t in zip(rows, tasks, strict=True))
        found = f"tasks {task.min()} to {task.max()} beside {table}"
        raise _broken(f"{root}: meta/tasks.parquet and the frames in data do not belong together", found)


def _check_order(
    root: Path, columns: Mapping[str, np.ndarray], starts: np.ndarray, info: Mapping[str, Any], video: bool
) -> None:
    """Raise EpisodeError for rows that are not the frames in their order, each once, with times from each start on.

    LeRobot believes meta/info.json's number of frames, and finds a picture in a video by its time.
    """
    count = len(columns["index"])
    if (said := info.get("total_frames", count)) != count:
        raise _broken(f"{root}: {INFO} says {quote(said)} frames", f"{count} in data")
    row = np.arange(count)
    within = row - np.repeat(starts, np.diff([*starts, count]))
    for key, right in (("index", row), ("frame_index", within)):
        if len(wrong := np.flatnonzero(columns[key] != right)):
            raise _broken(
                f"{root}: its frames are not in their order", f"{key} {columns[key][wrong[0]]} in row {wrong[0]}"
            )
    begin_s = columns["timestamp"][starts]
    if len(late := np.flatnonzero(~(np.abs(begin_s) * info["fps"] < 1))):
        raise _broken(f"{root}: the times of an episode begin at 0", f"{begin_s[late[0]]:g} s in episode {late[0]}")
    off_s = np.abs(columns["timestamp"].astype(np.float64) - within / info["fps"])
    if video and len(late := np.flatnonzero(off_s > 2 * TOLERANCE_S)):
        raise _broken(
            f"{root}: {len(late)} frames have another time than their picture in the video",
            f"frame {late[0]} is {off_s[late[0]] * 1e3:.2f} ms off, of which LeRobot takes {TOLERANCE_S * 1e3:g}",
        )


def _episode(
    root: Path,
    pictures: _Pictures,
    columns: Mapping[str, np.ndarray],
    rows: np.ndarray,
    chunk: int,
    car: Car,
    driver: str,
    outcome: str | None,
) -> Episode:
    """rows: of the whole dataset, those of one episode. car, driver, outcome: as in _Exported."""
    meta, first, n = pictures.dataset.meta, int(rows[0]), len(rows)
    number = int(columns["episode_index"][first])
    name, keys = f"episode_{number:06d}", [camera.key for camera in pictures.cameras]
    with _said_of(root, f"where the files of episode {number} lie cannot be read"):
        data = root / meta.get_data_file_path(number)
        files = [root / meta.get_video_file_path(number, key) if key in meta.video_keys else data for key in keys]
    if not data.is_file():
        raise _broken(f"{data}: not there, and episode {number} is in it")
    index = np.arange(n)[:, None] + np.arange(chunk)
    actions, pads = columns[ACTION][rows], index >= n
    chunks = actions[np.minimum(index, n - 1)]
    taken_over = columns[INTERVENTION][rows] if INTERVENTION in columns else np.zeros(n, bool)
    if outcome is None and SUCCESS in columns:
        outcome = HIT if columns[SUCCESS][rows].any() else MISSED
    samples = tuple(
        LerobotSample(
            episode=name,
            frame_path=files[0],
            time_s=float(columns["timestamp"][row] - columns["timestamp"][first]),
            state=columns[STATE][row].copy(),
            chunk=chunks[k].copy(),
            is_pad=pads[k].copy(),
            pictures=pictures,
            row=int(row),
            driver=HUMAN if taken_over[k] else driver,
            car=car,
        )
        for k, row in enumerate(rows)
    )
    return Episode(
        id=name,
        path=root,
        label=meta.tasks.index[columns["task_index"][first]],
        duration_s=samples[-1].time_s,
        frames=n,
        controls=n,
        samples=samples,
        files=(root / INFO, data, *files[1:]),
        corrects=bool(taken_over.any()),
        outcome=outcome,
    )


def lerobot_train(dataset: Path | str) -> str:
    """Return the command of LeRobot's own that trains an ACT on a LeRobotDataset."""
    return (
        f"lerobot-train --dataset.repo_id=local/drives --dataset.root={dataset} --policy.type=act "
        "--policy.push_to_hub=false --policy.chunk_size=32 --policy.n_action_steps=32 --output_dir=trained"
    )
