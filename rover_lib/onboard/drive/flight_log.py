"""The flight log: one line per control tick, written without ever holding up the loop.

    with FlightLog(path, header={"hz": 30, "fade_s": 0.5, "stop_s": 1.0}, max_bytes=10_000_000, keep=3) as log:
        log.tick(Tick(t_s=time.monotonic() - log.start_s, ...))
        log.event("camera unplugged", level=logging.WARNING, frame=812)
    flight = read_log(path)

A log is text. Each file begins with a header, a line of JSON that names the columns of the ticks. A tick is a line of
values between commas; an unknown value is empty. Events, and the machine's temperature and throttling once a second,
are lines of JSON. Every line ends with a checksum, the CRC-16 of what stands before it, so that a line that a power cut
or a full disk has damaged is recognized and skipped.

`tick` and `event` only put a row into a bounded queue. Two threads do everything that may take long or fail: one reads
the machine's state, writes the file and syncs it; the other passes events on to `logging` (logger "rover"), whose
stream may be a terminal that somebody stopped.
"""

import binascii
import contextlib
import errno
import fcntl
import glob
import json
import logging
import math
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.host import THROTTLED_VALUE, Host, throttled_means
from rover_lib.onboard.car.servo_link import State
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import ParamsError, RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.signal_event import SignalEvent
from rover_lib.onboard.stage import FILE_BYTES, plain, read_plain

SCHEMA = 1
QUEUE_TICKS = 2048  # the disk may stall for a minute at 30 Hz; 1 MB
QUEUE_EVENTS = 256
BATCH_LINES = 16  # formatted between two writes; each write lets the other threads run
RETRY_S = 1.0  # from a failed write to the next attempt
MACHINE_S = 1.0  # between two readings of the machine's state
CLOSE_S = 2.0  # close() waits no longer
MIN_BYTES = 20_000
EVENT_CHARACTERS = 800
RECENT = 8
ARMED = "armed"  # the loop's event with which a drive begins
NAME_A_LOG = "name a file that rover drive wrote"
MISSING = "ticks are missing before this one"
BACK_S = 1.0  # a tick that is this much older than the one before it belongs to another drive

_log = logging.getLogger("rover")


class LogError(RoverError):
    """The flight log is missing, or nothing in it can be read."""


class Tick(NamedTuple):
    """One control tick. None means "not known" or "none yet"."""

    t_s: float  # since FlightLog.start_s, by the same clock
    late_ms: float  # how long after its deadline the command went out
    state: str  # who drives: M, A or S as the Arduino says, "" if not known
    reason: str  # why, a key of servo_link.REASONS
    steering: float  # commanded, [-1, 1]
    throttle: float  # commanded, [0, 1]
    steering_us: int  # commanded pulses
    throttle_us: int
    pins_steering_us: int | None  # the pulses on the Arduino's pins, by its newest status
    pins_throttle_us: int | None
    plan: int  # number of the plan in use, 0 for none
    plan_age_ms: float | None  # since the capture of that plan's frame
    latency_ms: float | None  # of that plan, from capture to ready
    fade: float  # how much throttle the plan's age allows, 1 to 0
    frame: int  # number of the newest frame


_FORMATS = dict.fromkeys(Tick._fields, "d") | {
    "t_s": ".4f",
    "late_ms": ".3f",
    "state": "",
    "reason": "",
    "steering": ".4f",
    "throttle": ".4f",
    "plan_age_ms": ".1f",
    "latency_ms": ".1f",
    "fade": ".3f",
}
_TEXTS = ("state", "reason")


class Event(NamedTuple):
    """Something that happened. t_s: seconds since the log's start. fields: details."""

    t_s: float
    text: str
    fields: dict[str, Any]

    def __str__(self) -> str:
        return "; ".join([self.text, *(f"{name} {value}" for name, value in self.fields.items())])


def _seal(row: dict[str, Any]) -> bytes:
    """Return a line of JSON with its checksum as the last member."""
    body = json.dumps(plain(row), separators=(",", ":"), default=str)[:-1].encode()
    return b'%s,"crc":"%04X"}\n' % (body, binascii.crc_hqx(body, 0))


def _tick_line(tick: Tick) -> bytes:
    values = ["" if v is None else format(v, f) for v, f in zip(tick, _FORMATS.values(), strict=True)]
    body = ",".join(values).encode()
    return b"%s,%04X\n" % (body, binascii.crc_hqx(body, 0))


def _event_line(event: Event) -> bytes:
    fields = event.fields
    if len(whole := repr(fields)) > EVENT_CHARACTERS:  # a log file is bounded, a traceback is not
        fields = {"cut": whole[:EVENT_CHARACTERS]}
    text = event.text[:EVENT_CHARACTERS]
    return _seal({"kind": "event", "t_s": round(event.t_s, 4), "event": text, "fields": fields})


def log_limits() -> tuple[int, int]:
    """Return FlightLog's max_bytes and keep from params.yml. Raises ParamsError if they are not a size and a count."""
    section = params()["flight_log"]
    max_mb, keep = section["max_mb"], section["keep"]
    if not is_number(max_mb) or max_mb * 1e6 > FILE_BYTES or not is_whole(keep):
        raise ParamsError(
            f"flight_log: max_mb must be a number up to {FILE_BYTES / 1e6:g}, and keep a whole one",
            found=f"{max_mb!r} and {keep!r}",
            remedy="see params.yml",
        )
    return int(max_mb * 1e6), keep


class FlightLog:
    """The flight log of one drive. It is written inside its context.

    path: the file, to which the drive is appended; None only passes events on to logging. header: what the drive was
    started with; the figure of a log looks for hz, fade_s and stop_s in it. max_bytes: before the file grows beyond
    this, it is renamed to path.1, path.1 to path.2 and so on, and only `keep` older files stay. flush_s: pause between
    two syncs to the disk. Raises ParamsError for limits that make no sense, LogError on entering if another drive
    writes the file, and nothing later: if the disk is full or gone, this is logged once, counted in `failures`, and
    tried again every second. Ticks must come from one thread; events may come from any.
    """

    def __init__(
        self,
        path: Path | str | None,
        *,
        header: dict[str, Any],
        max_bytes: int,
        keep: int,
        flush_s: float = 0.5,
        clock: Callable[[], float] = time.monotonic,
        host: Host | None = None,
    ):
        if max_bytes < MIN_BYTES or keep < 0 or not 0 < flush_s <= 1:
            raise ParamsError(
                f"a flight log needs max_bytes from {MIN_BYTES}, keep from 0 and flush_s in (0, 1]",
                found=f"{max_bytes}, {keep} and {flush_s}",
                remedy="see params.yml",
            )
        self.path = Path(path) if path is not None else None
        self.start_s = clock()
        self.failures = 0
        self.last_error: str | None = None
        self.dropped = 0  # ticks for which the queue had no room
        self.recent: deque[Event] = deque(maxlen=RECENT)
        self.machine: dict[str, Any] = {}  # its newest state: temperature_c, throttled
        self._header = {
            "schema": SCHEMA,
            "kind": "header",
            "start": datetime.now().astimezone().isoformat(),
            "start_monotonic_s": self.start_s,
            "columns": [*Tick._fields, "crc"],
            "drive": header,
        }
        self._max_bytes, self._keep, self._flush_s, self._clock = max_bytes, keep, flush_s, clock
        self._host = host or Host()
        self._ticked = 0
        self._ticks: deque[tuple[int, Tick]] = deque(maxlen=QUEUE_TICKS if self.path else 0)
        self._events: deque[Event] = deque(maxlen=QUEUE_EVENTS if self.path else 0)
        self._messages: deque[tuple[int, Event | str]] = deque(maxlen=QUEUE_EVENTS)
        self._messages_wait = SignalEvent()  # because a signal's handler calls event() too
        self._last_messages = False  # set when no more will come
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        # Only the writing thread uses these:
        self._written = 0  # number of the last tick
        self._failed_since: float | None = None
        self._retry_s = self._machine_s = 0.0
        self._vcgencmd = False
        self._bad_row_logged = False

    def __enter__(self) -> "FlightLog":
        self._threads = [threading.Thread(target=self._run_messages, name="flight log events", daemon=True)]
        if self.path:
            file = _LogFile(self.path, self._header, self._max_bytes, self._keep)
            file.refuse_another()
            self._threads.append(
                threading.Thread(target=self._run_writer, args=(file,), name="flight log", daemon=True)
            )
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def tick(self, row: Tick) -> None:
        """Log a tick. Takes a microsecond, waits for nothing, raises nothing."""
        self._ticked += 1
        self._ticks.append((self._ticked, row))

    def event(self, text: str, *, level: int = logging.INFO, **fields: Any) -> None:
        """Log an event with its details, in the file and through `logging`. Waits for nothing, raises nothing."""
        event = Event(self._clock() - self.start_s, text, fields)
        self._events.append(event)
        self.recent.append(event)
        self._pass_on(level, event)

    def close(self) -> None:
        """Write what is left. Waits 2 s at most, and then gives up on a disk or a terminal that is stuck."""
        end = time.monotonic() + CLOSE_S
        self._closing.set()
        for thread in reversed(self._threads):  # the messages' thread last: the writer may still add some
            self._last_messages = thread is self._threads[0]
            self._messages_wait.set()
            thread.join(max(0.0, end - time.monotonic()))

    def _pass_on(self, level: int, event: Event | str) -> None:
        self._messages.append((level, event))
        self._messages_wait.set()

    def _run_messages(self) -> None:
        """The thread that passes messages on to logging.

        It is not logging's QueueListener, because that one's stop() would wait for ever for a stream that is stuck,
        and so hold up the end of a drive.
        """
        while True:
            self._messages_wait.wait()
            self._messages_wait.clear()
            closing = self._last_messages
            while self._messages:
                level, event = self._messages.popleft()
                with contextlib.suppress(Exception):  # a failing handler must not end this thread
                    _log.log(level, "%s", event)
            if closing:
                return

    def _run_writer(self, file: "_LogFile") -> None:
        """The thread that writes the file."""
        self._vcgencmd = shutil.which(self._host.vcgencmd) is not None  # never start a program that is not there
        while True:
            closing = self._closing.wait(self._flush_s)
            try:
                if closing or time.monotonic() >= self._retry_s:
                    self._write_all(file)
            except Exception as error:
                self._fail(error)
                file.close()
            if closing:
                file.close()
                return

    def _write_all(self, file: "_LogFile") -> None:
        """Empty the queues into the file and sync it. Raises OSError if the disk does not accept it."""
        file.open()
        if self._failed_since is not None:
            failed_s = round(time.monotonic() - self._failed_since, 1)
            self.event("the flight log is written again", level=logging.WARNING, failed_s=failed_s)
            self._failed_since = None
        file.write(file.unwritten)
        if time.monotonic() >= self._machine_s:
            self._machine_s = time.monotonic() + MACHINE_S
            file.write(self._machine_line())
        for queue, line in ((self._ticks, self._tick_lines), (self._events, _event_line)):
            left = len(queue)  # rows that arrive meanwhile are left for the next turn
            while left > 0:
                rows = [queue.popleft() for _ in range(min(left, BATCH_LINES))]
                left -= len(rows)
                file.write(b"".join(self._lines(rows, line)))
        file.sync()

    def _lines(self, rows: Iterable[Any], line: Callable[[Any], bytes]) -> Iterable[bytes]:
        for row in rows:
            try:
                yield line(row)
            except Exception as error:
                self.failures += 1
                self.last_error = f"{type(error).__name__}: {error}"
                if not self._bad_row_logged:
                    self._bad_row_logged = True
                    self._pass_on(logging.WARNING, f"a row is not in the flight log: {self.last_error}")

    def _tick_lines(self, row: tuple[int, Tick]) -> bytes:
        number, tick = row
        lost, self._written = number - self._written - 1, number
        line = _tick_line(tick)
        if not lost:
            return line
        self.dropped += lost
        return _event_line(Event(tick.t_s, MISSING, {"ticks": lost})) + line

    def _machine_line(self) -> bytes:
        row: dict[str, Any] = {"kind": "machine", "t_s": round(self._clock() - self.start_s, 4)}
        row["temperature_c"] = self._host.temperature_c()
        row["throttled"] = self._host.throttled() if self._vcgencmd else None
        self.machine = {name: row[name] for name in ("temperature_c", "throttled")}
        return _seal(row)

    def _fail(self, error: Exception) -> None:
        self.failures += 1
        self.last_error = f"{type(error).__name__}: {error}"
        self._retry_s = time.monotonic() + RETRY_S
        if self._failed_since is None:
            self._failed_since = time.monotonic()
            text = f"{self.path}: the flight log cannot be written ({self.last_error}); driving goes on without"
            self._pass_on(logging.WARNING, text)


class _LogFile:
    """The file of a flight log, and its older parts. write(), open() and sync() raise OSError if the disk fails."""

    def __init__(self, path: Path, header: dict[str, Any], max_bytes: int, keep: int):
        self._path, self._header, self._max_bytes, self._keep = path, header, max_bytes, keep
        self._fd: int | None = None
        self._size = self._header_end = self._part = 0
        self.unwritten = b""  # the lines of a batch that the disk did not accept

    def write(self, lines: bytes) -> None:
        """Append whole lines. Those that the disk did not accept are in `unwritten` afterwards."""
        self.unwritten = lines
        if not lines:
            return
        if self._size + len(lines) > self._max_bytes and self._size > self._header_end:
            self.close()
            self._shift()
        done = os.write(self.open(), lines)
        self._size += done
        self.unwritten = b""
        if done < len(lines):
            # A line that was cut is written again as a whole; read_log() skips the cut one, so no line counts twice.
            # A line that lacks only its line feed is not cut: open() ends it.
            self.unwritten = lines[lines.rfind(b"\n", 0, done + 1) + 1 :]
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def refuse_another(self) -> None:
        """Raise LogError if another drive writes the file: a reader could not tell their lines apart."""
        if not self._path.is_file():
            return
        with contextlib.suppress(PermissionError), self._path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise LogError(f"{self._path}: another drive writes this log", remedy="name another by --log") from None

    def open(self) -> int:
        """Return the open file. Opening it writes a header and starts a new part of the log."""
        if self._fd is not None:
            return self._fd
        path = self._path
        path.parent.mkdir(parents=True, exist_ok=True)
        header = _seal(self._header | {"part": self._part + 1})
        if path.is_file() and path.stat().st_size + len(header) > self._max_bytes:
            self._shift()
        fd = self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._size = os.fstat(fd).st_size
        if self._size and os.pread(fd, 1, self._size - 1) != b"\n":
            header = b"\n" + header  # ends a line that a power cut or a full disk has cut
        if os.write(fd, header) != len(header):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._size += len(header)
        self._header_end = len(header)
        self._part += 1
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)  # so that the name of a new file survives a power cut too
        finally:
            os.close(folder)
        return fd

    def sync(self) -> None:
        """Wait until what was written is on the disk."""
        os.fsync(self.open())

    def close(self) -> None:
        fd, self._fd = self._fd, None
        if fd is not None:
            with contextlib.suppress(OSError):
                os.close(fd)

    def _shift(self) -> None:
        """Rename the files so that `path` is free, and delete those beyond `keep`."""
        for old in _older(self._path):
            if int(old.suffix[1:]) >= self._keep:
                old.unlink()
            else:
                old.replace(_number_lines(self._path, int(old.suffix[1:]) + 1))
        if self._keep:
            self._path.replace(_number_lines(self._path, 1))
        else:
            self._path.unlink()


def _number_lines(path: Path, number: int) -> Path:
    return path.with_name(f"{path.name}.{number}")


def _older(path: Path) -> list[Path]:
    """Return path.N, ..., path.2, path.1: the oldest first."""
    found = [p for p in path.parent.glob(f"{glob.escape(path.name)}.*") if p.suffix[1:].isdecimal()]
    return sorted((p for p in found if p.stem == path.name), key=lambda p: -int(p.suffix[1:]))


@dataclass(frozen=True)
class Flight:
    """One drive, as read from its log.

    header: empty if it was damaged; header["drive"] is what the drive was started with. ticks: an array per field of
    Tick, (n,) float64 with NaN for "not known"; state and reason are text. machine: t_s and temperature_c, (m,)
    float64, and throttled, a list of texts and None. drive: its index among the `drives` of these files. damaged: how
    many lines were skipped in these files, of all drives together.
    """

    path: Path
    header: dict[str, Any]
    ticks: dict[str, np.ndarray]
    events: list[Event]
    machine: dict[str, Any]
    drive: int
    drives: int
    damaged: int

    @property
    def period_ms(self) -> float | None:
        """Time between two ticks by the header's hz, or else the median time between the ticks.

        None if the header has no hz and there are fewer than two ticks.
        """
        hz = self.header.get("drive", {}).get("hz")
        if isinstance(hz, (int, float)) and hz > 0:
            return 1000 / hz
        return float(np.median(np.diff(self.ticks["t_s"])) * 1000) if len(self.ticks["t_s"]) > 1 else None

    @property
    def car(self) -> Car:
        """The car that was driven, from the header; if that names none, the car of the original recordings.

        Raises CarError if the header's description is not one of a car.
        """
        described = self.header.get("drive", {}).get("car")
        return Car.of(described, f"{self.path}: its car") if described else Car()

    def summary(self) -> dict[str, Any]:
        """Return the drive in figures; a figure is None if nothing was measured.

        jitter: how late commands were. missed: deadlines without a tick; ticks that happened but are missing from the
        log do not count. plan_age is over the ticks that had a plan, latency over the plans.
        """
        ticks, period_ms = self.ticks, self.period_ms
        t_s, late_ms, plans = ticks["t_s"], ticks["late_ms"], ticks["plan"]
        _, first = np.unique(plans, return_index=True)  # the first tick of each plan
        latency_ms = ticks["latency_ms"][first][plans[first] > 0] if len(plans) else plans
        durations_s = np.diff(t_s, append=t_s[-1:] + (period_ms or 0) / 1000)
        states = {s.value: s.name.lower() for s in State} | {"": "not known"}
        throttled = next((v for v in reversed(self.machine["throttled"]) if v is not None), None)
        not_logged = sum(e.fields.get("ticks", 0) for e in self.events if e.text == MISSING)
        missed = None
        if period_ms:
            passed = np.rint(np.diff(t_s * 1000 - late_ms) / period_ms) - 1
            missed = max(0, int(passed[passed > 0].sum()) - not_logged)
        return {
            "start": self.header.get("start"),
            "seconds": float(t_s[-1] - t_s[0]) if len(t_s) else 0.0,
            "ticks": len(t_s),
            "missed": missed,
            "jitter_p50_ms": _percentile(late_ms, 50),
            "jitter_p99_ms": _percentile(late_ms, 99),
            "jitter_max_ms": _percentile(late_ms, 100),
            "plans": len(latency_ms),
            "plan_age_p95_ms": _percentile(ticks["plan_age_ms"], 95),
            "latency_p50_ms": _percentile(latency_ms, 50),
            "latency_p95_ms": _percentile(latency_ms, 95),
            "seconds_in": {
                states.get(str(s), str(s)): float(durations_s[ticks["state"] == s].sum())
                for s in np.unique(ticks["state"])
            },
            "temperature_max_c": _percentile(self.machine["temperature_c"], 100),
            "throttled": throttled,
            "throttled_means": throttled_means(throttled),
            "events": [{"t_s": e.t_s, "event": e.text, **e.fields} for e in self.events],
            "ticks_not_logged": not_logged,
            "drive": self.drive,
            "drives": self.drives,
            "damaged_lines": self.damaged,
        }


def _percentile(values: np.ndarray, q: float) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.percentile(values, q)) if len(values) else None


class _Drive:
    """One drive while it is read."""

    def __init__(self, header: dict[str, Any]):
        self.header = header
        self.ticks: list[list[Any]] = []
        self.events: list[Event] = []
        self.machine: list[dict[str, Any]] = []

    def begins(self, header: dict[str, Any]) -> bool:
        """Whether `header` begins another drive, and not just the next file of this one."""
        return any(header.get(key) != self.header.get(key) for key in ("start", "start_monotonic_s"))

    def goes_on(self, t_s: float) -> bool:
        return not self.ticks or t_s > self.ticks[-1][0] - BACK_S

    def split(self) -> "list[_Drive]":
        """Split the log of a service into its drives, from each arming to the next.

        What came before the first arming belongs to the first drive.
        """
        armed_s = [e.t_s for e in self.events if e.text == ARMED][1:]
        parts = []
        for since_s, until_s in pairwise([-math.inf, *sorted(armed_s), math.inf]):
            part = _Drive(self.header)
            part.ticks = [t for t in self.ticks if since_s <= t[0] < until_s]
            part.events = [e for e in self.events if since_s <= e.t_s < until_s]
            part.machine = [m for m in self.machine if since_s <= m["t_s"] < until_s]
            parts.append(part)
        return parts


def read_log(path: Path | str, drive: int = -1) -> Flight:
    """Read a flight log, with the older files path.1, path.2, ... that belong to it.

    drive: index of the drive in these files: 0 is the first, -1 the last. Raises LogError if the file is missing or not
    a plain file, holds no line of a flight log, has no such drive, or was written in another version of the format.
    """
    path = Path(path)
    try:
        files = [read_plain(p) for p in (*_older(path), path)]
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})", remedy=NAME_A_LOG) from error
    drives: list[_Drive] = []
    damaged = 0
    lines = [line for data in files for line in data.split(b"\n") if line]
    for line in lines:
        row = _row(line)
        if row is None:
            damaged += 1
            continue
        if isinstance(row, dict) and row["kind"] == "header":
            if not drives or drives[-1].begins(row):
                drives.append(_Drive(row))
            continue
        if not drives or (isinstance(row, list) and not drives[-1].goes_on(row[0])):
            drives.append(_Drive({}))  # its header was damaged
        if isinstance(row, list):
            drives[-1].ticks.append(row)
        elif isinstance(row, Event):
            drives[-1].events.append(row)
        elif row["kind"] == "machine":
            drives[-1].machine.append(row)
    drives = [part for drive_ in drives for part in drive_.split()]
    if not drives:
        raise LogError(f"{path}: no line of a flight log in it, {damaged} of something else", remedy=NAME_A_LOG)
    if not -len(drives) <= drive < len(drives):
        raise LogError(
            f"{path}: no drive {drive}, it has {len(drives)}", remedy=f"choose from 0 to {len(drives) - 1}, or -1"
        )
    chosen = drives[drive]
    if chosen.header.get("schema", SCHEMA) != SCHEMA:
        raise LogError(f"{path}: of version {chosen.header['schema']}, this program reads {SCHEMA}", remedy="update it")
    columns = zip(*chosen.ticks, strict=True) if chosen.ticks else [()] * len(Tick._fields)
    return Flight(
        path=path,
        header=chosen.header,
        ticks={n: np.array(c, str if n in _TEXTS else float) for n, c in zip(Tick._fields, columns, strict=True)},
        events=sorted(chosen.events, key=lambda e: e.t_s),
        machine={
            "t_s": np.array([m["t_s"] for m in chosen.machine], float),
            "temperature_c": np.array([m["temperature_c"] for m in chosen.machine], float),  # None becomes NaN
            "throttled": [m["throttled"] for m in chosen.machine],
        },
        drive=drive % len(drives),
        drives=len(drives),
        damaged=damaged,
    )


def _row(line: bytes) -> list[Any] | Event | dict[str, Any] | None:
    """Parse a line: a tick's values, an event, or the members of another JSON row. Return None if it is damaged."""
    try:
        if line.startswith(b"{"):
            body, _, crc = line.rpartition(b',"crc":"')
            if crc != b'%04X"}' % binascii.crc_hqx(body, 0):
                return None
            return _json_row(json.loads(body + b"}"))
        body, _, crc = line.rpartition(b",")
        if crc != b"%04X" % binascii.crc_hqx(body, 0):
            return None
        texts = dict(zip(Tick._fields, body.decode().split(","), strict=True))
        _time_of({"t_s": float(texts["t_s"])})
        return [text if name in _TEXTS else _number_of(text) for name, text in texts.items()]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None


def _number_of(text: str) -> float:
    """Parse a tick's value; NaN means "not known"."""
    value = float(text) if text else math.nan
    return value if math.isfinite(value) else math.nan


def _time_of(row: dict[str, Any]) -> float:
    t_s = row["t_s"]
    if not is_number(t_s):
        raise ValueError("no time")
    return float(t_s)


def _json_row(row: dict[str, Any]) -> Event | dict[str, Any]:
    """Check the row of an undamaged JSON line. Raises an error that _row() catches if no log has such a row."""
    match row["kind"], row:
        case "event", {"event": str(text), "fields": dict(fields)}:
            if text == MISSING and not isinstance(fields.get("ticks"), int):
                raise ValueError("no count")
            return Event(_time_of(row), text, fields)
        case "machine", {"temperature_c": int() | float() | None as temperature_c, "throttled": str() | None as bits}:
            if bits is not None and not THROTTLED_VALUE.fullmatch(bits):
                raise ValueError("no bits")
            known = {} if temperature_c is None else {"temperature_c": float(temperature_c)}
            return {**row, "t_s": _time_of(row), **known}
        case "header", _ if isinstance(row.get("drive", {}), dict):
            return row
        case "event" | "machine" | "header", _:
            raise ValueError("its members are others")
    return row  # a kind that a later version may write
