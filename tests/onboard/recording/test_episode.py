"""An episode's files: the user's format to the byte, whole or not at all, and the controls that come back."""

import csv
import json
import math
import os
import re
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recorded import real_episode

from rover_lib.cli import main
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US, PwmCalibration
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording.episode import (
    CONTROL_FIELDS,
    FLAG_FIELDS,
    About,
    EpisodeWriter,
    find_killed,
    finish_killed,
    read_controls,
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
    controls = read_controls(folder)
    assert (controls.steering_us.tolist(), controls.throttle_us.tolist(), controls.left_out) == ([1500], [136], 3)


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


# ---- controls that come back -----------------------------------------------------------------------------


def csv_of(folder, rows):
    folder.mkdir(exist_ok=True)
    with (folder / "control_data.csv").open("w", newline="") as f:
        table = csv.DictWriter(f, rows[0].keys() if rows else CONTROL_FIELDS)
        table.writeheader()
        table.writerows(rows)
    return folder


def row_of(system_s, arduino_ms, steering_us=1500, throttle_us=136, steering_period_us=21316, throttle_period_us=1016):
    pulses = (0, 0, steering_us, throttle_us, steering_period_us, throttle_period_us)
    return dict(zip(CONTROL_FIELDS, (arduino_ms, system_s, *pulses), strict=True))


PULSES = st.tuples(st.integers(252, 478), st.integers(30, 177)).map(lambda p: (4 * p[0], 4 * p[1]))


@given(
    pulses=st.lists(st.one_of(PULSES, st.none()), max_size=30),
    first=PULSES,
    steps=st.lists(st.integers(10, 60), min_size=31, max_size=31),
)
@settings(max_examples=30, deadline=None)
def test_pulses_come_back(tmp_path_factory, pulses, first, steps):
    folder = tmp_path_factory.mktemp("round") / NAME
    pulses = [first, *pulses]
    times = [1.76e9 + sum(steps[:i]) / 1000 for i in range(len(pulses))]
    with EpisodeWriter(folder, About("x"), resolution=(64, 36), flags=True) as writer:
        for i, (t_s, found) in enumerate(zip(times, pulses, strict=True)):
            steering, throttle = found or (1500, None)
            writer.control(t_s, sum(steps[:i]), steering, throttle, 21316, 1016 if throttle else None)
            writer.frame(t_s, FRAME)
    measured = [p for p in pulses if p]
    expected = [t for t, p in zip(times, pulses, strict=True) if p]
    for _ in range(2):
        controls = read_controls(folder)
        assert list(zip(controls.steering_us.tolist(), controls.throttle_us.tolist(), strict=True)) == measured
        assert controls.left_out == len(pulses) - len(measured)
        assert controls.times_s == pytest.approx(np.array(expected) - expected[0], abs=1e-6)
        (folder / "control_data.csv").unlink(missing_ok=True)  # and again from the JSON
    recordings = load_recordings(folder, chunk=1, sync_s=0.005)
    assert recordings.samples
    pwm = PwmCalibration()
    known = {round(t - times[0], 3): p for t, p in zip(times, pulses, strict=True) if p}
    for sample in recordings.samples:
        again = pwm.pulses(*sample.chunk[0].tolist())
        steering, throttle = known[round(sample.time_s, 3)]
        assert abs(again.steering_us - steering) < ARDUINO_STEP_US
        assert abs(again.throttle_us - throttle) < ARDUINO_STEP_US


def times_of(folder, rows):
    return read_controls(csv_of(folder, rows)).times_s


def test_times_are_the_systems(tmp_path):
    rows = [row_of(1.76e9 + t, ms) for t, ms in ((0, 0), (0.033, 20), (0.066, 60), (1.1, 1100))]
    assert times_of(tmp_path, rows) == pytest.approx([0, 0.033, 0.066, 1.1], abs=1e-6)


def test_times_of_a_burst_are_the_arduinos(tmp_path):
    late = [row_of(1.76e9 + 0.0003 * i, 33 * i) for i in range(20)]
    live = [row_of(1.76e9 + 0.006 + 0.033 * i, 33 * (20 + i)) for i in range(20)]
    assert times_of(tmp_path, late + live) == pytest.approx(0.033 * np.arange(40), abs=1e-6)


@pytest.mark.parametrize("by_s", [3600, -3600, -0.2])
def test_times_over_a_clock_that_was_set_are_the_arduinos(tmp_path, by_s):
    rows = [row_of(1.76e9 + 0.033 * i + (by_s if i > 5 else 0), 33 * i) for i in range(12)]
    assert times_of(tmp_path, rows) == pytest.approx(0.033 * np.arange(12), abs=1e-6)


def test_the_arduinos_clock_wraps_and_restarts(tmp_path):
    stamps = [2**32 - 66, 2**32 - 33, 0, 33, 66, 5, 38, 38]  # and says one thing twice
    rows = [row_of(1.76e9 + 0.0003 * i, ms) for i, ms in enumerate(stamps)]
    expected = [0, 0.033, 0.066, 0.099, 0.132, 0.1323, 0.1653, 0.1656]
    assert times_of(tmp_path, rows) == pytest.approx(expected, abs=2e-6)


def test_a_hole_of_unmeasured_controls_is_a_long_step(tmp_path):
    rows = [row_of(1.76e9 + 0.033 * i, 33 * i, throttle_us=0 if 3 <= i < 9 else 136) for i in range(12)]
    controls = read_controls(csv_of(tmp_path, rows))
    assert controls.left_out == 6
    assert controls.times_s == pytest.approx([0.033 * i for i in (0, 1, 2, 9, 10, 11)], abs=1e-6)


def test_what_no_recorder_measured_is_left_out(tmp_path):
    rows = [row_of(1.76e9 + 0.033 * i, 33 * i) for i in range(4)]
    rows[1]["throttle_measured"] = False  # whatever the values say
    rows[2]["steering_raw_us"] = 1500.5
    (tmp_path / "episode_data.json").write_text(json.dumps({"control_samples": rows}))
    controls = read_controls(tmp_path)
    assert controls.left_out == 2
    assert controls.times_s == pytest.approx([0, 0.099], abs=1e-6)


@pytest.mark.parametrize("word", ["nobody", "the cat"])
def test_pulses_that_the_car_did_not_follow_are_never_replayed(tmp_path, word):
    """The throttle was held, and the stick said go: a replay would move a car that had stood."""
    drivers = ["policy"] * 4 + [word] * 4 + ["human"] * 4
    rows = [row_of(1.76e9 + 0.033 * i, 33 * i) | {"driver": driver} for i, driver in enumerate(drivers)]
    left = [0.033 * i for i in (*range(4), *range(8, 12))]
    (tmp_path / "json").mkdir()
    (tmp_path / "json" / "episode_data.json").write_text(json.dumps({"control_samples": rows}))
    for folder in (csv_of(tmp_path / "csv", rows), tmp_path / "json"):
        controls = read_controls(folder)
        assert controls.left_out == 4 and controls.times_s == pytest.approx(left, abs=1e-6)


def test_controls_of_a_real_recording():
    folder = real_episode()
    rows = json.loads((folder / "episode_data.json").read_text())["control_samples"]
    measured = [r for r in rows if r["throttle_raw_us"] and 762 < r["throttle_period_us"] < 1270]
    controls = read_controls(folder)
    assert controls.steering_us.tolist() == [r["steering_raw_us"] for r in measured]
    assert controls.throttle_us.tolist() == [r["throttle_raw_us"] for r in measured]
    stamps = np.array([r["arduino_timestamp"] for r in measured])
    assert controls.times_s == pytest.approx((stamps - stamps[0]) / 1000, abs=1e-6)  # it begins with a burst
    assert controls.left_out == len(rows) - len(measured)


@pytest.mark.parametrize("make", ["nothing", "empty", "frames", "fifo", "unmeasured"])
def test_no_controls_is_a_sentence(tmp_path, make):
    folder = tmp_path / NAME
    if make != "nothing":
        folder.mkdir()
    if make == "frames":
        (folder / "frame_data.csv").write_text("frame_id,timestamp,image_path\n1,1.0,x.jpg\n")
    if make == "fifo":
        os.mkfifo(folder / "control_data.csv")
    if make == "unmeasured":
        csv_of(folder, [row_of(1.0, 0, throttle_us=0), row_of(1.1, 100, steering_period_us=42632)])
    with pytest.raises(EpisodeError, match="no control with both pulses") as e:
        read_controls(folder)
    assert "\n" not in str(e.value)


ODD = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.just([]), st.just("nan"))
FIELDS = {
    "arduino_timestamp": st.integers(0, 2**32),
    "system_timestamp": st.one_of(st.floats(0, 3), st.floats()),
    "steering_raw_us": st.sampled_from([0, 1000, 1456, 1900.5]),
    "throttle_raw_us": st.sampled_from([0, 120, 136, "136", None]),
    "steering_period_us": st.sampled_from([21316, 42632]),
    "throttle_period_us": st.sampled_from([0, 1016]),
    "steering_normalized": st.just(0.1),
    "throttle_normalized": st.just(0.1),
    "throttle_measured": st.sampled_from([True, False, "False", "True", None]),
}
ROW = st.fixed_dictionaries({f: st.one_of(v, v, v, v, v, ODD) for f, v in FIELDS.items()})
WILD = st.one_of(
    ODD, st.fixed_dictionaries({"control_samples": st.one_of(st.lists(st.one_of(ROW, ROW, ODD), max_size=25), ODD)})
)
QUICK = settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))


def check_sane(folder):
    try:
        controls = read_controls(folder)
    except EpisodeError as e:
        assert "\n" not in str(e)
        return False
    n = len(controls.times_s)
    assert n == len(controls.steering_us) == len(controls.throttle_us) > 0
    assert controls.times_s[0] == 0
    assert np.isfinite(controls.times_s).all()
    assert (np.diff(controls.times_s) >= 0).all()
    assert (controls.steering_us > 0).all()
    assert (controls.throttle_us > 0).all()
    assert controls.steering_us.dtype == controls.throttle_us.dtype == np.int64
    return True


@QUICK
@given(content=WILD)
def test_wild_json(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("json")
    (folder / "episode_data.json").write_text(json.dumps(content))
    check_sane(folder)


@pytest.mark.slow
@QUICK
@given(rows=st.lists(ROW, max_size=25), tail=st.binary(max_size=40), cut=st.integers(0, 60))
def test_wild_csv(tmp_path_factory, rows, tail, cut):
    folder = tmp_path_factory.mktemp("csv")
    with (folder / "control_data.csv").open("w", newline="") as f:
        table = csv.DictWriter(f, list(FIELDS))
        table.writeheader()
        table.writerows(rows)
    path = folder / "control_data.csv"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - cut] + tail)
    check_sane(folder)
