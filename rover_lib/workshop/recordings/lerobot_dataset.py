"""Read a LeRobotDataset v3, with images or video, by LeRobot's own loader, and check it before it is used.

What its numbers mean is read from the names of its features, or said by the user, and never guessed.
"""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import CarError, EpisodeError
from rover_lib.onboard.kinds import refuse_pointer
from rover_lib.onboard.policy.load import action_limits
from rover_lib.onboard.recording.episode import HUMAN, POLICY
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
from rover_lib.workshop.untrusted import (
    check_encoded,
    check_inside,
    check_table,
    check_video,
    limited_memory,
    quote,
    quote_all,
    read_json,
)

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

INFO = Path("meta/info.json")
INFO_BYTES = 5_000_000  # LeRobot's: some kB
MOST_FEATURES = 200  # an arm with six cameras has 20
PICTURE_PIXELS = 4608 * 2592  # at most: a Pi camera's largest
BACKEND = "pyav"  # needs no FFmpeg on the machine, as torchcodec does
STATE, ACTION = "observation.state", "action"
NUMBERS = (STATE, ACTION, "timestamp", "frame_index", "episode_index", "index", "task_index")
INTERVENTION = "intervention"  # as lerobot-rollout writes it: in this frame a human had taken over from a policy
REPORT = "rover_export.json"  # beside a dataset of our own; of each episode it says:
DRIVEN_BY = "driven_by"  # who drove where nobody intervened
CAR = "car"  # and of them all, the content of their car.yml
COPY_AGAIN = "copy the whole dataset again"
UNEVEN = 0.1  # the time between two frames may differ by this share


def _broken(what: str, found: object = None) -> EpisodeError:
    """The error of a dataset that no LeRobot wrote so, for the caller to raise."""
    return EpisodeError(f"{what}: a broken dataset", found=found, remedy=COPY_AGAIN)


def is_dataset(root: Path) -> bool:
    """Whether a folder is a LeRobotDataset, of whatever version."""
    return (root / INFO).is_file()


@dataclass(frozen=True, eq=False)
class LerobotSample(Sample):
    """A sample whose picture is one of many in `frame_path`, a parquet or mp4 file (that of the first camera).

    encoded: all rows' pictures as they lie in the table. cameras: by the policy's name, the key and (height, width).
    """

    dataset: "LeRobotDataset" = field(kw_only=True)
    encoded: Any = field(kw_only=True)
    cameras: Mapping[str, tuple[str, tuple[int, int]]] = field(kw_only=True)

    @property
    def frame_name(self) -> str:
        return f"frame {self.row}"

    def frame_bgr(self) -> Any:
        """Read the picture, (h, w, 3) uint8 BGR, by LeRobot's loader; of several cameras, a dict by their names.

        Raises EpisodeError if it cannot be decoded, or has another size than the others.
        """
        frames = {}
        where = f"{self.frame_path}: its frame {self.row}"
        with _as_episode_error(f"{where} cannot be decoded"), limited_memory(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torchvision warns of the decoder that LeRobot has chosen
            for key, encoded in self.encoded[self.row].items():  # LeRobot decodes all, also those of no policy
                check_encoded(f"{where} of '{key}'", encoded, _size_of(self.dataset.meta.features[key]))
            item = self.dataset[self.row]
            for name, (key, size) in self.cameras.items():
                # (3, h, w) float32 in [0, 1]. Dividing a uint8 by 255 and multiplying by 255 again is exact.
                rgb = (item[key] * 255).round().byte().permute(1, 2, 0).numpy()
                if rgb.shape != (*size, 3):
                    raise _broken(f"{where} of '{key}' has another shape than {size} in {INFO}", rgb.shape)
                frames[name] = np.ascontiguousarray(rgb[..., ::-1])
        return frames if len(frames) > 1 else self.turned(next(iter(frames.values())))


def load_dataset(source: Source, chunk: int, progress: Progress = silent) -> Recordings:
    """Read a LeRobotDataset v3 folder.

    chunk: actions per sample, padded at an episode's end with its last one. Each frame is a sample, with the state that
    was recorded with it. A human drove; if the dataset marks interventions, in the marked frames, and a policy in all
    others, unless our own export says otherwise. Raises EpisodeError for another version, damaged or missing files,
    numbers that no rover can have, and if nothing says which camera and which numbers are the car's.
    """
    root = source.path
    info = _read_info(root)
    layout, cameras = _layout(root, info, source)
    import lerobot.datasets.lerobot_dataset  # noqa: F401, takes seconds, and memory beside what is limited below

    with limited_memory():
        _check_files(root, info["features"], [key for key, _ in cameras.values()])
    tables = sum(path.stat().st_size for path in root.rglob("*.parquet"))
    episodes = []
    with _as_episode_error(f"{root}: LeRobot cannot read it"):
        with limited_memory(3 * tables):
            dataset = _open_local(root)
            columns = _columns(dataset, layout)
            starts = _check_frames(root, dataset, columns)
            for key in dataset.meta.video_keys:
                _check_videos(root, dataset.meta, key)
            encoded = _encoded(dataset)
        drivers, car, faults = _read_export(root, len(starts), INTERVENTION in columns)
        _check_numbers(root, columns, layout, car)
        parts = np.split(np.arange(len(columns["index"])), starts[1:])
        for i, rows in enumerate(progress(parts, desc="reading episodes", total=len(starts))):
            episodes.append(_episode(dataset, encoded, cameras, columns, rows, chunk, drivers[i], car))
    last = {e.samples[-1].frame_path: e.samples[-1] for e in episodes}
    for sample in last.values():  # the last picture of each file, because a file that was cut lacks its end
        sample.frame_bgr()
    return Recordings(root, tuple(episodes), faults, source, layout)


def _read_export(root: Path, episodes: int, marked: bool) -> tuple[list[str], Car, tuple[Fault, ...]]:
    """Return who drove in each episode where nobody intervened, whose car, and a fault if REPORT is of other episodes.

    marked: whether the dataset marks interventions.
    """
    drivers, car = [POLICY if marked else HUMAN] * episodes, this_car()
    if not (root / REPORT).is_file():
        return drivers, car, ()
    try:
        report = read_json(root / REPORT, INFO_BYTES)
        car = Car.of(report[CAR], "the exported car")  # right also if somebody has removed episodes since
        said = report[DRIVEN_BY]
        if len(said) != episodes or not set(said) <= {POLICY, HUMAN}:
            raise ValueError(f"it is of {len(said)} episodes, here are {episodes}, or has unknown words")
    except (OSError, ValueError, TypeError, KeyError, CarError) as e:
        return drivers, car, (Fault(REPORT, "another_export", 1, f"not used: {quote(str(e))}"),)
    return said, car, ()


def _read_info(root: Path) -> dict[str, Any]:
    """Read meta/info.json. Raises EpisodeError."""
    path = root / INFO
    refuse_pointer(path, EpisodeError)
    try:
        info = read_json(path, INFO_BYTES)
    except (OSError, ValueError) as e:
        raise _broken(f"{path}: not readable as JSON ({quote(str(e))})") from None
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not str(version).startswith("v3"):
        remedy = "convert it to v2.1 by a LeRobot of that time, or use a newer version of this"
        if str(version).startswith("v2.1"):
            remedy = "convert it once by LeRobot's own convert_dataset_v21_to_v30"
        raise EpisodeError(f"{root}: a LeRobotDataset {quote(version)}, only v3 is read", remedy=remedy)
    features, fps = info.get("features"), info.get("fps")
    try:
        right = len(features) <= MOST_FEATURES and not any("/" in name for name in features)
        right = right and all(is_whole(n, 1, 10_000) for feature in features.values() for n in feature["shape"])
        paths = [Path(str(info.get(name))) for name in ("data_path", "video_path")]
        right = right and not any(path.is_absolute() or ".." in path.parts for path in paths)
    except (AttributeError, TypeError, KeyError):
        right = False
    if not right or not is_number(fps, 0, 1000) or not fps:
        raise _broken(f"{path}: lacks frames per second, or plain features with a dtype and a shape", quote(fps))
    return info


def _layout(root: Path, info: Mapping[str, Any], source: Source) -> tuple[Layout, dict[str, Any]]:
    """Find the names and columns of states and actions, and the policy's cameras, as `LerobotSample` wants them."""
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
        row = features.get(key, {})  # LeRobot makes 1 of 0.3 where it says bool
        if len(row.get("shape", ())) != 1 or not str(row.get("dtype")).startswith(("float", "int", "uint")):
            what = f"{root}: its '{key}' is missing or not a row of numbers"
            raise EpisodeError(what, found=quote_all(features), remedy="record one")
    actions, action_order = _name_numbers(root, features, ACTION, source.action_names)
    states, state_order = _name_numbers(root, features, STATE, _state_names(features, source.action_names))
    sizes = {name: size for name, (_, size) in cameras.items()}
    return Layout(names, states, actions, float(info["fps"]), state_order, action_order, sizes), cameras


def _state_names(features: Mapping[str, Any], said: tuple[str, ...]) -> tuple[str, ...]:
    """Return the state's own names; the user's names of the actions if it has none, or the same as the actions."""
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
        remedy = f"name them in the order of the numbers: --action-names {','.join(example)}"
        found = quote(features[key].get("names"))
        raise EpisodeError(f"{root}: '{key}' does not name its {size} numbers", found=found, remedy=remedy)
    if len(names) != size or len(set(names)) != size:
        what = f"{root}: '{key}' has {size} numbers, their names are {quote_all(names)}"
        raise EpisodeError(what, remedy="name each once: --action-names with commas between")
    if set(names) == set(ACTION_NAMES):
        return ACTION_NAMES, tuple(names.index(name) for name in ACTION_NAMES)
    return names, tuple(range(size))


def _names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names in a feature, a list, or a list under one word; () if there are none."""
    names = feature.get("names")
    if isinstance(names, dict) and len(names) == 1:
        return _names({"names": next(iter(names.values()))})  # {"motors": [...]}
    if isinstance(names, list) and names and all(isinstance(n, str) for n in names):
        bare = tuple(name.removesuffix(".vel") for name in names)  # as our plugin's are in LeRobot 0.6
        return bare if set(bare) == set(ACTION_NAMES) else tuple(names)
    return ()


def _picture_size(root: Path, key: str, feature: Mapping[str, Any]) -> tuple[int, int]:
    shape, kind = list(feature["shape"]), feature.get("info")
    depth = isinstance(kind, dict) and (kind.get("is_depth_map") or kind.get("video.is_depth_map"))
    if depth or len(shape) != 3 or 3 not in (shape[0], shape[2]):
        remedy = "choose another: --camera NAME"
        raise EpisodeError(f"{root}: '{key}' is not a colour camera", found=shape, remedy=remedy)
    height, width = _size_of(feature)
    if height * width > PICTURE_PIXELS:
        raise EpisodeError(f"{root}: '{key}' has pictures of {width}x{height}", remedy="scale them down")
    return height, width


def _size_of(feature: Mapping[str, Any]) -> tuple[int, int]:
    """Height and width of a camera, whose shape has its colours last or first."""
    first, second, last = feature["shape"]
    return (second, last) if first <= 4 < last else (first, second)


def _check_files(root: Path, features: Mapping[str, Any], cameras: list[str]) -> None:
    """Raise EpisodeError for what Git LFS left in place of files, and for tables without a column that is read.

    LeRobot would look for missing tables on the Hub, and fill such a column with nothing.
    """
    for pattern in ("meta/tasks.parquet", "meta/episodes/*/*.parquet", "data/*/*.parquet"):
        if not list(root.glob(pattern)):
            raise _broken(f"{root}: has no {pattern}")
    for path in (path for folder in ("meta", "data", "videos") for path in (root / folder).rglob("*")):
        check_inside(root, path)
        refuse_pointer(path, EpisodeError)
    read = {*NUMBERS, INTERVENTION, *cameras}
    wanted = {name for name, feature in features.items() if name in read and feature.get("dtype") != "video"}
    for path in sorted(root.rglob("*.parquet")):
        with _as_episode_error(f"{path}: LeRobot cannot read it"):
            columns = check_table(path)
        odd = {*(wanted - {*columns}), *({*columns} - features.keys())}
        if odd and path.is_relative_to(root / "data"):
            raise _broken(f"{path}: its columns are not those of {INFO}", quote_all(sorted(odd)))


def _encoded(dataset: "LeRobotDataset") -> Any:
    """The rows' pictures as they lie in the table, of all cameras that are no video."""
    keys = [key for key, feature in dataset.meta.features.items() if feature["dtype"] == "image"]
    rows = dataset.hf_dataset.with_format(None).select_columns(keys or ["index"])
    for key in keys:
        rows = rows.cast_column(key, replace(rows.features[key], decode=False))
    return rows if keys else [{}] * len(rows)


def _open_local(root: Path) -> "LeRobotDataset":
    """Open a local folder by LeRobot's own loader, which would fetch missing files; here they are an error."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    class Local(LeRobotDataset):
        def download(self, *_: Any, **__: Any) -> None:
            raise FileNotFoundError("frames of some of its episodes are not there")

        _download = download  # as LeRobot 0.6 calls it

    return Local(f"local/{root.resolve().name}", root, revision="local", video_backend=BACKEND)


def _check_videos(root: Path, meta: Any, key: str) -> None:
    """Raise EpisodeError unless each video has the camera's size, and each episode a part of its own, of its length.

    The merge of LeRobot 0.4.0 wrote times by which an episode is shown another one's pictures.
    """
    names = ("length", *(f"videos/{key}/{name}" for name in ("from_timestamp", "to_timestamp")))
    lengths, first_s, last_s = (np.asarray(meta.episodes[name], np.float64) for name in names)
    files = [meta.get_video_file_path(number, key) for number in range(len(lengths))]
    for file in sorted(set(files)):
        check_inside(root, root / file)
        with _as_episode_error(f"{root / file}: cannot be decoded"):
            check_video(root / file, _size_of(meta.features[key]))
    wrong = set(np.flatnonzero(abs((last_s - first_s) * meta.fps - lengths) >= 1).tolist())
    order = sorted(range(len(lengths)), key=lambda number: (files[number], first_s[number]))
    for number, after in pairwise(order):
        if files[number] == files[after] and last_s[number] > first_s[after] + 0.5 / meta.fps:
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


def _columns(dataset: "LeRobotDataset", layout: Layout) -> dict[str, np.ndarray]:
    """All frames' numbers, in their order: state (n, S) and action (n, A) float32 by the layout's names, and times."""
    marks = [INTERVENTION] if INTERVENTION in dataset.meta.features else []
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
            # written so that NaN is wrong
            wrong = np.flatnonzero(~(np.isfinite(values) & (values >= low) & (values <= high)))
            if len(wrong):
                what = f"{root}: {name} of '{key}' is {values[wrong[0]]:g} in {len(wrong)} frames from {wrong[0]} on"
                remedy = "are names (--action-names) and units right? if the car reverses, say reverse_us in car.yml"
                raise EpisodeError(f"{what}, a rover's lies from {low:g} to {high:g}", remedy=remedy)


def _check_frames(root: Path, dataset: "LeRobotDataset", columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the row at which each episode starts.

    Raises EpisodeError for rows that are not the frames in their order, each once, as the table of episodes says, by
    which LeRobot finds them, and for frames that do not come `fps` times a second from 0 s on.
    """
    number, times_s = columns["episode_index"], columns["timestamp"].astype(np.float64)
    starts, rows = np.flatnonzero(np.diff(number, prepend=-1)), np.arange(len(number))
    lengths = np.diff([*starts, len(number)])
    names = ("episode_index", "dataset_from_index", "dataset_to_index")
    table = np.stack([np.asarray(dataset.meta.episodes[name]) for name in names], 1)
    episodes = np.stack([np.arange(len(starts)), starts, starts + lengths], 1)
    within = rows - np.repeat(starts, lengths)
    ordered = np.array_equal(columns["index"], rows) and np.array_equal(columns["frame_index"], within)
    if not ordered or not np.array_equal(number[starts], episodes[:, 0]) or not np.array_equal(table, episodes):
        raise _broken(f"{root}: meta/episodes and the frames in data, or their order, do not belong together")
    fps = dataset.meta.fps
    steps = np.where(within > 0, np.diff(times_s, prepend=0.0), times_s + 1 / fps) * fps  # of a first frame, from 0 s
    if len(odd := steps[~(np.abs(steps - 1) <= np.where(within > 0, UNEVEN, 1))]):  # so that NaN counts as odd
        what = f"{root}: {INFO} says {fps:g} frames a second, but {len(odd)} frames come at another rate"
        found = f"{odd[0] / fps:.4f} s after the one before"
        raise EpisodeError(what, found=found, remedy="correct the rate, or record again")
    return starts


def _episode(
    dataset: "LeRobotDataset",
    encoded: Any,
    cameras: Mapping[str, Any],
    columns: Mapping[str, np.ndarray],
    rows: np.ndarray,
    chunk: int,
    driver: str,
    car: Car,
) -> Episode:
    """rows: of the whole dataset, those of this episode."""
    root, meta, first, n = dataset.root, dataset.meta, int(rows[0]), len(rows)
    number = int(columns["episode_index"][first])
    name, keys = f"episode_{number:06d}", [key for key, _ in cameras.values()]
    data = root / meta.get_data_file_path(number)
    files = [root / meta.get_video_file_path(number, key) if key in meta.video_keys else data for key in keys]
    tasks = dict(zip(meta.tasks["task_index"], meta.tasks.index, strict=True))
    index = np.arange(n)[:, None] + np.arange(chunk)
    actions, pads = columns[ACTION][rows], index >= n
    chunks = actions[np.minimum(index, n - 1)]
    taken_over = columns[INTERVENTION][rows] if INTERVENTION in columns else np.zeros(n, bool)
    samples = tuple(
        LerobotSample(
            episode=name,
            frame_path=files[0],
            time_s=float(columns["timestamp"][row] - columns["timestamp"][first]),
            state=columns[STATE][row].copy(),
            chunk=chunks[k].copy(),
            is_pad=pads[k].copy(),
            dataset=dataset,
            encoded=encoded,
            cameras=cameras,
            row=int(row),
            driver=HUMAN if taken_over[k] else driver,
            car=car,
        )
        for k, row in enumerate(rows)
    )
    return Episode(
        id=name,
        path=root,
        label=str(tasks.get(columns["task_index"][first], "")),
        duration_s=samples[-1].time_s,
        frames=n,
        controls=n,
        samples=samples,
        files=(root / INFO, data, *files[1:]),
        corrects=bool(taken_over.any()),
    )


def lerobot_train(dataset: Path | str) -> str:
    """Return the command of LeRobot's own that trains an ACT on a LeRobotDataset."""
    return (
        f"lerobot-train --dataset.repo_id=local/drives --dataset.root={dataset} --policy.type=act "
        "--policy.push_to_hub=false --policy.chunk_size=32 --policy.n_action_steps=32 --output_dir=trained"
    )
