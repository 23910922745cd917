"""Stage files: whole or absent, and plain JSON."""

import json

import numpy as np
import pytest
import torch

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import atomic_path, read_stage, write_stage


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


def test_a_file_has_the_mode_that_the_umask_says(tmp_path):
    (tmp_path / "usual").touch()
    with atomic_path(tmp_path / "x") as temporary:
        temporary.write_text("whole")
    assert (tmp_path / "x").stat().st_mode == (tmp_path / "usual").stat().st_mode
