"""Read recorded drives, the user's episode folders with all their faults, as training and calibration samples.

    recordings = load_recordings("episodes")
    parts = split(recordings)
    samples, note = choose_calibration(parts.calibration, 200, seed=0)

How a recording becomes samples:
- A control measures a channel only if the firmware saw a pulse there (`pwm.Channel.measured`). If it saw none, the file
  has a flag and no value, or the old recorder's 0 (onboard/recording/episode.py): here that is missing, never 0.
  A frame takes its throttle and its steering each from the nearest *measured* control within `sync_s`. So one lost
  reading between two good ones costs nothing (controls come every 33 ms), and a longer hole leaves its frames without
  an action.
- Controls that waited in the serial buffer arrive in one burst, so their system times say nothing. They get the times
  of the Arduino's clock, counted back from the first control after them that arrived live (backwards and from close by,
  because that clock drifts). Those that the clock cannot place are dropped.
- If the system's clock was set back in the middle of a drive, which shows because the frames' numbers and the Arduino's
  clock go on, everything after that is left out. Its times belong to other moments of the same drive, and it would be
  given their actions.
- A frame's action is its control. Its state is the previous frame's action. Its chunk is its own action and those of
  the following frames (LeRobot's delta indices range(chunk)), padded at the end with the last one and masked.
- A picture that is missing or damaged costs only its own sample: that frame's time and action are known, so its
  neighbours keep their state and chunk. A frame without an action, or a hole in time, ends the chunks before it, and
  the frame after it is no sample, because its state would be invented. Only an episode's first frame starts neutral.
- If nobody drove, the pulses are those of a human whose car did something else, because it was held. Such frames are
  samples with that driver, but no chunk and no state reaches from them to frames at which somebody drove, or back.
- Actions that follow another formula of the pulses than this car's, as older firmware wrote them, are recomputed from
  the pulses (see `formula`). If they follow none, the recording is left out.
- A drive that failed is as good a recording as any other: its outcome is noted, and nothing is left out because of it.
"""

import csv
import json
import math
import os
import stat
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import simplejpeg

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import NEUTRAL, Channel, PwmCalibration
from rover_lib.onboard.errors import CarError, EpisodeError
from rover_lib.onboard.kinds import refuse_holder
from rover_lib.onboard.recording.episode import (
    BURST_MIN,
    CONTROL_FIELDS,
    DATA_BYTES,
    FRAME_FIELDS,
    NOBODY,
    OUTCOMES,
    arduino_step_s,
    driver_of,
    find_backlog,
    find_killed,
    no_pulse,
    number_of,
    read_car_of,
)
from rover_lib.workshop import hub
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings import lerobot_dataset
from rover_lib.workshop.recordings.formula import EXACT, FOLLOWS, LEAST_READINGS, Formula, formulas_of, half_unit_of
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Episode, Fault, Recordings, Sample, Source, relative
from rover_lib.workshop.untrusted import quote, quote_all

DATA_FILES = ("episode_data.json", "control_data.csv", "frame_data.csv")
HOLE_INTERVALS = 2.5  # one dropped frame is bridged; two in a row are a hole in time
HOLE_S = 0.5  # always a hole in time, whatever the usual interval: no camera of a moving car is that slow
# Faults of which one is enough to leave a recording out, and those that follow from another.
FOLLOWING = ("absent", "nothing_usable")
DECISIVE = ("no_formula", "no_car", "no_overlap", "not_seconds", "coarse_times", "wrong_header", "broken_json")
LAST_S = 1e11  # Unix time is a hundredth of it
FAR = 0.2  # of an action's unit: a pulse beyond the ends of its range by more is no jitter
JPEG_HEAD = 1024  # in which most cameras say how large the picture is
JPEG_TAIL = 64  # some recorders pad the end marker with zeros
Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class Split:
    """Three parts that share no episode, or, if `note` says so, no moment in time.

    calibration: for the observers. choosing: to pick observers and mixed blocks. held_out: to judge the result; it must
    be used for nothing else. episodes: the ids of each part's episodes.
    """

    calibration: tuple[Sample, ...]
    choosing: tuple[Sample, ...]
    held_out: tuple[Sample, ...]
    note: str | None
    episodes: dict[str, list[str]]


@dataclass
class Faults:
    """Counts faults by file and kind, and keeps the note of the first."""

    root: Path
    counted: dict[tuple[str, str], list] = field(default_factory=dict)

    def add(self, path: Path, kind: str, note: str, count: int = 1) -> None:
        if count:
            entry = self.counted.setdefault((relative(path, self.root), kind), [0, note])
            entry[0] += count

    def listed(self) -> tuple[Fault, ...]:
        return tuple(Fault(file, kind, count, note) for (file, kind), (count, note) in sorted(self.counted.items()))


@dataclass(frozen=True)
class _Control:
    """One reading. arduino_s is NaN if that clock was no number; an action is None if nothing was measured, and its
    pulse, in microseconds, then is NaN.
    """

    system_s: float
    arduino_s: float
    actions: tuple[float | None, float | None]
    driver: str
    pulses_us: tuple[float, ...]


@dataclass(frozen=True)
class _Frame:
    number: int
    time_s: float
    path: Path
    size: tuple[int, int] | None  # None: it cannot be used


def load_recordings(
    root: Path | str | Source, chunk: int = 32, sync_s: float = 0.05, progress: Progress = silent
) -> Recordings:
    """Read every episode folder below `root` (or `root` itself, if it is one), or a LeRobotDataset, also from the Hub.

    chunk: actions per sample. sync_s: largest distance in time between a frame and its control. Faults are counted, and
    what they affect is repaired or skipped. Here only the two ends of each picture are checked; `Sample.frame_bgr`
    decodes it. Raises EpisodeError if nothing usable is left, with the most frequent reasons.
    """
    source = Source.of(root)
    root = source.path
    if chunk < 1 or not sync_s > 0:
        raise EpisodeError("chunk must be at least 1 and sync_s above 0", found=f"{chunk} and {sync_s}")
    if hub.is_hub_id(root):
        return lerobot_dataset.load_dataset(lerobot_dataset.fetch_dataset(source), chunk, progress)
    if lerobot_dataset.is_dataset(root):
        return lerobot_dataset.load_dataset(source, chunk, progress)
    if source.action_names not in ((), ACTION_NAMES):
        raise EpisodeError(
            f"{root}: recordings of this project name their actions themselves",
            found=f"--action-names {','.join(source.action_names)}",
            remedy="leave it out",
        )
    root = root if root.name else root.resolve()  # "." has no name to give an episode
    try:
        if any((root / name).exists() for name in DATA_FILES):
            root, folders = root.parent, [root]  # so that faults and hashes name the episode here too
        else:
            folders = sorted(p for p in root.iterdir() if not p.name.startswith(".") and p.is_dir())
    except OSError as e:
        raise EpisodeError(
            f"{root}: no folder of episodes ({e.strerror})",
            remedy="give the folder with episode_* in it, a LeRobotDataset's (with meta/info.json), or "
            "user/name@revision of the Hub",
        ) from None
    if {"data", "meta"} <= {p.name for p in folders}:
        raise EpisodeError(f"{root}: a LeRobotDataset without meta/info.json", remedy=lerobot_dataset.COPY_AGAIN)
    finish = f"`rover record {root} --finish` makes an episode of it"
    killed = find_killed(root)
    if not folders:
        refuse_holder(root)
        remedy = finish if killed else "give the folder that holds episode_YYYYMMDD_HHMMSS"
        raise EpisodeError(
            f"{root}: no episode folders in it", found=f"{len(killed)} killed ones" if killed else None, remedy=remedy
        )
    faults = Faults(root)
    for part in killed:
        faults.add(part, "killed_recording", finish)
    read = (
        _load_episode(folder, chunk, sync_s, faults)
        for folder in progress(folders, desc="reading episodes", total=len(folders))
    )
    episodes = tuple(episode for episode in read if episode)
    if not episodes:
        if {fault.kind for fault in faults.listed()} == {"no_data"}:
            refuse_holder(root)
        raise nothing_usable(
            f"{root}: no usable sample in {len(folders)} episode folder(s)",
            faults.listed(),
            "record again, or copy the whole folders, frames included",
        )
    return Recordings(root, episodes, faults.listed(), source)


def nothing_usable(what: str, faults: Iterable[Fault], remedy: str) -> EpisodeError:
    """The error of recordings of which all is left out. remedy: if the first reason has none of its own."""
    kinds: Counter[str] = Counter()
    first: dict[str, str] = {}
    for fault in faults:
        if fault.handled == "left out":
            kinds[fault.kind] += fault.count
            first.setdefault(fault.kind, f"{fault.note} ({fault.file})")
    most = sorted(kinds, key=lambda kind: (kind not in DECISIVE, kind in FOLLOWING, -kinds[kind], kind))[:6]
    worst = ", ".join(f"{kind} {kinds[kind]} times" for kind in most)
    found = first[most[0]] if most else ""
    return EpisodeError(f"{what} ({worst or 'empty'})", found=found or None, remedy="" if "; " in found else remedy)


def _load_episode(folder: Path, chunk: int, sync_s: float, faults: Faults) -> Episode | None:
    """Read one folder's episode. None if it has no usable sample; a fault then says why."""
    try:
        present = any((folder / name).exists() for name in DATA_FILES)
    except OSError as e:
        faults.add(folder, "unreadable", e.strerror or type(e).__name__)
        return None
    if not present:
        faults.add(folder, "no_data", f"none of {', '.join(DATA_FILES)} is there")
        return None
    try:
        car = read_car_of(folder)
    except CarError as e:
        faults.add(folder, "no_car", str(e))
        return None
    (label, outcome), tables = _read_tables(folder, faults)
    try:
        controls, formulas = _read_controls(*tables["control_samples"], car.pwm, faults)
    except EpisodeError as e:
        faults.add(folder, "no_formula", str(e))
        return None
    frames = _read_frames(folder, *tables["frame_samples"], faults)
    if not controls or not frames:
        faults.add(folder, "nothing_usable", f"{len(controls)} usable controls and {len(frames)} usable frame entries")
        return None
    source = tables["control_samples"][0]
    controls = _place_bursts(controls, source, faults)
    samples = _make_samples(folder, car, frames, controls, chunk, sync_s, faults)
    if not samples:
        faults.add(folder, "nothing_usable", "no frame with a picture, an action and a known state")
        return None
    return Episode(
        id=folder.name,
        path=folder,
        label=label,
        duration_s=frames[-1].time_s - frames[0].time_s,
        frames=len(tables["frame_samples"][1]),
        controls=len(tables["control_samples"][1]),
        samples=samples,
        files=tuple(p for name in DATA_FILES if (p := folder / name).is_file()),
        outcome=outcome,
        formulas=formulas,
    )


def _read_tables(folder: Path, faults: Faults) -> tuple[tuple[str, str | None], dict[str, tuple[Path, list]]]:
    """Return (label, outcome), and for controls and frames the file that they came from and its rows.

    The rows are those of the JSON file if it has any, else those of the CSV file.
    """
    content = _read_json(folder / "episode_data.json", faults)
    label = content.get("action_label", "")
    metadata = content.get("metadata")
    outcome = metadata.get("outcome") if isinstance(metadata, dict) else None
    if outcome is not None and outcome not in OUTCOMES:
        faults.add(folder / "episode_data.json", "unknown_outcome", f"{quote(outcome)}: rover label says it anew")
        outcome = None
    tables = {}
    for key, name, fields in (
        ("control_samples", "control_data.csv", CONTROL_FIELDS),
        ("frame_samples", "frame_data.csv", FRAME_FIELDS),
    ):
        rows = content.get(key, [])
        if not isinstance(rows, list):
            faults.add(folder / "episode_data.json", "wrong_type", f"{key} is a {type(rows).__name__}, not a list")
            rows = []
        if rows:
            tables[key] = folder / "episode_data.json", rows
        else:
            tables[key] = folder / name, _read_csv(folder / name, fields, faults)
    return (label if isinstance(label, str) else "", outcome), tables


def _read_bytes(path: Path, faults: Faults) -> bytes | None:
    """Return a data file's bytes.

    None, with a fault, if it is absent, empty, unreadable, too large, or a link that leaves its folder.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            faults.add(path, "unreadable", "not a file")
            return None
        if status.st_size > DATA_BYTES:
            faults.add(path, "too_large", f"{status.st_size / 1e6:.0f} MB, at most {DATA_BYTES / 1e6:.0f} are read")
            return None
        if not _inside(path, path.parent):
            faults.add(path, "path_leaves_folder", "a link to somewhere else")
            return None
        data = path.read_bytes()
    except FileNotFoundError:
        faults.add(path, "absent", "not there")
        return None
    except OSError as e:
        faults.add(path, "unreadable", e.strerror or type(e).__name__)
        return None
    if not data.strip():
        faults.add(path, "empty", "nothing in it")
        return None
    return data


def _read_json(path: Path, faults: Faults) -> dict[str, Any]:
    data = _read_bytes(path, faults)
    if data is None:
        return {}
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as e:  # bad syntax or encoding, or brackets nested without end
        faults.add(path, "broken_json", quote(str(e)))
        return {}
    if not isinstance(content, dict):
        faults.add(path, "wrong_type", f"holds a {type(content).__name__}, not an object")
        return {}
    return content


def _read_csv(path: Path, fields: tuple[str, ...], faults: Faults) -> list[dict[str, Any]]:
    data = _read_bytes(path, faults)
    if data is None:
        return []
    # In a row that was cut, a missing field must not look like an empty one, which means "no pulse".
    table = csv.DictReader(data.decode("utf-8-sig", errors="replace").splitlines(), restval="missing")
    rows: list[dict[str, Any]] = []
    try:
        if missing := [name for name in fields if name not in (table.fieldnames or ())]:
            begins = quote(data[:80].decode(errors="replace"))
            faults.add(path, "wrong_header", f"no column {missing[0]} in its first line, {begins}")
            return []
        rows.extend(table)
    except csv.Error as e:
        faults.add(path, "broken_csv", quote(str(e)))
    return rows


def _read_controls(path: Path, rows: list, pwm: PwmCalibration, faults: Faults) -> tuple[list[_Control], dict]:
    """Return the usable readings, ordered by system time, and by channel the formula that its actions followed, if it
    was another than the car's, and they were recomputed.

    Raises EpisodeError if a channel's actions follow no formula of its pulses.
    """
    read: list[tuple[int, dict[str, float], list[str], str]] = []
    for i, row in enumerate(rows):
        if not isinstance(row, dict):
            faults.add(path, "wrong_type", f"control {i} is a {type(row).__name__}, not an object")
            continue
        lost = [name for name in ACTION_NAMES if no_pulse(row, name)]
        wanted = [name for name in CONTROL_FIELDS if name.split("_")[0] not in lost]
        numbers = {name: number_of(row.get(name)) for name in wanted}
        values = {name: value for name, value in numbers.items() if value is not None}
        bad = [name for name in wanted if name not in values]
        nan = [name for name, value in values.items() if math.isnan(value)]
        if bad:
            faults.add(path, "wrong_type", f"control {i}: {bad[0]} is {quote(row.get(bad[0]))}")
            continue  # the recorder did not write such a row, so nothing in it can be trusted
        if nan:
            faults.add(path, "not_finite", f"control {i}: {nan[0]} is {quote(row.get(nan[0]))}")
        if "system_timestamp" in nan or _is_no_second(values["system_timestamp"], f"control {i}", path, faults):
            continue  # without a time it cannot be the action of a frame
        for name in lost:
            faults.add(path, f"{name}_no_pulse", f"control {i}: not measured; such values are missing, not 0")
        if (driver := driver_of(row)) is None:
            faults.add(path, "unknown_driver", f"control {i}: {quote(row.get('driver'))} drove; left out")
            continue
        read.append((i, values, lost, driver))
    pairs = {}
    formulas = {}
    for name in ACTION_NAMES:
        rows_of = {i: values for i, values, lost, _ in read if name not in lost}
        recorded, meant, formula = _read_actions(pwm.channel(name), rows_of, path, faults)
        pairs[name] = recorded, meant
        if formula:
            formulas[name] = formula
    # Too few readings to show a formula are of older firmware too, if the other channel's are.
    actions = {n: _take(pwm.channel(n), *both, bool(formulas), path, faults) for n, both in pairs.items()}
    controls = []
    for i, values, _, driver in read:
        pair = actions["steering"].get(i), actions["throttle"].get(i)
        pulses = tuple(values.get(f"{n}_raw_us", math.nan) if i in actions[n] else math.nan for n in ACTION_NAMES)
        times_s = values["system_timestamp"], values["arduino_timestamp"] / 1000
        controls.append(_Control(*times_s, pair, driver, pulses))
    system_s, arduino_s = (np.abs(np.diff([getattr(c, s) for c in controls])) for s in ("system_s", "arduino_s"))
    if len(controls) > LEAST_READINGS:
        # Most of a backlog's steps are too short, but not all of the recording's.
        known = arduino_s[np.isfinite(arduino_s)]
        usual_s, live_s = np.median(known) if len(known) else 0.0, np.quantile(system_s, 0.9)
        if usual_s > 0 and live_s > 0 and not 0.1 < live_s / usual_s < 10:
            note = f"its steps are {1000 * usual_s:.3g}, the system's clock's {1000 * live_s:.3g} ms; it is not used"
            faults.add(path, "arduino_clock_not_in_ms", note, len(controls))
            controls = [replace(c, arduino_s=math.nan) for c in controls]
    went_on = [arduino_step_s(a.arduino_s, b.arduino_s) > 0 for a, b in pairwise(controls)]
    return _in_order([(c.system_s, c) for c in controls], went_on, path, "control", faults), formulas


def _read_actions(
    channel: Channel, rows: dict[int, dict[str, float]], path: Path, faults: Faults
) -> tuple[dict[int, float], dict[int, float], Formula | None]:
    """Return one channel's recorded actions by the number of their control, those that their pulses mean, and the
    formula that the recorded ones follow, if it is another than the car's. Those that were not measured are left out.

    Raises EpisodeError if they follow none.
    """
    name = channel.name
    recorded, meant = {}, {}
    duties_pct = {}
    for i, values in rows.items():
        action, pulse_us, period_us = (values[f"{name}_{part}"] for part in ("normalized", "raw_us", "period_us"))
        if any(math.isnan(v) for v in (action, pulse_us, period_us)):
            continue  # the caller has counted it, with the field's name
        expected = channel.action(pulse_us, period_us)
        if expected is None:
            kind = "zero_period" if period_us == 0 or pulse_us == 0 else "odd_period"
            note = f"control {i}: pulse {pulse_us:g} us of {period_us:g} us; such values are missing, not 0"
            faults.add(path, f"{name}_{kind}", note)
            continue
        recorded[i], meant[i] = action, expected
        duties_pct[i] = 100 * pulse_us / (channel.period_us if channel.by_pulse else period_us)
    found, expects, duties = (np.array(list(of.values())) for of in (recorded, meant, duties_pct))
    _refuse_other_pulses(channel, rows, duties_pct)
    half_unit = half_unit_of(found)
    off = np.abs(found - expects)
    agrees = off <= EXACT + half_unit
    # Firmware may have been changed within a recording, so only what disagrees must follow another formula.
    formulas = formulas_of(channel, found[~agrees], duties[~agrees], half_unit)
    unlike = len(found) >= LEAST_READINGS and agrees.mean() < FOLLOWS
    rounded = half_unit and not formulas and agrees.mean() >= FOLLOWS and (off > EXACT).any()
    if formulas or unlike or rounded:
        wrong = off > EXACT if rounded else ~agrees
        first = next(i for i, is_wrong in zip(recorded, wrong, strict=True) if is_wrong)
        seen = f"control {first}: {recorded[first]:g} recorded, its pulse says {meant[first]:.4f}"
        if unlike and not formulas:
            raise EpisodeError(
                f"{name} follows no formula of its pulses: {100 * agrees.mean():.0f} % the car's, the rest no line",
                found=seen,
                remedy="correct them, or record again",
            )
        said = f"recorded as {', then as '.join(map(str, formulas))} instead of {Formula.of(channel)}"
        note = f"{f'rounded to {2 * half_unit:g}' if rounded else said}; {seen}; recomputed from the pulses"
        faults.add(path, f"{name}_recomputed", note, int(wrong.sum()))
        return meant, meant, formulas[0] if formulas else None
    return recorded, meant, None


def _refuse_other_pulses(channel: Channel, rows: dict[int, dict[str, float]], duties_pct: dict[int, float]) -> None:
    """Raise EpisodeError if most pulses lie far beyond this car's: all would be recomputed as one end of its range."""
    (low_us, high_us), margin_us = channel.ends_us, FAR * channel.us_per_unit
    pulses_us = {i: duty * channel.period_us / 100 for i, duty in duties_pct.items()}
    far = [i for i, us in pulses_us.items() if not low_us - margin_us <= us <= high_us + margin_us]
    if len(pulses_us) >= LEAST_READINGS and 2 * len(far) > len(pulses_us):
        row = rows[far[0]]
        raise EpisodeError(
            f"{channel.name}: {len(far)} of {len(pulses_us)} pulses lie far beyond this car's {low_us} to {high_us} us",
            found=f"control {far[0]}: {row[f'{channel.name}_raw_us']:g} us of {row[f'{channel.name}_period_us']:g} us",
            remedy="write pulses and periods in microseconds, or say which car it is in metadata.car",
        )


def _take(
    channel: Channel, recorded: dict[int, float], meant: dict[int, float], recompute: bool, path: Path, faults: Faults
) -> dict[int, float]:
    """Return the actions of one channel, as recorded, or where pulses deny them, as these mean them if `recompute`."""
    name = channel.name
    for i, action in list(recorded.items()):
        if recompute and abs(action - meant[i]) > EXACT:
            note = f"control {i}: {action:g} recorded, its pulse says {meant[i]:.4f}; recomputed from the pulses"
            faults.add(path, f"{name}_recomputed", note)
            recorded[i] = meant[i]
        elif not channel.low <= action <= channel.high:
            faults.add(path, f"{name}_out_of_range", f"control {i}: {action:g}")
            del recorded[i]
        elif abs(action - meant[i]) > EXACT:
            note = f"control {i}: {action:g} recorded, its pulse says {meant[i]:.4f}; taken as recorded"
            faults.add(path, f"{name}_disagrees_with_pulse", note)
    return recorded


def _in_order(
    timed: list[tuple[float, Item]], went_on: list[bool], path: Path, what: str, faults: Faults
) -> list[Item]:
    """Sort the items by time, keeping the order of equal times, and count the steps back in time.

    If the clock was set back, everything from there on is left out. timed: (time in seconds, item), in the file's
    order. went_on: for each item but the first, whether it was made after the one before it, whatever their times say.
    """
    times_s = [time_s for time_s, _ in timed]
    end = next((i for i in range(2, len(timed)) if went_on[i - 1] and _was_set_back(times_s, i)), len(timed))
    note = f"the clock was set back at {what} {end}; from there on, times may be those of other moments"
    faults.add(path, f"clock_set_back_at_{what}", note, len(timed) - end)
    back = sum(b < a for a, b in pairwise(times_s[:end]))
    faults.add(path, f"unsorted_{what}_times", f"{what}s were put in order of time", back)
    return [item for _, item in sorted(timed[:end], key=lambda pair: pair[0])]


def _was_set_back(times_s: list[float], i: int) -> bool:
    """Whether the two times before `i` are both later than those at `i` and `i + 1`.

    A single wrong time does not mean that the clock was set back.
    """
    return min(times_s[i - 2 : i]) > max(times_s[i : i + 2])


def _place_bursts(controls: list[_Control], path: Path, faults: Faults) -> list[_Control]:
    """Give the controls of a serial burst the times at which they were measured, or drop them."""
    late = find_backlog([c.system_s for c in controls], [c.arduino_s for c in controls])
    placed: list[_Control] = []
    moved = dropped = 0
    farthest_s = 0.0
    end = len(controls)
    while end:
        # A burst and the live control that ends it: late[start..end-2] are true, late[end-1] is not.
        start = end - 1
        while start and late[start - 1]:
            start -= 1
        run, end = controls[start:end], start
        placed.append(run[-1])
        if len(run) - 1 < BURST_MIN:
            placed.extend(reversed(run[:-1]))
            continue
        for k in range(len(run) - 2, -1, -1):
            control, after = run[k], run[k + 1]
            step_s = arduino_step_s(control.arduino_s, after.arduino_s)
            if math.isnan(step_s):  # a restart, readings that were sent twice, or no number
                dropped += k + 1
                break
            time_s = placed[-1].system_s - step_s
            farthest_s = max(farthest_s, control.system_s - time_s)
            placed.append(replace(control, system_s=time_s))
            moved += 1
    faults.add(
        path, "serial_burst", f"placed by the Arduino's clock, up to {farthest_s:.2f} s before they arrived", moved
    )
    faults.add(path, "serial_burst_dropped", "the Arduino's clock is missing, or steps back after them", dropped)
    return sorted(placed, key=lambda c: c.system_s)


def _inside(path: Path, folder: Path) -> bool:
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def _read_frames(folder: Path, path: Path, rows: list, faults: Faults) -> list[_Frame]:
    """Return the listed frames that have a time, ordered by it. A picture of another size than most cannot be used."""
    frames: list[_Frame] = []
    numbers: set[float] = set()
    for i, row in enumerate(rows):
        if not isinstance(row, dict):
            faults.add(path, "wrong_type", f"frame {i} is a {type(row).__name__}, not an object")
            continue
        number, time_s, name = (number_of(row.get("frame_id")), number_of(row.get("timestamp")), row.get("image_path"))
        if number is None or time_s is None or not isinstance(name, str) or not name:
            faults.add(path, "wrong_type", f"frame {i}: {quote_all(row.get(name) for name in FRAME_FIELDS)}")
            continue
        if math.isnan(number) or math.isnan(time_s):
            faults.add(path, "not_finite", f"frame {i}: {quote(row.get('timestamp'))}")
            continue
        if _is_no_second(time_s, f"frame {i}", path, faults):
            continue
        if number in numbers:
            faults.add(path, "duplicate_frame_id", f"frame id {number:g} again in row {i}; the first one counts")
            continue
        numbers.add(number)
        picture = folder / name.replace("\\", "/")
        frames.append(_Frame(int(number), time_s, picture, check_picture(folder, picture, name, path, faults)))
    sizes = Counter(f.size for f in frames if f.size and any(f.size))
    usual = max(sizes, key=sizes.__getitem__, default=(0, 0))
    for i, frame in enumerate(frames):
        if frame.size and frame.size not in (usual, (0, 0)):
            note = "{} pixels high, {} wide, and most here {} and {}: another camera's?".format(*frame.size, *usual)
            faults.add(frame.path, "another_size", note)
            frames[i] = replace(frame, size=None)
    went_on = [b.number > a.number for a, b in pairwise(frames)]
    frames = _in_order([(f.time_s, f) for f in frames], went_on, path, "frame", faults)
    kept = frames[:1]
    for frame in frames[1:]:
        if frame.time_s > kept[-1].time_s:
            kept.append(frame)
        else:
            faults.add(path, "duplicate_frame_time", f"frame {frame.number} has the time of frame {kept[-1].number}")
    if 2 * len(kept) < len(frames):
        note = f"{len(frames)} frames have {len(kept)} different times; write them to the millisecond"
        faults.add(path, "coarse_times", note, len(kept))
        return []
    return kept


def _is_no_second(time_s: float, which: str, path: Path, faults: Faults) -> bool:
    """Whether a time is none in seconds since 1970, but in milliseconds: a fault then says so."""
    if time_s > LAST_S:
        faults.add(path, "not_seconds", f"{which} was at {time_s:.0f}, which is no time in seconds; divide by 1000")
    return time_s > LAST_S


def check_picture(folder: Path, picture: Path, name: str, path: Path, faults: Faults) -> tuple[int, int] | None:
    """Return the height and width of a listed picture, (0, 0) where it says them late; None if it is not there, inside
    the episode's folder, and whole. Only its two ends are read.
    """
    try:
        if Path(name).is_absolute() or not _inside(picture, folder):
            faults.add(path, "path_leaves_folder", f"{quote(name)} is outside of the episode")
            return None
        if not stat.S_ISREG(picture.stat().st_mode):  # opening a pipe would wait for ever
            faults.add(path, "frame_missing", f"{quote(name)} is no file")
            return None
        with picture.open("rb") as f:
            head = f.read(JPEG_HEAD)
            f.seek(max(f.seek(0, os.SEEK_END) - JPEG_TAIL, 0))
            problem = _jpeg_problem(head, f.read())
    except (OSError, ValueError):  # not there, unreadable, a name too long, or with a zero byte in it
        faults.add(path, "frame_missing", f"{quote(name)} is listed but cannot be read")
        return None
    if problem:
        faults.add(picture, "broken_jpeg", problem)
        return None
    try:
        return simplejpeg.decode_jpeg_header(head)[:2]
    except ValueError:
        return 0, 0


def _jpeg_problem(head: bytes, tail: bytes) -> str | None:
    """Say what is wrong with the two ends of a JPEG, None if nothing is.

    cv2 would only warn of a file that was cut short, and return a picture.
    """
    if not head.startswith(b"\xff\xd8"):
        return f"no JPEG: it begins with {quote(head[:12])}"
    if not tail.rstrip(b"\0").endswith(b"\xff\xd9"):
        return "cut short: its end marker is missing"
    return None


def _actions_of(
    frames: list[_Frame], controls: list[_Control], sync_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """Return for each frame its action, (n, 2) float32, whether it has one, (n,), whether any control is near, (n,),
    and the pulses of each action in microseconds, (n, 2), and who drove.
    """
    times_s = np.array([f.time_s for f in frames])
    actions = np.zeros((len(frames), len(ACTION_NAMES)), np.float32)
    pulses_us = np.zeros((len(frames), len(ACTION_NAMES)))
    known = np.ones(len(frames), bool)
    for i in range(len(ACTION_NAMES)):
        measured = [c for c in controls if c.actions[i] is not None]
        near, index = _nearest(times_s, np.array([c.system_s for c in measured]), sync_s)
        known &= near
        if measured:
            actions[:, i] = np.where(near, np.array([c.actions[i] for c in measured], np.float32)[index], 0)
            pulses_us[:, i] = np.array([c.pulses_us[i] for c in measured])[index]
    near, index = _nearest(times_s, np.array([c.system_s for c in controls]), sync_s)
    return actions, known, near, pulses_us, [controls[i].driver for i in index]


def _nearest(times_s: np.ndarray, sorted_s: np.ndarray, within_s: float) -> tuple[np.ndarray, np.ndarray]:
    """For each time, return whether the nearest of `sorted_s` is within `within_s`, and the index of that one."""
    if not len(sorted_s):
        return np.zeros(len(times_s), bool), np.zeros(len(times_s), int)
    after = np.searchsorted(sorted_s, times_s).clip(1, max(len(sorted_s) - 1, 1)).clip(0, len(sorted_s) - 1)
    before = (after - 1).clip(0)
    index = np.where(np.abs(sorted_s[before] - times_s) <= np.abs(sorted_s[after] - times_s), before, after)
    return np.abs(sorted_s[index] - times_s) <= within_s, index


def _make_samples(
    folder: Path, car: Car, frames: list[_Frame], controls: list[_Control], chunk: int, sync_s: float, faults: Faults
) -> tuple[Sample, ...]:
    actions, known, near, pulses_us, drivers = _actions_of(frames, controls, sync_s)
    if not near.any():
        gap_s = min(abs(frames[0].time_s - controls[-1].system_s), abs(controls[0].system_s - frames[-1].time_s))
        faults.add(folder, "no_overlap", f"frames and controls are {gap_s:.1f} s apart")
        return ()
    faults.add(folder, "frame_without_control", f"no control within {sync_s * 1000:g} ms", int((~near).sum()))
    note = f"controls near, but without a measured pulse within {sync_s * 1000:g} ms"
    faults.add(folder, "frame_without_measurement", note, int((near & ~known).sum()))

    times_s = np.array([f.time_s for f in frames])
    steps_s = np.diff(times_s)
    longest_s = min(HOLE_INTERVALS * float(np.median(steps_s)), HOLE_S) if len(steps_s) else HOLE_S
    holes = np.flatnonzero(steps_s > longest_s) + 1
    note = f"more than {longest_s:.3f} s between two frames"
    faults.add(folder, "hole_in_time", note, len(holes))

    samples: list[Sample] = []
    unknown_state = 0
    held = np.array([driver == NOBODY for driver in drivers])
    breaks = {*holes.tolist(), *(np.flatnonzero(held[1:] != held[:-1]) + 1).tolist()}
    for segment in _segments(known, breaks):
        n = len(segment)
        index = np.arange(n)[:, None] + np.arange(chunk)
        chunks, pads = actions[segment][np.minimum(index, n - 1)], index >= n
        for k, i in enumerate(segment):
            if frames[i].size is None:
                continue
            if k == 0 and i > 0:
                unknown_state += 1
                continue
            state = actions[i - 1] if k else np.asarray(NEUTRAL, np.float32)
            samples.append(
                Sample(
                    episode=folder.name,
                    frame_path=frames[i].path,
                    time_s=float(times_s[i] - times_s[0]),
                    state=state.copy(),
                    chunk=chunks[k].copy(),
                    is_pad=pads[k].copy(),
                    row=i,
                    driver=drivers[i],
                    car=car,
                    pulses_us=(float(pulses_us[i, 0]), float(pulses_us[i, 1])),
                )
            )
    faults.add(folder, "frame_without_state", "the previous frame's action is not known", unknown_state)
    return tuple(samples)


def _segments(known: np.ndarray, holes: set[int]) -> list[list[int]]:
    """Return runs of consecutive frames with actions, as lists of indices. A new run begins at an index in `holes`."""
    runs: list[list[int]] = []
    for i in np.flatnonzero(known).tolist():
        if runs and runs[-1][-1] == i - 1 and i not in holes:
            runs[-1].append(i)
        else:
            runs.append([i])
    return runs


def split(recordings: Recordings, held_out_share: float = 0.25, seed: int = 0) -> Split:
    """Split the samples by whole episodes, drawn at random with `seed`. Half of the held-out share is for choosing, the
    other half judges.

    With fewer than three episodes, each is split along its time instead, calibration first, with a gap of one chunk
    between the parts, so that no action is in two of them; `note` says so. Raises EpisodeError for a share outside
    (0, 1), and for recordings too short to be split.
    """
    if not 0 < held_out_share < 1:
        raise EpisodeError("held_out_share must be between 0 and 1", found=held_out_share)
    episodes = recordings.episodes
    if len(episodes) < 3:
        return _split_by_time(episodes, held_out_share)
    count = min(max(round(len(episodes) * held_out_share), 2), len(episodes) - 1)
    order = np.random.default_rng(seed).permutation(len(episodes)).tolist()
    parts = {
        "calibration": sorted(order[count:]),
        "choosing": sorted(order[: count // 2]),
        "held_out": sorted(order[count // 2 : count]),
    }
    note = None
    if abs(count / len(episodes) - held_out_share) > 0.1:
        note = f"only {len(episodes)} episodes: {count} of them are held out, not {held_out_share:.0%}"
    return Split(
        **{part: tuple(s for i in indices for s in episodes[i].samples) for part, indices in parts.items()},
        note=note,
        episodes={part: [episodes[i].id for i in indices] for part, indices in parts.items()},
    )


def _split_by_time(episodes: tuple[Episode, ...], held_out_share: float) -> Split:
    parts: dict[str, list[Sample]] = {"calibration": [], "choosing": [], "held_out": []}
    for episode in episodes:
        samples = episode.samples
        gap = len(samples[0].chunk)
        left = len(samples) - 2 * gap
        if left < 3:
            continue  # too short to leave a gap of one chunk between the parts
        held = min(max(round(left * held_out_share), 2), left - 1)
        first, second = left - held, held // 2
        parts["calibration"] += samples[:first]
        parts["choosing"] += samples[first + gap : first + gap + second]
        parts["held_out"] += samples[first + gap + second + gap :]
    if not parts["held_out"]:
        lengths = ", ".join(f"{e.id}: {len(e.samples)}" for e in episodes)
        raise EpisodeError(
            f"{len(episodes)} episode(s) are too short to be parted (samples: {lengths})",
            remedy="record at least three episodes, or a longer one",
        )
    return Split(
        **{part: tuple(samples) for part, samples in parts.items()},
        note=f"only {len(episodes)} episode(s): parted along time, with a gap of one chunk between",
        episodes={part: sorted({s.episode for s in samples}) for part, samples in parts.items()},
    )


def choose_calibration(
    samples: tuple[Sample, ...], count: int = 200, seed: int = 0
) -> tuple[tuple[Sample, ...], str | None]:
    """Choose at most `count` samples that cover the recorded actions, in the given order; the same for the same seed.

    One half is chosen by farthest points over (state, four actions along the chunk), each action divided by its own
    spread, because an observer must see the extremes, and throttle's are a tenth of steering's. The other half is drawn
    at random from the rest, because an observer must also see what is usual. The second value returned is a note if
    there were fewer than asked for, else None. Raises EpisodeError for no samples or a count below 1.
    """
    if not samples or count < 1:
        raise EpisodeError(
            f"cannot choose {count} of {len(samples)} samples for calibration", remedy="record more episodes"
        )
    if len(samples) <= count:
        fewer = len(samples) < count
        note = f"asked for {count} calibration samples, found only {len(samples)}: all are used" if fewer else None
        return tuple(samples), note
    rng = np.random.default_rng(seed)
    steps = np.unique(np.linspace(0, len(samples[0].chunk) - 1, 4).round().astype(int))
    points = np.stack([np.concatenate([s.state[None], s.chunk[steps]]) for s in samples]).astype(np.float64)
    spread = points.reshape(-1, points.shape[-1]).std(axis=0)
    points = (points / np.where(spread > 0, spread, 1)).reshape(len(samples), -1)
    chosen = [int(rng.integers(len(samples)))]
    distance = np.full(len(samples), np.inf)
    while len(chosen) < (count + 1) // 2:
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        distance[chosen] = -1  # equal points must not be taken twice
        chosen.append(int(distance.argmax()))
    rest = np.setdiff1d(np.arange(len(samples)), chosen)
    chosen += rng.choice(rest, count - len(chosen), replace=False).tolist()
    return tuple(samples[i] for i in sorted(chosen)), None
