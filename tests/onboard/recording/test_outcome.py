"""`rover label`: one word in an episode's file, and nothing else in it."""

import json
import os
import stat

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_lib.cli import main
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording import outcome as module
from rover_lib.onboard.recording.episode import About, EpisodeWriter
from rover_lib.onboard.recording.outcome import label, relabel
from rover_lib.workshop.recordings.episodes import load_recordings

FRAME = np.full((18, 32, 3), (30, 90, 200), np.uint8)


def recorded(folder):
    with EpisodeWriter(folder, About("hit red balloon"), resolution=(32, 18)) as writer:
        writer.metadata["source"] = "rover drive"
        for i in range(10):
            writer.control(1000 + i / 30, 33 * i, 1500, 150, 21316, 1016)
            writer.frame(1000 + i / 30, FRAME)
    return folder


@pytest.fixture
def episode(tmp_path):
    return recorded(tmp_path / "episode_20260101_120000")


def text_of(episode):
    return (episode / "episode_data.json").read_bytes()


def files_of(episode):
    return {p.relative_to(episode): p.read_bytes() for p in episode.rglob("*") if p.is_file()}


def test_one_line_is_added_and_taken_back(episode):
    before = files_of(episode)
    label([episode], "hit")
    lines = text_of(episode).decode().splitlines()
    old = before.pop(next(p for p in before if p.name == "episode_data.json")).decode()
    (place,) = [i for i, line in enumerate(lines) if line == '    "outcome": "hit"']
    assert lines[place - 1] == '    "source": "rover drive",' and lines[place + 1] == "  },"
    assert json.loads(text_of(episode))["metadata"].pop("outcome") == "hit"
    assert before.items() <= files_of(episode).items() and len(files_of(episode)) == len(before) + 1
    label([episode], "missed")
    assert text_of(episode).decode() == "\n".join(lines).replace('"hit"\n', '"missed"\n')
    label([episode], "none")
    assert text_of(episode).decode() == old
    label([episode], "none")
    assert text_of(episode).decode() == old


def test_the_loader_keeps_what_missed(tmp_path):
    episodes = [recorded(tmp_path / f"episode_20260101_12000{i}") for i in range(3)]
    label(episodes[:2], "missed")
    label(episodes[:1], "hit")
    recordings = load_recordings(tmp_path, chunk=2)
    assert [e.outcome for e in recordings.episodes] == ["hit", "missed", None]
    assert len(recordings.samples) == 30 and recordings.faults == ()
    assert recordings.summary()["outcomes"] == {"hit": 1, "missed": 1, "not labelled": 1}


@pytest.mark.parametrize(
    ("text", "after"),
    [
        ("{}", '{"metadata": {"outcome": "hit"}}'),
        ('{"a": 1}', '{"a": 1,"metadata": {"outcome": "hit"}}'),
        ('{ "metadata" : { } }', '{ "metadata" : {"outcome": "hit" } }'),
        ('{"metadata":{"outcome":null,"b":[{}]},"c":NaN}', '{"metadata":{"outcome":"hit","b":[{}]},"c":NaN}'),
        ('{"metadata":{"b":"}\\"","outcome":{"x":[1]}}}', '{"metadata":{"b":"}\\"","outcome":"hit"}}'),
        ('\ufeff{"metadata":{"b":1.50}}', '\ufeff{"metadata":{"b":1.50,"outcome": "hit"}}'),
        ('{\r\n\t"metadata": {\r\n\t\t"b": 2\r\n\t}\r\n}\r\n', None),
    ],
)
def test_whatever_the_file_looks_like_it_stays_so(tmp_path, text, after):
    path = tmp_path / "episode_data.json"
    path.write_bytes(text.encode())
    label([tmp_path], "hit")
    after = after or '{\r\n\t"metadata": {\r\n\t\t"b": 2,\r\n\t\t"outcome": "hit"\r\n\t}\r\n}\r\n'
    assert path.read_bytes() == after.encode()
    label([tmp_path], "none")
    assert "outcome" not in path.read_text()
    content = json.loads(path.read_bytes())
    assert "outcome" not in content["metadata"]


@settings(max_examples=40, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(["metadata", "control_samples", "é", 'a"b', ""]),
        st.recursive(
            st.none() | st.booleans() | st.floats(allow_nan=False) | st.integers() | st.text(max_size=5),
            lambda inner: st.lists(inner, max_size=3)
            | st.dictionaries(st.sampled_from(["outcome", "b", "}", "metadata"]), inner, max_size=3),
            max_leaves=8,
        ),
    ),
    st.sampled_from([None, 0, 2, "\t"]),
    st.booleans(),
)
def test_any_json_keeps_all_else(tmp_path_factory, content, indent, ascii_only):
    folder = tmp_path_factory.getbasetemp()
    text = json.dumps(content, indent=indent, ensure_ascii=ascii_only)
    path = folder / "episode_data.json"
    path.write_bytes(text.encode(errors="surrogatepass"))
    if not isinstance(content.get("metadata", {}), dict):
        with pytest.raises(EpisodeError, match="no object"):
            label([folder], "hit")
        return
    for outcome in ("hit", "missed"):
        label([folder], outcome)
        found = json.loads(path.read_bytes())
        assert found["metadata"].pop("outcome") == outcome
        wanted = {k: v for k, v in content.get("metadata", {}).items() if k != "outcome"}
        assert found == content | {"metadata": wanted}
    label([folder], "none")
    assert json.loads(path.read_bytes()) == content | {"metadata": wanted}


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "not readable as JSON"),
        (b"{", "not readable as JSON"),
        (b"[1]", "no object"),
        (b'{"metadata": 3}', "no object"),
        (b"[" * 100_000, "not readable as JSON"),
        (b"\xff\xfe\x00", "not readable as JSON"),
        (b'{"metadata": {"outcome": "hit"}, "metadata": {}}', "has a name twice"),
    ],
)
def test_what_is_no_episodes_file_stays_as_it_is(tmp_path, data, says):
    path = tmp_path / "episode_data.json"
    path.write_bytes(data)
    with pytest.raises(EpisodeError, match=says) as error:
        label([tmp_path], "missed")
    assert path.read_bytes() == data and "\n" not in str(error.value)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_folder_of_episodes_or_nothing_or_a_link_is_no_episode(episode, tmp_path):
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(EpisodeError, match="no episode with"):
            relabel(path, "hit")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "episode_data.json").symlink_to(episode / "episode_data.json")
    with pytest.raises(EpisodeError, match="no episode with"):
        relabel(tmp_path / "other", "hit")
    with pytest.raises(EpisodeError, match="one of hit, missed, none"):
        relabel(episode, "perhaps")


def test_all_or_none_are_labelled_where_one_is_no_episode(episode, tmp_path):
    before = text_of(episode)
    with pytest.raises(EpisodeError):
        label([episode, tmp_path / "nothing"], "hit")
    assert text_of(episode) == before


@pytest.mark.parametrize("fails", ["replace", "fsync"])
def test_a_full_disk_or_a_power_cut_leaves_the_old_file(episode, monkeypatch, fails):
    before = files_of(episode)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((module.Path, "replace", full) if fails == "replace" else (os, "fsync", full)))
    with pytest.raises(EpisodeError, match=r"cannot be written \(No space"):
        label([episode], "hit")
    assert files_of(episode) == before


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


def test_the_command(episode, tmp_path):
    other = recorded(tmp_path / "episode_20260101_120001")
    done = CliRunner().invoke(main, ["label", str(episode), str(other), "missed"])
    assert (done.exit_code, done.output) == (0, "2 labelled: missed\n")
    assert {e.outcome for e in load_recordings(tmp_path, chunk=2).episodes} == {"missed"}
    done = CliRunner().invoke(main, ["inspect", str(tmp_path)])
    assert "missed" in done.output and "human" in done.output, done.output
    assert CliRunner().invoke(main, ["label", str(episode), "perhaps"]).exit_code == 2
    assert CliRunner().invoke(main, ["label", "hit"]).exit_code == 2
    done = CliRunner().invoke(main, ["label", str(tmp_path), "hit"])
    assert done.exit_code == 1 and "give each episode's folder" in done.output
