import json
import shutil

import cv2
import pytest

from balloon_world.record import record_episodes
from rover_lib.onboard.errors import TrainingError

pytestmark = pytest.mark.slow


def bytes_of(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_episodes_say_what_was_done(recorded):
    folders = sorted(recorded.glob("episode_*"))
    assert len(folders) == 5
    for folder in folders:
        episode = json.loads((folder / "episode_data.json").read_text())
        assert (episode["episode_id"], episode["action_label"]) == (folder.name, "hit red balloon")
        assert (episode["metadata"]["camera_fps"], episode["metadata"]["camera_resolution"]) == (30, [640, 360])
        assert cv2.imread(str(folder / episode["frame_samples"][-1]["image_path"])).shape == (360, 640, 3)
        for control in episode["control_samples"]:  # pulses are what an Arduino measures
            measured = control["steering_raw_us"], control["throttle_raw_us"]
            assert all(isinstance(us, int) and us % 4 == 0 for us in measured) and measured[1] >= 120
            assert (control["steering_period_us"], control["throttle_period_us"]) == (21316, 1016)


def test_the_same_seed_gives_the_same_bytes_also_in_place_of_another_versions(recorded, tmp_path):
    again = shutil.copytree(recorded, tmp_path / "again")
    marker = again / ".recorded.json"
    marker.write_text(marker.read_text().replace('"key": "', '"key": "of another version '))
    (again / "episode_20250104_120000" / "control_data.csv").write_text("another")
    refused = {path: path.read_bytes() for path in again.rglob("*") if path.is_file()}
    with pytest.raises(TrainingError, match="is not this recording"):  # somebody has edited it
        record_episodes(again, count=5, seed=3)
    assert {path: path.read_bytes() for path in refused} == refused
    marker.touch()
    assert bytes_of(record_episodes(again, count=5, seed=3)) == bytes_of(recorded)
    before = {p: p.stat().st_mtime_ns for p in recorded.rglob("*")}
    assert record_episodes(recorded, count=5, seed=3) == recorded  # which is left as it is
    assert {p: p.stat().st_mtime_ns for p in recorded.rglob("*")} == before


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("do not touch")
    with pytest.raises(TrainingError, match="is not this recording"):
        record_episodes(tmp_path, count=1)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
