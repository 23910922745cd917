"""Ids of the Hub, by a cache as its client leaves it and a Hub that is not there: a folder, or one sentence."""

import json
import shutil

import pytest
from policies import TINY, lerobot_policy

from rover_lib.onboard.errors import CheckpointError, EpisodeError
from rover_lib.workshop import hub
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.recordings.episodes import load_recordings

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The Hub's cache of this machine, without network: a function that puts a repository into it."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)

    def put(kind, repo, revision="main"):
        folder = tmp_path / "hub" / f"{kind}s--{repo.replace('/', '--')}"
        (folder / "refs").mkdir(parents=True)
        (folder / "refs" / revision).write_text(COMMIT)
        snapshot = folder / "snapshots" / COMMIT
        snapshot.mkdir(parents=True)
        return snapshot

    return put


def test_what_is_an_id_unless_it_is_a_path_that_is_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for text in ("user/name@main", "user/na.me_2@refs/pr/1", f"user/name@{COMMIT}"):
        assert hub.is_hub_id(text) and hub.absolute(text) == text
    (tmp_path / "user/name@main").mkdir(parents=True)
    for text in ("user/name", "runs/demo/episodes", "/user/name@main", "../name@main", "name@main", "user/name@main"):
        assert not hub.is_hub_id(text)
    assert hub.absolute("user/name@main") == str(tmp_path / "user/name@main")


def test_a_policy_of_the_hub(cache, tmp_path):
    policy = lerobot_policy(**TINY)
    policy.config.normalization_mapping = dict.fromkeys(("VISUAL", "STATE", "ACTION"), "IDENTITY")
    policy.save_pretrained(tmp_path / "policy")
    shutil.copytree(tmp_path / "policy", cache("model", "user/policy"), dirs_exist_ok=True)
    here, there = load_checkpoint(tmp_path / "policy"), load_checkpoint("user/policy@main")
    assert there.sha256 == here.sha256 and there.path.name == COMMIT


def test_without_network_nothing_is_left_behind(cache, tmp_path):
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(EpisodeError, match="cannot be reached"):
        load_recordings("user/name@v1")
    assert sorted(tmp_path.rglob("*")) == before


def test_a_dataset_of_another_version_is_refused_before_it_is_fetched(cache, monkeypatch):
    snapshot = cache("dataset", "user/drives")
    (snapshot / "meta").mkdir()
    (snapshot / "meta/info.json").write_text(json.dumps({"codebase_version": "v2.1"}))
    asked = []
    fetch = hub.fetch
    monkeypatch.setattr(hub, "fetch", lambda *a, **o: asked.append(o.get("files")) or fetch(*a, **o))
    with pytest.raises(EpisodeError, match="only v3"):
        load_recordings("user/drives@main")
    assert asked == [("meta/*",)]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("RepositoryNotFoundError", "is its name right"),
        ("RevisionNotFoundError", "give a branch"),
        ("GatedRepoError", "request access"),
        ("LocalEntryNotFoundError", "cannot be reached"),
    ],
)
def test_what_the_hub_refuses_is_a_sentence(monkeypatch, name, says):
    import huggingface_hub
    from huggingface_hub import errors

    kind = getattr(errors, name)

    def refuse(*_, **__):
        raise kind.__new__(kind)  # what such an error is made of is the client's affair

    monkeypatch.setattr(huggingface_hub, "snapshot_download", refuse)
    with pytest.raises(CheckpointError, match=says) as e:
        load_checkpoint("user/name@v9")
    assert "\n" not in str(e.value)
