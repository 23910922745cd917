"""The flight log: one line of JSON per control tick, written without ever holding up the loop.

Each file begins with a header, which names the columns of the ticks. A tick is an array of values, null if unknown;
all else are objects. The reader skips a line that a power cut or a full disk has cut short.
"""

import contextlib
import errno
import glob
import json
import logging
import math
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from io import FileIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from filelock import BaseFileLock, Timeout

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.host import THROTTLED_VALUE, Host, throttled_means
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import ParamsError, RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import FILE_BYTES, plain, private_lock, read_plain

SCHEMA = 2
QUEUE_ROWS = 2048  # the disk may stall for a minute at 30 Hz; 1 MB
SYNC_S = 0.9  # between two syncs to the disk: a power cut costs a second at most
RETRY_S = 1.0  # from a failed write to the next attempt
CLOSE_S = 2.0  # close() waits no longer
EVENT_CHARACTERS = 800
RECENT = 8
ARMED = "armed"  # the loop's event with which a drive begins
NAME_A_LOG = "name a file that rover drive wrote"

_log = logging.getLogger("rover")


class Tick(NamedTuple):
    """One control tick. None means "not known" or "none yet"."""

    t_s: float  # since FlightLog.start_s, by the same clock
    late_ms: float  # how long after its deadline the command went out
    state: str  # who drives: M, A or S as the Arduino says, "" if not known
    reason: str  # why, a key of protocol.REASONS
    steering: float  # commanded, [-1, 1]
    throttle: float  # commanded, [0, 1]
    steering_us: int  # commanded pulses
    throttle_us: int
    pins_steering_us: int | None  # the pulses on the Arduino's pins, by its newest status
    pins_throttle_us: int | None
    plan: int  # number of the plan in use, 0 for none
    plan_age_ms: float | None  # since the capture of that plan's frame
    latency_ms: float | None  # of that plan, from capture to ready
    fade: float  # how much throttle the plan's age and an unfamiliar place allow, 1 to 0
    frame: int  # number of the newest frame
    strange: float | None = None  # smoothed, as a share of the artifact's threshold


_TEXTS = ("state", "reason")


class Event(NamedTuple):
    """Something that happened. t_s: seconds since the log's start."""

    t_s: float
    text: str


def log_limits() -> tuple[int, int]:
    """Return FlightLog's max_bytes and keep from params.yml. Raises ParamsError."""
    section = params()["flight_log"]
    max_mb = section["max_mb"]
    keep = section["keep"]
    if not is_number(max_mb, 0.02, FILE_BYTES / 1e6) or not is_whole(keep, 0):
        problem = f"flight_log: max_mb must be from 0.02 to {FILE_BYTES / 1e6:g}, keep whole and not negative"
        raise ParamsError(problem, found=f"{max_mb!r} and {keep!r}", remedy="see params.yml")
    return int(max_mb * 1e6), keep


class FlightLog:
    """The flight log of one drive. It is written inside its context, in which no other drive can write that file.

    path: the file, to which the drive is appended. header: what the drive was started with; figures need hz, fade_s and
    stop_s in it. max_bytes: a file of this size is renamed to path.1, path.1 to path.2 and so on; `keep` older files
    stay. Raises RoverError on entering if another drive writes the file, and nothing later: a full disk is logged once,
    and tried again every second. Ticks must come from one thread; events may come from any, and from signals' handlers.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        header: dict[str, Any],
        max_bytes: int,
        keep: int,
        clock: Callable[[], float] = time.monotonic,
        host: Host | None = None,
    ):
        self.path = Path(path)
        self.start_s = clock()
        self.recent: deque[Event] = deque(maxlen=RECENT)
        self.machine: dict[str, Any] = {}  # its newest state: t_s, temperature_c, throttled
        start = {"start": datetime.now().astimezone().isoformat(), "start_monotonic_s": self.start_s}
        self._header = {"schema": SCHEMA, "kind": "header", **start, "columns": Tick._fields, "drive": header}
        self._max_bytes = max_bytes
        self._keep = keep
        self._clock = clock
        self._host = host or Host()
        self._rows: deque[Tick | Event | dict[str, Any]] = deque(maxlen=QUEUE_ROWS)
        self._lock: BaseFileLock | None = None
        self._closing = threading.Event()
        self._writer = threading.Thread(target=self._write, name="flight log", daemon=True)
        # Another one, because a low supply must stop the car on a full or stuck disk too.
        self._reader = threading.Thread(target=self._read_machine, name="supply and heat", daemon=True)
        # Only the writing thread uses these, once it runs:
        self._file: FileIO | None = None
        self._lines: deque[bytes] = deque()  # not written yet

    def __enter__(self) -> "FlightLog":
        self._take_lock()
        self._reader.start()
        self._writer.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def tick(self, row: Tick) -> None:
        """Log a tick. Waits for nothing, raises nothing."""
        self._rows.append(row)

    def event(self, text: str, *, level: int = logging.INFO) -> None:
        """Log an event, in the file and through `logging`. Waits for nothing, raises nothing."""
        event = Event(self._clock() - self.start_s, text)
        self._rows.append(event)
        self.recent.append(event)
        _log.log(level, "%s", text)

    def close(self) -> None:
        """Write what is left. Waits 2 s at most, and then gives up on a disk that is stuck."""
        self._closing.set()
        if self._writer.is_alive():
            self._writer.join(CLOSE_S)
        if self._lock and not self._writer.is_alive():  # a stuck one still writes, and keeps other drives out
            self._lock.release()

    def _take_lock(self) -> None:
        """Keep other drives from the file, also while it is renamed. Raises RoverError if one writes it now."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = private_lock(self.path.with_name(f".{self.path.name}.lock"))
            self._lock.acquire()
        except Timeout:
            raise RoverError(f"{self.path}: another drive writes this log", remedy="name another by --log") from None
        except OSError:  # where nothing can be locked, such as beside /dev/null
            pass

    def _write(self) -> None:
        closing = failed = False
        while not closing:
            closing = self._closing.wait(RETRY_S if failed else SYNC_S)
            if closing:
                self._reader.join(CLOSE_S / 4)  # for its last row
            try:
                if not self._lines:  # while the disk takes nothing, the queue drops the oldest
                    for _ in range(len(self._rows)):
                        self._lines.append(_line(self._rows.popleft()))
                self._write_lines()
                if failed:
                    self.event("the flight log is written again", level=logging.WARNING)
                failed = False
            except Exception as error:  # of any type: a drive goes on without its log
                if not failed:
                    _log.warning("%s: the flight log cannot be written (%s); driving goes on without", self.path, error)
                failed = True
                self._close_file()
        self._close_file()

    def _read_machine(self) -> None:
        while True:
            now_s = self._clock() - self.start_s
            vcgencmd = shutil.which(self._host.vcgencmd)  # never start a program that is not there
            bits = self._host.throttled() if vcgencmd else None
            self.machine = {"t_s": now_s, "temperature_c": self._host.temperature_c(), "throttled": bits}
            self._rows.append({"kind": "machine", **self.machine})
            if self._closing.wait(SYNC_S):
                return

    def _write_lines(self) -> None:
        """Write the lines, and sync them to the disk. Raises OSError."""
        file = self._file or self._open()
        while self._lines:
            if file.tell() >= self._max_bytes:
                file = self._shift()
            if file.write(self._lines[0]) < len(self._lines[0]):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._lines.popleft()
        os.fsync(file)

    def _open(self) -> FileIO:
        self._file = file = FileIO(self.path, "a")
        file.write(b"\n" * (file.tell() > 0) + _line(self._header))  # the line feed ends a line that was cut short
        return file

    def _close_file(self) -> None:
        if self._file:
            with contextlib.suppress(OSError):
                self._file.close()
        self._file = None

    def _shift(self) -> FileIO:
        names = [self.path, *(self.path.with_name(f"{self.path.name}.{i}") for i in range(1, self._keep + 1))]
        for older, newer in zip(names[:0:-1], names[-2::-1], strict=True):
            with contextlib.suppress(FileNotFoundError):
                newer.replace(older)
        self.path.unlink(missing_ok=True)
        self._close_file()
        return self._open()


def _line(row: Any) -> bytes:
    if isinstance(row, Tick):
        row = [round(value, 4) if isinstance(value, float) else value for value in plain(row)]
    elif isinstance(row, Event):
        # cut, because a log file is bounded and an error's text is not
        row = {"kind": "event", "t_s": row.t_s, "event": row.text[:EVENT_CHARACTERS]}
    return json.dumps(plain(row), separators=(",", ":"), default=str).encode() + b"\n"


@dataclass(frozen=True)
class Flight:
    """One drive, as read from its log.

    header: empty if it was damaged; header["drive"] is what the drive was started with. ticks: an array per field of
    Tick, (n,) float64 with NaN for "not known"; state and reason are text. machine: (t_s, temperature_c, throttled) of
    each reading, None where it was not known. drive: its index among the `drives` of these files. damaged: lines that
    were skipped.
    """

    path: Path
    header: dict[str, Any]
    ticks: dict[str, np.ndarray]
    events: list[Event]
    machine: list[tuple[float, float | None, str | None]]
    drive: int
    drives: int
    damaged: int

    @property
    def period_ms(self) -> float | None:
        hz = self.header.get("drive", {}).get("hz")
        return 1000 / hz if is_number(hz) and hz > 0 else None

    @property
    def car(self) -> Car:
        """The car that was driven, by the header. Raises CarError."""
        described = self.header.get("drive", {}).get("car")
        return Car.of(described, f"{self.path}: its car") if described else Car()

    def summary(self) -> dict[str, Any]:
        """Return the drive in figures; a figure is None if nothing was measured.

        jitter: how late commands were. missed: deadlines without a tick. plan_age is over the ticks that had a plan,
        latency over the plans.
        """
        ticks = self.ticks
        period_ms = self.period_ms
        t_s = ticks["t_s"]
        late_ms = ticks["late_ms"]
        plans = ticks["plan"]
        _, first = np.unique(plans, return_index=True)  # the first tick of each plan
        latency_ms = ticks["latency_ms"][first][plans[first] > 0] if len(plans) else plans
        throttled = next((bits for *_, bits in reversed(self.machine) if bits is not None), None)
        missed = None
        if period_ms:
            passed = np.rint(np.diff(t_s * 1000 - late_ms) / period_ms) - 1
            missed = int(passed[passed > 0].sum())
        return {
            "start": self.header.get("start"),
            "seconds": float(t_s[-1] - t_s[0]) if len(t_s) else 0.0,
            "ticks": len(t_s),
            "missed": missed,
            **figures(late_ms, ticks["plan_age_ms"], latency_ms),
            "plans": len(latency_ms),
            "temperature_max_c": _percentile([heat for _, heat, _ in self.machine if heat is not None], 100),
            "throttled": throttled,
            "throttled_means": throttled_means(throttled),
            "events": [{"t_s": e.t_s, "event": e.text} for e in self.events],
            "drive": self.drive,
            "drives": self.drives,
            "damaged_lines": self.damaged,
        }


def figures(late_ms: Any, plan_age_ms: Any, latency_ms: Any) -> dict[str, float | None]:
    """Return how late commands were, how old plans, and how long they took, each in ms; None for none."""
    jitter = {f"jitter_{name}_ms": _percentile(late_ms, q) for name, q in (("p50", 50), ("p99", 99), ("max", 100))}
    latency = {f"latency_p{q}_ms": _percentile(latency_ms, q) for q in (50, 95)}
    return {**jitter, "plan_age_p95_ms": _percentile(plan_age_ms, 95), **latency}


def _percentile(values: Any, q: float) -> float | None:
    numbers = np.asarray(values)[np.isfinite(values)]
    return round(float(np.percentile(numbers, q)), 3) if len(numbers) else None


def read_log(path: Path | str, drive: int = -1) -> Flight:
    """Read a flight log, with the older files path.1, path.2, ... that belong to it.

    drive: index of the drive in these files: 0 is the first, -1 the last. A service's log has a drive for each arming.
    Raises RoverError if the file cannot be read, or holds no such drive.
    """
    path = Path(path)
    rows = [_row(line) for line in _lines_of(path)]
    drives = _drives_of([row for row in rows if row is not None])
    if not -len(drives) <= drive < len(drives):
        raise RoverError(f"{path}: no drive {drive} in it", found=f"{len(drives)} drives", remedy=NAME_A_LOG)
    header, *lines = drives[drive]
    ticks = [row for row in lines if isinstance(row, list)]
    machine = [row for row in lines if type(row) is tuple]
    columns = zip(*ticks, strict=True) if ticks else [()] * len(Tick._fields)
    return Flight(
        path=path,
        header=header,
        ticks={n: np.array(c, str if n in _TEXTS else float) for n, c in zip(Tick._fields, columns, strict=True)},
        events=sorted((row for row in lines if isinstance(row, Event)), key=lambda e: e.t_s),
        machine=machine,
        drive=drive % len(drives),
        drives=len(drives),
        damaged=rows.count(None),
    )


def _lines_of(path: Path) -> list[bytes]:
    """Return the lines of a log and its older files, in order. Raises RoverError."""
    older = [p for p in path.parent.glob(f"{glob.escape(path.name)}.*") if p.suffix[1:].isdecimal()]
    files = [*sorted(older, key=lambda p: -int(p.suffix[1:])), path]
    try:
        return [line for file in files for line in read_plain(file).split(b"\n") if line]
    except OSError as error:
        raise RoverError(f"{path}: cannot be read ({error.strerror})", remedy=NAME_A_LOG) from error


def _drives_of(rows: list[Any]) -> list[list[Any]]:
    """Split rows into drives, each of which begins with its header."""
    drives: list[list[Any]] = []
    armed = False
    for row in rows:
        if isinstance(row, dict):
            if not drives or any(drives[-1][0].get(k) != row.get(k) for k in ("start", "start_monotonic_s")):
                drives.append([row])  # and not just the next file of the same drive
                armed = False
            continue
        begins = isinstance(row, Event) and row.text == ARMED
        if not drives or (begins and armed):
            drives.append([drives[-1][0] if drives else {}])
            armed = False
        armed = armed or begins
        drives[-1].append(row)
    return drives


def _row(line: bytes) -> list[Any] | Event | tuple[Any, ...] | dict[str, Any] | None:
    """Parse a line: a tick's values, an Event, (t_s, temperature_c, throttled), or a header. None: it is damaged."""
    try:
        match json.loads(line):
            case list(values):
                values += [None] * (len(values) == len(Tick._fields) - 1)  # of a log from before `strange`
                return [_value(name, value) for name, value in zip(Tick._fields, values, strict=True)]
            case {"kind": "event", "t_s": t_s, "event": str(text)} if is_number(t_s):
                return Event(float(t_s), text)
            case {"kind": "machine", "t_s": t_s, "temperature_c": heat, "throttled": bits} if is_number(t_s):
                valid = (heat is None or is_number(heat)) and (bits is None or THROTTLED_VALUE.fullmatch(bits))
                if valid:
                    return (float(t_s), heat, bits)
            case {"kind": "header", "schema": schema, "drive": dict()} as header if schema == SCHEMA:
                return header
    except (ValueError, TypeError, RecursionError):
        pass
    return None


def _value(name: str, value: Any) -> Any:
    if value is None and name != "t_s":
        return "" if name in _TEXTS else math.nan
    if not (isinstance(value, str) if name in _TEXTS else is_number(value)):
        raise ValueError("not a value of this column")
    return value
