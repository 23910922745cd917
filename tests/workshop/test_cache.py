"""The cache is where the user says; each entry is made once, and its key says what it was made from."""

import json
from pathlib import Path

from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.recordings import episodes


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
