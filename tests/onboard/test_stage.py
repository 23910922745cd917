"""Stage files: whole or absent, and plain JSON."""

import json
import os
import stat

import numpy as np
import pytest
import torch

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import atomic_path, read_stage, sha256_of, write_stage


def test_writes_plain_json(tmp_path):
    path = tmp_path / "runs" / "x" / "load.json"
    metrics = {"a_ms": np.float32(1.5), "b": np.arange(2), "c": torch.tensor(3), "nan": float("nan"), "p": path}
    written = write_stage(path, "load", params={}, metrics=metrics, inputs={"f": "0"})
    assert read_stage(path, "load") == written == json.loads(path.read_text())
    assert written["metrics"] == {"a_ms": 1.5, "b": [0, 1], "c": 3, "nan": None, "p": str(path)}
    assert set(written) == {"schema", "stage", "params", "metrics", "inputs", "env"}
    assert {"host", "machine", "torch", "commit"} <= set(written["env"])
    with pytest.raises(RoverError):
        read_stage(path, "calibrate")


@pytest.mark.parametrize("content", [None, "{", "[]", '{"schema": 2, "stage": "load"}'])
def test_refuses_what_is_no_stage(tmp_path, content):
    path = tmp_path / "load.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(RoverError, match=str(path)):
        read_stage(path, "load")


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_a_file_has_the_mode_that_the_umask_says_and_the_umask_is_left_alone(tmp_path, monkeypatch, umask):
    """Whoever sets the umask, even to what it was, sets it for other threads that write a file just then."""
    set_umask = os.umask
    before = set_umask(umask)
    monkeypatch.setattr(os, "umask", lambda mask: pytest.fail(f"the umask was set to {mask:o}"))
    try:
        with atomic_path(tmp_path / "x") as temporary:
            temporary.write_text("whole")
    finally:
        set_umask(before)
    assert stat.S_IMODE((tmp_path / "x").stat().st_mode) == 0o666 & ~umask


def test_an_exception_leaves_the_old_file(tmp_path):
    path = tmp_path / "x"
    path.write_text("old")
    before = sha256_of(path)
    with pytest.raises(ZeroDivisionError), atomic_path(path) as temporary:
        temporary.write_text("half")
        1 / 0  # noqa: B018
    assert sha256_of(path) == before and list(tmp_path.iterdir()) == [path]
