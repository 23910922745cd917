"""An episode's files: the user's format to the byte, whole or not at all, and the controls that come back."""

import csv
import json
import math
import re
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from recorded import real_episode

from rover_lib.cli import main
from rover_lib.onboard.errors import EpisodeError
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

NAME = "episode_20260101_120000"
FRAME = np.full((36, 64, 3), (30, 90, 200), np.uint8)


def write(folder, controls=3, frames=2, **options):
    with EpisodeWriter(folder, About("hit red balloon"), resolution=(64, 36), **options) as writer:
        for i in range(controls):
            writer.control(100 + i / 30, 33 * i, 1500, 136, 21308, 1016)
        for i in range(frames):
            writer.frame(100 + i / 30, FRAME)
    return folder


def killed(folder, controls=5, frames=3):
    """What a recorder leaves that is killed while it records, and another while it writes the episode's files."""
    code = (
        "import os, sys, numpy as np; from rover_lib.onboard.recording import episode as e\n"
        "w = e.EpisodeWriter(sys.argv[1], e.About('hit'), resolution=None, flags=True); w.open()\n"
        "[w.control(100 + i / 30, 33 * i, 1500, 136, 21308, 1016, driver='human') for i in range(int(sys.argv[2]))]\n"
        "[w.frame(100 + i / 30, np.full((36, 64, 3), 99, np.uint8)) for i in range(int(sys.argv[3]))]\n"
        "print(len(e.find_killed(w.folder.parent)), flush=True); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, folder, str(controls), str(frames)], capture_output=True, text=True
    )
    assert done.stdout == "0\n", done
    return folder.with_name(f".{folder.name}.part")


def test_a_recording_that_was_killed_is_not_lost(tmp_path, caplog):
    """93 frames and 102 rows were, to every command."""
    part = killed(tmp_path / NAME)
    with (part / "control.rows").open("ab") as file:
        file.write(b'{"arduino_timestamp": 9')  # cut by the kill
    picture = part / "frames/frame_000003.jpg"
    picture.write_bytes(picture.read_bytes()[:-9])
    with pytest.raises(EpisodeError, match=r"no episode folders.*1 killed.*--finish` makes an episode"):
        load_recordings(tmp_path, chunk=4)
    write(tmp_path / "episode_2")
    (fault,) = [f for f in load_recordings(tmp_path, chunk=4).faults if f.kind == "killed_recording"]
    assert fault.file == part.name and "--finish" in fault.note
    _new_episode(tmp_path, 0.0, About()).discard()
    assert f"1 recordings here were killed; `rover record {tmp_path} --finish`" in caplog.text
    done = CliRunner().invoke(main, ["record", str(tmp_path), "--finish"])
    assert done.output == f"finished: {tmp_path / NAME}\n", done
    about = json.loads((tmp_path / NAME / "episode_data.json").read_text())
    assert (len(about["control_samples"]), len(about["frame_samples"]), about["action_label"]) == (5, 2, "hit")
    assert about["metadata"]["fault"] == "the program that recorded it was killed"
    assert about["control_samples"][0]["driver"] == "human" and not find_killed(tmp_path)
    assert len(load_recordings(tmp_path / NAME, chunk=4).episodes[0].samples) == 2
    assert "nothing to finish" in CliRunner().invoke(main, ["record", str(tmp_path), "--finish"]).output


def test_a_kill_while_an_episode_is_finished_costs_nothing(tmp_path):
    whole = write(tmp_path / "whole", controls=5, frames=3, flags=True)
    part = killed(tmp_path / NAME)
    for name in ("control_data.csv", "frame_data.csv", "episode_data.json"):
        (part / name).write_bytes((whole / name).read_bytes())
    for gone in ("frame.rows", "control.rows"):
        (part / gone).unlink()
    assert finish_killed(part) == tmp_path / NAME
    assert (tmp_path / NAME / "episode_data.json").read_bytes() == (whole / "episode_data.json").read_bytes()


def test_what_is_being_recorded_is_not_finished(tmp_path):
    with EpisodeWriter(tmp_path / NAME, About(), resolution=None) as writer:
        writer.control(100, 33, 1500, 136, 21308, 1016)
        writer.frame(100, FRAME)
        assert not find_killed(tmp_path)
        with pytest.raises(EpisodeError, match="is being recorded"):
            finish_killed(tmp_path / f".{NAME}.part")
    with pytest.raises(EpisodeError, match="nothing usable was recorded; remove it"):
        finish_killed(killed(tmp_path / "episode_2", frames=0))


def test_format_of_a_real_recording_to_the_byte(tmp_path):
    sample_episode = real_episode()
    text = (sample_episode / "episode_data.json").read_text()
    real = json.loads(text)
    width, height = real["metadata"]["camera_resolution"]
    frame = np.zeros((height, width, 3), np.uint8)
    with EpisodeWriter(
        tmp_path / sample_episode.name,
        About(
            real["action_label"],
            fps=real["metadata"]["camera_fps"],
            start_time_s=real["start_time"],
            end_time_s=real["end_time"],
            arduino_port=real["metadata"]["arduino_port"],
        ),
        resolution=(width, height),
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


def test_normalised_values_have_four_decimals_and_the_firmwares_zero(tmp_path):
    with EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36)) as writer:
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


def test_an_exception_or_half_an_episode_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36)) as writer:
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.frame(1.0, FRAME)
        raise KeyboardInterrupt
    for controls, frames in ((3, 0), (0, 3)):
        with pytest.raises(EpisodeError):
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
        EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36)) as writer,
    ):
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.frame(1.0, FRAME)
        (tmp_path / NAME).mkdir()
    assert list((tmp_path / NAME).iterdir()) == []
    assert [p.name for p in tmp_path.iterdir()] == [NAME]


def test_only_numbers_are_written(tmp_path):
    with EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36)) as writer:
        for bad in (None, "136", math.nan, 136.5, -4, True):
            with pytest.raises(EpisodeError, match="throttle_raw_us"):
                writer.control(1.0, 0, 1500, bad, 21308, 1016)
        for bad in (None, "soon", math.inf, 10**400):
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
        EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36)) as writer,
    ):
        writer.frame(1.0, bad)


def test_what_is_written_a_row_at_a_time_is_json_as_a_whole(tmp_path):
    text = (write(tmp_path / NAME) / "episode_data.json").read_text()
    assert text == json.dumps(json.loads(text), indent=2)


# ---- the flag --------------------------------------------------------------------------------------------


def flagged(folder):
    with EpisodeWriter(folder, About("x"), resolution=None, flags=True) as writer:
        writer.metadata |= {"source": "human", "at": np.float32(0.5)}
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.control(1.02, 20, 1500, None, 21308, None, mode="static")
        writer.control(1.04, 40, None, 136, None, 1016, mode="static", age_ms=np.float32(80.5))
        writer.control(1.06, 60, 1500, 136, 42632, 0)  # two periods at once, and the old recorder's 0
        writer.frame(1.0, FRAME)
    return folder


def test_no_pulse_is_a_flag_and_no_value(tmp_path):
    folder = flagged(tmp_path / NAME)
    content = json.loads((folder / "episode_data.json").read_text())
    rows = content["control_samples"]
    assert content["metadata"]["camera_resolution"] == [64, 36]
    assert (content["metadata"]["source"], content["metadata"]["at"]) == ("human", 0.5)
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


def test_further_columns_must_be_new_and_plain(tmp_path):
    with EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36)) as writer:
        for extra in ({"steering_measured": 1}, {"arduino_timestamp": 1}):
            with pytest.raises(EpisodeError, match="is taken"):
                writer.control(1.0, 0, 1500, 136, 21308, 1016, **extra)
        with pytest.raises(EpisodeError, match="cannot be written"):
            writer.control(1.0, 0, 1500, 136, 21308, 1016, mode=object())
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.frame(1.0, FRAME)
    assert len(json.loads((tmp_path / NAME / "episode_data.json").read_text())["control_samples"]) == 1


# ---- the disk --------------------------------------------------------------------------------------------


def test_one_name_is_recorded_once(tmp_path):
    with EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36)) as writer:
        with pytest.raises(EpisodeError, match="is being recorded"):
            write(tmp_path / NAME)
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.frame(1.0, FRAME)
    assert [p.name for p in tmp_path.iterdir()] == [NAME]


def test_half_a_row_of_a_full_disk_is_taken_back(tmp_path):
    class Full:
        """A file that takes ten bytes of a row."""

        def __init__(self, file):
            self.file, self.full = file, False

        def __getattr__(self, name):
            return getattr(self.file, name)

        def write(self, data):
            return self.file.write(data[:10] if self.full else data)

    with EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36)) as writer:
        file = writer._rows["control"] = Full(writer._rows["control"])
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        file.full = True
        with pytest.raises(EpisodeError, match="No space left"):
            writer.control(1.1, 33, 1500, 136, 21308, 1016)
        file.full = False
        writer.control(1.2, 66, 1500, 136, 21308, 1016)
        writer.frame(1.0, FRAME)
    rows = json.loads((tmp_path / NAME / "episode_data.json").read_text())["control_samples"]
    assert [r["arduino_timestamp"] for r in rows] == [0, 66]


def test_half_a_picture_of_a_full_disk_is_taken_back(tmp_path, monkeypatch):
    whole = Path.write_bytes

    def half(path, data):
        whole(path, bytes(data)[:50])
        raise OSError(28, "No space left on device")

    with EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36)) as writer:
        writer.control(1.0, 0, 1500, 136, 21308, 1016)
        writer.frame(1.0, FRAME)
        with monkeypatch.context() as m:
            m.setattr(Path, "write_bytes", half)
            with pytest.raises(EpisodeError, match="No space left"):
                writer.frame(1.1, FRAME)
    assert [p.name for p in (tmp_path / NAME / "frames").iterdir()] == ["frame_000001.jpg"]


def test_a_long_drive_stays_out_of_memory(tmp_path):
    with EpisodeWriter(tmp_path / NAME, About("x"), resolution=(64, 36), flags=True) as writer:
        writer.frame(1.0, FRAME)
        tracemalloc.start()
        for i in range(3000):
            writer.control(1.0 + i / 30, 33 * i, 1500, 136, 21308, 1016, mode="static", plan_age_ms=80.5)
        held, _ = tracemalloc.get_traced_memory()
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 100_000  # 3000 rows are a megabyte
    assert most < 400_000
