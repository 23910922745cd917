"""Write one drive as an episode folder, in the format of the user's recorder.

episode_YYYYMMDD_HHMMSS/
  episode_data.json   control_data.csv   frame_data.csv   frames/frame_%06d.jpg

"No pulse" is a flag, not a 0: where steering_measured or throttle_measured is false, that channel's values are null in
JSON and empty in CSV. Files without these two columns come from the user's recorder or the balloon world; in them, a
pulse or period of 0 means "not measured". docs/data.md has all columns.
"""

import contextlib
import csv
import errno
import json
import math
import os
import shlex
import shutil
import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from io import FileIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.durable import lock_folder, move_durably, sync_disk
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.stage import atomic_path, plain, read_plain

CHANNELS = ("steering", "throttle")
CONTROL_FIELDS = (
    "arduino_timestamp", "system_timestamp", "steering_normalized", "throttle_normalized", "steering_raw_us",
    "throttle_raw_us", "steering_period_us", "throttle_period_us",
)  # fmt: skip
FLAG_FIELDS = ("steering_measured", "throttle_measured")
FRAME_FIELDS = ("frame_id", "timestamp", "image_path")
# Who drove at a control: a policy; a human, whose pulses went to the servos; or nobody, and the car was in neutral.
POLICY, HUMAN, NOBODY = DRIVERS = ("policy", "human", "nobody")

DATA = "episode_data.json"
PART = ".part"  # how the name of the hidden folder ends
ABOUT = "about.json"  # in the hidden folder: what finish_killed() needs
KINDS = {"control": "system_timestamp", "frame": "timestamp"}  # of rows, and the name of their time
SYNC_S = 0.4  # and two syncs of 0.3 s: a power cut costs the last second
DATA_BYTES = 200_000_000  # largest data file that is read: three hours of driving
LARGEST = 1e15  # no time, pulse or id is larger; differences of such numbers stay finite
ARDUINO_WRAP_MS = 1 << 32  # its clock starts at 0 again after 49.7 days
BURST_SHARE = 0.3  # two controls that arrive within this share of the usual interval had waited in a buffer
BURST_MIN = 3  # fewer than this in a row are the USB line's jitter, shorter than a frame, and left as they are


@dataclass(frozen=True)
class About:
    """The description of a recording.

    label: what was done. fps: the camera's rate. start_time_s, end_time_s: system time at start and end; None: that of
    the first and last sample. source: who drove; None: not noted. car: whose pulses these are, in the metadata if it
    drives otherwise than the default; None: the default, the car of the first recordings.
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

    Until then everything is in a hidden folder beside it, synced about twice a second. After an error, a kill or a
    power cut it stays there for finish_killed(), unless nothing was recorded.

    folder: must not exist; its name is the episode's id. resolution: (width, height) of the frames; None: that of the
    first. flags: write the two columns that say what was measured. Raises EpisodeError for an existing folder, frames
    of another size, values that are not numbers, an episode without a frame or a control, or a full disk.
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
        self.folder = Path(folder)
        self.about = about
        self.resolution = resolution
        self.jpeg_quality = jpeg_quality
        self.flags = flags
        car = about.car or Car()
        self.pwm = car.pwm
        self.metadata: dict[str, Any] = {}  # further entries of the episode's metadata
        if not car.drives_like(Car()):
            self.metadata["car"] = car.description()
        if about.source is not None:
            self.metadata["source"] = about.source
        self.controls = self.frames = self.picture_bytes = 0
        self._extra: dict[str, None] = {}  # names of further columns, in order
        self._first_s = math.inf
        self._last_s = -math.inf
        self._part: Path | None = None  # the hidden folder, while it is open
        self._lock: int | None = None
        self._rows: dict[str, FileIO] = {}
        self._damaged: set[Any] = set()  # pictures that a kill or a power cut has left without their end
        self._left_out = 0  # damaged rows and pictures
        self._closing = threading.Event()
        self._syncing = threading.Thread(target=self._keep_synced, daemon=True)
        self._unsynced: OSError | None = None

    def __enter__(self) -> "EpisodeWriter":
        self.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.finish()
        else:
            self.close()

    def open(self) -> None:
        """Begin the episode. Raises EpisodeError if the folder exists or another program is recording it."""
        self._refuse_existing()
        # beside the target, so that the rename stays within one filesystem; hidden from loaders
        part = self.folder.with_name(f".{self.folder.name}{PART}")
        with self._disk():
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileExistsError):
                part.mkdir()
                self._lock = lock_folder(part)
        if self._lock is None:
            problem = f"{self.folder}: is being recorded, or was when its program was killed"
            remedy = f"name another folder; {_finish_by(self.folder.parent)}"
            raise EpisodeError(problem, remedy=remedy, kind="exists")
        self._part = part
        try:
            with self._disk():
                (part / "frames").mkdir()
                head = {"about": vars(replace(self.about, car=None)), "metadata": self.metadata, "flags": self.flags}
                (part / ABOUT).write_text(json.dumps(head))
                for kind in KINDS:
                    self._rows[kind] = (part / f"{kind}.rows").open("ab", buffering=0)
            self._syncing.start()
        except BaseException:
            self.close()  # no __exit__ follows a failed open()
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
        self._check_time(t_system_s)
        row: dict[str, Any] = dict.fromkeys(CONTROL_FIELDS)
        row["arduino_timestamp"], row["system_timestamp"] = arduino_ms, float(t_system_s)
        pulses = ("steering", steering_us, steering_period_us), ("throttle", throttle_us, throttle_period_us)
        for name, pulse_us, period_us in pulses:
            action = None
            if not (self.flags and (pulse_us is None or period_us is None)):
                if not is_whole(pulse_us, 0) or not is_whole(period_us, 0):
                    problem = f"{self.folder.name}: pulse and period of {name} must be whole numbers from 0"
                    raise EpisodeError(problem, found=f"{pulse_us!r} and {period_us!r}")
                action = self.pwm.channel(name).action(pulse_us, period_us)
            if action is not None or not self.flags:
                row[f"{name}_normalized"] = round(action or 0.0, 4) + 0.0  # + 0.0: no "-0.0" in the file
                row[f"{name}_raw_us"], row[f"{name}_period_us"] = pulse_us, period_us
            if self.flags:
                row[f"{name}_measured"] = action is not None
        self._extra |= dict.fromkeys(extra)
        self._append("control", plain(extra) | row, t_system_s)
        self.controls += 1

    def frame(self, t_s: float, frame_bgr: np.ndarray) -> None:
        """Add one picture, (height, width, 3) uint8 BGR of the episode's resolution, at system time `t_s`."""
        part = self._part
        assert part, "not open"
        self._check_time(t_s)
        if self.resolution is None and isinstance(frame_bgr, np.ndarray) and frame_bgr.ndim == 3:
            self.resolution = frame_bgr.shape[1], frame_bgr.shape[0]
        shape = (self.resolution[1], self.resolution[0], 3) if self.resolution else ("height", "width", 3)
        if not isinstance(frame_bgr, np.ndarray) or frame_bgr.shape != shape or frame_bgr.dtype != np.uint8:
            actual = f"{getattr(frame_bgr, 'dtype', type(frame_bgr).__name__)} {getattr(frame_bgr, 'shape', '')}"
            problem = f"{self.folder.name}: frames must be uint8 {shape}"
            raise EpisodeError(problem, found=actual, remedy="check the camera")
        number = self.frames + 1
        relative = f"frames/frame_{number:06d}.jpg"
        _, jpeg = cv2.imencode(".jpg", frame_bgr, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        picture = part / relative
        try:
            with self._disk():
                picture.write_bytes(jpeg.data)
        except EpisodeError:
            with contextlib.suppress(OSError):  # half a file is no picture, and the episode may go on without it
                picture.unlink()
            raise
        self._append("frame", {"frame_id": number, "timestamp": float(t_s), "image_path": relative}, t_s)
        self.frames = number
        self.picture_bytes += len(jpeg)

    def finish(self) -> Path:
        """Make the folder appear and return it. If that fails, the hidden folder stays, and EpisodeError says why."""
        part = self._part
        assert part, "not open"
        try:
            with self._disk():
                if (part / "control.rows").is_file() or not (part / DATA).is_file():  # else only the rename is missing
                    self._write(part)
                    sync_disk(part)
                for name in (*(f"{kind}.rows" for kind in KINDS), ABOUT):
                    if not self._left_out:  # else the damaged rows stay too: nothing that was recorded is removed
                        (part / name).unlink(missing_ok=True)
                self._refuse_existing()  # rename would replace an empty folder without a word
                move_durably(part, self.folder)
            self._part = None
        finally:
            self.close()
        return self.folder

    def close(self, unwanted: bool = False) -> None:
        """End the episode as it is. Its hidden folder is removed if nothing was recorded, or if it is unwanted."""
        self._closing.set()
        if self._syncing.is_alive():
            self._syncing.join()
        for file in self._rows.values():
            file.close()
        if self._part and (unwanted or not _holds_anything(self._part)):
            shutil.rmtree(self._part, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
        self._rows = {}
        self._part = None
        self._lock = None

    def _take(self, part: Path, lock: int) -> None:
        """Go on with what an ended process has left in a hidden folder."""
        self._part = part
        self._lock = lock
        names = {*CONTROL_FIELDS, *FLAG_FIELDS}
        for kind, time in KINDS.items():
            for row in _rows(part, kind):
                if row and kind == "frame":
                    picture = _data_of(part / str(row.get("image_path")))
                    if not (picture.startswith(b"\xff\xd8") and picture.endswith(b"\xff\xd9")):
                        self._damaged.add(row.get("image_path"))
                        row = None
                if row is None:
                    self._left_out += 1
                    continue
                self.controls += kind == "control"
                self.frames += kind == "frame"
                self._extra |= dict.fromkeys(name for name in row if kind == "control" and name not in names)
                self._first_s = min(self._first_s, row[time])
                self._last_s = max(self._last_s, row[time])
                if kind == "frame" and self.resolution is None:
                    image = cv2.imread(str(part / row["image_path"]))
                    if image is not None:
                        self.resolution = image.shape[1], image.shape[0]
        damaged = f"; {self._left_out} damaged rows and pictures are left out" if self._left_out else ""
        self.metadata["fault"] = f"the recording was cut off{damaged}"

    def _whole_rows(self, part: Path, kind: str) -> Iterator[dict[str, Any]]:
        return (row for row in _rows(part, kind) if row and row.get("image_path") not in self._damaged)

    def _append(self, kind: str, row: dict[str, Any], t_s: float) -> None:
        line = json.dumps(row, allow_nan=False).encode() + b"\n"
        with self._disk():
            if self._unsynced:
                raise self._unsynced
            file = self._rows[kind]
            if (count := file.write(line)) < len(line):
                file.truncate(file.tell() - count)  # half a row would spoil the next one
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._first_s = min(self._first_s, t_s)
        self._last_s = max(self._last_s, t_s)

    def _keep_synced(self) -> None:
        while self._part and not self._closing.wait(SYNC_S):
            try:
                sync_disk(self._part)
            except OSError as error:
                self._unsynced = error
                return

    @contextlib.contextmanager
    def _disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as e:
            remedy = f"make room; {_finish_by(self.folder.parent)}"
            raise EpisodeError(f"{self.folder}: cannot be written ({e.strerror or e})", remedy=remedy) from e

    def _check_time(self, t_s: float) -> None:
        if not is_number(t_s):
            raise EpisodeError(f"{self.folder.name}: a time must be finite seconds", found=repr(t_s))

    def _refuse_existing(self) -> None:
        if os.path.lexists(self.folder):
            remedy = "name another folder, or move it away first"
            raise EpisodeError(f"{self.folder}: exists already", remedy=remedy, kind="exists")

    def _write(self, part: Path) -> None:
        if not self.controls or not self.frames:
            content = f"{self.controls} controls and {self.frames} frames"
            remedy = f"check that the camera and the Arduino deliver; {part.name} has what there is"
            raise EpisodeError(f"{self.folder.name}: too little for an episode", found=content, remedy=remedy)
        note = self.about
        start_s = self._first_s if note.start_time_s is None else note.start_time_s
        end_s = self._last_s if note.end_time_s is None else note.end_time_s
        duration_s = end_s - start_s
        rates = [count / duration_s if duration_s > 0 else 0 for count in (self.controls, self.frames)]
        head = {
            "episode_id": self.folder.name,
            "action_label": note.label,
            "start_time": start_s,
            "end_time": end_s,
            "duration": duration_s,
            "metadata": {
                "camera_fps": note.fps,
                "camera_resolution": list(self.resolution or ()),
                "arduino_port": note.arduino_port,
                "total_control_samples": self.controls,
                "total_frames": self.frames,
                "avg_control_rate": rates[0],
                "avg_frame_rate": rates[1],
                **plain(self.metadata),
            },
        }
        controls = (*CONTROL_FIELDS, *(FLAG_FIELDS if self.flags else ()), *self._extra)
        columns = {"control": controls, "frame": FRAME_FIELDS}
        with atomic_path(part / DATA) as path, path.open("w") as f:
            # As json.dumps(episode, indent=2) would, but a row at a time: a long drive does not fit in memory.
            f.write(json.dumps(head, indent=2, allow_nan=False).removesuffix("\n}"))
            for kind, names in columns.items():
                f.write(f',\n  "{kind}_samples": [')
                for i, row in enumerate(self._whole_rows(part, kind)):
                    fields = json.dumps({name: row.get(name) for name in names}, separators=(",\n      ", ": "))[1:-1]
                    f.write(f"{',' if i else ''}\n    {{\n      {fields}\n    }}")
                f.write("\n  ]")
            f.write("\n}")
        for kind, names in columns.items():
            with atomic_path(part / f"{kind}_data.csv") as path, path.open("w", newline="") as f:
                # ends lines with CR LF, as the user's recorder did
                table = csv.DictWriter(f, names, extrasaction="ignore")
                table.writeheader()
                table.writerows(self._whole_rows(part, kind))


def _finish_by(folder: Path) -> str:
    return f"`rover record {shlex.quote(str(folder))} --finish` keeps what was recorded"


def find_killed(folder: Path) -> list[Path]:
    """Return the hidden folders of recordings whose program was killed, in a folder of episodes."""
    folders = []
    for part in sorted(folder.glob(f".*{PART}")):
        if (lock := lock_folder(part)) is not None:
            os.close(lock)
            folders.append(part)
    return folders


def remove_if_empty(part: Path) -> bool:
    """Remove what a killed recording has left if nothing was recorded; return whether it is gone."""
    if (lock := lock_folder(part)) is not None:
        if not _holds_anything(part):
            shutil.rmtree(part)
        os.close(lock)
    return not part.exists()


def finish_killed(part: Path) -> Path | None:
    """Make an episode of what a killed recording has left, and return its folder; None, if nothing was recorded.

    What was cut is left out, and metadata.fault counts it. Raises EpisodeError, and removes nothing,
    without controls or pictures, or if another process is recording or finishing it.
    """
    folder = part.with_name(part.name.removeprefix(".").removesuffix(PART))
    if remove_if_empty(part):
        return None
    if (lock := lock_folder(part)) is None:
        problem = f"{folder}: is being recorded, or finished by another process"
        raise EpisodeError(problem, remedy="wait until it is", kind="exists")
    try:
        head = json.loads(_data_of(part / ABOUT))
        writer = EpisodeWriter(folder, About(**head["about"]), resolution=None, flags=head["flags"])
        writer.metadata = dict(head["metadata"])
    except (ValueError, TypeError, KeyError):
        writer = EpisodeWriter(folder, About(), resolution=None, flags=True)
    writer._take(part, lock)
    return writer.finish()


def _holds_anything(part: Path) -> bool:
    return any(path.stat().st_size for path in part.rglob("*") if path.is_file() and path.name != ABOUT)


def _rows(part: Path, kind: str) -> Iterator[dict[str, Any] | None]:
    """Yield what was recorded of a kind, row by row; None for a damaged row."""
    with contextlib.suppress(FileNotFoundError), (part / f"{kind}.rows").open("rb") as file:
        for line in file:
            row = None
            with contextlib.suppress(ValueError):
                row = json.loads(line)
            yield row if isinstance(row, dict) and KINDS[kind] in row else None


def number_of(value: object) -> float | None:
    """Return a number from JSON or from a CSV's text: NaN if not finite or absurdly large, None if not a number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return math.nan
    except ValueError:
        return None
    return number if abs(number) < LARGEST else math.nan


def no_pulse(row: Mapping[str, Any], channel: str) -> bool:
    """Whether a row says, by its flag or by no value, that its channel, "steering" or "throttle", was not measured."""
    flag = row.get(f"{channel}_measured")
    values = (row.get(f"{channel}_{part}") for part in ("normalized", "raw_us", "period_us"))
    return str(flag).strip().lower() in ("false", "0") or all(v is None or v == "" for v in values)


def driver_of(row: Mapping[str, Any]) -> str | None:
    """Return who drove, one of DRIVERS; by default a policy if it names a mode, else a human. None: unknown."""
    driver = row.get("driver")
    if driver is None or driver == "":
        return POLICY if row.get("mode") else HUMAN
    return driver if driver in DRIVERS else None


def arduino_step_s(before_s: float, after_s: float) -> float:
    """Return the seconds between two readings of the Arduino's clock, which may wrap; NaN if it did not go on."""
    step_s = after_s - before_s
    wrap_s = ARDUINO_WRAP_MS / 1000
    if before_s < wrap_s and -wrap_s < step_s < -wrap_s / 2:
        step_s += wrap_s
    return step_s if step_s > 0 else math.nan


def find_backlog(system_s: Iterable[float], arduino_s: Iterable[float]) -> list[bool]:
    """Return for each control whether the next one arrived so soon after it that both had waited in a buffer."""
    steps = [step for a, b in pairwise(arduino_s) if (step := arduino_step_s(a, b)) < 1]
    usual_s = float(np.median(steps)) if steps else 0.033
    return [b - a < BURST_SHARE * usual_s for a, b in pairwise(system_s)] + [False]


def read_car_of(folder: Path | str) -> Car:
    """Return the car whose pulses an episode contains, by its metadata, or the default. Raises CarError for no car."""
    try:
        return car_in(json.loads(_data_of(Path(folder) / DATA))["metadata"], folder)
    except (ValueError, RecursionError, TypeError, KeyError):
        return Car()


def car_in(metadata: Any, folder: Path | str) -> Car:
    """Return the car that an episode's metadata describe, or the default. Raises CarError for no car."""
    described = metadata.get("car") if isinstance(metadata, dict) else None
    if described is None:  # the balloon world once noted a mirrored car by its side alone
        to_left = isinstance(metadata, dict) and metadata.get("steering_positive") == "left"
        return Car(positive="left") if to_left else Car()
    return Car.of(described, f"{folder}: its car")


def _data_of(path: Path) -> bytes:
    """Return a data file's bytes; none if it cannot be read, or is larger than any drive's."""
    try:
        return read_plain(path, DATA_BYTES)
    except OSError:
        return b""
