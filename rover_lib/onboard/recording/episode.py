"""Write one drive as an episode folder, in the format of the user's recorder, and read its controls again.

episode_YYYYMMDD_HHMMSS/
  episode_data.json   control_data.csv   frame_data.csv   frames/frame_%06d.jpg

"No pulse" is a flag, not a 0. A recording made on the car has two more columns for each control, steering_measured and
throttle_measured: true or false in JSON, True or False in CSV. If one is false, that channel has no values: its
normalized, raw_us and period_us are null in JSON and empty in CSV, which pandas reads as NaN and no program mistakes
for "stopped". Files without the two columns come from the user's recorder (or the balloon world, where no pulse is ever
lost); in them, a pulse or period of 0 means "not measured". More columns may follow: `driver` says who drove, one of
DRIVERS. Whether a drive succeeded, one of OUTCOMES, is metadata.outcome, noted afterwards (outcome.py).
"""

import contextlib
import csv
import errno
import fcntl
import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from io import FileIO
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.stage import atomic_path, open_plain, plain, read_plain

CHANNELS = ("steering", "throttle")
CONTROL_FIELDS = (
    "arduino_timestamp", "system_timestamp", "steering_normalized", "throttle_normalized", "steering_raw_us",
    "throttle_raw_us", "steering_period_us", "throttle_period_us",
)  # fmt: skip
FLAG_FIELDS = ("steering_measured", "throttle_measured")
FRAME_FIELDS = ("frame_id", "timestamp", "image_path")
# Who drove at a control: a policy; a human, whose pulses went to the servos; or nobody, and the car was in neutral.
POLICY, HUMAN, NOBODY = DRIVERS = ("policy", "human", "nobody")
HIT, MISSED = OUTCOMES = ("hit", "missed")  # whether a drive succeeded: metadata.outcome

ABOUT = "about.json"  # in the hidden folder: what finish_killed() needs
DATA_BYTES = 200_000_000  # largest data file that is read: three hours of driving
LARGEST = 1e15  # no time, pulse or id is larger; differences of such numbers stay finite
ARDUINO_WRAP_MS = 1 << 32  # its clock starts at 0 again after 49.7 days
BURST_SHARE = 0.3  # two controls that arrive within this share of the usual interval had waited in a buffer
BURST_MIN = 3  # fewer than this in a row are the USB line's jitter, shorter than a frame, and left as they are
SIMULATED = "playground"  # the port of the balloon world's Arduino


@dataclass(frozen=True)
class About:
    """The description of a recording.

    label: what was done, e.g. "hit red balloon". fps: the camera's rate. start_time_s, end_time_s: system time at the
    start and the end; None: that of the first and of the last sample. arduino_port: the port of the Arduino that the
    controls came through. source: who drove; None: not noted. car: the car that the pulses belong to, described in the
    metadata if it drives otherwise than the default; None: the default, the car of the first recordings.
    """

    label: str = ""
    fps: float = 30
    start_time_s: float | None = None
    end_time_s: float | None = None
    arduino_port: str = ""
    source: str | None = None
    car: Car | None = None


class EpisodeWriter:
    """Write one episode. The complete folder appears when the `with` block ends without an error, and only then.

    Until then everything is in a hidden folder beside it, on the disk and not in memory.

    folder: the folder to make, e.g. episodes/episode_20251007_144013; it must not exist. Its name is the episode's id.
    resolution: (width, height) of the frames; None: that of the first frame. flags: write the two columns that say what
    was measured (see above).
    Raises EpisodeError for an existing folder, frames of another size, times or pulses that are not finite
    numbers, an episode without a frame or a control, or a disk that takes no more.
    """

    def __init__(
        self,
        folder: Path | str,
        about: About,
        *,
        resolution: tuple[int, int] | None = (640, 360),
        jpeg_quality: int = 95,
        flags: bool = False,
    ):
        self.folder, self.about = Path(folder), about
        self.resolution = resolution and (int(resolution[0]), int(resolution[1]))
        self.jpeg_quality, self.flags = jpeg_quality, flags
        car = about.car or Car()
        self.pwm = car.pwm
        self.metadata: dict[str, Any] = {}  # further entries of the episode's metadata
        if not car.drives_like(Car()):
            self.metadata["car"] = car.description()
        if about.source is not None:
            self.metadata["source"] = about.source
        self.controls = self.frames = self.picture_bytes = 0
        self._extra: dict[str, None] = {}  # names of further columns, in order
        self._first_s, self._last_s = math.inf, -math.inf
        self._temporary: Path | None = None  # while it is open
        self._rows: dict[str, FileIO] = {}

    def __enter__(self) -> "EpisodeWriter":
        self.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.finish()
        else:
            self.discard()

    def open(self) -> None:
        """Begin the episode. Raises EpisodeError if the folder exists or another program is recording it."""
        self._refuse_existing()
        # beside the target, so that the rename stays within one filesystem; hidden from loaders
        temporary = self.folder.with_name(f".{self.folder.name}.part")
        with self._disk():
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            try:
                temporary.mkdir()
            except FileExistsError:
                raise EpisodeError(
                    f"{self.folder}: is being recorded, or was when its program was killed",
                    remedy=f"name another folder; `rover record {self.folder.parent} --finish` keeps what was recorded",
                    kind="exists",
                ) from None
        self._temporary = temporary
        try:
            with self._disk():
                (temporary / "frames").mkdir()
                told = {"about": vars(replace(self.about, car=None)), "metadata": self.metadata, "flags": self.flags}
                (temporary / ABOUT).write_text(json.dumps(told))
                for name in ("control", "frame"):
                    self._rows[name] = (temporary / f"{name}.rows").open("ab", buffering=0)
                fcntl.flock(self._rows["control"], fcntl.LOCK_EX | fcntl.LOCK_NB)  # says that it is being recorded
        except BaseException:
            self.discard()  # no __exit__ follows a failed open()
            raise

    def control(
        self,
        t_system_s: float,
        arduino_ms: int,
        steering_us: int | None,
        throttle_us: int | None,
        steering_period_us: int | None,
        throttle_period_us: int | None,
        **extra: Any,
    ) -> None:
        """Add one reading of the transmitter, at system time `t_system_s`. Each name in `extra` becomes a column.

        Pulses and periods of 0 mean "not measured"; with flags, None does too. The normalised values have 4 decimals.
        Without flags they are 0 where no pulse was measured, as the firmware has it.
        """
        self._must_be_open()
        row: dict[str, Any] = dict.fromkeys(CONTROL_FIELDS)
        row["arduino_timestamp"] = self._whole("arduino_timestamp", arduino_ms)
        row["system_timestamp"] = self._time(t_system_s)
        for name, pulse_us, period_us, flag in (
            ("steering", steering_us, steering_period_us, FLAG_FIELDS[0]),
            ("throttle", throttle_us, throttle_period_us, FLAG_FIELDS[1]),
        ):
            action = None
            if not (self.flags and (pulse_us is None or period_us is None)):
                pulse_us = self._whole(f"{name}_raw_us", pulse_us)
                period_us = self._whole(f"{name}_period_us", period_us)
                action = self.pwm.channel(name).action(pulse_us, period_us)
            if action is not None or not self.flags:
                row[f"{name}_normalized"] = round(action or 0.0, 4) + 0.0  # + 0.0: no "-0.0" in the file
                row[f"{name}_raw_us"], row[f"{name}_period_us"] = pulse_us, period_us
            if self.flags:
                row[flag] = action is not None
        if extra:
            if taken := extra.keys() & {*CONTROL_FIELDS, *FLAG_FIELDS}:
                raise EpisodeError(f"{self.folder.name}: column {min(taken)} is taken", remedy="give it another name")
            row |= plain(extra)
            self._extra |= dict.fromkeys(extra)
        self._append("control", row, row["system_timestamp"])
        self.controls += 1

    def frame(self, t_s: float, frame_bgr: np.ndarray) -> None:
        """Add one picture, (height, width, 3) uint8 BGR of the episode's resolution, at system time `t_s`."""
        temporary = self._must_be_open()
        t_s = self._time(t_s)
        if self.resolution is None and isinstance(frame_bgr, np.ndarray) and frame_bgr.ndim == 3:
            self.resolution = frame_bgr.shape[1], frame_bgr.shape[0]
        shape = (self.resolution[1], self.resolution[0], 3) if self.resolution else ("height", "width", 3)
        if not isinstance(frame_bgr, np.ndarray) or frame_bgr.shape != shape or frame_bgr.dtype != np.uint8:
            found = f"{getattr(frame_bgr, 'dtype', type(frame_bgr).__name__)} {getattr(frame_bgr, 'shape', '')}"
            what = f"{self.folder.name}: frames must be uint8 {shape}"
            raise EpisodeError(what, found=found, remedy="check the camera")
        number = self.frames + 1
        relative = f"frames/frame_{number:06d}.jpg"
        ok, jpeg = cv2.imencode(".jpg", frame_bgr, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        if not ok:
            raise EpisodeError(f"{self.folder.name}: frame {number} is not JPEG", remedy="check the camera")
        picture = temporary / relative
        try:
            with self._disk():
                picture.write_bytes(jpeg.data)
        except EpisodeError:
            with contextlib.suppress(OSError):  # half a file is no picture, and the episode may go on without it
                picture.unlink()
            raise
        self._append("frame", {"frame_id": number, "timestamp": t_s, "image_path": relative}, t_s)
        self.frames, self.picture_bytes = number, self.picture_bytes + len(jpeg)

    def finish(self) -> Path:
        """Make the folder appear and return it. If that fails, nothing is left, and EpisodeError says why."""
        try:
            temporary = self._must_be_open()
            with self._disk():
                self._write(temporary)
                self._refuse_existing()  # rename would replace an empty folder without a word
                temporary.rename(self.folder)
            return self.folder
        finally:
            self.discard()

    def discard(self) -> None:
        """End the episode, and remove it unless it is finished."""
        for file in self._rows.values():
            file.close()
        self._rows = {}
        if self._temporary:
            shutil.rmtree(self._temporary, ignore_errors=True)
        self._temporary = None

    def _take(self, part: Path, controls: list[dict[str, Any]], frames: list[dict[str, Any]]) -> None:
        """Go on with what a killed recording has left: its rows, of which there is one of each kind at least."""
        known = {*CONTROL_FIELDS, *FLAG_FIELDS}
        self._extra = dict.fromkeys(name for row in controls for name in row if name not in known)
        times = [row["system_timestamp"] for row in controls] + [row["timestamp"] for row in frames]
        self.controls, self.frames, self._first_s, self._last_s = len(controls), len(frames), min(times), max(times)
        first = cv2.imread(str(part / frames[0]["image_path"]))
        if first is not None:
            self.resolution = first.shape[1], first.shape[0]
        self.metadata["fault"] = "the program that recorded it was killed"

    def _append(self, kind: str, row: dict[str, Any], t_s: float) -> None:
        try:
            line = json.dumps(row, allow_nan=False).encode() + b"\n"
        except (TypeError, ValueError) as e:
            what = f"{self.folder.name}: a column cannot be written ({e})"
            raise EpisodeError(what, remedy="give numbers or text") from None
        with self._disk():
            file = self._rows[kind]
            if (written := file.write(line)) < len(line):
                file.truncate(file.tell() - written)  # half a row would spoil the next one
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._first_s, self._last_s = min(self._first_s, t_s), max(self._last_s, t_s)

    @contextlib.contextmanager
    def _disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as e:
            raise EpisodeError(
                f"{self.folder}: cannot be written ({e.strerror or e})", remedy="make room, or name another folder"
            ) from e

    def _must_be_open(self) -> Path:
        """Return the hidden folder. Raises EpisodeError if there is none."""
        if self._temporary is None:
            raise EpisodeError(f"{self.folder.name}: not open", remedy="use it as `with EpisodeWriter(...) as writer:`")
        return self._temporary

    def _whole(self, name: str, value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
            raise EpisodeError(f"{self.folder.name}: {name} must be a whole number from 0", found=f"{value!r}")
        return int(value)

    def _time(self, t_s: float) -> float:
        try:
            found = float(t_s)
        except (TypeError, ValueError, OverflowError):
            found = math.nan
        if not math.isfinite(found):
            raise EpisodeError(f"{self.folder.name}: a time must be finite seconds", found=repr(t_s))
        return found

    def _refuse_existing(self) -> None:
        if os.path.lexists(self.folder):
            raise EpisodeError(
                f"{self.folder}: exists already", remedy="name another folder, or move it away first", kind="exists"
            )

    def _write(self, temporary: Path) -> None:
        """Write the three files in the hidden folder."""
        if not self.controls or not self.frames:
            found = f"{self.controls} controls and {self.frames} frames"
            remedy = "check that the camera and the Arduino deliver"
            raise EpisodeError(f"{self.folder.name}: too little for an episode", found=found, remedy=remedy)
        for file in self._rows.values():
            file.close()
        about = self.about
        start_s = self._first_s if about.start_time_s is None else self._time(about.start_time_s)
        end_s = self._last_s if about.end_time_s is None else self._time(about.end_time_s)
        duration_s = end_s - start_s
        head = {
            "episode_id": self.folder.name,
            "action_label": about.label,
            "start_time": start_s,
            "end_time": end_s,
            "duration": duration_s,
            "metadata": {
                "camera_fps": about.fps,
                "camera_resolution": list(self.resolution or ()),
                "arduino_port": about.arduino_port,
                "total_control_samples": self.controls,
                "total_frames": self.frames,
                "avg_control_rate": self.controls / duration_s if duration_s > 0 else 0,
                "avg_frame_rate": self.frames / duration_s if duration_s > 0 else 0,
                **plain(self.metadata),
            },
        }
        columns = {
            "control": (*CONTROL_FIELDS, *(FLAG_FIELDS if self.flags else ()), *self._extra),
            "frame": FRAME_FIELDS,
        }
        with (temporary / "episode_data.json").open("w") as f:
            # As json.dumps(episode, indent=2) would, but a row at a time: a long drive does not fit in memory.
            f.write(json.dumps(head, indent=2, allow_nan=False).removesuffix("\n}"))
            for kind in columns:
                f.write(f',\n  "{kind}_samples": [')
                for i, row in enumerate(_read_rows(temporary, kind, columns[kind])):
                    fields = json.dumps(row, separators=(",\n      ", ": "))[1:-1]
                    f.write(f"{',' if i else ''}\n    {{\n      {fields}\n    }}")
                f.write("\n  ]")
            f.write("\n}")
            _to_disk(f)
        for kind in columns:
            with (temporary / f"{kind}_data.csv").open("w", newline="") as f:
                table = csv.DictWriter(f, columns[kind])  # ends lines with CR LF, as the user's recorder did
                table.writeheader()
                table.writerows(_read_rows(temporary, kind, columns[kind]))
                _to_disk(f)
        for name in (*(f"{kind}.rows" for kind in columns), ABOUT):
            (temporary / name).unlink(missing_ok=True)


def find_killed(folder: Path) -> list[Path]:
    """Return the hidden folders of recordings whose program was killed, in a folder of episodes."""
    return [path for path in sorted(folder.glob(".*.part")) if path.is_dir() and not _is_recording(path)]


def _is_recording(part: Path) -> bool:
    try:
        with open_plain(part / "control.rows", OSError("not a plain file")) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def finish_killed(part: Path) -> Path | None:
    """Make an episode of what a killed recording has left, and return its folder.

    A row or a picture that was cut is left out. A recording that was killed before its first row is removed, and None
    returned. Raises EpisodeError, and changes nothing, if there are no controls or no pictures.
    """
    folder = part.with_name(part.name.removeprefix(".").removesuffix(".part"))
    if _is_recording(part):
        raise EpisodeError(f"{folder}: is being recorded", remedy="wait until it is", kind="exists")
    rows = {kind: part / f"{kind}.rows" for kind in ("control", "frame")}
    try:
        told = json.loads(_data_of(part / ABOUT))
        writer = EpisodeWriter(folder, About(**told["about"]), resolution=None, flags=told["flags"])
        writer.metadata = dict(told["metadata"])
    except (ValueError, TypeError, KeyError):
        writer = EpisodeWriter(folder, About(), resolution=None, flags=True)
    writer._refuse_existing()
    if all(path.is_file() for path in rows.values()):  # else all was written already, and only the rename is missing
        kept = {kind: list(_whole_rows(path)) for kind, path in rows.items()}
        kept["frame"] = [row for row in kept["frame"] if _is_whole_picture(part / str(row.get("image_path")))]
        if not kept["control"] and not kept["frame"]:
            shutil.rmtree(part)
            return None
        if not kept["control"] or not kept["frame"]:
            raise EpisodeError(f"{part}: nothing usable was recorded", remedy="remove it")
        for kind, path in rows.items():
            with atomic_path(path) as whole:
                whole.write_text("".join(json.dumps(row) + "\n" for row in kept[kind]))
        writer._take(part, kept["control"], kept["frame"])
        writer._write(part)
    elif not (part / "episode_data.json").is_file():
        shutil.rmtree(part)
        return None
    part.rename(folder)
    return folder


def _whole_rows(path: Path) -> Iterator[dict[str, Any]]:
    for line in _data_of(path).splitlines(keepends=True):
        with contextlib.suppress(ValueError):
            row = json.loads(line)
            if line.endswith(b"\n") and isinstance(row, dict):
                yield row


def _is_whole_picture(path: Path) -> bool:
    data = _data_of(path)
    return data.startswith(b"\xff\xd8") and data.endswith(b"\xff\xd9")


def _read_rows(folder: Path, kind: str, columns: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    with (folder / f"{kind}.rows").open() as f:
        for line in f:
            row = json.loads(line)
            yield {name: row.get(name) for name in columns}


def _to_disk(file: IO[str]) -> None:
    file.flush()
    os.fsync(file.fileno())  # a power cut after the rename must not leave an empty file


def number_of(value: object) -> float | None:
    """Return a number from JSON or from a CSV's text: NaN if not finite or absurdly large, None if not a number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        found = float(value)
    except OverflowError:
        return math.nan
    except ValueError:
        return None
    return found if abs(found) < LARGEST else math.nan


def no_pulse(row: Mapping[str, Any], channel: str) -> bool:
    """Return whether a row of a recording says that its channel, "steering" or "throttle", was not measured.

    It says so by its flag, or by having no value for the channel.
    """
    flag = row.get(f"{channel}_measured")
    values = (row.get(f"{channel}_{part}") for part in ("normalized", "raw_us", "period_us"))
    return str(flag).strip().lower() in ("false", "0") or all(v is None or v == "" for v in values)


def driver_of(row: Mapping[str, Any]) -> str | None:
    """Return who drove at a row of a recording, one of DRIVERS; None if the row says something else.

    If it says nothing, a policy drove if the row names an artifact's mode, and otherwise a human.
    """
    said = row.get("driver")
    if said is None or said == "":
        return POLICY if row.get("mode") else HUMAN
    return said if said in DRIVERS else None


def arduino_step_s(before_s: float, after_s: float) -> float:
    """Return the seconds between two readings of the Arduino's clock, also if it wrapped between them.

    Returns NaN if the clock stood still or went back (a reset), or if a reading is NaN.
    """
    step_s, wrap_s = after_s - before_s, ARDUINO_WRAP_MS / 1000
    if before_s < wrap_s and -wrap_s < step_s < -wrap_s / 2:
        step_s += wrap_s
    return step_s if step_s > 0 else math.nan


def find_backlog(system_s: Iterable[float], arduino_s: Iterable[float]) -> list[bool]:
    """Return for each control whether the next one arrived so soon after it that both had waited in a buffer.

    The usual interval is the median of the steps of the Arduino's clock. The last control is never late.
    """
    steps = [step for a, b in pairwise(arduino_s) if (step := arduino_step_s(a, b)) < 1]
    usual_s = float(np.median(steps)) if steps else 0.033
    return [b - a < BURST_SHARE * usual_s for a, b in pairwise(system_s)] + [False]


def read_car_of(folder: Path | str) -> Car:
    """Return the car whose pulses an episode folder contains, from its metadata.

    If the metadata do not describe one, it is the default, the car of the first recordings. Raises CarError if the
    description is not that of a car.
    """
    try:
        metadata = json.loads(_data_of(Path(folder) / "episode_data.json"))["metadata"]
        described, said = metadata.get("car"), metadata.get("steering_positive")
        before = metadata.get("arduino_port") == SIMULATED and said is None
    except (ValueError, RecursionError, TypeError, KeyError, AttributeError):
        return Car()
    car = Car() if described is None else Car.of(described, f"{folder}: its car")
    # In the balloon world the default car turned left until recordings said which side is positive.
    return replace(car, positive="left") if before and car.drives_like(Car()) else car


def _data_of(path: Path) -> bytes:
    """Return a data file's bytes; none if it cannot be read, or is larger than any drive's."""
    try:
        return read_plain(path, DATA_BYTES)
    except OSError:
        return b""


def json_controls(path: Path, key: str = "control_samples") -> list[dict[str, Any]]:
    """Return the controls, or what else is under `key`, in an episode_data.json; none if it cannot be read."""
    try:
        content = json.loads(_data_of(path))
        return [row for row in content[key] if isinstance(row, dict)]
    except (ValueError, RecursionError, TypeError, KeyError):
        return []
