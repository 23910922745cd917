"""`rover label`: one field of an episode's file."""

import json
import os
import stat

import numpy as np
import pytest
from click.testing import CliRunner

from rover_lib.cli import main
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording import outcome as module
from rover_lib.onboard.recording.episode import About, EpisodeWriter
from rover_lib.onboard.recording.outcome import label
from rover_lib.workshop.recordings.episodes import load_recordings

FRAME = np.full((18, 32, 3), (30, 90, 200), np.uint8)


def recorded(folder):
    with EpisodeWriter(folder, About("hit red balloon"), resolution=(32, 18)) as writer:
        for i in range(10):
            writer.control(1000 + i / 30, 33 * i, 1500, 150, 21316, 1016)
            writer.frame(1000 + i / 30, FRAME)
    return folder


@pytest.fixture
def episode(tmp_path):
    return recorded(tmp_path / "episode_20260101_120000")


def test_one_line_is_added_and_removed(episode):
    path = episode / "episode_data.json"
    before = path.read_text()
    for outcome in ("hit", "missed"):
        label([episode], outcome)
        added = set(path.read_text().splitlines()) - set(before.splitlines())
        assert f'    "outcome": "{outcome}"' in added and len(added) == 2  # and a comma before it
        assert json.loads(path.read_text())["metadata"]["outcome"] == outcome
    label([episode], "none")
    assert path.read_text() == before


@pytest.mark.parametrize("data", [b"", b"[1]", b'{"metadata": 3}', b"[" * 100_000, b"\xff\xfe\x00"])
def test_another_file_stays_as_it_is(episode, tmp_path, data):
    path, other = tmp_path / "episode_data.json", (episode / "episode_data.json").read_bytes()
    path.write_bytes(data)
    with pytest.raises(EpisodeError):
        label([episode, tmp_path], "missed")
    assert path.read_bytes() == data and (episode / "episode_data.json").read_bytes() == other
    path.unlink()
    with pytest.raises(EpisodeError, match="give each"):
        label([tmp_path], "hit")


@pytest.mark.parametrize("fails", ["replace", "fsync"])
def test_a_full_disk_leaves_the_old_file(episode, monkeypatch, fails):
    before = (episode / "episode_data.json").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((module.Path, "replace", full) if fails == "replace" else (os, "fsync", full)))
    with pytest.raises(EpisodeError, match="No space"):
        label([episode], "hit")
    assert (episode / "episode_data.json").read_bytes() == before and len(list(episode.iterdir())) == 4


def test_owner_and_mode_stay(episode):
    """On a rover they are the service's, and root labels."""
    path = episode / "episode_data.json"
    path.chmod(0o640)
    if os.geteuid() == 0:
        os.chown(path, 1234, 1234)
    before = path.stat()
    label([episode], "hit")
    after = path.stat()
    assert stat.S_IMODE(after.st_mode) == 0o640
    assert (after.st_uid, after.st_gid) == (before.st_uid, before.st_gid)


def test_the_command_and_the_loader(episode, tmp_path):
    other = recorded(tmp_path / "episode_20260101_120001")
    done = CliRunner().invoke(main, ["label", str(episode), str(other), "missed"])
    assert done.exit_code == 0, done.output
    assert CliRunner().invoke(main, ["label", str(episode), "hit"]).exit_code == 0
    recordings = load_recordings(tmp_path, chunk=2)
    assert [e.outcome for e in recordings.episodes] == ["hit", "missed"] and len(recordings.samples) == 20
    assert CliRunner().invoke(main, ["label", str(episode), "perhaps"]).exit_code == 2
    assert CliRunner().invoke(main, ["label", str(tmp_path), "hit"]).exit_code == 1
