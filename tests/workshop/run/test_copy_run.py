"""A run is opened as a copy: what is executed again there leaves the run as it was."""

import json

import pytest

from rover_lib.workshop.run.copy_run import copy_run
from rover_lib.workshop.run.run import NotebookError


@pytest.fixture
def run_dir(tmp_path):
    folder = tmp_path / "runs" / "demo"
    (folder / "figures").mkdir(parents=True)
    cell = f"run_dir = {json.dumps(str(folder))}\nepisodes = {json.dumps(str(folder / 'episodes'))}"
    (folder / "01_load.ipynb").write_text(json.dumps({"cells": [{"source": cell}]}))
    (folder / "best_model.pth").write_text("weights")
    (folder / "policy_static.pt").write_text("whole")
    (folder / "benchmark-pi.json").write_text("{}")
    return folder


def test_a_copy_works_in_its_own_folder_and_reads_the_same_recordings(run_dir):
    copy = copy_run("demo", "try1", run_dir.parent)
    cell = json.loads((copy / "01_load.ipynb").read_text())["cells"][0]["source"]
    assert cell.splitlines() == [f'run_dir = "{copy}"', f'episodes = "{run_dir}/episodes"']
    assert {p.name for p in copy.iterdir()} == {"01_load.ipynb", "policy_static.pt", "figures", "benchmark-pi.json"}
    (copy / "policy_static.pt").write_text("turned")
    assert copy_run("demo", "try1", run_dir.parent) == copy  # opened again, not made anew
    assert [(f / "policy_static.pt").read_text() for f in (copy, run_dir)] == ["turned", "whole"]
    assert copy_run("demo", runs_dir=run_dir.parent).name == "demo-copy"
    moved = run_dir.parent.rename(run_dir.parent.with_name("moved"))
    assert (
        f'run_dir = "{moved}/try2"'
        in json.loads((copy_run("demo", "try2", moved) / "01_load.ipynb").read_text())["cells"][0][
            "source"
        ].splitlines()
    )


@pytest.mark.parametrize(
    ("name", "copy", "says"),
    [("dmo", "", "there is no run .*dmo"), ("demo", "demo", "the run itself"), ("demo", "taken", "no copy of a run")],
)
def test_what_cannot_be_copied_is_a_sentence(run_dir, name, copy, says):
    (run_dir.parent / "taken").mkdir()
    with pytest.raises(NotebookError, match=says):
        copy_run(name, copy, run_dir.parent)
