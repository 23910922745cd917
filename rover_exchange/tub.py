"""Read a donkeycar tub as recordings, for `rover export-dataset`, which writes them as a LeRobotDataset.

A tub of donkeycar 4 on is manifest.json, catalogs with a line of JSON for each picture, and images/. Its angle is
positive to the right; negative throttle is "stopped" for a car that does not drive backwards. Records that the manifest
calls deleted, or at which a pilot drove, are left out. An episode ends where records are missing, where another session
begins, and at a hole in time; its first record gives the next one its state, but only a session's is a sample.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import NEUTRAL
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.stage import read_plain
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.controls import Faults, note_one_sided
from rover_lib.workshop.recordings.copies import leave_out_copies
from rover_lib.workshop.recordings.episodes import HOLE_INTERVALS, HOLE_S, check_pictures
from rover_lib.workshop.recordings.samples import (
    LEAST_RATED,
    Episode,
    Recordings,
    Sample,
    Source,
    frame_rate_hz,
    is_another_rate,
)
from rover_lib.workshop.untrusted import quote, quote_all

RATE_HZ = 20.0  # of records without a time: donkeycar's own
MOST_BYTES = 10_000_000  # of a manifest or a catalog; JSON takes 25 times its size, and a thousand records 200 kB
MOST_LINES, MOST_CATALOGS = 50_000, 10_000  # donkeycar's catalogs have a thousand lines
MOST_INDEX, MOST_MS = 10**9, 10**14
LEAST_S = 0.002  # between two records; no camera of a car is faster
LEAST_STANDING = 5  # gaps; fewer may be a camera's
WHOLE_PERIODS, MOST_WHOLE = 0.3, 0.8  # a gap differs by less from whole periods; the share of such gaps
OLDER = "copy it again; donkeycar's convert_to_tub_v2.py converts a tub of record_<number>.json"
PICTURE, ANGLE, THROTTLE, MODE = "cam/image_array", "user/angle", "user/throttle", "user/mode"


@dataclass(frozen=True)
class _Record:
    """One picture and what the driver did. driver: "user", or a pilot."""

    index: int
    session: str
    time_s: float
    picture: str
    angle: float
    throttle: float
    driver: Any
    timed: bool


def read_tub(tub: Path | str, car: Car, progress: Progress = silent, throttle: str | None = None) -> Recordings:
    """Read all usable records as samples of two actions.

    throttle: "as-recorded", "negated" or None. Raises EpisodeError for another folder or one without records, and if
    `throttle` is None and three in four throttles are negative.
    """
    tub = Path(tub)
    faults = Faults(tub)
    records = _in_order(_read_records(tub, faults), throttle, tub, faults)
    steps_s = np.diff([r.time_s for r in records])
    usual_s = float(np.median(steps_s[steps_s > 0])) if (steps_s > 0).any() else 1 / RATE_HZ
    if usual_s < LEAST_S:
        found, remedy = f"{usual_s * 1000:.3g} ms between two records", "are they seconds? write milliseconds"
        raise EpisodeError(f"{tub}: its _timestamp_ms are not of a drive", found=found, remedy=remedy)
    stands = _standing_parts(records, usual_s, tub, faults)
    runs: list[list[_Record]] = []
    for record in records:
        longest_s = HOLE_S if record.index in stands else min(HOLE_INTERVALS * usual_s, HOLE_S)
        if not runs or _ends(runs[-1][-1], record, longest_s, tub, faults):
            runs.append([])
        runs[-1].append(record)
    episodes, sessions = [], set()
    for run in progress(runs, desc="reading the tub", total=len(runs)):
        first = run[0]
        samples = _samples(run, tub, car, first.session not in sessions, stands, faults)
        sessions.add(first.session)
        found_hz = frame_rate_hz(samples)
        if len(samples) >= LEAST_RATED and is_another_rate(found_hz, 1 / usual_s):
            faults.add(tub, "another_rate", f"{found_hz:.1f} Hz from record {first.index} on", len(samples))
        elif samples:
            length_s = samples[-1].time_s - samples[0].time_s
            name = f"{first.session or 'session'} from {first.index}"
            episodes.append(Episode(name, tub, "drive", length_s, len(run), len(run), samples, ()))
    if not episodes:
        raise faults.nothing_usable("no usable record in it", "copy the whole tub, images included")
    note_one_sided(episodes, faults)
    return Recordings(tub, leave_out_copies(episodes, faults), faults.listed(), Source(tub))


def _in_order(records: Iterable[_Record], throttle: str | None, tub: Path, faults: Faults) -> list[_Record]:
    """Return the records by their index, each once, with throttles that are positive forward."""
    by_index: dict[int, _Record] = {}
    for record in records:
        if by_index.setdefault(record.index, record) is not record:
            faults.add(tub, "duplicate_record", f"record {record.index} is there again; the first one counts")
    ordered = [by_index[index] for index in sorted(by_index)]
    negative, moving = sum(r.throttle < 0 for r in ordered), sum(r.throttle != 0 for r in ordered)
    if throttle is None and 4 * negative > 3 * moving:
        remedy = "--throttle negated if its car drives forward by them, --throttle as-recorded if it drove backwards"
        raise EpisodeError(f"{tub}: most throttles are negative", found=f"{negative} of {moving}", remedy=remedy)
    return [replace(r, throttle=-r.throttle) for r in ordered] if throttle == "negated" else ordered


def _standing_parts(records: list[_Record], usual_s: float, tub: Path, faults: Faults) -> set[int]:
    """Return the records before which the car stood for some periods that were not recorded.

    donkeycar by default records only while the throttle is on (AUTO_RECORD_ON_THROTTLE), and numbers on. So it was off
    in the gaps of a tub without one record of throttle 0.
    """
    found = {}
    for before, record in pairwise(records):
        periods = (record.time_s - before.time_s) / usual_s
        if periods > HOLE_INTERVALS and record.index == before.index + 1 and record.session == before.session:
            found[record.index] = abs(periods - round(periods)) < WHOLE_PERIODS
    whole = sum(found.values()) >= MOST_WHOLE * len(found) and all(record.throttle for record in records)
    if len(found) < LEAST_STANDING:
        return set()
    kind, note = "stood_unrecorded" if whole else "gaps_unrecorded", "nothing was recorded in gaps of the drive"
    faults.add(tub, kind, f"{note}: AUTO_RECORD_ON_THROTTLE = False records while the throttle is off too", len(found))
    return {*found} if whole else set()


def _ends(before: _Record, record: _Record, longest_s: float, tub: Path, faults: Faults) -> bool:
    """Whether an episode ends between two records."""
    if record.session != before.session:
        return True
    if record.index != before.index + 1:
        faults.add(tub, "records_missing", f"none between {before.index} and {record.index}")
        return True
    step_s = record.time_s - before.time_s
    if 0 < step_s <= longest_s:
        return False
    faults.add(tub, "hole_in_time", f"{step_s:.2f} s between {before.index} and {record.index}")
    return True


def _samples(
    run: list[_Record], tub: Path, car: Car, begins: bool, stands: set[int], faults: Faults
) -> tuple[Sample, ...]:
    """begins: whether the run begins its session, so that the car stood before it. stands: see _standing_parts."""
    pictures = check_pictures(tub, [record.picture for record in run], tub, faults, "images")
    (_, low), (_, high) = car.limits.tolist()
    backwards = sum(r.throttle < low for r in run)
    faults.add(tub, "reverse_on_a_car_without", "negative throttle is read as stopped; see car.yml", backwards)
    throttle = np.clip([r.throttle for r in run], low, high)
    actions = np.stack([-car.left * np.array([r.angle for r in run]), throttle], 1).astype(np.float32)
    samples = []
    for k, (record, (path, size)) in enumerate(zip(run, pictures, strict=True)):
        if not size or (k == 0 and not begins):
            continue
        after = min(k + 1, len(run) - 1)
        before = actions[k - 1] if k else np.asarray(NEUTRAL, np.float32)
        if record.index in stands:
            before = np.array([before[0], 0], np.float32)
        samples.append(
            Sample(
                episode=f"{record.session} from {run[0].index}",
                frame_path=path,
                time_s=record.time_s - run[0].time_s,
                state=before,
                chunk=actions[[k, after]],
                is_pad=np.array([False, after == k]),
                row=k,
                car=car,
            )
        )
    return tuple(samples)


def _read_records(tub: Path, faults: Faults) -> Iterator[_Record]:
    """Yield the records that count."""
    names, deleted = _read_manifest(tub / "manifest.json")
    for name in dict.fromkeys(names):  # each once
        if Path(name).name != name or not (tub / name).is_file():
            faults.add(tub, "catalog_missing", f"{quote(name)} is in the manifest, and no file of the tub")
            continue
        lines = _read(tub / name).splitlines()
        if len(lines) > MOST_LINES:
            faults.add(tub, "broken_record", f"{name}: at most {MOST_LINES} lines are read", len(lines))
            continue
        for number, line in enumerate(lines, 1):
            where = f"{name}, line {number}"
            try:
                record = _parse(line)
            except (ValueError, RecursionError, TypeError, KeyError, AttributeError) as e:
                faults.add(tub, "broken_record", f"{where}: {quote(str(e))}")
                continue
            if record.index in deleted:
                faults.add(tub, "deleted_record", f"{where}: its manifest calls record {record.index} deleted")
            elif record.driver != "user":
                faults.add(tub, "a_pilot_drove", f"{where}: {quote(record.driver)}")
            else:
                faults.add(tub, "no_times", f"records without a time: taken as {RATE_HZ:g} a second", not record.timed)
                yield record


def _read(path: Path) -> str:
    try:
        return read_plain(path, MOST_BYTES).decode("utf-8-sig", errors="replace")
    except OSError as e:
        raise EpisodeError(f"{path}: cannot be read ({e.strerror})", remedy=OLDER) from None


def _read_manifest(path: Path) -> tuple[list[str], set[int]]:
    """Return the names of the catalogs and the numbers of the deleted records, from the manifest's last line."""
    try:
        last = json.loads(_read(path).rstrip().splitlines()[-1])
        if len(last["paths"]) > MOST_CATALOGS:
            raise ValueError
        return list(map(str, last["paths"])), set(map(int, last.get("deleted_indexes") or []))
    except (ValueError, RecursionError, TypeError, LookupError, AttributeError, OverflowError):
        raise EpisodeError(f"{path}: lists no catalogs, too many, or no deleted records", remedy=OLDER) from None


def _parse(text: str) -> _Record:
    """Return the record in a line. Raises ValueError, also of other kinds."""
    row = json.loads(text)
    number, ms, values = row["_index"], row.get("_timestamp_ms"), (row[ANGLE], row[THROTTLE])
    if not all(is_number(v, -1, 1) for v in values) or not isinstance(row[PICTURE], str):
        raise ValueError(f"{quote_all(values)} with {quote(row[PICTURE])}")
    if not is_whole(number, 0, MOST_INDEX) or not (ms is None or is_number(ms, 0, MOST_MS)):
        raise ValueError(f"number {quote(number)}, time {quote(ms)}")
    time_s = number / RATE_HZ if ms is None else ms / 1000
    session, driver = str(row.get("_session_id", "")), row.get(MODE, "user")
    return _Record(number, session, time_s, row[PICTURE], *values, driver, timed=ms is not None)
