"""A flight log as MCAP, read back by the library's own reader."""

import base64
import json
import math
from datetime import datetime

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from test_film import HZ, PICTURES_HZ, SECONDS, drive

from rover_lib.cli import main
from rover_lib.onboard.drive.flight_log import LogError, Tick, read_log
from rover_lib.onboard.errors import EpisodeError

pytest.importorskip("mcap", reason="needs the package mcap, of the extra workshop")

from mcap.reader import make_reader

from rover_look.mcap_log import SCHEMAS, write_mcap


def read_back(path):
    """By topic, [(log time in seconds since the drive's start, content)]; and the metadata."""
    found, schemas = {}, {}
    with path.open("rb") as file:
        reader = make_reader(file)
        (metadata,) = reader.iter_metadata()
        start_s = datetime.fromisoformat(json.loads(metadata.metadata["start"])).timestamp()
        last_ns = 0
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert message.log_time == message.publish_time >= last_ns and channel.message_encoding == "json"
            last_ns = message.log_time
            schemas[channel.topic] = schema.name, schema.encoding, json.loads(schema.data)
            row = json.loads(message.data)
            assert row.keys() >= json.loads(schema.data)["properties"].keys() - {"driver"}
            found.setdefault(channel.topic, []).append((message.log_time / 1e9 - start_s, row))
    assert schemas == {topic: (SCHEMAS[topic][0], "jsonschema", SCHEMAS[topic][1]) for topic in found}
    return found, metadata.metadata


def test_each_tick_event_and_reading_is_there_at_its_time(tmp_path):
    path = drive(tmp_path)
    counts = write_mcap(tmp_path / "out.mcap", read_log(path))
    found, metadata = read_back(tmp_path / "out.mcap")
    flight = read_log(path)
    ticks = found["/tick"]
    assert counts["tick"] == len(ticks) == SECONDS * HZ
    for k, (t_s, row) in enumerate(ticks):
        assert t_s == pytest.approx(flight.ticks["t_s"][k], abs=2e-6)
        for name in Tick._fields:
            value = flight.ticks[name][k]
            assert row[name] == (str(value) if isinstance(value, str) else pytest.approx(float(value))), name
    events = [(round(t_s, 3), row["message"], row["timestamp"]) for t_s, row in found["/event"]]
    assert [text for _, text, _ in events] == [str(e) for e in flight.events] and counts["event"] == len(events)
    assert [t_s for t_s, _, _ in events] == pytest.approx([e.t_s for e in flight.events], abs=1e-3)
    assert len(found["/machine"]) == len(flight.machine["t_s"]) == counts["machine"]
    assert json.loads(metadata["drive"])["hz"] == HZ


def test_what_is_not_known_is_null(tmp_path):
    path = drive(tmp_path)
    flight = read_log(path)
    for name in ("plan_age_ms", "pins_throttle_us"):
        flight.ticks[name][7] = math.nan
    write_mcap(tmp_path / "out.mcap", flight)
    row = read_back(tmp_path / "out.mcap")[0]["/tick"][7][1]
    assert row["plan_age_ms"] is None and row["pins_throttle_us"] is None and row["latency_ms"] == 125.0


def test_the_pictures_and_controls_of_the_drives_episode(tmp_path):
    path = drive(tmp_path)
    episode = tmp_path / "episodes" / "episode_1"
    begin_s = datetime.fromisoformat(read_log(path).header["start"]).timestamp()
    drivers = ["policy"] * 60 + ["human"] * 30
    rows = [{"system_timestamp": begin_s + i / 30, "driver": driver} for i, driver in enumerate(drivers)]
    nulls = dict.fromkeys(SCHEMAS["/control"][1]["properties"])
    rows = [nulls | row for row in rows] + ["nonsense", nulls, nulls | {"system_timestamp": math.nan}]
    (episode / "episode_data.json").write_text(json.dumps({"control_samples": rows}))
    (episode / "frames" / "frame_000003.jpg").write_bytes(b"\xff\xd8 no picture")
    (episode / "frames" / "frame_000004.jpg").unlink()
    counts = write_mcap(tmp_path / "out.mcap", read_log(path))
    found, _ = read_back(tmp_path / "out.mcap")
    assert counts["camera"] == len(found["/camera"]) == SECONDS * PICTURES_HZ - 2
    numbers = [k for k in range(20) if k not in (3, 4)]
    for k, (t_s, row) in zip(numbers, found["/camera"], strict=True):
        assert t_s == pytest.approx(k / PICTURES_HZ + 0.01, abs=2e-6) and row["format"] == "jpeg"
        assert row["timestamp"]["sec"] + row["timestamp"]["nsec"] / 1e9 == pytest.approx(begin_s + t_s, abs=2e-6)
        data = base64.b64decode(row["data"])
        assert data == (episode / "frames" / f"frame_{k:06d}.jpg").read_bytes()
        assert abs(int(cv2.imdecode(np.frombuffer(data, np.uint8), 1).mean()) - (30 + 5 * k)) <= 2
    assert [row["driver"] for _, row in found["/control"]] == drivers
    assert found["/control"][-1][0] > found["/tick"][-1][0]  # it goes on after the takeover


def test_a_drive_without_pictures_is_one_too_and_named_ones_must_be_there(tmp_path):
    flight = read_log(drive(tmp_path, pictures=False))
    assert set(write_mcap(tmp_path / "out.mcap", flight)) == {"tick", "event", "machine"}
    (tmp_path / "other").mkdir()
    with pytest.raises(EpisodeError, match="its list of pictures cannot be read"):
        write_mcap(tmp_path / "other.mcap", flight, tmp_path / "other")
    flight.header.clear()
    with pytest.raises(LogError, match="when it began is not known"):
        write_mcap(tmp_path / "other.mcap", flight)
    assert not (tmp_path / "other.mcap").exists() and not list(tmp_path.glob(".other*"))


def test_the_command(tmp_path):
    path = drive(tmp_path)
    done = CliRunner().invoke(main, ["log", str(path), "--mcap", str(tmp_path / "out.mcap")])
    assert done.exit_code == 0, done.output
    assert "60 of tick" in done.output and "20 of camera" in done.output
    assert not (tmp_path / "flight.log.png").exists()
    assert len(read_back(tmp_path / "out.mcap")[0]["/camera"]) == 20
