"""`rover label`: one field of an episode's file."""

import json
import os
import stat

import pytest
from click.testing import CliRunner
from test_episodes import load, record

from rover_lib.cli import main
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording.outcome import label


@pytest.fixture
def episode(tmp_path):
    return record(tmp_path, "episode_20260101_120000", frames=10)


def test_one_line_is_added_and_removed_and_owner_and_mode_stay(episode):
    """On a rover they are the service's, and root labels."""
    path = episode / "episode_data.json"
    path.chmod(0o640)
    if os.geteuid() == 0:
        os.chown(path, 1234, 1234)
    before, text = path.stat(), path.read_text()
    for outcome in ("hit", "missed"):
        label([episode], outcome)
        added = set(path.read_text().splitlines()) - set(text.splitlines())
        assert f'    "outcome": "{outcome}"' in added and len(added) == 2  # and a comma before it
    label([episode], "none")
    after = path.stat()
    assert path.read_text() == text and stat.S_IMODE(after.st_mode) == 0o640
    assert (after.st_uid, after.st_gid) == (before.st_uid, before.st_gid)


@pytest.mark.parametrize("data", [b"", b"[1]", b'{"metadata": 3}', b"[" * 100_000, b"\xff\xfe\x00"])
def test_another_file_stays_as_it_is(episode, tmp_path, data):
    path, other = tmp_path / "episode_data.json", (episode / "episode_data.json").read_bytes()
    path.write_bytes(data)
    with pytest.raises(EpisodeError):
        label([episode, tmp_path], "missed")
    assert path.read_bytes() == data and (episode / "episode_data.json").read_bytes() == other


def test_a_full_disk_leaves_the_old_file(episode, monkeypatch):
    before = (episode / "episode_data.json").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(EpisodeError, match="No space"):
        label([episode], "hit")
    assert (episode / "episode_data.json").read_bytes() == before and len(list(episode.iterdir())) == 4


def test_the_command_and_the_loader(episode, tmp_path):
    other = record(tmp_path, "episode_20260101_120001", frames=10)
    words = ([episode, other, "missed"], [episode, "hit"], [episode, "perhaps"], [tmp_path, "hit"])
    codes = [CliRunner().invoke(main, ["label", *map(str, given)]).exit_code for given in words]
    assert codes == [0, 0, 2, 1]
    assert [e.outcome for e in load(tmp_path).episodes] == ["hit", "missed"]
    assert json.loads((other / "episode_data.json").read_text())["metadata"]["outcome"] == "missed"
