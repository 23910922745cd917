"""An episode's files: the user's format to the byte, whole or not at all, and nothing that was recorded is lost."""

import csv
import json
import math
import re
import resource
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from unittest.mock import Mock

import numpy as np
import pytest

from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording import episode as module
from rover_lib.onboard.recording.episode import (
    CONTROL_FIELDS,
    FLAG_FIELDS,
    About,
    EpisodeWriter,
    find_killed,
    finish_killed,
)
from rover_lib.onboard.recording.recorder import _new_episode
from rover_lib.workshop.recordings.episodes import load_recordings
from tests.helpers.command import rover
from tests.helpers.recorded import content_of, names_in, real_episode

NAME = "episode_20260101_120000"
FRAME = np.full((36, 64, 3), (30, 90, 200), np.uint8)


def fill(writer, controls=1, frames=1):
    for i in range(controls):
        writer.control(100 + i / 30, 33 * i, 1500, 136, 21308, 1016)
    for i in range(frames):
        writer.frame(100 + i / 30, FRAME)


def write(folder, controls=3, frames=2, **options):
    with EpisodeWriter(folder, About("hit"), resolution=(64, 36), **options) as writer:
        fill(writer, controls, frames)
    return folder


def cut(folder, controls=5, frames=3):
    """What a recorder leaves that ends while it records: its hidden folder."""
    with pytest.raises(KeyboardInterrupt), EpisodeWriter(folder, About("hit"), resolution=None, flags=True) as writer:
        fill(writer, controls, frames)
        assert not find_killed(folder.parent)
        raise KeyboardInterrupt
    return folder.with_name(f".{folder.name}.part")


def finish(folder):
    return rover("record", folder, "--finish")


def test_a_recording_that_was_cut_off_is_not_lost(tmp_path, caplog):
    """93 frames and 102 rows were, to every command."""
    part = cut(tmp_path / NAME)
    with (part / "control.rows").open("ab") as file:
        file.write(b'{"arduino_timestamp": 9')
    picture = part / "frames/frame_000003.jpg"
    picture.write_bytes(picture.read_bytes()[:-9])
    (part / "frames/frame_000001.jpg").write_bytes(b"")
    with pytest.raises(EpisodeError, match=r"no episode folders.*--finish` makes an episode"):
        load_recordings(tmp_path, chunk=4)
    write(tmp_path / "episode_2")
    (fault,) = [f for f in load_recordings(tmp_path, chunk=4).faults if f.kind == "killed_recording"]
    assert fault.file == part.name
    _new_episode(tmp_path, 0.0, About()).close()
    assert f"1 recordings here were killed; `rover record {tmp_path} --finish`" in caplog.text
    assert finish(tmp_path).output == f"finished: {tmp_path / NAME}\n"
    about = content_of(tmp_path / NAME)
    assert (len(about["control_samples"]), len(about["frame_samples"]), about["action_label"]) == (5, 1, "hit")
    assert about["metadata"]["fault"].endswith("3 damaged rows and pictures are left out")
    assert about["metadata"]["camera_resolution"] == [64, 36] and (tmp_path / NAME / "control.rows").exists()
    assert "nothing to finish" in finish(tmp_path).output


def test_a_full_disk_at_the_end_costs_nothing(tmp_path, monkeypatch):
    """It removed all 8,460 rows of a drive."""
    with monkeypatch.context() as patch:
        patch.setattr(csv.DictWriter, "writerows", Mock(side_effect=OSError(28, "No space left on device")))
        with pytest.raises(EpisodeError, match=r"No space left.*make room; `rover record .* --finish` keeps"):
            write(tmp_path / NAME, controls=5, frames=3)
        assert finish(tmp_path).exit_code == 1 and names_in(tmp_path) == [f".{NAME}.part"]
    assert finish(tmp_path).exit_code == 0
    found = content_of(tmp_path / NAME)
    assert len(found["control_samples"]) == 5 and found["metadata"]["fault"] == "the recording was cut off"
    assert names_in(tmp_path / NAME) == ["control_data.csv", "episode_data.json", "frame_data.csv", "frames"]


@pytest.mark.parametrize(("controls", "frames"), [(0, 3), (5, 0)])
def test_half_an_episode_stays_and_what_is_missing_is_said(tmp_path, controls, frames):
    part = cut(tmp_path / NAME, controls, frames)
    before = {path: path.read_bytes() for path in part.rglob("*") if path.is_file()}
    done = finish(tmp_path)
    assert done.exit_code == 1 and f"found {controls} controls and {frames} frames" in done.stderr
    assert {path: path.read_bytes() for path in part.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("gone", [("control",), ("control", "frame")])
def test_a_cut_while_an_episode_is_finished_costs_nothing(tmp_path, gone):
    whole = write(tmp_path / "whole", controls=5, frames=3, flags=True)
    part = cut(tmp_path / NAME)
    for name in ("control_data.csv", "frame_data.csv", "episode_data.json"):
        (part / name).write_bytes((whole / name).read_bytes())
    for kind in gone:
        (part / f"{kind}.rows").unlink()
    assert finish_killed(part) == tmp_path / NAME and names_in(tmp_path / NAME) == names_in(whole)
    assert (tmp_path / NAME / "episode_data.json").read_bytes() == (whole / "episode_data.json").read_bytes()


def test_only_one_finishes_a_recording_and_nobody_one_that_goes_on(tmp_path):
    """Two at once made half an episode."""
    part, barrier = cut(tmp_path / NAME, controls=200, frames=200), Barrier(4)

    def finish_one(_):
        barrier.wait()
        try:
            return finish_killed(part)
        except EpisodeError:
            return None

    with ThreadPoolExecutor(4) as pool:
        assert sorted(pool.map(finish_one, range(4)), key=str)[:-3] == [tmp_path / NAME]
    found = content_of(tmp_path / NAME)
    assert len(found["control_samples"]) == len(found["frame_samples"]) == 200
    with EpisodeWriter(tmp_path / "episode_2", About(), resolution=None) as writer:
        fill(writer)
        assert not find_killed(tmp_path)
        with pytest.raises(EpisodeError, match="is being recorded"):
            finish_killed(tmp_path / ".episode_2.part")
        with pytest.raises(EpisodeError, match="is being recorded"):
            write(tmp_path / "episode_2")


def test_a_recording_that_has_just_begun_is_not_removed(tmp_path, monkeypatch):
    lock = module.lock_folder

    def late(folder):
        monkeypatch.undo()
        finish_killed(folder)  # between mkdir and the lock
        return lock(folder)

    monkeypatch.setattr(module, "lock_folder", late)
    writer = _new_episode(tmp_path, 0.0, About())
    fill(writer)
    assert writer.finish().exists()


def test_what_holds_nothing_is_removed_by_the_next(tmp_path):
    kept = cut(tmp_path / NAME, controls=1, frames=0)
    part = tmp_path / ".episode_0.part"
    (part / "frames").mkdir(parents=True)
    for name in ("about.json", "control.rows", "frames/frame_000001.jpg"):
        (part / name).write_text("{}" if name == "about.json" else "")
    _new_episode(tmp_path, 0.0, About()).close()
    assert names_in(tmp_path) == [kept.name]


def test_an_existing_folder_is_refused_and_kept(tmp_path):
    folder = write(tmp_path / NAME)
    before = (folder / "episode_data.json").read_bytes()
    with pytest.raises(EpisodeError, match="exists already"):
        write(folder, controls=9)
    assert (folder / "episode_data.json").read_bytes() == before and names_in(tmp_path) == [NAME]
    late = tmp_path / "late"
    writing = EpisodeWriter(late, About(), resolution=None)
    with pytest.raises(EpisodeError, match="exists already"), writing as writer:
        fill(writer)
        late.mkdir()  # meanwhile
    assert names_in(late) == []
    late.rmdir()
    assert finish_killed(tmp_path / ".late.part") == late


def test_a_row_or_a_picture_that_a_full_disk_took_half_of_is_taken_back(tmp_path):
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with EpisodeWriter(tmp_path / NAME, About(), resolution=None) as writer:
        fill(writer)
        size = writer._rows["control"].tell() + 10
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            for controls, frames in ((1, 0), (0, 1)):
                with pytest.raises(EpisodeError, match="cannot be written"):
                    fill(writer, controls, frames)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
        writer.control(101, 66, 1500, 136, 21308, 1016)
    assert [row["arduino_timestamp"] for row in content_of(tmp_path / NAME)["control_samples"]] == [0, 66]
    assert names_in(tmp_path / NAME / "frames") == ["frame_000001.jpg"]


def test_a_disk_that_cannot_sync_ends_the_recording(tmp_path, monkeypatch):
    writer = EpisodeWriter(tmp_path / NAME, About(), resolution=None)
    with monkeypatch.context() as patch:
        patch.setattr(module, "sync_disk", Mock(side_effect=OSError(5, "Input/output error")))
        patch.setattr(module, "SYNC_S", 0.5)
        writer.open()
        fill(writer)
        writer._syncing.join(10)
        with pytest.raises(EpisodeError, match="Input/output error"):
            fill(writer)
    assert len(content_of(writer.finish())["control_samples"]) == 1


def test_format_of_a_real_recording_to_the_byte(tmp_path):
    """Its normalised values have four decimals, and 0.0 where no pulse was measured, in half of its rows."""
    sample_episode = real_episode()
    text = (sample_episode / "episode_data.json").read_text()
    real = json.loads(text)
    width, height = real["metadata"]["camera_resolution"]
    made = tmp_path / sample_episode.name
    about = About(
        real["action_label"],
        fps=real["metadata"]["camera_fps"],
        start_time_s=real["start_time"],
        end_time_s=real["end_time"],
        arduino_port=real["metadata"]["arduino_port"],
    )
    names = [name for name in CONTROL_FIELDS if name not in ("system_timestamp", "arduino_timestamp")]
    with EpisodeWriter(made, about, resolution=(width, height)) as writer:
        for c in real["control_samples"]:
            pulses = [c[name] for name in names if not name.endswith("normalized")]
            writer.control(c["system_timestamp"], c["arduino_timestamp"], *pulses)
        for f in real["frame_samples"]:
            writer.frame(f["timestamp"], np.zeros((height, width, 3), np.uint8))
    for name in ("control_data.csv", "frame_data.csv"):
        assert (made / name).read_bytes() == (sample_episode / name).read_bytes()
    # the user's recorder took the duration (and so both rates) from another clock; all else is equal
    derived = r'"(duration|avg_control_rate|avg_frame_rate)": [\d.]+'
    written = (made / "episode_data.json").read_text()
    assert re.sub(derived, "", written) == re.sub(derived, "", text)
    assert json.loads(written)["duration"] == pytest.approx(real["duration"], abs=1e-4)


def test_only_numbers_and_pictures_of_one_size_are_written(tmp_path):
    with EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36)) as writer:
        for bad in (None, "136", math.nan, -4, True):
            with pytest.raises(EpisodeError, match="throttle must be whole"):
                writer.control(1.0, 0, 1500, bad, 21308, 1016)
        for bad in (None, "soon", math.inf, 10**400):
            with pytest.raises(EpisodeError, match="finite"):
                writer.frame(bad, FRAME)
        for bad in (None, FRAME[:-1], FRAME.astype(np.float32), FRAME[..., 0]):
            with pytest.raises(EpisodeError, match="frames must be uint8"):
                writer.frame(1.0, bad)
        fill(writer)
    assert names_in(tmp_path / NAME / "frames") == ["frame_000001.jpg"]
    assert len(content_of(tmp_path / NAME)["control_samples"]) == 1


def test_no_pulse_is_a_flag_and_no_value(tmp_path):
    folder = tmp_path / NAME
    with EpisodeWriter(folder, About("x", source="human"), resolution=None, flags=True) as writer:
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.control(1.02, 20, 1500, None, 21308, None, mode="static")
        writer.control(1.04, 40, None, 136, None, 1016, mode="static", age_ms=np.float32(80.5))
        writer.control(1.06, 60, 1500, 136, 42632, 0)  # two periods at once, and the old recorder's 0
        writer.frame(1.0, FRAME)
    content = content_of(folder)
    rows = content["control_samples"]
    assert (folder / "episode_data.json").read_text() == json.dumps(content, indent=2)
    assert content["metadata"]["camera_resolution"] == [64, 36] and content["metadata"]["source"] == "human"
    assert [list(r) for r in rows] == [[*CONTROL_FIELDS, *FLAG_FIELDS, "mode", "age_ms"]] * 4
    assert [r["steering_measured"] for r in rows] == [True, True, False, False]
    assert [r["throttle_measured"] for r in rows] == [True, False, True, False]
    for row in rows:
        for name in ("steering", "throttle"):
            values = [row[f"{name}_{part}"] for part in ("normalized", "raw_us", "period_us")]
            assert [v is not None for v in values] == [row[f"{name}_measured"]] * 3
    assert [r["age_ms"] for r in rows] == [None, None, 80.5, None]
    with (folder / "control_data.csv").open(newline="") as f:
        lines = list(csv.DictReader(f))
    assert [{k: "" if v is None else str(v) for k, v in r.items()} for r in rows] == lines


def test_a_long_drive_stays_out_of_memory(tmp_path):
    with EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36), flags=True) as writer:
        writer.frame(1.0, FRAME)
        tracemalloc.start()
        for i in range(1000):
            writer.control(1.0 + i / 30, 33 * i, 1500, 136, 21308, 1016, mode="static", plan_age_ms=80.5)
        held, _ = tracemalloc.get_traced_memory()
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 50_000 and most < 250_000  # a thousand rows are 340 kB
