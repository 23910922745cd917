"""The cache is where the user says; each entry is made once, and its key says what it was made from."""

import json
from pathlib import Path

from rover_lib.workshop.cache import cache_folder, cache_root, key_of
from rover_lib.workshop.recordings import episodes


def test_the_cache_is_where_the_user_says(monkeypatch, tmp_path):
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path))
    assert cache_root() == tmp_path
    monkeypatch.delenv("ROVER_CACHE")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_root() == tmp_path / ".cache" / "rover"


def test_a_cached_folder_is_made_once(monkeypatch, tmp_path):
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path))
    made = []

    def make(folder):
        made.append(folder)
        (folder / "file").write_text("x")

    assert cache_folder("thing", "1", make) == cache_folder("thing", "1", make) == tmp_path / "thing-1"
    assert len(made) == 1


def test_keys_follow_parameters_and_sources():
    file = Path(__file__)
    assert key_of({"a": 1}, episodes, file) == key_of({"a": 1}, episodes, file)
    assert key_of({"a": 1}, episodes, file) != key_of({"a": 2}, episodes, file)
    assert key_of({"a": 1}, episodes, file) != key_of({"a": 1}, json, file)
