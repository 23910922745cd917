import json
import shutil

import cv2
import numpy as np
import pytest

from balloon_world import record
from balloon_world.record import record_episodes
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import WorldError
from rover_lib.onboard.recording.episode import read_car_of
from rover_lib.workshop.recordings.episodes import load_recordings

pytestmark = pytest.mark.slow


def episodes_of(folder):
    return [json.loads((p / "episode_data.json").read_text()) for p in sorted(folder.glob("episode_*"))]


def bytes_of(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_episodes_say_what_was_done(recorded):
    episodes = episodes_of(recorded)
    assert len(episodes) == 5
    for folder, episode in zip(sorted(recorded.glob("episode_*")), episodes, strict=True):
        assert episode["episode_id"] == folder.name
        assert episode["action_label"] == "hit red balloon"
        assert episode["metadata"]["camera_fps"] == 30
        assert episode["metadata"]["camera_resolution"] == [640, 360]
        for frame in episode["frame_samples"]:
            assert cv2.imread(str(folder / frame["image_path"])).shape == (360, 640, 3)


def test_pulses_are_what_an_arduino_measures(recorded):
    controls = [c for e in episodes_of(recorded) for c in e["control_samples"]]
    for name in ("steering_raw_us", "throttle_raw_us", "steering_period_us", "throttle_period_us"):
        assert all(isinstance(c[name], int) and c[name] % 4 == 0 for c in controls)
    assert {c["steering_period_us"] for c in controls} == {21316}
    assert {c["throttle_period_us"] for c in controls} == {1016}
    assert min(c["throttle_raw_us"] for c in controls) >= 120, "never below stopped"


def test_the_loader_finds_no_fault_and_the_recordings_range(recorded):
    recordings = load_recordings(recorded)
    assert not recordings.faults
    assert len(recordings.episodes) == 5
    ranges = recordings.action_range()
    assert -0.75 < ranges["steering"][0] < 0 < ranges["steering"][1] < 0.75
    assert ranges["throttle"][0] < 0.02
    assert 0.07 < ranges["throttle"][1] < 0.1


def test_drives_last_seconds_at_thirty_a_second(recorded):
    for episode in episodes_of(recorded):
        assert 2 < episode["duration"] < 8
        assert len(episode["frame_samples"]) == len(episode["control_samples"])
        assert np.diff([f["timestamp"] for f in episode["frame_samples"]]) == pytest.approx(1 / 30, abs=1e-5)
        assert np.diff([c["arduino_timestamp"] for c in episode["control_samples"]]) == pytest.approx(33, abs=1)


def test_the_same_seed_gives_the_same_bytes(recorded, tmp_path, monkeypatch):
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "another"))
    again = record_episodes(tmp_path / "again", count=5, seed=3)
    assert bytes_of(again) == bytes_of(recorded)


def test_a_recording_that_was_made_is_taken_from_the_cache(recorded, tmp_path, monkeypatch):
    def never(*args):
        raise AssertionError("recorded again")

    monkeypatch.setattr(record, "record_drive", never)
    again = record_episodes(tmp_path / "again", count=5, seed=3)
    assert bytes_of(again) == bytes_of(recorded)
    with pytest.raises(AssertionError, match="recorded again"):
        record_episodes(tmp_path / "other", count=5, seed=4)
    assert not (tmp_path / "other").exists()


def test_the_same_recording_in_place_is_left_as_it_is(recorded):
    before = {p: p.stat().st_mtime_ns for p in recorded.rglob("*")}
    assert record_episodes(recorded, count=5, seed=3) == recorded
    assert {p: p.stat().st_mtime_ns for p in recorded.rglob("*")} == before


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("do not touch")
    with pytest.raises(WorldError, match="is not this recording"):
        record_episodes(tmp_path, count=1)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(("count", "seed"), [(0, 0), (-1, 0), (1, -1)])
def test_a_recording_of_nothing_is_refused(tmp_path, count, seed):
    with pytest.raises(WorldError, match="at least 1 episode"):
        record_episodes(tmp_path / "episodes", count=count, seed=seed)
    assert not (tmp_path / "episodes").exists()


def test_a_failure_leaves_nothing(tmp_path, monkeypatch):
    def fails(folder, index, seed):
        (folder / "half").mkdir()
        raise OSError("disk full")

    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(record, "record_drive", fails)
    with pytest.raises(OSError, match="disk full"):
        record_episodes(tmp_path / "episodes", count=1)
    assert not (tmp_path / "episodes").exists()
    assert not list((tmp_path / "cache").iterdir())


def test_recordings_of_before_are_of_a_car_that_turns_left(recorded, tmp_path):
    """Their policies still hit: the side travels with the recordings, and all pulses stay as they are."""
    folder = shutil.copytree(sorted(recorded.glob("episode_*"))[0], tmp_path / "episode_1")
    assert read_car_of(folder) == Car()
    path = folder / "episode_data.json"
    content = json.loads(path.read_text())
    assert content["metadata"].pop("steering_positive") == "right"
    path.write_text(json.dumps(content))
    car = read_car_of(folder)
    assert car.positive == "left" and car.drives_like(Car()) and car.pwm == Car().pwm
