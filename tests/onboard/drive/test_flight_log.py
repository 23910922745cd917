"""The flight log on good and bad disks, and what is read back from complete and damaged files."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from needs import until

from rover_lib.onboard.drive import flight_log as module
from rover_lib.onboard.drive.flight_log import FlightLog, Tick, read_log
from rover_lib.onboard.errors import ParamsError, RoverError

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


@pytest.fixture
def quick(monkeypatch):
    """The writing thread writes, and tries again, at once."""
    monkeypatch.setattr(module, "SYNC_S", 0.01)
    monkeypatch.setattr(module, "RETRY_S", 0.01)


# ---- what is written


def test_what_goes_in_comes_out(path, pi_host):
    unknown = tick(0, state="", reason="", plan=0, plan_age_ms=None, latency_ms=None, pins_steering_us=None)
    write(path, [unknown, tick(1, steering=np.float32(0.25), steering_us=np.int64(1500))], host=pi_host)
    flight = read_log(path)
    assert flight.header["drive"] == HEADER
    assert flight.header["columns"] == list(flight.ticks) == list(Tick._fields)
    assert flight.ticks["state"].tolist() == ["", "A"]
    assert flight.ticks["t_s"] == pytest.approx([0, 1 / 30], abs=1e-4)
    assert flight.ticks["steering"].tolist() == [-0.5, 0.25]
    assert flight.ticks["steering_us"].tolist() == [1204, 1500]
    for unknown in ("plan_age_ms", "pins_steering_us"):
        assert np.isnan(flight.ticks[unknown]).tolist() == [True, False]
    assert flight.machine["temperature_c"].tolist() == [61.35] and flight.machine["throttled"] == ["0x50000"]
    assert (flight.drive, flight.drives, flight.damaged, flight.events) == (0, 1, 0, [])


def test_each_line_can_be_read_without_this_program(path):
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        log.tick(tick(12345, throttle=0.0912, latency_ms=1520.4, plan_age_ms=1520.4, late_ms=10.123))
        log.event("camera unplugged", frame=812)
    header, machine, row, event = map(json.loads, path.read_text().splitlines())
    assert [r["kind"] for r in (header, machine, event)] == ["header", "machine", "event"]
    assert dict(zip(header["columns"], row, strict=True))["latency_ms"] == 1520.4
    assert event["fields"] == {"frame": 812}


def test_events_have_their_time_and_go_to_logging_too(path, caplog):
    now = [100.0]
    with caplog.at_level("INFO", "rover"), FlightLog(path, header=HEADER, **LIMITS, clock=lambda: now[0]) as log:
        now[0] = 102.5
        fields = {"frame": np.int64(812), "age": float("nan"), "what": ValueError("x")}
        log.event("camera unplugged", level=logging.WARNING, **fields)
        log.event("x" * 3000, details="y" * 3000)
    first, second = read_log(path).events
    assert first == (2.5, "camera unplugged", {"frame": 812, "age": None, "what": "x"})
    assert len(str(second)) < 2000  # a file is bounded, a traceback is not
    assert [r.levelname for r in caplog.records] == ["WARNING", "INFO"]


def test_a_second_drive_into_one_log_is_refused_at_once(path):
    """The reader cannot tell two drives' lines apart; the first 0.5 s were not guarded."""
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        with pytest.raises(RoverError, match="another drive"), FlightLog(path, header=HEADER, **LIMITS):
            pytest.fail("it was let in")
        log.tick(tick(0))
    write(path, [tick(1)])  # and then it is free
    assert read_log(path).drives == 2


def test_it_stays_locked_after_a_rotation(path, quick):
    with FlightLog(path, header=HEADER, max_bytes=2000, keep=1) as log:
        for k in range(100):
            log.tick(tick(k))
        until(lambda: path.with_name("flight.log.1").exists())
        with pytest.raises(RoverError, match="another drive"), FlightLog(path, header=HEADER, **LIMITS):
            pytest.fail("it was let in")


def test_without_a_file_events_are_still_said(caplog):
    with FlightLog(None, header=HEADER, **LIMITS) as log:
        log.tick(tick(0))
        log.event("camera unplugged", level=logging.WARNING)
    assert [r.message for r in caplog.records] == ["camera unplugged"] and not log._rows


@pytest.mark.slow
def test_a_power_cut_costs_a_second(path):
    code = (
        "import sys, time, os, signal\n"
        "from rover_lib.onboard.drive.flight_log import FlightLog, Tick\n"
        f"log = FlightLog(sys.argv[1], header={{}}, **{LIMITS}).__enter__()\n"
        "while (t := time.monotonic() - log.start_s) < 1.8:\n"
        f"    log.tick(Tick(*(t, *{tuple(tick(0))[1:]})))\n"
        "    time.sleep(0.01)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(path)])
    assert ended.returncode == -signal.SIGKILL
    assert read_log(path).ticks["t_s"][-1] > 0.8


def test_the_log_is_synced_with_what_it_has(path, monkeypatch, quick):
    synced = []
    monkeypatch.setattr(module.os, "fsync", lambda file: synced.append(os.fstat(file.fileno()).st_size))
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        log.tick(tick(0))
        until(path.exists)
        until(lambda: path.stat().st_size in synced and len(read_log(path).ticks["t_s"]) == 1)
    assert module.SYNC_S < 1


@pytest.mark.parametrize("bad", ["max_mb: '8'", "max_mb: .nan", "max_mb: 51", "max_mb: 0", "keep: 1.5", "keep: -1"])
def test_limits_of_params_that_make_no_sense(tmp_path, monkeypatch, bad):
    (tmp_path / "params.yml").write_text(f"flight_log: {{{bad}}}")
    monkeypatch.setenv("ROVER_PARAMS", str(tmp_path / "params.yml"))
    with pytest.raises(ParamsError, match="flight_log"):
        module.log_limits()


# ---- one file, many drives; a drive in many files


@pytest.mark.parametrize("keep", [0, 2])
def test_files_are_bounded_and_each_can_be_read_alone(path, keep):
    write(path, map(tick, range(1600)), max_bytes=20_000, keep=keep)
    files = [path.with_name(f"flight.log.{k}") for k in range(keep, 0, -1)] + [path]
    assert sorted(path.parent.glob("flight*")) == sorted(files)
    parts = []
    for file in files:
        assert file.stat().st_size <= 20_200
        (alone := path.parent / "alone.log").write_bytes(file.read_bytes())
        parts.append(read_log(alone).ticks["frame"])
        alone.unlink()
    flight = read_log(path)
    assert (flight.drives, flight.damaged, flight.header["drive"]) == (1, 0, HEADER)
    assert flight.ticks["frame"].tolist() == list(range(int(parts[0][0]), 1600)) == np.concatenate(parts).tolist()


def test_drives_are_appended_and_chosen(path):
    for k in range(3):
        write(path, [tick(k)])
    for drive, frame in ((-1, 2), (0, 0), (1, 1), (-3, 0)):
        flight = read_log(path, drive)
        assert (flight.drives, flight.drive, flight.ticks["frame"].tolist()) == (3, drive % 3, [frame])
    with pytest.raises(RoverError, match="no drive 3"):
        read_log(path, 3)


def test_a_services_log_has_a_drive_for_each_arming(path):
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        for k in range(3):
            log.event("not armed: no transmitter")
            log.event(module.ARMED)
            log.tick(tick(k))
    for k in range(3):
        flight = read_log(path, k)
        assert (flight.drives, flight.ticks["frame"].tolist()) == (3, [k])


def test_a_drive_after_a_power_cut(path):
    write(path, map(tick, range(5)))
    path.write_bytes(path.read_bytes()[:-9])
    write(path, [tick(7)])
    assert read_log(path).ticks["frame"].tolist() == [7]
    flight = read_log(path, 0)
    assert (flight.ticks["frame"].tolist(), flight.damaged) == ([0, 1, 2, 3], 1)


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
    with pytest.raises(RoverError):
        read_bytes(data, tmp_path_factory.getbasetemp())


@given(st.data())
def test_a_cut_log_gives_what_is_complete(tmp_path_factory, good, data):
    end = data.draw(st.integers(good.index(b"\n") + 1, len(good)))
    flight = read_bytes(good[:end], tmp_path_factory.getbasetemp())
    complete = [line for line in good[:end].split(b"\n")[:-1] if line.startswith(b"[")]
    found = flight.ticks["frame"].tolist()
    # A line of which only the end-of-line is missing may count too.
    assert found[: len(complete)] == list(range(len(complete))) and len(found) <= len(complete) + 1
    assert flight.damaged <= 1


TICK = [0.1, 0.2, "A", "a", 0, 0, 1456, 120, None, None, 0, None, None, 1, 0]
NO_ROWS = {
    "not a row": "7",
    "without a kind": {},
    "a machine without a time": {"kind": "machine"},
    "a temperature in words": {"kind": "machine", "t_s": 1, "temperature_c": "hot", "throttled": None},
    "throttling in words": {"kind": "machine", "t_s": 1, "temperature_c": None, "throttled": "hot"},
    "an event at the end of time": {"kind": "event", "t_s": 10**400, "event": "a", "fields": {}},
    "an event without fields": {"kind": "event", "t_s": 1, "event": "a", "fields": []},
    "a gap of no size": {"kind": "event", "t_s": 1, "event": module.MISSING, "fields": {"ticks": "many"}},
    "a header of no drive": {"kind": "header", "drive": [1]},
    "a tick of too few values": TICK[:-1],
    "a tick without a time": [None, *TICK[1:]],
    "a tick at infinity": [TICK[0], float("inf"), *TICK[2:]],
    "a tick of texts": ["a"] * 15,
    "a state that is no text": [*TICK[:2], 7, *TICK[3:]],
}


@pytest.mark.parametrize("what", NO_ROWS)
def test_a_line_of_another_form_is_skipped(tmp_path, good, what):
    flight = read_bytes(good + json.dumps(NO_ROWS[what]).encode() + b"\n", tmp_path)
    assert flight.damaged == 1 and flight.summary()["ticks"] == 40


def test_a_line_that_is_nested_without_end_is_skipped(tmp_path, good):
    assert read_bytes(good + b"[" * 200_000 + b"]" * 200_000, tmp_path).damaged == 1


def test_what_cannot_be_read(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    for name in ("nothing.log", "fifo", "."):
        with pytest.raises(RoverError, match="cannot be read"):
            read_log(tmp_path / name)
    other = tmp_path / "old.log"
    other.write_text('{"schema":1,"kind":"header","start":"x"}\n')
    with pytest.raises(RoverError, match="version 1"):
        read_log(other)


# ---- bad disks


def test_a_full_disk_is_said_once_and_logging_goes_on_when_it_has_room(path, caplog, quick):
    path.symlink_to("/dev/full")
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        for k in range(20):
            log.tick(tick(k))
        until(lambda: caplog.records)
        time.sleep(0.05)  # it has tried again several times
        path.unlink()
        until(path.is_file)
        log.tick(tick(20))
    flight = read_log(path)
    assert flight.ticks["frame"].tolist() == list(range(21))
    said = [r.message for r in caplog.records]
    assert len(said) == 2 and "No space left" in said[0] and "written again" in said[1]


@pytest.mark.parametrize("taken", [0, 5, -1])
def test_a_disk_that_takes_a_part_of_a_line(path, monkeypatch, quick, taken):
    """None is lost and none is read twice: not even of a line that lacks only its end."""
    cut = []

    class Disk(module.FileIO):
        def write(self, data):
            if not cut and data.startswith(b"[") and b",4]" in data:
                cut.append(data)
                return super().write(data[:taken])
            return super().write(data)

    monkeypatch.setattr(module, "FileIO", Disk)
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        for k in range(10):
            log.tick(tick(k))
        until(lambda: cut)
    flight = read_log(path)
    assert sorted(set(flight.ticks["frame"])) == list(range(10)) and flight.drives == 1
    assert len(flight.ticks["frame"]) == 10 + (taken == -1)


def test_ticks_that_were_not_logged_are_not_missed(path, monkeypatch):
    monkeypatch.setattr(module, "QUEUE_ROWS", 50)
    write(path, map(tick, range(200)))
    flight = read_log(path)
    assert flight.ticks["frame"].tolist() == list(range(150, 200))
    assert [e.fields for e in flight.events] == [{"ticks": 150}]
    assert (flight.summary()["ticks_not_logged"], flight.summary()["missed"]) == (150, 0)


def test_a_writer_that_raises_anything_goes_on(path, caplog, quick):
    failing = [RuntimeError("who knows")]

    class Odd:
        vcgencmd = "none"

        def temperature_c(self):
            if failing:
                raise failing.pop()

    write(path, [tick(0)], host=Odd())
    with FlightLog(path, header=HEADER, **LIMITS, host=Odd()) as log:
        log.tick(tick(1))
    assert read_log(path).ticks["frame"].tolist() == [1]
    assert "who knows" in caplog.text


def test_a_stuck_disk_holds_up_neither_the_loop_nor_the_end(path, monkeypatch, quick):
    monkeypatch.setattr(module, "CLOSE_S", 0.2)
    go_on = threading.Event()
    monkeypatch.setattr(module.os, "fsync", lambda file: go_on.wait(10))
    start = time.monotonic()
    try:
        log = write(path, map(tick, range(5000)))
        assert time.monotonic() - start < 2 and len(log._rows) <= module.QUEUE_ROWS
    finally:
        go_on.set()
        log._writer.join()


@pytest.mark.parametrize("fault", ["stuck", "raises"])
def test_a_logger_that_is_stuck_or_raises_does_not_matter(path, monkeypatch, fault):
    monkeypatch.setattr(module, "CLOSE_S", 0.5)
    go_on, handler = threading.Event(), logging.Handler()
    handler.emit = lambda record: go_on.wait(10) if fault == "stuck" else 1 / 0
    logging.getLogger("rover").addHandler(handler)
    start = time.monotonic()
    try:
        with FlightLog(path, header=HEADER, **LIMITS) as log:
            for _ in range(1000):
                log.event("two", level=logging.WARNING)
            assert time.monotonic() - start < 0.5
            log.tick(tick(0))
        assert time.monotonic() - start < 2
    finally:
        go_on.set()
        logging.getLogger("rover").removeHandler(handler)
    assert len(read_log(path).events) == 1000 and len(read_log(path).ticks["t_s"]) == 1


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
    assert (found["jitter_p50_ms"], found["jitter_max_ms"]) == (0.1, 30.0)
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
