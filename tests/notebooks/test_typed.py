"""What docs/notebooks.md says to type to papermill, as it is typed, but with few frames; `make test` types nbval's."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "notebooks.md").read_text()
pytestmark = pytest.mark.release  # a minute


def test_papermill_turns_a_parameter(demo_run, tmp_path):
    shutil.copytree(demo_run, tmp_path / "try1", ignore=shutil.ignore_patterns("episodes", "*.pth"))
    there = {"runs/try1": str(tmp_path / "try1"), "out.ipynb": str(tmp_path / "out.ipynb")}
    (line,) = (line.strip() for line in PAGE.splitlines() if line.startswith("    papermill "))
    words = [there.get(word, word) for word in line.split()]
    env = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    subprocess.run([*words, "-p", "held_out_frames", "8"], cwd=ROOT, env=env, check=True)
    compared = json.loads((tmp_path / "try1" / "compare.json").read_text())
    assert compared["metrics"]["fp32"]["trials"] == 10
    assert (tmp_path / "out.ipynb").is_file()
