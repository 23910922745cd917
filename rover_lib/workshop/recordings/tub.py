"""Read donkeycar tubs as recordings: one, or all in a folder.

A tub of donkeycar 4 on is manifest.json, catalogs with a line of JSON for each picture, and images/. Its angle is
positive to the right; negative throttle is "stopped" for a car that does not drive backwards. Records that the manifest
calls deleted, or at which a pilot drove, are left out. An episode ends where records are missing, where another session
begins, and at a hole in time; its first record gives the next one its state, but only a session's is a sample.
"""

import json
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.car.pwm import NEUTRAL
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.kinds import EPISODE_FILES, kinds_of
from rover_lib.onboard.stage import read_plain
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.blocks import name_blocks
from rover_lib.workshop.recordings.controls import note_one_sided
from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.recordings.pictures import HOLE_INTERVALS, HOLE_S, check_pictures
from rover_lib.workshop.recordings.samples import (
    LEAST_RATED,
    Episode,
    Recordings,
    Sample,
    following,
    frame_rate_hz,
    is_another_rate,
)
from rover_lib.workshop.recordings.source import Source
from rover_lib.workshop.recordings.twins import leave_out_copies
from rover_lib.workshop.untrusted import quote, quote_all

RATE_HZ = 20.0  # of records without a time: donkeycar's own
MOST_BYTES = 10_000_000  # of a manifest or a catalog; JSON takes 25 times its size, and a thousand records 200 kB
MOST_LINES, MOST_CATALOGS = 50_000, 10_000  # donkeycar's catalogs have a thousand lines
MOST_INDEX, MOST_MS = 10**9, 10**14
LEAST_S = 0.002  # between two records; no camera of a car is faster
LEAST_STANDING = 5  # gaps; fewer may be a camera's
WHOLE_PERIODS, MOST_WHOLE = 0.3, 0.8  # a gap differs by less from whole periods; the share of such gaps
MOST_ZERO = 0.02  # of the records: donkeycar's loop writes some of throttle 0 though it is to record only the others
OTHER_SIGN = 0.75  # of the throttles that are not 0
DEEPEST, MOST_FOLDERS = 3, 1000  # folders in folders that are looked into for tubs, and in each
ASKS = "another sign"  # the kind of an error that is a question
OLDER = "copy it again; donkeycar's convert_to_tub_v2.py converts a tub of record_<number>.json"
PICTURE = "cam/image_array"
PICTURES = r"\.(?i:jpe?g|png)$"
ANGLE = "user/angle"
THROTTLE = "user/throttle"
MODE = "user/mode"
REMEDIES = {  # by what most records were left out for
    "deleted_record": "restore them in donkeycar's tub manager, or copy the tub as it was before",
    "a_pilot_drove": "only a human's driving is learned from: record in user mode",
    "broken_record": OLDER,
    "other_record": f"only a human's drives by a camera in colours are read: each needs {PICTURE}, {ANGLE}, {THROTTLE}",
    "catalog_missing": "copy the whole tub, catalogs included",
    "nothing": "nothing was recorded in it: give another",
}
COPY = "copy the whole tub, images included"


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


def find_tubs(root: Path, kinds: Sequence[str], deepest: int = DEEPEST) -> list[Path]:
    """Return a tub itself, or the tubs in a folder and in folders of it; none if it holds recordings of ours.

    kinds: those of `root`.
    """
    if "tub" in kinds:
        return [root]
    if kinds or not deepest or not root.is_dir():
        return []
    folders = [p for p in root.iterdir() if p.is_dir() and not p.name.startswith((".", "__MACOSX"))][:MOST_FOLDERS]
    if any((folder / name).exists() for folder, name in product(folders, EPISODE_FILES)):
        return []
    inside = (find_tubs(folder, kinds_of(folder), deepest - 1) for folder in sorted(folders))
    return list(chain.from_iterable(inside))


def load_tubs(source: Source, tubs: Sequence[Path], chunk: int, progress: Progress = silent) -> Recordings:
    """Read all usable records of tubs as samples of two actions, for this machine's car.

    tubs: what find_tubs found in source.path. chunk: actions per sample, padded at an episode's end. A tub of several
    gives its folder's name to its sessions; one that cannot be used is a fault. Raises EpisodeError for another folder
    or without usable records, and if nothing says which sign of throttle is forward where most of one tub's differ.
    """
    root = source.path
    car = this_car()
    all_faults = Faults(source.path)
    parts = list[tuple[str, list[Episode]]]()
    for tub in progress(tubs, desc="reading tubs", total=len(tubs)):
        faults = Faults(root)
        place = "" if tub == root else tub.relative_to(root).as_posix()
        try:
            parts.append((place, _Tub(tub, place, car, faults).read(source.throttle, chunk)))
        except EpisodeError as e:
            if len(tubs) == 1 or e.kind == ASKS:
                raise
            all_faults.add(tub, "unusable_tub", str(e))
        else:
            all_faults.counted |= faults.counted
    if not parts:
        raise all_faults.nothing_usable(f"none of its {len(tubs)} tubs can be used", COPY)
    whole = list(chain.from_iterable(own for _, own in parts))
    note_one_sided(whole, all_faults)
    unique = set(map(id, leave_out_copies(whole, all_faults)))
    episodes = list[Episode]()
    blocks = list[tuple[str, ...]]()
    for place, own in parts:
        if unique_here := [e for e in own if id(e) in unique]:
            named, names = name_blocks(unique_here, place)
            episodes += named
            if names:
                blocks.append(names)
    return Recordings(root, tuple(episodes), all_faults.listed(), source, blocks=tuple(blocks), kind="tub")


@dataclass(frozen=True)
class _Tub:
    """One tub's folder. place: its name among others, or "". began: the first record of each session, used or not."""

    path: Path
    place: str
    car: Car
    faults: Faults
    began: dict[str, int] = field(default_factory=dict)

    def read(self, throttle: str, chunk: int) -> list[Episode]:
        """Return the episodes with usable records. Raises EpisodeError."""
        catalogs, deleted = _read_manifest(self.path / "manifest.json")
        records = _in_order(self._records(catalogs, deleted), self.path, self.faults)
        records = _forward(records, throttle, self.path)
        steps_s = np.diff([r.time_s for r in records])
        usual_s = float(np.median(steps_s[steps_s > 0])) if (steps_s > 0).any() else 1 / RATE_HZ
        if usual_s < LEAST_S:
            actual = f"{usual_s * 1000:.3g} ms between two records"
            remedy = "are they seconds? write milliseconds"
            raise EpisodeError(f"{self.path}: its _timestamp_ms are not of a drive", found=actual, remedy=remedy)
        self._note_reverse(records, throttle)
        stands = _standing_parts(records, usual_s, self.path, self.faults)
        pictures = check_pictures(self.path, [r.picture for r in records], self.path, self.faults, "images")
        files = tuple(path for name in ("manifest.json", *catalogs) if (path := self.path / name).is_file())
        episodes = list[Episode]()
        began_s = dict[str, float]()
        for run in self._runs(records, usual_s, stands):
            first = records[run[0]]
            session = "/".join(filter(None, (self.place, first.session or "session")))
            began_s.setdefault(session, first.time_s)
            part = [(records[i], pictures[i]) for i in run]
            samples = self._samples(f"{session} from {first.index}", part, stands, chunk)
            found_hz = frame_rate_hz(samples)
            if len(samples) >= LEAST_RATED and is_another_rate(found_hz, 1 / usual_s):
                note = f"{found_hz:.1f} Hz from record {first.index} on"
                self.faults.add(self.path, "another_rate", note, len(samples))
            elif samples:
                length_s = samples[-1].time_s - samples[0].time_s
                begin_s = first.time_s - began_s[session]
                counts = length_s, len(run), len(run)
                whole = Episode(samples[0].episode, self.path, "drive", *counts, samples, files)
                episodes.append(replace(whole, session=session, begin_s=begin_s))
        if not episodes:
            raise self._nothing_usable(bool(records))
        return episodes

    def _nothing_usable(self, some: bool) -> EpisodeError:
        """some: whether there were records that count, so that all of their pictures cannot be used."""
        counts = Counter[str]()
        for (_, kind), (count, _) in self.faults.counted.items():
            counts[kind] += count
        main_kind = next((kind for kind, _ in counts.most_common() if kind in REMEDIES), "") if counts else "nothing"
        error = self.faults.nothing_usable("no usable record in it", "")
        return EpisodeError(error.what, found=error.found, remedy=COPY if some else REMEDIES.get(main_kind, COPY))

    def _note_reverse(self, records: Sequence["_Record"], throttle: str) -> None:
        backwards = sum(r.throttle < 0 for r in records)
        if self.car.limits[0][1] >= 0 and backwards:
            share = f"{100 * backwards / len(records):.0f} % of the records have negative throttle"
            note = f"{share}, read as stopped: with reverse_us in this machine's car.yml they are kept as reverse"
            if not throttle:
                note += "; --throttle as-recorded says that it is reverse, --throttle negated that it is forward"
            self.faults.add(self.path, "reverse_on_a_car_without", note, backwards)

    def _runs(self, records: Sequence["_Record"], usual_s: float, stands: set[int]) -> list[list[int]]:
        """The numbers of the records of each episode."""
        runs: list[list[int]] = []
        for i, record in enumerate(records):
            longest_s = HOLE_S if record.index in stands else min(HOLE_INTERVALS * usual_s, HOLE_S)
            if not runs or _ends(records[i - 1], record, longest_s, self.path, self.faults):
                runs.append([])
            runs[-1].append(i)
        return runs

    def _samples(
        self, name: str, run: Sequence[tuple["_Record", tuple[Path, bool]]], stands: set[int], chunk: int
    ) -> tuple[Sample, ...]:
        """run: the records of an episode, each with its picture, and whether that can be used."""
        (_, low), (_, high) = self.car.limits.tolist()
        throttle = np.clip([r.throttle for r, _ in run], low, high)
        actions = np.stack([-self.car.left * np.array([r.angle for r, _ in run]), throttle], 1).astype(np.float32)
        chunks, pads = following(actions, chunk)
        first = run[0][0]
        samples = list[Sample]()
        stood = self.began[first.session] == first.index  # before it
        for k, (record, (path, usable)) in enumerate(run):
            if not usable or (k == 0 and not stood):
                continue
            before = actions[k - 1] if k else np.asarray(NEUTRAL, np.float32)
            if record.index in stands:
                before = np.array([before[0], 0], np.float32)
            time_s = record.time_s - first.time_s
            samples.append(Sample(name, path, time_s, before, chunks[k], pads[k], k, car=self.car))
        return tuple(samples)

    def _records(self, catalogs: Iterable[str], deleted: set[int]) -> Iterator["_Record"]:
        """Yield the records that count."""
        faults = self.faults
        for name in dict.fromkeys(catalogs):  # each once
            if Path(name).name != name or not (self.path / name).is_file():
                faults.add(self.path, "catalog_missing", f"{quote(name)} is in the manifest, and no file of the tub")
                continue
            lines = _read(self.path / name).splitlines()
            if len(lines) > MOST_LINES:
                faults.add(self.path, "broken_record", f"{name}: at most {MOST_LINES} lines are read", len(lines))
                continue
            for number, line in enumerate(lines, 1):
                place = f"{name}, line {number}"
                try:
                    record = _parse(line, self.path)
                except (ValueError, RecursionError, TypeError, KeyError, AttributeError) as e:
                    kind = "other_record" if isinstance(e, KeyError) else "broken_record"
                    faults.add(self.path, kind, f"{place}: {quote(str(e))}")
                    continue
                self.began[record.session] = min(record.index, self.began.get(record.session, record.index))
                if record.index in deleted:
                    faults.add(
                        self.path, "deleted_record", f"{place}: its manifest calls record {record.index} deleted"
                    )
                elif record.driver != "user":
                    faults.add(self.path, "a_pilot_drove", f"{place}: {quote(record.driver)}")
                else:
                    note = f"records without a time: taken as {RATE_HZ:g} a second"
                    faults.add(self.path, "no_times", note, not record.timed)
                    yield record


def _in_order(records: Iterable["_Record"], tub: Path, faults: Faults) -> list["_Record"]:
    """Return the records by their index, each once."""
    by_index: dict[int, _Record] = {}
    for record in records:
        if by_index.setdefault(record.index, record) is not record:
            faults.add(tub, "duplicate_record", f"record {record.index} is there again; the first one counts")
    return [by_index[index] for index in sorted(by_index)]


def _forward(records: list["_Record"], throttle: str, tub: Path) -> list["_Record"]:
    """Return the records with throttles that are positive forward. Raises EpisodeError where that must be asked."""
    negative = sum(r.throttle < 0 for r in records)
    moving = sum(r.throttle != 0 for r in records)
    if not throttle and negative > OTHER_SIGN * moving:
        remedy = "--throttle negated if its car drives forward by them, --throttle as-recorded if it drove backwards"
        actual = f"{negative} of {moving}"
        raise EpisodeError(f"{tub}: most throttles are negative", found=actual, remedy=remedy, kind=ASKS)
    if throttle == "negated" and moving - negative > OTHER_SIGN * moving:
        remedy = "leave --throttle out, and give tubs of other signs by themselves"
        actual = f"{moving - negative} of {moving}"
        raise EpisodeError(f"{tub}: most throttles are positive already", found=actual, remedy=remedy, kind=ASKS)
    return [replace(r, throttle=-r.throttle) for r in records] if throttle == "negated" else records


def _standing_parts(records: list[_Record], usual_s: float, tub: Path, faults: Faults) -> set[int]:
    """Return the records before which the car stood for some periods that were not recorded.

    donkeycar by default records only while the throttle is on (AUTO_RECORD_ON_THROTTLE), and numbers on. So it was off
    in the gaps of a tub with hardly a record of throttle 0.
    """
    parts = {}
    for before, record in pairwise(records):
        periods = (record.time_s - before.time_s) / usual_s
        if periods > HOLE_INTERVALS and record.index == before.index + 1 and record.session == before.session:
            parts[record.index] = abs(periods - round(periods)) < WHOLE_PERIODS
    off = sum(record.throttle == 0 for record in records)
    whole = sum(parts.values()) >= MOST_WHOLE * len(parts) and off < MOST_ZERO * len(records)
    if len(parts) < LEAST_STANDING:
        return set()
    kind = "stood_unrecorded" if whole else "gaps_unrecorded"
    note = "nothing was recorded in gaps of the drive"
    faults.add(tub, kind, f"{note}: AUTO_RECORD_ON_THROTTLE = False records while the throttle is off too", len(parts))
    return {*parts} if whole else set()


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


def _parse(text: str, tub: Path) -> _Record:
    """Return the record in a line. Raises ValueError, also of other kinds, and EpisodeError for other cars' tubs."""
    row = json.loads(text)
    similar = [key for key in row if key.startswith("cam/") and re.search(PICTURES, str(row[key]))]
    if PICTURE not in row and similar:
        catalogs = f"{shlex.quote(str(tub))}/*.catalog"
        remedy = f"to use one, name it so in the catalogs: sed -i 's#{similar[0]}#{PICTURE}#' {catalogs}"
        problem = f"{tub}: a record has no '{PICTURE}', as of two cameras, or another"
        raise EpisodeError(problem, found=quote_all(similar), remedy=remedy)
    number = row["_index"]
    ms = row.get("_timestamp_ms")
    values = (row[ANGLE], row[THROTTLE])
    if not all(is_number(v, -1, 1) for v in values) or not isinstance(row[PICTURE], str):
        raise ValueError(f"{quote_all(values)} with {quote(row[PICTURE])}")
    if not is_whole(number, 0, MOST_INDEX) or not (ms is None or is_number(ms, 0, MOST_MS)):
        raise ValueError(f"number {quote(number)}, time {quote(ms)}")
    time_s = number / RATE_HZ if ms is None else ms / 1000
    session = str(row.get("_session_id", ""))
    driver = row.get(MODE, "user")
    return _Record(number, session, time_s, row[PICTURE], *values, driver, timed=ms is not None)
