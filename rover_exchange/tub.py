"""Read a donkeycar tub as recordings, for `rover import`, which writes them as a LeRobotDataset.

    recordings = read_tub("data/tub_1", this_car())

A tub of donkeycar 4 on is manifest.json, catalogs with a line of JSON for each picture, and images/. An older one has a
record_<number>.json for each picture. Its angle is positive to the right; the car says to which side our steering is,
and whether it drives backwards: if not, negative throttle is "stopped". Some cars drive forward by negative throttle;
that a tub is of such a one must be said.

Records that the manifest calls deleted, or at which a pilot drove, are left out. An episode ends where records are
missing, where another session begins, and at a hole in time. Only a session's first record has a state that is known
without another one, neutral; the first record of any other episode gives the next one its state, and is left out.
"""

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import NEUTRAL
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording.episode import DATA_BYTES
from rover_lib.onboard.stage import read_plain
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import HOLE_INTERVALS, HOLE_S, Faults, check_picture, nothing_usable
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
MOST_HZ = 250.0  # no car's camera is faster
PICTURE, ANGLE, THROTTLE, MODE = "cam/image_array", "user/angle", "user/throttle", "user/mode"


@dataclass(frozen=True)
class _Record:
    """One picture and what the driver did. time_s: None if the tub does not say it."""

    index: int
    session: str
    time_s: float | None
    picture: str
    angle: float
    throttle: float


def read_tub(tub: Path | str, car: Car, progress: Progress = silent, throttle: str | None = None) -> Recordings:
    """Read all usable records as samples of two actions.

    throttle: "as-recorded" or "negated", None if the tub does not need it. Raises EpisodeError for what is no tub or
    has no record, and for one in which three in four throttles are negative, if `throttle` is None.
    """
    tub = Path(tub)
    faults = Faults(tub)
    records: dict[int, _Record] = {}
    for record in _read_records(tub, faults):
        if records.setdefault(record.index, record) is not record:
            faults.add(tub, "duplicate_record", f"record {record.index} is there again; the first one counts")
    ordered = [records[index] for index in sorted(records)]
    negative, moving = sum(r.throttle < 0 for r in ordered), sum(r.throttle != 0 for r in ordered)
    if throttle is None and 4 * negative > 3 * moving:
        raise EpisodeError(
            f"{tub}: most throttles are negative",
            found=f"{negative} of {moving}",
            remedy="--throttle negated if its car drives forward by them, --throttle as-recorded if it drove backwards",
        )
    if throttle == "negated":
        ordered = [replace(r, throttle=-r.throttle) for r in ordered]
    times_s = [r.time_s for r in ordered if r.time_s is not None]
    steps_s = np.diff(times_s)
    usual_s = float(np.median(steps_s[steps_s > 0])) if (steps_s > 0).any() else 1 / RATE_HZ
    if usual_s * MOST_HZ < 1:
        raise EpisodeError(
            f"{tub}: most records come {usual_s:.3g} s after another", remedy="write their times in milliseconds"
        )
    runs: list[list[_Record]] = []
    for record in ordered:
        if not runs or _ends(runs[-1][-1], record, min(HOLE_INTERVALS * usual_s, HOLE_S), tub, faults):
            runs.append([])
        runs[-1].append(record)
    sessions = [run[0].session for run in runs]
    first = {i: session not in sessions[:i] for i, session in enumerate(sessions)}
    images = tub / "images" if (tub / "images").is_dir() else tub
    episodes = []
    for i, run in enumerate(progress(runs, desc="reading the tub", total=len(runs))):
        if samples := _samples(run, tub, images, car, first[i], faults):
            found_hz = frame_rate_hz(samples)
            if len(samples) >= LEAST_RATED and is_another_rate(found_hz, 1 / usual_s):
                faults.add(tub, "another_rate", f"{found_hz:.1f} Hz from record {run[0].index} on", len(samples))
                continue
            length_s = samples[-1].time_s - samples[0].time_s
            name = f"{run[0].session or 'session'} from {run[0].index}"
            episodes.append(Episode(name, tub, "drive", length_s, len(run), len(run), samples, ()))
    if not episodes:
        remedy = "copy the whole tub, images included"
        raise nothing_usable(f"{tub}: no usable record in it", faults.listed(), remedy)
    return Recordings(tub, tuple(episodes), faults.listed(), Source(tub))


def _ends(before: _Record, record: _Record, longest_s: float, tub: Path, faults: Faults) -> bool:
    """Whether an episode ends between two records."""
    if record.session != before.session:
        return True
    if record.index != before.index + 1:
        faults.add(tub, "records_missing", f"none between {before.index} and {record.index}")
        return True
    if record.time_s is None or before.time_s is None or 0 < record.time_s - before.time_s <= longest_s:
        return False
    faults.add(tub, "hole_in_time", f"{record.time_s - before.time_s:.2f} s between {before.index} and {record.index}")
    return True


def _samples(run: list[_Record], tub: Path, images: Path, car: Car, begins: bool, faults: Faults) -> tuple[Sample, ...]:
    """begins: whether the run begins its session, so that the car stood before it."""
    (_, low), (_, high) = car.limits.tolist()
    backwards = sum(r.throttle < low for r in run)
    faults.add(tub, "reverse_on_a_car_without", "negative throttle is read as stopped; see car.yml", backwards)
    throttle = np.clip([r.throttle for r in run], low, high)
    actions = np.stack([-car.left * np.array([r.angle for r in run]), throttle], 1).astype(np.float32)
    samples = []
    for k, record in enumerate(run):
        if not check_picture(tub, images / record.picture, record.picture, tub, faults) or (k == 0 and not begins):
            continue
        since_s = k / RATE_HZ if record.time_s is None or run[0].time_s is None else record.time_s - run[0].time_s
        after = min(k + 1, len(run) - 1)
        samples.append(
            Sample(
                episode=f"{record.session} from {run[0].index}",
                frame_path=images / record.picture,
                time_s=since_s,
                state=actions[k - 1] if k else np.asarray(NEUTRAL, np.float32),
                chunk=actions[[k, after]],
                is_pad=np.array([False, after == k]),
                row=k,
                car=car,
            )
        )
    return tuple(samples)


def _read_records(tub: Path, faults: Faults) -> Iterator[_Record]:
    """Yield the records that count, of either format."""
    manifest = tub / "manifest.json"
    if manifest.is_file():
        paths, deleted = _read_manifest(manifest)
        for other in sorted({p.name for p in tub.glob("*.catalog")} - set(paths)):
            faults.add(tub, "catalog_not_listed", f"{quote(other)} is not in the manifest; not read")
        for name in dict.fromkeys(paths):  # each once
            if Path(name).name != name or not (tub / name).is_file():
                faults.add(tub, "catalog_missing", f"{quote(name)} is in the manifest, and no file of the tub")
                continue
            for number, line in enumerate(_read(tub / name).splitlines()):
                yield from _read_record(line, f"{name}, line {number + 1}", None, deleted, tub, faults)
        return
    files = [p for p in tub.glob("record_*.json") if p.stem.removeprefix("record_").isdecimal()]
    if not files:
        raise EpisodeError(
            f"{tub}: no donkeycar tub, neither manifest.json nor record_<number>.json is in it",
            remedy="give the folder that holds them, such as data or tub_1",
        )
    for path in sorted(files):
        yield from _read_record(_read(path), path.name, int(path.stem.removeprefix("record_")), set(), tub, faults)


def _read(path: Path) -> str:
    try:
        return read_plain(path, DATA_BYTES).decode("utf-8-sig", errors="replace")
    except OSError as e:
        raise EpisodeError(f"{path}: cannot be read ({e.strerror})", remedy="copy it again") from None


def _read_manifest(path: Path) -> tuple[list[str], set[Any]]:
    """Return the names of the catalogs and the deleted records, from the manifest's last line."""
    for line in reversed(_read(path).splitlines()):
        try:
            last = json.loads(line)
        except (ValueError, RecursionError):
            break
        if isinstance(last, dict) and isinstance(last.get("paths"), list):
            deleted = last.get("deleted_indexes") or []
            try:
                return list(map(str, last["paths"])), set(map(int, deleted))
            except (ValueError, TypeError):
                found = quote_all(deleted) if isinstance(deleted, list) else quote(deleted)
                raise EpisodeError(f"{path}: its deleted_indexes are no numbers of records", found=found) from None
    raise EpisodeError(f"{path}: does not say which catalogs there are", remedy="is it a tub of donkeycar 4 or later?")


def _as_ms(date: Any) -> float | None:
    """Return a record's date as milliseconds; None for what is none, as a tub without times can be read too."""
    with suppress(ValueError, TypeError):
        return datetime.fromisoformat(date).replace(tzinfo=UTC).timestamp() * 1000
    return None


def _read_record(
    text: str, where: str, index: int | None, deleted: set[Any], tub: Path, faults: Faults
) -> Iterator[_Record]:
    """Yield the record in a text, nothing for one that does not count. index: None: it has its own."""
    try:
        row = json.loads(text)
        number = row["_index"] if index is None else index
        ms = row.get("_timestamp_ms", row.get("milliseconds", _as_ms(row.get("timestamp"))))
        values = row[ANGLE], row[THROTTLE]
        if not all(is_number(v, -1, 1) for v in values) or not isinstance(row[PICTURE], str):
            raise ValueError(f"{quote_all(values)} with {quote(row[PICTURE])}")
        if not is_whole(number) or not (ms is None or is_number(ms)):
            raise ValueError(f"number {quote(number)}, time {quote(ms)}")
    except (ValueError, RecursionError, TypeError, KeyError, AttributeError) as e:
        faults.add(tub, "broken_record", f"{where}: {quote(str(e))}")
        return
    if number in deleted:
        faults.add(tub, "deleted_record", f"{where}: its manifest calls record {number} deleted")
    elif row.get(MODE, "user") != "user":
        faults.add(tub, "a_pilot_drove", f"{where}: {quote(row[MODE])}")
    else:
        yield _Record(number, str(row.get("_session_id", "")), None if ms is None else ms / 1000, row[PICTURE], *values)
