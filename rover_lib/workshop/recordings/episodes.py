"""Read recorded drives, the user's episode folders with all their faults, as training and calibration samples.

    recordings = load_recordings("episodes")
    parts = split(recordings)
    samples, note = choose_calibration(parts.calibration, 200, seed=0)

docs/data.md has the table of faults. A frame's action is the nearest *measured* control's within `sync_s`; what was not
measured is missing, never 0. Its state is the previous frame's action. Its chunk is its own action and the following
ones, padded at the end with the last one and masked. A damaged picture costs only its own sample. A frame without an
action, a hole in time, and a change to or from nobody driving end the chunks before them, and the frame after it is no
sample, because its state would be invented.
"""

import csv
import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import NEUTRAL
from rover_lib.onboard.errors import CarError, EpisodeError
from rover_lib.onboard.kinds import EPISODE_FILES, kinds_of
from rover_lib.onboard.recording.episode import (
    CONTROL_FIELDS,
    DATA,
    DATA_BYTES,
    FRAME_FIELDS,
    NOBODY,
    car_in,
    find_killed,
    number_of,
    read_car_of,
)
from rover_lib.onboard.stage import read_plain
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.blocks import (
    SAME_PLACE,
    draw_blocks,
    name_long_drives,
    part_by_blocks,
    usual_rate_hz,
)
from rover_lib.workshop.recordings.controls import Control, in_order, place_bursts, read_controls
from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.recordings.lerobot_dataset import load_dataset
from rover_lib.workshop.recordings.pictures import HOLE_INTERVALS, HOLE_S, check_pictures
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Episode, Recordings, Sample, block_of, following
from rover_lib.workshop.recordings.source import Source
from rover_lib.workshop.recordings.strangers import READ, name_stranger
from rover_lib.workshop.recordings.tub import find_tubs, load_tubs
from rover_lib.workshop.recordings.twins import leave_out_copies
from rover_lib.workshop.untrusted import limited_memory, quote, quote_all, read_json

# What the JSON file has under these names, and where it is again with which columns.
TABLES = {"control_samples": ("control_data.csv", CONTROL_FIELDS), "frame_samples": ("frame_data.csv", FRAME_FIELDS)}
FOLDER = "give the folder that holds episode_*, or a LeRobotDataset's"
Samples = tuple[Sample, ...]


@dataclass(frozen=True, eq=False)
class Split:
    """Three parts that share no episode, or, if `note` says so, no block of one or no moment in time.

    choosing: to pick observers and mixed blocks. held_out: judges, and nothing else.
    """

    calibration: Samples
    choosing: Samples
    held_out: Samples
    note: str | None

    @property
    def episodes(self) -> dict[str, list[str]]:
        """The names of each part's episodes, or of its blocks where these are parted."""
        parts = {"calibration": self.calibration, "choosing": self.choosing, "held_out": self.held_out}
        return {part: list(dict.fromkeys(map(block_of, samples))) for part, samples in parts.items()}


@dataclass(frozen=True)
class _Frame:
    number: int
    time_s: float
    path: Path
    is_whole: bool  # and of the usual size; else it cannot be used


def load_recordings(
    root: Path | str | Source, chunk: int = 32, sync_s: float = 0.05, progress: Progress = silent
) -> Recordings:
    """Read recordings. Faults are counted, and what they affect is repaired or skipped.

    Args:
        root: a folder of episodes, or one of them; a LeRobotDataset; a donkeycar tub, or a folder of them.
        chunk: actions per sample.
        sync_s: largest distance in time between a frame and its control, in seconds.
        progress: shows which episode is read.

    Returns:
        The episodes, their samples and faults, and what their states and actions are called.

    Raises:
        EpisodeError: nothing usable is left, with the most frequent reasons.
    """
    source = Source.of(root)
    root = source.path
    if chunk < 1 or not sync_s > 0:
        raise EpisodeError("chunk must be at least 1 and sync_s above 0", found=f"{chunk} and {sync_s}")
    kinds = kinds_of(root)
    if "dataset" not in kinds:
        for option, names in (("--action-names", source.action_names), ("--camera", source.cameras)):
            if names not in ((), ACTION_NAMES):
                problem = f"{root}: our recordings and tubs have one camera and named actions"
                raise EpisodeError(problem, found=f"{option} {','.join(names)}", remedy="leave it out")
        if tubs := find_tubs(root, kinds):
            return load_tubs(source, tubs, chunk, progress)
    if source.throttle:
        raise EpisodeError(f"{root}: --throttle is for donkeycar tubs", found=source.throttle, remedy="leave it out")
    if "dataset" in kinds:
        return load_dataset(source, chunk, progress)
    root = root if root.name else root.resolve()  # "." has no name to give an episode
    try:
        if any((root / name).exists() for name in EPISODE_FILES):
            root, folders, strangers = root.parent, [root], []  # so that faults and hashes name the episode here too
        else:
            strangers = sorted(p for p in root.iterdir() if not p.name.startswith((".", "__MACOSX")) and p.is_dir())
            folders = [p for p in strangers if any((p / name).exists() for name in EPISODE_FILES)]
    except OSError as e:
        words, remedy = (name_stranger(root) if root.is_file() else None) or ("no folder of episodes", FOLDER)
        raise EpisodeError(f"{root}: {words} ({e.strerror})", remedy=remedy) from None
    finish = f"`rover record {shlex.quote(str(root))} --finish` makes an episode of it"
    killed = find_killed(root)
    if not folders:
        inside = quote_all(sorted(p.name for p in root.iterdir())) or None
        problem = "no episode folders in it"
        remedy = finish if killed else READ
        if not killed and (stranger := name_stranger(root)):
            problem = f"{stranger[0]}, not our recordings"
            remedy = stranger[1]
        raise EpisodeError(f"{root}: {problem}", found=inside, remedy=remedy)
    faults = Faults(root)
    for part in killed:
        faults.add(part, "killed_recording", finish)
    for folder in sorted({*strangers} - {*folders}):
        faults.add(folder, "no_episode", f"neither {DATA} nor CSV files; drives in folders of it are not read")
    episodes = []
    for folder in progress(folders, desc="reading episodes", total=len(folders)):
        try:
            episodes.append(_load_episode(folder, chunk, sync_s, faults))
        except CarError as e:
            faults.add(folder, "no_car", str(e))
        except EpisodeError as e:
            faults.add(folder, e.kind, str(e))
    if not episodes:
        remedy = "record again, or copy the whole folders, frames included"
        raise faults.nothing_usable(f"no usable sample in {len(folders)} folder(s)", remedy)
    own, blocks = name_long_drives(leave_out_copies(episodes, faults))
    return Recordings(root, own, faults.listed(), source, blocks=blocks)


def _load_episode(folder: Path, chunk: int, sync_s: float, faults: Faults) -> Episode:
    """Read one folder's episode. Raises CarError, and EpisodeError of the fault's kind, if it has no usable sample."""
    try:
        with limited_memory():
            content, tables = _read_tables(folder, faults)
            # read_car_of reads larger files
            car = car_in(content.get("metadata"), folder) if content else read_car_of(folder)
    except (OSError, ValueError, csv.Error, MemoryError) as e:
        problem = f"neither {DATA} nor its CSV files can be read: {quote(str(e) or 'too much memory')}"
        raise EpisodeError(problem, kind="unreadable") from None
    (source, control_rows), (frames_source, frame_rows) = tables["control_samples"], tables["frame_samples"]
    controls, formulas = read_controls(source, control_rows, car.pwm, faults)
    frames = _read_frames(folder, frames_source, frame_rows, faults)
    samples: Samples = ()
    if controls and frames:
        controls = place_bursts(controls, source, faults)
        samples = _make_samples(folder, car, frames, controls, chunk, sync_s, faults)
    if not samples:
        problem = f"of {len(controls)} usable controls and {len(frames)} usable frame entries"
        raise EpisodeError(problem, kind="nothing_usable")
    files = tuple(p for name in EPISODE_FILES if (p := folder / name).is_file())
    counts = frames[-1].time_s - frames[0].time_s, len(frame_rows), len(control_rows)
    label = raw_label if isinstance(raw_label := content.get("action_label"), str) else ""
    return Episode(folder.name, folder, label, *counts, samples, files, formulas)


def _read_tables(folder: Path, faults: Faults) -> tuple[dict[str, Any], dict[str, tuple[Path, list[Any]]]]:
    """Return the JSON file's content, {} if it has none, and for controls and frames the file that has rows, and these.

    The rows are the JSON's, or where it has none the CSV file's. Raises OSError, ValueError and csv.Error for that one.
    """
    path = folder / DATA
    content = dict[str, Any]()
    why = "no rows of controls or frames in it"
    try:
        found = read_json(path)
        content = found if isinstance(found, dict) else {}
    except (OSError, ValueError) as e:
        why = quote(str(e))
    tables = {key: (path, rows) for key in TABLES if isinstance(rows := content.get(key), list) and rows}
    if len(tables) < len(TABLES):
        faults.add(path, "broken_json", f"{why}: its CSV files are read")
    for key, (name, fields) in TABLES.items():
        if key not in tables:
            tables[key] = folder / name, _read_csv(folder / name, fields)
    return content, tables


def _read_csv(path: Path, fields: Sequence[str]) -> list[dict[str, Any]]:
    lines = read_plain(path, DATA_BYTES).decode("utf-8-sig", errors="replace").splitlines()
    # In a row that was cut, a missing field must not look like an empty one, which means "no pulse".
    table = csv.DictReader(lines, restval="missing")
    if missing := [name for name in fields if name not in (table.fieldnames or ())]:
        raise ValueError(f"{path.name} has no column {missing[0]}")
    return list(table)


def _read_frames(folder: Path, path: Path, rows: list, faults: Faults) -> list[_Frame]:
    """Return the listed frames that have a time, ordered by it. A picture of another size than most cannot be used."""
    listed: dict[float, tuple[int, float, str]] = {}
    for i, row in enumerate(rows):
        if not isinstance(row, dict):
            faults.add(path, "wrong_type", f"frame {i} is a {type(row).__name__}, not an object")
            continue
        number = number_of(row.get("frame_id"))
        time_s = number_of(row.get("timestamp"))
        name = row.get("image_path")
        nan = math.isnan(number or 0) or math.isnan(time_s or 0)
        if nan or number is None or time_s is None or not isinstance(name, str) or not name:
            row_values = quote_all(row.get(name) for name in FRAME_FIELDS)
            faults.add(path, "not_finite" if nan else "wrong_type", f"frame {i}: {row_values}")
            continue
        if number in listed:
            faults.add(path, "duplicate_frame_id", f"frame id {number:g} again in row {i}; the first one counts")
            continue
        listed[number] = int(number), time_s, name
    pictures = check_pictures(folder, [name for *_, name in listed.values()], path, faults)
    frames = []
    for (number, time_s, _), (picture, usable) in zip(listed.values(), pictures, strict=True):
        frames.append(_Frame(number, time_s, picture, usable))
    went_on = [b.number > a.number for a, b in pairwise(frames)]
    frames = in_order([(f.time_s, f) for f in frames], went_on, path, "frame", faults)
    valid = frames[:1]
    for frame in frames[1:]:
        if frame.time_s > valid[-1].time_s:
            valid.append(frame)
        else:
            faults.add(path, "duplicate_frame_time", f"frame {frame.number} has the time of frame {valid[-1].number}")
    return valid


def _nearest(times_s: np.ndarray, controls: list[Control], within_s: float) -> list[Control | None]:
    """Return for each time the nearest control, or None if that is farther away."""
    if not controls:
        return [None] * len(times_s)
    system_s = np.array([c.system_s for c in controls])
    index = np.searchsorted((system_s[1:] + system_s[:-1]) / 2, times_s)
    near = np.abs(system_s[index] - times_s) <= within_s
    return [controls[k] if is_near else None for k, is_near in zip(index.tolist(), near, strict=True)]


def _make_samples(
    folder: Path, car: Car, frames: list[_Frame], controls: list[Control], chunk: int, sync_s: float, faults: Faults
) -> Samples:
    times_s = np.array([f.time_s for f in frames])
    nearest = _nearest(times_s, controls, sync_s)
    if not any(nearest):
        gap_s = min(abs(frames[0].time_s - controls[-1].system_s), abs(controls[0].system_s - frames[-1].time_s))
        faults.add(folder, "no_overlap", f"frames and controls are {gap_s:.1f} s apart")
        return ()
    steering = _nearest(times_s, [c for c in controls if c.actions[0] is not None], sync_s)
    throttle = _nearest(times_s, [c for c in controls if c.actions[1] is not None], sync_s)
    measured = list(zip(steering, throttle, strict=True))
    measured_both = np.array([all(pair) for pair in measured])
    actions = np.array([[c.actions[i] if c else 0 for i, c in enumerate(pair)] for pair in measured], np.float32)
    pulses_us = [[c.pulses_us[i] if c else math.nan for i, c in enumerate(pair)] for pair in measured]
    without = nearest.count(None)
    faults.add(folder, "frame_without_control", f"no control within {sync_s * 1000:g} ms", without)
    note = f"controls near, but without a measured pulse within {sync_s * 1000:g} ms"
    faults.add(folder, "frame_without_measurement", note, len(frames) - without - int(measured_both.sum()))

    steps_s = np.diff(times_s)
    longest_s = min(HOLE_INTERVALS * float(np.median(steps_s)), HOLE_S) if len(steps_s) else HOLE_S
    holes = np.flatnonzero(steps_s > longest_s) + 1
    note = f"more than {longest_s:.3f} s between two frames"
    faults.add(folder, "hole_in_time", note, len(holes))

    samples: list[Sample] = []
    drivers = [c.driver if c else "" for c in nearest]
    undriven = np.array([driver == NOBODY for driver in drivers])
    breaks = np.union1d(holes, np.flatnonzero(undriven[1:] != undriven[:-1]) + 1)
    with_action = np.flatnonzero(measured_both)
    cuts = np.flatnonzero((np.diff(with_action) > 1) | np.isin(with_action[1:], breaks)) + 1
    for segment in np.split(with_action, cuts):
        chunks, pads = following(actions[segment], chunk)
        for k, i in enumerate(segment.tolist()):
            if not frames[i].is_whole:
                continue
            if k == 0 and i > 0:
                faults.add(folder, "frame_without_state", "the previous frame's action is not known")
                continue
            state = actions[i - 1] if k else np.asarray(NEUTRAL, np.float32)
            numbers = state.copy(), chunks[k], pads[k]
            source = folder.name, frames[i].path, float(times_s[i] - times_s[0])
            samples.append(Sample(*source, *numbers, i, drivers[i], car, (pulses_us[i][0], pulses_us[i][1])))
    return tuple(samples)


def split(recordings: Recordings, held_out_share: float = 0.25, seed: int = 0) -> Split:
    """Split the samples by whole episodes, drawn at random.

    Long drives are split by their blocks instead, and fewer than three episodes along their time, with a gap of one
    chunk between the parts; `note` says so.

    Args:
        recordings: at least two chunks long.
        held_out_share: of the episodes, in (0, 1); half of it is for choosing.
        seed: of the draw.

    Returns:
        The samples to calibrate or learn with, those to choose with, and those to judge with.

    Raises:
        EpisodeError: for another share, and for recordings too short to be split.
    """
    if not 0 < held_out_share < 1:
        raise EpisodeError("held_out_share must be between 0 and 1", found=held_out_share)
    episodes = recordings.episodes
    if recordings.blocks:
        return _split_by_blocks(recordings, held_out_share, seed)
    if len(episodes) < 3:
        return _split_by_time(episodes, held_out_share)
    count = min(max(round(len(episodes) * held_out_share), 2), len(episodes) - 1)
    order = np.random.default_rng(seed).permutation(len(episodes)).tolist()
    far = abs(count / len(episodes) - held_out_share) > 0.1
    note = f"only {len(episodes)} episodes: {count} of them are held out, not {held_out_share:.0%}" if far else None

    def samples_of(drawn: list[int]) -> Samples:
        return tuple(chain.from_iterable(episodes[i].samples for i in sorted(drawn)))

    half = count // 2
    return Split(samples_of(order[count:]), samples_of(order[:half]), samples_of(order[half:count]), note)


def _split_by_blocks(recordings: Recordings, held_out_share: float, seed: int) -> Split:
    """Split by the blocks that are left, if episodes were left out since they were named."""
    episodes = recordings.episodes
    there = {s.block for s in recordings.samples}
    places = [[name for name in names if name in there] for names in recordings.blocks]
    drawn = draw_blocks([names for names in places if len(names) > 2], held_out_share, np.random.default_rng(seed))
    if not drawn:
        return _split_by_time(episodes, held_out_share)
    count = sum(map(len, places))
    each_s = sum(bool(s.block) for s in recordings.samples) / usual_rate_hz(episodes) / count
    note = f"{count} blocks of some {each_s:.0f} s, {len(drawn)} of them held out, with gaps of a plan between"
    return Split(**part_by_blocks(episodes, drawn), note=f"{note}: judged on {SAME_PLACE}")


def _split_by_time(episodes: tuple[Episode, ...], held_out_share: float) -> Split:
    calibration = list[Sample]()
    choosing = list[Sample]()
    held_out = list[Sample]()
    for episode in episodes:
        samples = episode.samples
        gap = len(samples[0].chunk)
        remaining = len(samples) - 2 * gap
        if remaining < 3:
            continue  # too short to leave a gap of one chunk between the parts
        held_count = min(max(round(remaining * held_out_share), 2), remaining - 1)
        first = remaining - held_count
        second = held_count // 2
        calibration += samples[:first]
        choosing += samples[first + gap : first + gap + second]
        held_out += samples[first + gap + second + gap :]
    if not held_out:
        problem = f"{len(episodes)} episode(s) are too short to be parted"
        raise EpisodeError(problem, remedy="record at least three episodes, or a longer one")
    note = f"only {len(episodes)} episode(s): parted along time, with a gap of one chunk between"
    return Split(tuple(calibration), tuple(choosing), tuple(held_out), note)


def choose_calibration(samples: Samples, count: int = 200, seed: int = 0) -> tuple[Samples, str | None]:
    """Choose at most `count` samples that cover the recorded actions, in the given order; the same for the same seed.

    One half, so that observers see the extremes, is chosen by farthest points over (state, four actions along the
    chunk), each action divided by its spread; the other half at random from the rest. Also returns a note if there were
    fewer than asked for, else None. Raises EpisodeError for no samples or a count below 1.
    """
    if not samples or count < 1:
        problem = f"cannot choose {count} of {len(samples)} samples for calibration"
        raise EpisodeError(problem, remedy="record more episodes")
    if len(samples) <= count:
        fewer = len(samples) < count
        note = f"asked for {count} calibration samples, found only {len(samples)}: all are used" if fewer else None
        return tuple(samples), note
    rng = np.random.default_rng(seed)
    steps = np.unique(np.linspace(0, len(samples[0].chunk) - 1, 4).round().astype(int))
    points = np.stack([np.concatenate([s.state[None], s.chunk[steps]]) for s in samples]).astype(np.float64)
    spread = points.reshape(-1, points.shape[-1]).std(axis=0)
    points = (points / np.where(spread > 0, spread, 1)).reshape(len(samples), -1)
    picks = [int(rng.integers(len(samples)))]
    distance = np.full(len(samples), np.inf)
    while len(picks) < (count + 1) // 2:
        distance = np.minimum(distance, ((points - points[picks[-1]]) ** 2).sum(axis=1))
        distance[picks] = -1  # equal points must not be taken twice
        picks.append(int(distance.argmax()))
    rest = np.setdiff1d(np.arange(len(samples)), picks)
    picks += rng.choice(rest, count - len(picks), replace=False).tolist()
    return tuple(samples[i] for i in sorted(picks)), None
