"""The recorder: the user's format to the byte, and whole or not at all."""

import csv
import json
import math
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
from recorded import real_episode

from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording import CONTROL_FIELDS, FRAME_FIELDS, EpisodeWriter

NAME = "episode_20260101_120000"
FRAME = np.full((36, 64, 3), (30, 90, 200), np.uint8)


def write(folder, controls=3, frames=2, **options):
    with EpisodeWriter(folder, label="hit red balloon", resolution=(64, 36), **options) as writer:
        for i in range(controls):
            writer.control(100 + i / 30, 33 * i, 1500, 136, 21308, 1016)
        for i in range(frames):
            writer.frame(100 + i / 30, FRAME)
    return folder


def test_format_of_a_real_recording_to_the_byte(tmp_path):
    sample_episode = real_episode()
    text = (sample_episode / "episode_data.json").read_text()
    real = json.loads(text)
    width, height = real["metadata"]["camera_resolution"]
    frame = np.zeros((height, width, 3), np.uint8)
    with EpisodeWriter(
        tmp_path / sample_episode.name,
        label=real["action_label"],
        fps=real["metadata"]["camera_fps"],
        resolution=(width, height),
        start_time_s=real["start_time"],
        end_time_s=real["end_time"],
        arduino_port=real["metadata"]["arduino_port"],
    ) as writer:
        for c in real["control_samples"]:
            writer.control(
                c["system_timestamp"],
                c["arduino_timestamp"],
                c["steering_raw_us"],
                c["throttle_raw_us"],
                c["steering_period_us"],
                c["throttle_period_us"],
            )
        for f in real["frame_samples"]:
            writer.frame(f["timestamp"], frame)
    made = tmp_path / sample_episode.name
    for name in ("control_data.csv", "frame_data.csv"):
        assert (made / name).read_bytes() == (sample_episode / name).read_bytes()
    # the user's recorder took the duration (and so both rates) from another clock; all else is equal
    derived = r'"(duration|avg_control_rate|avg_frame_rate)": [\d.]+'
    written = (made / "episode_data.json").read_text()
    assert re.sub(derived, "", written) == re.sub(derived, "", text)
    assert json.loads(written)["duration"] == pytest.approx(real["duration"], abs=1e-4)


def test_folder_and_files(tmp_path):
    folder = write(tmp_path / "new" / NAME)
    assert sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*")) == [
        "control_data.csv",
        "episode_data.json",
        "frame_data.csv",
        "frames",
        "frames/frame_000001.jpg",
        "frames/frame_000002.jpg",
    ]
    assert [p.name for p in folder.parent.iterdir()] == [NAME]
    episode = json.loads((folder / "episode_data.json").read_text())
    assert list(episode) == [
        "episode_id",
        "action_label",
        "start_time",
        "end_time",
        "duration",
        "metadata",
        "control_samples",
        "frame_samples",
    ]
    assert list(episode["metadata"]) == [
        "camera_fps",
        "camera_resolution",
        "arduino_port",
        "total_control_samples",
        "total_frames",
        "avg_control_rate",
        "avg_frame_rate",
    ]
    assert episode["episode_id"] == NAME
    assert episode["duration"] == pytest.approx(2 / 30)
    assert episode["metadata"]["avg_control_rate"] == pytest.approx(45)
    assert list(episode["control_samples"][0]) == list(CONTROL_FIELDS)
    assert list(episode["frame_samples"][0]) == list(FRAME_FIELDS)
    with (folder / "control_data.csv").open(newline="") as f:
        rows = list(csv.DictReader(f))
    assert [{k: float(v) for k, v in row.items()} for row in rows] == episode["control_samples"]
    picture = cv2.imread(str(folder / "frames/frame_000001.jpg"))
    assert picture.shape == FRAME.shape
    assert np.abs(picture.astype(int) - FRAME).max() <= 3


def test_normalised_values_have_four_decimals_and_the_firmwares_zero(tmp_path):
    with EpisodeWriter(tmp_path / NAME, label="x", resolution=(64, 36)) as writer:
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.control(1.1, 33, 1500, 0, 21308, 0)
        writer.control(1.2, 66, np.int64(1456), 120, 21316, 1016)
        writer.frame(1.0, FRAME)
    episode = json.loads((tmp_path / NAME / "episode_data.json").read_text())
    samples = episode["control_samples"]
    assert [(s["steering_normalized"], s["throttle_normalized"]) for s in samples] == [
        (0.0804, 0.0271),
        (0.0804, 0.0),
        (0.0002, 0.0),
    ]
    assert "-0.0" not in (tmp_path / NAME / "control_data.csv").read_text()


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_nothing(tmp_path, error):
    with pytest.raises(error), EpisodeWriter(tmp_path / NAME, label="x", resolution=(64, 36)) as writer:
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.frame(1.0, FRAME)
        raise error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("controls", "frames"), [(0, 0), (3, 0), (0, 3)])
def test_half_an_episode_is_none(tmp_path, controls, frames):
    with pytest.raises(EpisodeError, match="no episode"):
        write(tmp_path / NAME, controls, frames)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_refused_and_kept(tmp_path):
    folder = write(tmp_path / NAME)
    before = (folder / "episode_data.json").read_bytes()
    with pytest.raises(EpisodeError, match="exists already"):
        write(folder, controls=9)
    assert (folder / "episode_data.json").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [NAME]


def test_a_folder_that_appears_meanwhile_is_not_replaced(tmp_path):
    with (
        pytest.raises(EpisodeError, match="exists already"),
        EpisodeWriter(tmp_path / NAME, label="x", resolution=(64, 36)) as writer,
    ):
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.frame(1.0, FRAME)
        (tmp_path / NAME).mkdir()
    assert list((tmp_path / NAME).iterdir()) == []
    assert [p.name for p in tmp_path.iterdir()] == [NAME]


@pytest.mark.parametrize("bad", [None, "136", math.nan, 136.5, -4, True])
def test_controls_must_be_whole_numbers(tmp_path, bad):
    with (
        pytest.raises(EpisodeError, match="throttle_raw_us"),
        EpisodeWriter(tmp_path / NAME, label="x", resolution=(64, 36)) as writer,
    ):
        writer.control(1.0, 0, 1500, bad, 21308, 1016)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("bad", [None, "soon", math.nan, math.inf, 10**400])
def test_times_must_be_finite(tmp_path, bad):
    with EpisodeWriter(tmp_path / NAME, label="x", resolution=(64, 36)) as writer:
        with pytest.raises(EpisodeError, match="finite"):
            writer.control(bad, 0, 1500, 136, 21308, 1016)
        with pytest.raises(EpisodeError, match="finite"):
            writer.frame(bad, FRAME)
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.frame(1.0, FRAME)
    assert len(list((tmp_path / NAME / "frames").iterdir())) == 1


@pytest.mark.parametrize(
    "bad", [None, FRAME[:-1], FRAME.astype(np.float32), FRAME[..., 0]], ids=["none", "size", "float", "grey"]
)
def test_frames_must_be_pictures_of_the_right_size(tmp_path, bad):
    with (
        pytest.raises(EpisodeError, match="frames must be uint8"),
        EpisodeWriter(tmp_path / NAME, label="x", resolution=(64, 36)) as writer,
    ):
        writer.frame(1.0, bad)


def test_a_closed_writer_says_so(tmp_path):
    writer = EpisodeWriter(tmp_path / NAME, label="x")
    with pytest.raises(EpisodeError, match="not open"):
        writer.control(1.0, 0, 1500, 136, 21308, 1016)


def test_the_same_drive_gives_the_same_bytes(tmp_path):
    a, b = write(tmp_path / "a" / NAME), write(tmp_path / "b" / NAME)
    for path in sorted(p for p in a.rglob("*") if p.is_file()):
        assert path.read_bytes() == (b / path.relative_to(a)).read_bytes()


def test_needs_no_workshop():
    code = (
        "import sys, rover_lib.onboard.recording, rover_lib.onboard.pwm\n"
        "bad = {'lerobot', 'torchvision', 'yaml', 'jsonschema', 'rover_lib.workshop'} & set(sys.modules)\n"
        "sys.exit(str(bad) if bad else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)
