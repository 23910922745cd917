"""The flight log on good and bad disks, and what is read back from whole and damaged files."""

import binascii
import json
import logging
import math
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from needs import until

from rover_lib.onboard.drive import flight_log as telemetry
from rover_lib.onboard.drive.flight_log import FlightLog, LogError, Tick, read_log
from rover_lib.onboard.errors import ParamsError

LIMITS = {"max_bytes": 1_000_000, "keep": 2}
HEADER = {"hz": 30, "fade_s": 0.5, "stop_s": 1.0}


def tick(number, t_s=None, **changes):
    row = Tick(
        t_s=number / 30 if t_s is None else t_s, late_ms=0.25, state="A", reason="a", steering=-0.5, throttle=0.05,
        steering_us=1204, throttle_us=150, pins_steering_us=1204, pins_throttle_us=148, plan=1 + number // 8,
        plan_age_ms=150.0 + number % 8 * 33.3, latency_ms=152.5, fade=1.0, frame=number,
    )  # fmt: skip
    return row._replace(**changes)


def write(path, ticks=(), host=None, **options):
    with FlightLog(path, header=HEADER, **LIMITS | options, host=host) as log:
        for row in ticks:
            log.tick(row)
    return log


@pytest.fixture
def path(tmp_path):
    return tmp_path / "flight.log"


# ---- what is written


def test_what_goes_in_comes_out(path, pi_host):
    log = write(
        path,
        [
            tick(0, state="", reason="", plan=0, plan_age_ms=None, latency_ms=None, pins_steering_us=None),
            tick(1, steering=np.float32(0.25), steering_us=np.int64(1500)),
        ],
        host=pi_host,
    )
    assert (log.failures, log.last_error, log.dropped) == (0, None, 0)
    flight = read_log(path)
    assert flight.header["drive"] == HEADER
    assert flight.header["columns"] == [*Tick._fields, "crc"]
    assert list(flight.ticks) == list(Tick._fields)
    assert flight.ticks["state"].tolist() == ["", "A"]
    assert flight.ticks["t_s"] == pytest.approx([0, 1 / 30], abs=1e-4)
    assert flight.ticks["steering"].tolist() == [-0.5, 0.25]
    assert flight.ticks["steering_us"].tolist() == [1204, 1500]
    assert np.isnan(flight.ticks["plan_age_ms"]).tolist() == [True, False]
    assert np.isnan(flight.ticks["pins_steering_us"]).tolist() == [True, False]
    assert flight.machine["temperature_c"].tolist() == [61.35]
    assert flight.machine["throttled"] == ["0x50000"]
    assert (flight.drive, flight.drives, flight.damaged, flight.events) == (0, 1, 0, [])


def test_each_line_can_be_read_without_this_program(path):
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        log.tick(tick(12345, throttle=0.0912, latency_ms=1520.4, plan_age_ms=1520.4, late_ms=10.123))
        log.event("camera unplugged", frame=812)
    lines = path.read_text().splitlines()
    rows = [json.loads(line) for line in lines if line.startswith("{")]
    assert [r["kind"] for r in rows] == ["header", "machine", "event"]
    assert rows[2]["event"] == "camera unplugged"
    (row,) = (line for line in lines if not line.startswith("{"))
    assert len(row) <= 110
    assert dict(zip(rows[0]["columns"], row.split(","), strict=True))["latency_ms"] == "1520.4"


def test_events_have_their_time_and_go_to_logging_too(path, caplog):
    now = [100.0]
    with caplog.at_level("INFO", "rover"), FlightLog(path, header=HEADER, **LIMITS, clock=lambda: now[0]) as log:
        now[0] = 102.5
        log.event(
            "camera unplugged", level=logging.WARNING, frame=np.int64(812), age=float("nan"), what=ValueError("x")
        )
        log.event("new plan")
    (first, second) = read_log(path).events
    assert first == (2.5, "camera unplugged", {"frame": 812, "age": None, "what": "x"})
    assert second == (2.5, "new plan", {})
    assert [(r.levelname, r.message.split(";")[0]) for r in caplog.records] == [
        ("WARNING", "camera unplugged"),
        ("INFO", "new plan"),
    ]


def test_a_second_drive_into_one_log_is_refused(path):
    """The reader gave 127 of 900 ticks: it cannot tell two drives' lines apart."""
    with FlightLog(path, header=HEADER, **LIMITS, flush_s=0.01) as log:
        until(lambda: path.exists() and path.stat().st_size)
        with pytest.raises(LogError, match="another drive writes this log"), FlightLog(path, header=HEADER, **LIMITS):
            pytest.fail("it was let in")
        log.tick(tick(0))
    write(path, [tick(0)])  # and then it is free


def test_without_a_file_events_are_still_said(caplog):
    with FlightLog(None, header=HEADER, **LIMITS) as log:
        for k in range(10):
            log.tick(tick(k))
        log.event("camera unplugged", level=logging.WARNING)
    assert [r.message for r in caplog.records] == ["camera unplugged"]
    assert not log._ticks


@pytest.mark.slow
def test_a_power_cut_costs_less_than_a_second(path):
    code = (
        "import sys, time, os, signal\n"
        "from rover_lib.onboard.drive.flight_log import FlightLog, Tick\n"
        f"log = FlightLog(sys.argv[1], header={{}}, **{LIMITS}).__enter__()\n"
        "while (t := time.monotonic() - log.start_s) < 1.5:\n"
        f"    log.tick(Tick(*(t, *{tuple(tick(0))[1:]})))\n"
        "    time.sleep(0.01)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(path)])
    assert ended.returncode == -signal.SIGKILL
    assert read_log(path).ticks["t_s"][-1] > 0.9  # 1.5 less flush_s and what a busy machine adds


def test_the_log_is_synced(path, monkeypatch):
    synced = []
    monkeypatch.setattr(telemetry.os, "fsync", lambda fd: synced.append(os.fstat(fd).st_size))
    with FlightLog(path, header=HEADER, **LIMITS, flush_s=0.05) as log:
        log.tick(tick(0))
        until(lambda: path.exists() and path.stat().st_size in synced and len(read_log(path).ticks["t_s"]) == 1)


@pytest.mark.parametrize("bad", [{"max_bytes": 100}, {"keep": -1}, {"flush_s": 0}, {"flush_s": 2}])
def test_limits_that_make_no_sense(path, bad):
    with pytest.raises(ParamsError, match="flight log needs"):
        FlightLog(path, header=HEADER, **LIMITS | bad)


@pytest.mark.parametrize(
    "bad", ["max_mb: '8'", "max_mb: .nan", "max_mb: null", "max_mb: 51", "keep: 1.5", "keep: many"]
)
def test_limits_of_params_that_make_no_sense(tmp_path, monkeypatch, bad):
    (tmp_path / "params.yml").write_text(f"flight_log: {{{bad}}}")
    monkeypatch.setenv("ROVER_PARAMS", str(tmp_path / "params.yml"))
    with pytest.raises(ParamsError, match="flight_log: max_mb must be a number up to 50, and keep a whole one, found"):
        telemetry.log_limits()


# ---- rotation


def test_files_are_bounded_and_each_can_be_read_alone(path):
    (path.parent / "flight.log.7").write_text("of a time when more were kept")
    (path.parent / "flight.log.old").write_text("somebody's")
    with FlightLog(path, header=HEADER, max_bytes=20_000, keep=2) as log:
        for k in range(1600):
            log.tick(tick(k))
        log.event("x" * 30_000, y="z" * 30_000)
    assert sorted(p.name for p in path.parent.iterdir()) == [
        "flight.log", "flight.log.1", "flight.log.2", "flight.log.old",
    ]  # fmt: skip
    assert log.failures == 0
    parts = []
    for name in ("flight.log.2", "flight.log.1", "flight.log"):
        assert path.with_name(name).stat().st_size <= 20_000
        alone = path.parent / "alone.log"
        alone.write_bytes(path.with_name(name).read_bytes())
        part = read_log(alone)
        assert part.header["drive"] == HEADER
        parts.append(part.ticks["frame"])
    whole = read_log(path)
    assert (whole.drives, whole.damaged) == (1, 0)
    assert whole.ticks["frame"].tolist() == list(range(int(parts[0][0]), 1600))
    assert whole.ticks["frame"].tolist() == np.concatenate(parts).tolist()
    assert len(whole.ticks["frame"]) > 400


def test_nothing_older_is_kept_if_so_asked(path):
    write(path, map(tick, range(900)), max_bytes=20_000, keep=0)
    assert [p.name for p in path.parent.iterdir()] == ["flight.log"]
    assert read_log(path).ticks["frame"][-1] == 899


# ---- one file, many drives


def test_drives_are_appended_and_chosen(path):
    for k in range(3):
        write(path, [tick(k)])
    for drive, frame in ((-1, 2), (0, 0), (1, 1), (-3, 0)):
        flight = read_log(path, drive)
        assert (flight.drives, flight.drive, flight.ticks["frame"].tolist()) == (3, frame, [frame])
    with pytest.raises(LogError, match=r"no drive 3, it has 3; choose from 0 to 2"):
        read_log(path, 3)


def test_a_drive_after_a_power_cut(path):
    write(path, map(tick, range(5)))
    path.write_bytes(path.read_bytes()[:-9])
    write(path, [tick(7)])
    assert read_log(path).ticks["frame"].tolist() == [7]
    flight = read_log(path, 0)
    assert flight.ticks["frame"].tolist() == [0, 1, 2, 3]
    assert flight.damaged == 1


def test_a_damaged_header_does_not_mix_two_drives(path):
    write(path, map(tick, range(60)))
    first = path.read_bytes()
    write(path, map(tick, range(3)))
    second = path.read_bytes()[len(first) :]
    path.write_bytes(first + second[:20] + b"\0" + second[21:])
    flight = read_log(path)
    assert (flight.drives, flight.damaged, flight.header) == (2, 1, {})
    assert flight.ticks["frame"].tolist() == [0, 1, 2]
    assert flight.summary()["ticks"] == 3
    assert len(read_log(path, 0).ticks["frame"]) == 60


# ---- damage


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("good") / "flight.log"
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        for k in range(40):
            log.tick(tick(k))
        log.event("armed", who="host")
    return path.read_bytes()


def read_bytes(data, folder):
    path = folder / "damaged.log"
    path.write_bytes(data)
    return read_log(path)


@given(data=st.binary(max_size=400))
def test_random_bytes_are_no_log(tmp_path_factory, data):
    with pytest.raises(LogError, match="no line of a flight log"):
        read_bytes(data, tmp_path_factory.getbasetemp())


@given(st.data())
def test_a_cut_log_gives_what_is_whole(tmp_path_factory, good, data):
    end = data.draw(st.integers(good.index(b"\n") + 1, len(good)))
    flight = read_bytes(good[:end], tmp_path_factory.getbasetemp())
    whole = [line for line in good[:end].split(b"\n")[1:-1] if not line.startswith(b"{")]
    found = flight.ticks["frame"].tolist()
    # A line of which only the end-of-line is missing may count too.
    assert found[: len(whole)] == list(range(len(whole)))
    assert len(found) <= len(whole) + 1
    assert flight.damaged <= 1


@pytest.mark.slow
@given(st.data())
def test_damaged_lines_are_skipped_and_counted(tmp_path_factory, good, data):
    lines = good.splitlines(keepends=True)
    hit = data.draw(st.sets(st.integers(1, len(lines) - 1), max_size=8))
    damaged, frames = list(lines), []
    for k, line in enumerate(lines):
        if k in hit:
            at = data.draw(st.integers(0, len(line) - 2))
            new = data.draw(st.integers(0, 255).filter(lambda v, old=line[at]: v not in (old, 10)))
            damaged[k] = line[:at] + bytes([new]) + line[at + 1 :]
        elif not line.startswith(b"{"):
            frames.append(int(line.split(b",")[-2]))
    flight = read_bytes(b"".join(damaged), tmp_path_factory.getbasetemp())
    assert flight.ticks["frame"].tolist() == frames
    assert flight.damaged == len(hit)


@given(junk=st.lists(st.binary(max_size=200), max_size=5), at=st.integers(1, 30))
def test_bytes_between_lines_do_not_matter(tmp_path_factory, good, junk, at):
    lines = good.splitlines(keepends=True)
    noisy = b"".join(lines[:at]) + b"\n".join(junk) + b"\n" + b"".join(lines[at:])
    flight = read_bytes(noisy, tmp_path_factory.getbasetemp())
    assert flight.ticks["frame"].tolist() == list(range(40))
    assert flight.damaged == sum(bool(part) for j in junk for part in j.split(b"\n"))


def test_what_is_no_log(tmp_path):
    with pytest.raises(LogError, match=r"nothing\.log: cannot be read \(No such file"):
        read_log(tmp_path / "nothing.log")
    with pytest.raises(LogError, match="cannot be read"):
        read_log(tmp_path)
    other = tmp_path / "new.log"
    other.write_bytes(telemetry._seal({"schema": 2, "kind": "header", "start": "x"}))
    with pytest.raises(LogError, match="of version 2, this program reads 1"):
        read_log(other)


ROWS = {  # with a right checksum, and no lines of a flight log all the same
    "no kind": {},
    "a machine without a time": {"kind": "machine"},
    "a temperature in words": {"kind": "machine", "t_s": 1, "temperature_c": "hot", "throttled": None},
    "a temperature beyond all": {"kind": "machine", "t_s": 1, "temperature_c": 10**400, "throttled": None},
    "throttling in words": {"kind": "machine", "t_s": 1, "temperature_c": None, "throttled": "hot"},
    "an event at no time": {"kind": "event", "t_s": "x", "event": "a", "fields": {}},
    "an event at the end of time": {"kind": "event", "t_s": 10**400, "event": "a", "fields": {}},
    "an event without fields": {"kind": "event", "t_s": 1, "event": "a", "fields": []},
    "a gap of no size": {"kind": "event", "t_s": 1, "event": telemetry.MISSING, "fields": {"ticks": "many"}},
    "a header of no drive": {"kind": "header", "drive": [1]},
}


@pytest.mark.parametrize("what", ROWS)
def test_a_line_of_another_form_is_skipped(tmp_path, good, what):
    flight = read_bytes(good + telemetry._seal(ROWS[what]), tmp_path)
    assert flight.damaged == 1 and flight.summary()["ticks"] == 40


def sealed(body):
    return b'%s,"crc":"%04X"}\n' % (body, binascii.crc_hqx(body, 0))


def test_a_line_that_is_nested_without_end_is_skipped(tmp_path, good):
    assert read_bytes(good + sealed(b'{"kind":"x","y":' + b"[" * 200_000 + b"]" * 200_000), tmp_path).damaged == 1


@pytest.mark.parametrize(
    ("change", "damaged"), [({"t_s": math.nan}, 1), ({"t_s": math.inf}, 1), ({"late_ms": math.inf}, 0)]
)
def test_a_tick_that_is_not_finite(tmp_path, good, change, damaged):
    flight = read_bytes(good + telemetry._tick_line(tick(40, **change)), tmp_path)
    assert flight.damaged == damaged and flight.summary()["jitter_max_ms"] == 0.25


def test_a_pipe_is_not_waited_for(path):
    os.mkfifo(path)
    with pytest.raises(LogError, match="not a file"):
        read_log(path)


# ---- bad disks


def test_a_full_disk_is_said_once_and_logging_goes_on_when_it_has_room(path, caplog, monkeypatch):
    monkeypatch.setattr(telemetry, "RETRY_S", 0.05)
    path.symlink_to("/dev/full")
    with FlightLog(path, header=HEADER, **LIMITS, flush_s=0.02) as log:
        for k in range(20):
            log.tick(tick(k))
        until(lambda: log.failures >= 3)
        assert "No space left" in log.last_error
        path.unlink()
        until(path.is_file)
        log.tick(tick(20))
    flight = read_log(path)
    assert flight.ticks["frame"].tolist() == list(range(21))
    assert [e.text for e in flight.events] == ["the flight log is written again"]
    said = [r.message for r in caplog.records]
    assert sum("cannot be written (OSError: [Errno 28]" in s for s in said) == 1
    assert sum("written again" in s for s in said) == 1
    assert len(said) == 2


def test_a_disk_that_takes_half_a_line(path, monkeypatch):
    """The kernel's own limit on a file's size: it takes what fits, then nothing."""
    monkeypatch.setattr(telemetry, "RETRY_S", 0.02)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        with FlightLog(path, header=HEADER, **LIMITS, flush_s=0.02) as log:
            until(lambda: path.exists() and b"machine" in path.read_bytes())
            resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 1000, before[1]))
            for k in range(40):
                log.tick(tick(k))
            until(lambda: log.failures >= 2)
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    flight = read_log(path)
    assert flight.ticks["frame"].tolist() == list(range(40))  # none lost, none twice
    assert (flight.drives, flight.damaged) == (1, 1)


@pytest.mark.parametrize("end", ["first", "last"])
def test_a_disk_that_takes_a_line_without_its_end(path, monkeypatch, end):
    monkeypatch.setattr(telemetry, "RETRY_S", 0.02)
    whole_write, cut = os.write, []

    def cut_write(fd, data):
        if not cut and b",A,a," in data:
            cut.append(data)
            data = data[: data.index(b"\n") if end == "first" else -1]
        return whole_write(fd, data)

    monkeypatch.setattr(os, "write", cut_write)
    with FlightLog(path, header=HEADER, **LIMITS, flush_s=0.1) as log:
        for k in range(10):
            log.tick(tick(k))
        until(lambda: log.failures == 1)
    flight = read_log(path)
    assert flight.ticks["frame"].tolist() == list(range(10))  # none lost, none twice
    assert (flight.drives, flight.damaged) == (1, 0)


def test_ticks_that_were_not_logged_are_not_missed(path, monkeypatch):
    monkeypatch.setattr(telemetry, "QUEUE_TICKS", 50)
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        log.tick(tick(0))
        until(lambda: path.exists() and b",A,a," in path.read_bytes())
        for k in range(1, 201):
            log.tick(tick(k))
    flight = read_log(path)
    assert flight.ticks["frame"].tolist() == [0, *range(151, 201)]
    assert [(e.text, e.t_s) for e in flight.events] == [(telemetry.MISSING, pytest.approx(151 / 30, abs=1e-3))]
    found = flight.summary()
    assert (found["ticks_not_logged"], found["missed"]) == (150, 0)


def test_a_row_that_is_none_is_left_out(path, caplog):
    log = write(path, [tick(0), tick(1, throttle="full"), (1, 2), None, tick(4)])
    assert read_log(path).ticks["frame"].tolist() == [0, 4]
    assert log.failures == 3
    assert len(caplog.records) == 1
    assert "a row is not in the flight log: ValueError" in caplog.text


def test_a_writer_that_raises_anything_goes_on(path, monkeypatch):
    monkeypatch.setattr(telemetry, "RETRY_S", 0.02)
    broken = threading.Event()
    broken.set()

    class Odd:
        vcgencmd = "none"

        def temperature_c(self):
            if broken.is_set():
                raise RuntimeError("who knows")

    with FlightLog(path, header=HEADER, **LIMITS, flush_s=0.02, host=Odd()) as log:
        log.tick(tick(0))
        until(lambda: log.failures >= 1)
        broken.clear()
        until(lambda: path.exists() and b",A,a," in path.read_bytes())
    assert log.last_error == "RuntimeError: who knows"


def test_a_stuck_disk_holds_up_neither_the_loop_nor_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr(telemetry, "CLOSE_S", 0.2)
    go_on = threading.Event()
    monkeypatch.setattr(telemetry.os, "fsync", lambda fd: go_on.wait(10))
    start = time.monotonic()
    try:
        with FlightLog(tmp_path / "flight.log", header=HEADER, **LIMITS, flush_s=0.01) as log:
            for k in range(5000):
                log.tick(tick(k))
        assert time.monotonic() - start < 2
        assert len(log._ticks) <= telemetry.QUEUE_TICKS
    finally:
        go_on.set()
        log._threads[-1].join()


@contextmanager
def handler_of(logger, emit):
    handler = logging.Handler()
    handler.emit = emit
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def test_a_logger_that_is_stuck_or_raises_does_not_matter(path, monkeypatch):
    monkeypatch.setattr(telemetry, "CLOSE_S", 0.5)
    logger, go_on = logging.getLogger("rover"), threading.Event()

    said = []

    def fail(record):
        said.append(record.getMessage())
        raise RuntimeError("a handler's fault")

    with handler_of(logger, fail), FlightLog(path, header=HEADER, **LIMITS) as log:
        log.event("one", level=logging.WARNING)
        until(lambda: said == ["one"])
        log.event("and another", level=logging.WARNING)
    assert said == ["one", "and another"]
    with handler_of(logger, lambda record: go_on.wait(10)), FlightLog(path, header=HEADER, **LIMITS) as log:
        start = time.monotonic()
        for _ in range(1000):
            log.event("two", level=logging.WARNING)
        assert time.monotonic() - start < 0.5
        log.tick(tick(0))
        log.close()
        assert time.monotonic() - start < 2
        go_on.set()
    assert [e.text for e in read_log(path, 0).events] == ["one", "and another"]
    assert len(read_log(path).events) == telemetry.QUEUE_EVENTS
    assert len(read_log(path).ticks["t_s"]) == 1


# ---- the summary


def test_summary(path, pi_host):
    late_ms = [0.1] * 97 + [30.0, 4.5, 1.0]
    rows = [
        tick(
            k,
            t_s=(k + 3 * (k > 50)) / 30 + late / 1000,  # three were missed
            late_ms=late,
            state="" if k < 10 else "A" if k < 70 else "M",
            plan=k // 10,
            latency_ms=None if k < 10 else 100.0 + k // 10,
            plan_age_ms=None if k < 10 else float(k),
        )
        for k, late in enumerate(late_ms)
    ]
    write(path, rows, host=pi_host)
    found = read_log(path).summary()
    json.dumps(found, allow_nan=False)
    assert (found["ticks"], found["missed"], found["plans"]) == (100, 3, 9)
    assert found["jitter_p50_ms"] == 0.1
    assert found["jitter_max_ms"] == 30.0
    assert found["plan_age_p95_ms"] == pytest.approx(np.percentile(np.arange(10, 100), 95))
    assert (found["latency_p50_ms"], found["latency_p95_ms"]) == (105.0, pytest.approx(108.6))
    assert found["seconds"] == pytest.approx(3.4009)
    assert found["seconds_in"] == pytest.approx({"not known": 1 / 3, "autonomous": 2.1, "manual": 1.0}, abs=2e-3)
    assert found["temperature_max_c"] == 61.35
    assert found["throttled_means"] == ["under-voltage since the start", "throttled since the start"]


def test_summary_of_a_drive_without_ticks(path):
    write(path)
    found = read_log(path).summary()
    assert (found["ticks"], found["missed"], found["seconds"], found["plans"]) == (0, 0, 0, 0)
    assert found["jitter_p50_ms"] is found["plan_age_p95_ms"] is found["temperature_max_c"] is None
