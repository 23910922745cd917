"""Notebook 06: what was counted is a table, and nothing counted is a sentence."""

import shutil

import pytest
from executed import shown

from lab.a76 import report
from rover_lib.workshop.run import run as runs

pytestmark = pytest.mark.slow  # each executes a notebook
COUNTED = runs.NOTEBOOKS.parent / "results" / "full" / "arm.json"


def test_counts_are_shown(tmp_path):
    shutil.copy(COUNTED, tmp_path)
    text = shown(runs.execute("06_arm", tmp_path))
    assert report.LABEL in text
    assert "teacher at 320x180" in text  # the computed times


def test_nothing_counted_is_a_sentence(tmp_path):
    (tmp_path / "mine").mkdir()
    assert "make count NAME=mine counts" in shown(runs.execute("06_arm", tmp_path / "mine"))
    assert {p.name for p in (tmp_path / "mine").iterdir()} == {"06_arm.ipynb"}
    with pytest.raises(runs.RoverError, match="not found"):
        runs.execute("06_arm", tmp_path / "nothing")
