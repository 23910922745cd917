"""A run is opened as a copy: what is executed again there leaves the run as it was."""

import pytest

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run.copy_run import copy_run


@pytest.fixture
def run_dir(tmp_path):
    folder = tmp_path / "runs" / "demo"
    (folder / "figures").mkdir(parents=True)
    for name in ("01_load.ipynb", "best_model.pth", "policy_static.pt", "benchmark-pi.json"):
        (folder / name).write_text("whole")
    return folder


def test_a_copy_has_what_the_run_left_and_is_made_once(run_dir):
    copy = copy_run("demo", "try1", run_dir.parent)
    assert {p.name for p in copy.iterdir()} == {"01_load.ipynb", "policy_static.pt", "figures", "benchmark-pi.json"}
    (copy / "policy_static.pt").write_text("turned")
    assert copy_run("demo", "try1", run_dir.parent) == copy  # opened again, not made anew
    assert [(f / "policy_static.pt").read_text() for f in (copy, run_dir)] == ["turned", "whole"]


@pytest.mark.parametrize(("name", "copy"), [("dmo", ""), ("demo", "demo"), ("demo", "taken")])
def test_what_cannot_be_copied_is_refused(run_dir, name, copy):
    (run_dir.parent / "taken").mkdir()
    with pytest.raises(RoverError):
        copy_run(name, copy, run_dir.parent)
