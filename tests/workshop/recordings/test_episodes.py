"""Every fault seen in recordings, and some not seen yet, is counted and skipped, and never becomes an action."""

import math
import os
import shutil
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
import simplejpeg

from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.errors import EpisodeError
from rover_lib.workshop.recordings.controls import _refuse_other_pulses
from rover_lib.workshop.recordings.episodes import choose_calibration, load_recordings, split
from tests.helpers import hostile
from tests.helpers.episodes import (
    CHUNK,
    FRAME,
    OLD,
    burst,
    edit,
    kinds,
    load,
    record,
    redrawn,
    rewritten,
    steering_at,
    throttle_at,
)
from tests.helpers.recorded import real_recordings


def changed(tmp_path, change):
    """Load a faultless recording of which the JSON was changed."""
    edit(record(tmp_path), change)
    return load(tmp_path)


# ---- a faultless recording -------------------------------------------------------------------------------


@pytest.mark.parametrize("first_s", [0.1, 0.12])  # soon after a control, and soon before one
def test_pairs_of_a_faultless_recording(tmp_path, first_s):
    record(tmp_path, first_s=first_s)
    recordings = load(tmp_path)
    assert recordings.faults == ()
    (episode,) = recordings.episodes
    assert (episode.id, episode.label, episode.frames) == ("episode_20260101_120000", "hit red balloon", 40)
    assert episode.duration_s == pytest.approx(39 / 30)
    samples = recordings.samples
    assert len(samples) == 40 and samples[0].state.tolist() == [0, 0]  # neutral at the start
    for k, sample in enumerate(samples):
        assert sample.state.dtype == sample.chunk.dtype == np.float32 and sample.chunk.shape == (CHUNK, 2)
        assert sample.time_s == pytest.approx(k / 30, abs=1e-6)
        # The chunk is this frame's action and the next ones, each within half a control interval of the drive's.
        for step in range(CHUNK):
            t_s = first_s + min(k + step, 39) / 30
            assert sample.chunk[step, 0] == pytest.approx(steering_at(t_s), abs=0.9 * 0.017 + 0.001)
            assert sample.chunk[step, 1] == pytest.approx(throttle_at(t_s), abs=0.06 * 0.017 + 0.001)
        assert sample.is_pad.tolist() == [k + step >= 40 for step in range(CHUNK)]
    for before, after in pairwise(samples):
        assert after.state.tolist() == before.chunk[0].tolist()
        assert after.chunk[0].tolist() == before.chunk[1].tolist()


@pytest.mark.parametrize(
    ("columns", "driver"), [({}, "human"), ({"mode": "static"}, "policy"), ({"driver": "nobody"}, "nobody")]
)
def test_every_sample_says_who_drove(tmp_path, columns, driver):
    edit(record(tmp_path), lambda content: [row.update(columns) for row in content["control_samples"][10:]])
    edit(tmp_path / "episode_20260101_120000", lambda content: content["control_samples"][20].update(driver="the cat"))
    recordings = load(tmp_path)
    assert {sample.driver for sample in recordings.samples if sample.row > 15} == {driver}
    assert kinds(recordings)["unknown_driver"] == 1


def test_no_chunk_and_no_state_goes_over_to_where_nobody_drove(tmp_path):
    """While nobody drives, the car is held, and does not do what the sticks say."""

    def change(content):
        for row in content["control_samples"]:
            row["driver"] = "nobody" if 15 <= round((row["system_timestamp"] - 1000.1) * 30) < 25 else "human"

    recordings = changed(tmp_path, change)
    by_row = {sample.row: sample for sample in recordings.samples}
    drivers = {row: sample.driver for row, sample in by_row.items()}
    begin, end = (f([row for row, driver in drivers.items() if driver == "nobody"]) for f in (min, max))
    assert 8 <= end - begin <= 10 and kinds(recordings) == {"frame_without_state": 2}
    assert set(range(40)) - set(by_row) == {begin - 1, end + 1}
    for row, sample in by_row.items():
        left = (begin - 1 if row < begin - 1 else end + 1 if row <= end else 40) - row
        assert sample.is_pad.tolist() == [step >= left for step in range(CHUNK)]
    assert recordings.summary()["driven_by_pct"].keys() == {"human", "nobody"}


def test_summary_range_and_hashes(tmp_path):
    record(tmp_path)
    recordings = load(tmp_path)
    ends = recordings.action_range()
    assert ends["throttle"] == pytest.approx((0.01, 0.07), abs=0.004)
    assert ends["steering"][1] == pytest.approx(0.6, abs=0.01)
    hashes = recordings.hashes()
    assert len(hashes) == 43 and "episode_20260101_120000/frames/frame_000001.jpg" in hashes
    assert hashes == load(tmp_path / "episode_20260101_120000").hashes()


def test_pictures(tmp_path):
    folder = record(tmp_path, frames=3)
    samples = load(tmp_path).samples
    assert np.abs(samples[0].frame_bgr().astype(int) - FRAME).max() <= 3
    picture = folder / "frames/frame_000001.jpg"
    whole = picture.read_bytes()
    for damaged in (b"", hostile.cut(whole)):
        picture.write_bytes(damaged)
        with pytest.raises(EpisodeError, match="frame_000001"):
            samples[0].frame_bgr()
    picture.unlink()
    with pytest.raises(EpisodeError, match="cannot be read"):
        samples[0].frame_bgr()


# ---- the faults ------------------------------------------------------------------------------------------


def test_missing_and_truncated_pictures_cost_their_own_sample_only(tmp_path):
    folder = record(tmp_path)
    whole = load(tmp_path).samples
    (folder / "frames/frame_000005.jpg").write_bytes(simplejpeg.encode_jpeg(np.zeros((48, 64, 3), np.uint8)))
    (folder / "frames/frame_000010.jpg").unlink()
    padded = folder / "frames/frame_000015.jpg"  # which is no damage
    padded.write_bytes(padded.read_bytes() + bytes(20))
    torn = folder / "frames/frame_000025.jpg"  # and closed, so that OpenCV makes a picture of it
    torn.write_bytes(hostile.cut(torn.read_bytes()))
    cut = folder / "frames/frame_000020.jpg"
    cut.write_bytes(cut.read_bytes()[:-40])
    (folder / "frames/frame_000030.jpg").write_bytes(b"")
    recordings = load(tmp_path)
    assert kinds(recordings) == {"frame_missing": 1, "broken_jpeg": 3, "another_size": 1}
    left = [s for k, s in enumerate(whole) if k not in (4, 9, 19, 24, 29)]
    assert [s.chunk.tolist() for s in recordings.samples] == [s.chunk.tolist() for s in left]
    assert [s.state.tolist() for s in recordings.samples] == [s.state.tolist() for s in left]


def as_another(folder, change):
    """A copy of a recording, changed, under another name."""
    copy = shutil.copytree(folder, folder.with_name("episode_20270101_000099"))
    change(copy)


COPIES = [
    lambda folder: None,
    redrawn(lambda picture: cv2.resize(picture, None, fx=0.5, fy=0.5)),
    lambda folder: edit(folder, lambda content: content["frame_samples"].pop(7)),
    lambda folder: edit(folder, lambda content: content["frame_samples"].__delitem__(slice(20))),
    lambda folder: edit(folder, lambda content: content.update(frame_samples=content["frame_samples"][::4])),
    redrawn(lambda picture: cv2.add(picture, (40, 40, 40, 0))),
]


@pytest.mark.parametrize("change", COPIES)
def test_the_same_drive_again_is_left_out(tmp_path, change):
    """Else what is held out also calibrates, as in a backup's folder."""
    for second in range(3):
        folder = record(tmp_path, f"episode_20260101_12000{second}", frames=60)
    as_another(folder, change)
    recordings = load(tmp_path)
    assert [e.id[-2:] for e in recordings.episodes] == ["00", "01", "02"]
    (fault,) = [f for f in recordings.faults if f.kind == "copy"]
    assert fault.handled == "left out" and "the same drive as episode_20260101_120002" in fault.note


def test_equal_actions_before_other_scenes_are_no_copy(tmp_path):
    """As a keyboard makes them."""
    as_another(record(tmp_path), redrawn(lambda picture: np.full_like(picture, 90)))
    assert len(load(tmp_path).episodes) == 2


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("models/a/model_metadata.json", "DeepRacer"),
        ("set/40_30_ab.jpg", "JetRacer"),
        ("policy_best.ckpt", "the first ACT"),
        ("episode_0.hdf5", "the first ACT"),
        ("2026-01-01--0/rlog.zst", "openpilot"),
        ("drives.zip", "unpack it"),
        ("shard-000001.tar", "WebDataset"),
        ("GX010001.MP4", "videos without actions"),
        ("mycar/manage.py", "donkeycar's folder without a tub"),
        ("route/measurements/1.json.gz", "CARLA"),
        ("1.0.0/car.array_record-00000-of-00001", "TensorFlow"),
        ("record_7.json", "donkeycar 3.*convert_to_tub_v2.py"),
        ("data/chunk-000/file-000.parquet", "copy the whole dataset"),
        ("notes.md", "no episode folders in it, found .*notes.md; only folders of episodes"),
        ("tub_1/manifest.json", "tub_1/manifest.json: lists no catalogs"),
        ("more/episode_1/episode_data.json", "a folder of 1 folders of recordings"),
    ],
)
def test_what_others_bring_is_called_what_it_is(tmp_path, file, words):
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).touch()
    if file.startswith("tub"):
        (tmp_path / file).with_name("catalog_0.catalog").touch()
    with pytest.raises(EpisodeError, match=words) as e:
        load(tmp_path)
    assert "record again" not in str(e.value)


def test_other_folders_between_episodes_are_named(tmp_path):
    """A backup in its own folder, and what computers leave."""
    shutil.copytree(record(tmp_path), tmp_path / "backup" / "episode_20260101_120000")
    for name in (".ipynb_checkpoints", "__MACOSX"):
        (tmp_path / name).mkdir()
    (tmp_path / "._episode_20260101_120000").touch()
    recordings = load(tmp_path)
    assert kinds(recordings) == {"no_episode": 1} and len(recordings.samples) == 40


NO_PULSES = [
    {"throttle_raw_us": 0, "throttle_period_us": 0, "throttle_normalized": 0.0},
    {"throttle_raw_us": 0, "throttle_period_us": 2032, "throttle_normalized": 0.0},
    {"throttle_measured": False, "throttle_raw_us": None, "throttle_period_us": None, "throttle_normalized": None},
]


@pytest.mark.parametrize("lost", NO_PULSES, ids=["no period", "no pulse", "flagged"])
def test_throttle_without_a_measured_pulse_is_missing_not_zero(tmp_path, lost):
    edit(record(tmp_path), lambda content: [row.update(lost) for row in content["control_samples"][20:30]])
    recordings = load(tmp_path)
    kind = "throttle_no_pulse" if "throttle_measured" in lost else "throttle_zero_period"
    assert kinds(recordings) == {kind: 10, "frame_without_measurement": 8, "frame_without_state": 1}
    assert min(s.chunk[:, 1].min() for s in recordings.samples) > 0.009  # the drive's least throttle, no 0
    before = [s for s in recordings.samples if s.time_s < 0.7]
    assert before[-1].is_pad.tolist() == [False] + [True] * (CHUNK - 1)  # the hole ends the chunks before it


def single_readings_are_lost(content):
    controls = content["control_samples"]
    controls[20].update(steering_period_us=42632, steering_normalized=0.0)  # two periods at once
    for control in controls[5:35:3]:
        control.update(NO_PULSES[0])


def two_frames_lack_controls(content):
    del content["control_samples"][20:24]  # 165 ms: two frames in it are more than 50 ms from both ends


def two_frames_are_there_twice(content):
    frames = content["frame_samples"]
    frames[10]["frame_id"], frames[20]["timestamp"] = frames[9]["frame_id"], frames[19]["timestamp"]


@pytest.mark.parametrize(
    ("change", "found", "samples"),
    [
        (single_readings_are_lost, {"throttle_zero_period": 10, "steering_odd_period": 1}, 40),
        (lambda c: c["control_samples"][20].update(steering_normalized=0.99), {"steering_disagrees_with_pulse": 1}, 40),
        (two_frames_lack_controls, {"frame_without_control": 2, "frame_without_state": 1}, 37),
        (two_frames_are_there_twice, {"duplicate_frame_id": 1, "duplicate_frame_time": 1}, 38),
    ],
)
def test_a_fault_costs_its_own_frames_only(tmp_path, change, found, samples):
    recordings = changed(tmp_path, change)
    assert kinds(recordings) == found and len(recordings.samples) == samples
    assert min(s.chunk[:, 1].min() for s in recordings.samples) > 0.009
    assert "frame_without_control" not in found or len(load(tmp_path, sync_s=0.1).samples) == 40


@pytest.mark.parametrize(("gone", "samples"), [(slice(20, 30), 29), (slice(1, -1), 1)], ids=["a hole", "two frames"])
def test_a_hole_in_time_ends_chunks_and_states(tmp_path, gone, samples):
    edit(record(tmp_path), lambda content: content["frame_samples"].__delitem__(gone))
    recordings = load(tmp_path)
    assert kinds(recordings) == {"hole_in_time": 1, "frame_without_state": 1}
    assert len(recordings.samples) == samples
    assert recordings.samples[min(samples - 1, 19)].is_pad.sum() == CHUNK - 1


@pytest.mark.parametrize("wraps", [False, True], ids=["later", "over the wrap"])
def test_serial_burst_is_placed_by_the_arduinos_clock(tmp_path, wraps):
    folder = record(tmp_path)
    whole = load(tmp_path).samples

    def change(content):
        burst(content)
        for k, control in enumerate(content["control_samples"] if wraps else ()):
            control["arduino_timestamp"] = (2**32 - 330 + 33 * k) % 2**32

    edit(folder, change)
    recordings = load(tmp_path)
    assert kinds(recordings) == {"serial_burst": 20}
    assert wraps or "0.65 s" in recordings.faults[0].note
    assert [s.chunk.tolist() for s in recordings.samples] == [s.chunk.tolist() for s in whole]


def test_serial_burst_that_the_clock_cannot_place_is_dropped(tmp_path):
    def change(content):
        burst(content)
        content["control_samples"][15]["arduino_timestamp"] = 10**6

    found = kinds(changed(tmp_path, change))
    assert (found.pop("serial_burst"), found.pop("serial_burst_dropped")) == (4, 16)
    assert found == {"frame_without_control": 12, "frame_without_state": 1}


@pytest.mark.parametrize("text", ["", "{", "[]", '{"control_samples": {}, "frame_samples": 1}', "[" * 10_000_000])
def test_without_json_the_csvs_serve(tmp_path, text):
    folder = record(tmp_path)
    whole = load(tmp_path).samples
    (folder / "episode_data.json").write_text(text)
    recordings = load(tmp_path)
    assert kinds(recordings) == {"broken_json": 1}
    assert [s.chunk.tolist() for s in recordings.samples] == [s.chunk.tolist() for s in whole]
    assert [s.state.tolist() for s in recordings.samples] == [s.state.tolist() for s in whole]


def test_faults_of_a_csv_are_counted_and_another_table_is_refused(tmp_path):
    folder = record(tmp_path)
    (folder / "episode_data.json").unlink()
    lines = (folder / "control_data.csv").read_text().splitlines()
    lines[3] = "1,2"
    lines[6] = lines[6].replace("1000.", "nan1000.")
    lines[9] = "99," + "nan," + ",".join(lines[9].split(",")[2:])
    (folder / "control_data.csv").write_text("\n".join(lines))
    assert kinds(load(tmp_path)) == {"broken_json": 1, "wrong_type": 2, "not_finite": 1}
    (folder / "control_data.csv").write_text("a,b\n1,2\n")
    with pytest.raises(EpisodeError, match=r"unreadable 1 times.*no column arduino_timestamp"):
        load(tmp_path)


def test_not_finite_and_wrong_types_are_counted_and_skipped(tmp_path):
    def change(content):
        controls, frames = content["control_samples"], content["frame_samples"]
        controls[20]["system_timestamp"] = math.nan
        controls[23]["steering_normalized"] = math.inf
        controls[26]["throttle_raw_us"] = None
        controls[29]["throttle_normalized"] = 7.0
        controls.append("control")
        controls[5], controls[12] = controls[12], controls[5]
        frames[10]["timestamp"] = math.nan
        frames[15]["image_path"] = 15
        frames[20]["frame_id"] = "x"
        frames[25]["timestamp"] = 10**400
        frames[30]["image_path"] = ""
        frames += [None, {}]

    recordings = changed(tmp_path, change)
    odd = {"unsorted_control_times": 2}
    assert kinds(recordings) == {"not_finite": 4, "wrong_type": 7, "throttle_out_of_range": 1} | odd
    assert len(recordings.samples) == 35
    assert all(np.isfinite(s.chunk).all() and np.isfinite(s.state).all() for s in recordings.samples)


@pytest.mark.parametrize(
    ("names", "wrong", "share"),
    [("steering throttle", 0, 1), ("steering", 0, 1), ("steering throttle", 3, 1), ("steering throttle", 0, 0.6)],
)
def test_actions_of_the_older_formula_are_recomputed_from_their_pulses(tmp_path, names, wrong, share):
    """A stopped car, 120 us, stood as 0.1687 in most real recordings. One may begin with one and end with the other."""
    whole = [s.chunk.tolist() for s in load(record(tmp_path)).samples]
    edit(tmp_path / "episode_20260101_120000", rewritten({name: OLD[name] for name in names.split()}, wrong, share))
    recordings = load(tmp_path)
    assert np.abs(np.array([s.chunk.tolist() for s in recordings.samples]) - whole).max() <= 1e-4
    said = {"steering": "steering = (duty % - 7) / 2.42", "throttle": "throttle = duty % / 70"}
    assert recordings.recomputed().endswith(": " + ", ".join(said[name] for name in names.split()))
    assert recordings.faults_by_kind().keys() == {"recomputed from the pulses"}


@pytest.mark.parametrize(("name", "formula"), [("steering", (7, 2.4)), ("throttle", (5, 95))])
def test_actions_of_any_other_formula_are_refused(tmp_path, name, formula):
    record(tmp_path)
    edit(record(tmp_path, "episode_20260102_120000"), rewritten({name: formula}))
    recordings = load(tmp_path)
    assert [e.id for e in recordings.episodes] == ["episode_20260101_120000"]
    (fault,) = recordings.faults
    assert fault.kind == "no_formula" and fault.handled == "left out"
    assert name in fault.note and "its pulse says" in fault.note


def test_the_few_readings_of_one_channel_are_recomputed_where_the_other_channels_are(tmp_path):
    """Too few readings to show a formula were taken as recorded beside a steering that was recomputed."""
    whole = [s.chunk.tolist() for s in load(record(tmp_path)).samples]
    folder = tmp_path / "episode_20260101_120000"
    edit(folder, rewritten({"steering": OLD["steering"]}, share=0.6))
    edit(folder, rewritten({"throttle": (5, 80)}, share=0.09))  # four, and the fourth is the first frame's
    recordings = load(tmp_path)
    assert np.abs(np.array([s.chunk.tolist() for s in recordings.samples]) - whole).max() <= 1e-3
    assert recordings.faults_by_kind().keys() == {"recomputed from the pulses"}


@pytest.mark.parametrize(
    ("reason", "table", "column", "factor"),
    [
        ("no_formula 1 times", "control_samples", "steering_raw_us", 1e-3),
        ("no_overlap 1 times", "frame_samples", "timestamp", 2),
    ],
)
def test_the_reason_why_nothing_is_usable_comes_first(tmp_path, reason, table, column, factor):
    """What was recomputed, repaired or absent was counted and quoted as the reason; pulses in ms gave full left."""

    def change(content):
        for row in content[table]:
            row[column] *= factor

    edit(edit(record(tmp_path), rewritten(OLD)), change)
    with pytest.raises(EpisodeError, match=rf"\({reason}"):
        load(tmp_path)


def test_the_real_recordings_are_recomputed():
    recordings = load(real_recordings())
    assert len(recordings.episodes) == 6 and "5 of 6" in recordings.recomputed()
    assert recordings.action_range()["throttle"] == pytest.approx((0, 0.0812), abs=1e-3)
    assert sum(s.chunk[0, 1] > 0.1 for s in recordings.samples) == 0


@pytest.mark.parametrize("back_s", [0.2, 30])
def test_what_follows_on_a_clock_that_was_set_back_is_left_out(tmp_path, back_s):
    """Otherwise frames of two moments would have the same time, and get each other's actions."""
    folder = record(tmp_path)
    whole = {s.frame_name: s.chunk[0].tolist() for s in load(tmp_path).samples}

    def change(content):
        for i, frame in enumerate(content["frame_samples"]):
            frame["timestamp"] -= back_s * (i >= 20)
        set_s = content["frame_samples"][19]["timestamp"]
        for control in content["control_samples"]:
            control["system_timestamp"] -= back_s * (control["system_timestamp"] > set_s)

    edit(folder, change)
    recordings = load(tmp_path)
    assert kinds(recordings) == {"clock_set_back_at_frame": 20, "clock_set_back_at_control": 23}
    assert {s.frame_name: s.chunk[0].tolist() for s in recordings.samples} == dict(list(whole.items())[:20])


@pytest.mark.parametrize(("row", "wrong_s"), [(0, 60), (7, -60), (20, 60)])
def test_one_wrong_time_is_no_clock_that_was_set(tmp_path, row, wrong_s):
    def change(content):
        content["frame_samples"][row]["timestamp"] += wrong_s
        content["control_samples"][row]["system_timestamp"] += wrong_s

    recordings = changed(tmp_path, change)
    assert not {kind for kind in kinds(recordings) if kind.startswith("clock_set_back")}
    assert len(recordings.samples) > 20


def test_paths_that_leave_the_folder(tmp_path):
    outside = record(tmp_path / "other", "episode_20260101_000000") / "frames/frame_000001.jpg"
    folder = record(tmp_path / "mine")
    (folder / "frames/link.jpg").symlink_to(outside)
    os.mkfifo(folder / "frames/pipe.jpg")
    leaving = ["../../other/episode_20260101_000000/frames/frame_000001.jpg", str(outside), "frames/link.jpg"]
    other = ["frames/pipe.jpg", "frames", "frames/a\0b.jpg", "x" * 5000]

    def change(content):
        for frame, path in zip(content["frame_samples"][5:], leaving + other, strict=False):
            frame["image_path"] = path

    edit(folder, change)
    recordings = load(tmp_path / "mine")
    assert kinds(recordings) == {"path_leaves_folder": len(leaving), "frame_missing": len(other)}
    assert all(s.frame_path.resolve().is_relative_to(folder) for s in recordings.samples)


@pytest.mark.parametrize("make", [lambda root: None, lambda root: root.write_text("x"), lambda root: root.mkdir()])
def test_no_recordings_is_one_sentence(tmp_path, make):
    make(tmp_path / "episodes")
    for options in ({}, {"chunk": 0}, {"sync_s": math.nan}, {"sync_s": 0.0}):
        with pytest.raises(EpisodeError) as e:
            load(tmp_path / "episodes", **options)
        assert "\n" not in str(e.value) and ("sync_s above 0" in str(e.value)) == bool(options)


def test_the_folder_in_which_one_stands_names_its_episode(tmp_path, monkeypatch):
    monkeypatch.chdir(record(tmp_path))
    assert load(".").episodes[0].id == "episode_20260101_120000"


# ---- splitting and choosing ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    root = tmp_path_factory.mktemp("many")
    for k in range(16):
        record(root, f"episode_20260101_{k:06d}", frames=12)
    return load(root)


def test_split_by_whole_episodes(many):
    parts = split(many, 0.25, seed=0)
    assert {p: len(ids) for p, ids in parts.episodes.items()} == {"calibration": 12, "choosing": 2, "held_out": 2}
    assert parts.note is None
    assert sorted(i for part in parts.episodes.values() for i in part) == [e.id for e in many.episodes]
    assert len(parts.calibration) + len(parts.choosing) + len(parts.held_out) == len(many.samples)
    assert split(many, 0.25, seed=0).episodes == parts.episodes
    assert any(split(many, 0.25, seed=k).episodes != parts.episodes for k in range(1, 5))


def test_few_episodes_are_parted_along_time_with_a_gap(tmp_path):
    for k in range(2):
        record(tmp_path, f"episode_20260101_{k:06d}", frames=60)
    parts = split(load(tmp_path))
    assert "along time" in parts.note
    for k in range(2):
        every = (parts.calibration, parts.choosing, parts.held_out)
        times = [[s.time_s for s in part if s.episode.endswith(str(k))] for part in every]
        assert all(times)
        for before, after in pairwise(times):
            # A chunk's last action is (CHUNK - 1) frames after its frame, so no action is shared.
            assert min(after) - max(before) > (CHUNK - 0.5) / 30
        # Without two gaps of 8, 44 of 60 frames are left, and 11 of these are held out: 5 choose, 6 judge.
        assert [len(part) for part in times] == [33, 5, 6]
    assert load_recordings(tmp_path).samples[0].chunk.shape == (32, 2)
    smallest = split(load(record(tmp_path / "smallest", frames=2 * CHUNK + 3)))
    assert [len(smallest.calibration), len(smallest.choosing), len(smallest.held_out)] == [1, 1, 1]
    with pytest.raises(EpisodeError, match="too short to be parted"):
        split(load(record(tmp_path / "short", frames=2 * CHUNK)))


def test_calibration_covers_the_recorded_actions(many):
    chosen, note = choose_calibration(many.samples, 20, seed=0)
    assert note is None
    assert len({id(s) for s in chosen}) == 20
    assert [id(s) for s in choose_calibration(many.samples, 20, seed=0)[0]] == [id(s) for s in chosen]
    assert [id(s) for s in choose_calibration(many.samples, 20, seed=1)[0]] != [id(s) for s in chosen]
    recorded = np.concatenate([s.chunk for s in many.samples])
    covered = np.concatenate([s.chunk for s in chosen])
    np.testing.assert_allclose(np.ptp(covered, axis=0), np.ptp(recorded, axis=0), rtol=0.02)
    order = {id(s): k for k, s in enumerate(many.samples)}
    places = [order[id(s)] for s in chosen]
    assert places == sorted(places)


def test_fewer_than_asked_is_said(many):
    chosen, note = choose_calibration(many.samples[:7], 200)
    assert len(chosen) == 7
    assert "only 7" in note
    assert choose_calibration(many.samples[:7], 7)[1] is None
    with pytest.raises(EpisodeError, match="cannot choose"):
        choose_calibration((), 10)
    same = tuple(replace(many.samples[0]) for _ in range(30))
    assert len({id(s) for s in choose_calibration(same, 10)[0]}) == 10, "none is taken twice"


@pytest.mark.parametrize(("far", "refused"), [(20, False), (21, True), (39, True)])
def test_pulses_of_another_car_are_refused_if_most_are(far, refused):
    """Of 40: not only if each is. The recorded car's steering reaches from 900 to 2012 us."""
    pulses = {i: 9000.0 if i < far else 1456.0 for i in range(40)}
    with pytest.raises(EpisodeError, match=f"{far} of 40") if refused else nullcontext():
        _refuse_other_pulses(PwmCalibration().steering, pulses)
