"""What docs/notebooks.md says to type to papermill and nbval, as it is typed, but with few frames."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "notebooks.md").read_text()
pytestmark = pytest.mark.release  # a minute, and it writes where `make test` runs the notebooks


def typed(program: str) -> list[str]:
    (line,) = (line.strip() for line in PAGE.splitlines() if line.startswith(f"    {program} "))
    return line.split()


def run(words: list[str]) -> str:
    there = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(words, cwd=ROOT, env=there, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def test_papermill_turns_a_parameter(demo_run, tmp_path):
    shutil.copytree(demo_run, tmp_path / "try1", ignore=shutil.ignore_patterns("episodes", "*.pth"))
    there = {"runs/try1": str(tmp_path / "try1"), "out.ipynb": str(tmp_path / "out.ipynb")}
    words = [there.get(word, word) for word in typed("papermill")]
    run([*words, "-p", "held_out_frames", "8"])
    compared = json.loads((tmp_path / "try1" / "compare.json").read_text())
    assert compared["metrics"]["fp32"]["trials"] == 10
    assert (tmp_path / "out.ipynb").is_file()


def test_nbval_runs_a_notebook(demo_run):
    assert "failed" not in run(typed("pytest"))
