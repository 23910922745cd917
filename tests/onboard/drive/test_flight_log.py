"""The flight log on good and bad disks, and what is read back from complete and damaged files."""

import json
import logging
import os
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.onboard.drive import flight_log as module
from rover_lib.onboard.drive.flight_log import FlightLog, Tick, read_log
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.drive.watch import HealthWatch
from rover_lib.onboard.errors import DriveFault, ParamsError, RoverError
from tests.helpers.needs import until

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
    assert [reading[1:] for reading in flight.machine] == [(61.35, "0x50000")]
    assert (flight.drive, flight.drives, flight.damaged, flight.events) == (0, 1, 0, [])


def test_events_have_their_time_and_go_to_logging_too(path, caplog):
    now = [100.0]
    with caplog.at_level("INFO", "rover"), FlightLog(path, header=HEADER, **LIMITS, clock=lambda: now[0]) as log:
        now[0] = 102.5
        log.event("camera unplugged", level=logging.WARNING)
        log.event("x" * 3000)
    first, second = read_log(path).events
    assert first == (2.5, "camera unplugged")
    assert len(second.text) < 1000  # a file is bounded, an error's text is not
    assert [r.levelname for r in caplog.records] == ["WARNING", "INFO"]


def test_a_second_drive_into_one_log_is_refused_at_once(path):
    """The reader cannot tell two drives' lines apart; the first 0.5 s were not guarded."""
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        with pytest.raises(RoverError, match="another drive"), FlightLog(path, header=HEADER, **LIMITS):
            pytest.fail("it was let in")
        log.tick(tick(0))
    write(path, [tick(1)])  # and then it is free
    assert read_log(path).drives == 2


def test_the_log_is_synced_with_what_it_has(path, monkeypatch, quick):
    synced = []
    monkeypatch.setattr(module.os, "fsync", lambda file: synced.append(os.fstat(file.fileno()).st_size))
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        log.tick(tick(0))
        until(path.exists)
        until(lambda: path.stat().st_size in synced and len(read_log(path).ticks["t_s"]) == 1)
    assert module.SYNC_S < 1


@pytest.mark.parametrize("bad", ["max_mb: '8'", "max_mb: .nan", "keep: -1"])
def test_limits_of_params_that_make_no_sense(tmp_path, monkeypatch, bad):
    (tmp_path / "params.yml").write_text(f"flight_log: {{{bad}}}")
    monkeypatch.setenv("ROVER_PARAMS", str(tmp_path / "params.yml"))
    with pytest.raises(ParamsError, match="flight_log"):
        module.log_limits()


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
    with FlightLog(path, header=HEADER, **LIMITS) as log:  # a service's log has a drive for each arming
        for k in (3, 4):
            log.event("not armed: no transmitter")
            log.event(module.ARMED)
            log.tick(tick(k))
    assert [read_log(path, k).ticks["frame"].tolist() for k in range(5)] == [[k] for k in range(5)]


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("good") / "flight.log"
    with FlightLog(path, header=HEADER, **LIMITS) as log:
        for k in range(40):
            log.tick(tick(k))
        log.event("armed")
    return path.read_bytes()


def read_bytes(data, folder):
    path = folder / "damaged.log"
    path.write_bytes(data)
    return read_log(path)


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
NO_ROWS = [
    7,
    {"kind": "machine", "t_s": 1, "temperature_c": "hot", "throttled": None},
    {"kind": "event", "t_s": 10**400, "event": "a"},
    {"kind": "header", "schema": 2, "drive": [1]},
    {"kind": "header", "schema": 1, "drive": {}},
    TICK[:-1],
    [None, *TICK[1:]],
    ["a"] * 15,
]


def test_lines_of_another_form_are_skipped(tmp_path, good):
    lines = [json.dumps(row).encode() for row in NO_ROWS] + [b"[" * 200_000 + b"]" * 200_000, b"\xff"]
    flight = read_bytes(good + b"\n".join(lines), tmp_path)
    assert flight.damaged == len(lines) and flight.summary()["ticks"] == 40


def test_what_cannot_be_read(tmp_path):
    (tmp_path / "empty.log").touch()
    for name in ("nothing.log", ".", "empty.log"):
        with pytest.raises(RoverError):
            read_log(tmp_path / name)


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


@pytest.mark.parametrize("disk", ["full", "stuck"])
def test_a_low_supply_is_seen_whatever_the_disk_does(path, monkeypatch, quick, disk):
    go_on = threading.Event()
    if disk == "full":
        path.symlink_to("/dev/full")
    monkeypatch.setattr(module.os, "fsync", lambda file: go_on.wait(10))
    bits = ["0x0"]
    host = SimpleNamespace(vcgencmd="sh", throttled=lambda: bits[0], temperature_c=lambda: 50.0)
    with FlightLog(path, header=HEADER, **LIMITS, host=host) as log:
        log.tick(tick(0))
        time.sleep(0.1)  # the disk takes nothing now
        health = HealthWatch(Report(), None, log, 0.1)
        assert list(health()) == []
        bits[0] = "0x1"
        until(lambda: log.machine["throttled"] == "0x1")
        assert list(health()) == ["under-voltage"]
        time.sleep(0.11)
        with pytest.raises(DriveFault, match="under-voltage"):
            list(health())
        go_on.set()


def test_a_reading_of_the_supply_that_hangs_costs_no_line(path):
    go_on = threading.Event()
    host = SimpleNamespace(vcgencmd="sh", throttled=lambda: go_on.wait(10), temperature_c=lambda: 50.0)
    log = write(path, map(tick, range(3)), host)
    assert not log._writer.is_alive() and len(read_log(path).ticks["frame"]) == 3
    go_on.set()


@pytest.mark.parametrize("taken", [0, -1])
def test_a_disk_that_takes_a_part_of_a_line(path, monkeypatch, quick, taken):
    """None is lost and none is read twice: not even of a line that lacks only its end."""
    cut = []

    class Disk(module.FileIO):
        def write(self, data):
            if not cut and data.startswith(b"[") and b",4,null]" in data:
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


def test_a_stuck_disk_holds_up_neither_the_loop_nor_the_end(path, monkeypatch, quick):
    monkeypatch.setattr(module, "CLOSE_S", 0.2)
    go_on = threading.Event()
    monkeypatch.setattr(module.os, "fsync", lambda file: go_on.wait(10))
    start = time.monotonic()
    try:
        log = write(path, map(tick, range(5000)))
        assert time.monotonic() - start < 2 and len(log._rows) <= module.QUEUE_ROWS
        with pytest.raises(RoverError, match="another drive"):  # it still writes
            write(path)
    finally:
        go_on.set()
        log._writer.join()


PLAN = ("latency_ms", "plan_age_ms")


def test_summary(path, pi_host):
    rows = []
    for k, late_ms in enumerate([0.1] * 97 + [30.0, 4.5, 1.0]):
        times = {"t_s": (k + 3 * (k > 50)) / 30 + late_ms / 1000, "late_ms": late_ms}  # three were missed
        plan = {"latency_ms": 100.0 + k // 10, "plan_age_ms": float(k)} if k >= 10 else dict.fromkeys(PLAN)
        rows.append(tick(k, plan=k // 10, **times, **plan))
    write(path, rows, host=pi_host)
    found = read_log(path).summary()
    json.dumps(found, allow_nan=False)
    assert (found["ticks"], found["missed"], found["plans"]) == (100, 3, 9)
    assert (found["jitter_p50_ms"], found["jitter_max_ms"]) == (0.1, 30.0)
    assert found["plan_age_p95_ms"] == pytest.approx(np.percentile(np.arange(10, 100), 95), abs=1e-3)
    assert (found["latency_p50_ms"], found["latency_p95_ms"]) == (105.0, pytest.approx(108.6))
    assert found["seconds"] == pytest.approx(3.4009)
    assert found["temperature_max_c"] == 61.35
    assert found["throttled_means"] == ["under-voltage since the start", "throttled since the start"]
