import shutil

import pytest

from balloon_world.level import HARD
from balloon_world.record import record_episodes
from rover_lib.onboard.errors import TrainingError

pytestmark = pytest.mark.slow


def bytes_of(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


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


def test_hard_is_another_recording(tmp_path):
    record_episodes(tmp_path / "easy", count=1)
    record_episodes(tmp_path / "hard", count=1, level=HARD)
    assert bytes_of(tmp_path / "easy").keys() != bytes_of(tmp_path / "hard").keys()
    with pytest.raises(TrainingError, match="is not this recording"):
        (tmp_path / "hard" / "note.txt").write_text("mine")
        record_episodes(tmp_path / "hard", count=1)
