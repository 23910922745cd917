"""The demo's run, made by `make demo`, must pass the gates of params.yml; before a release, `make demo-more` too."""

import os
import re
import shlex
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from balloon_world import latency, students
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.judge.compare import gates
from tests.helpers.executed import shown

ROOT = Path(__file__).parents[1]


def test_the_policy_drives_and_int8_is_like_it(demo_run):
    metrics = read_stage(demo_run / "compare.json", "compare")["metrics"]
    fp32, static = metrics["fp32"], metrics["modes"]["static"]
    assert fp32["trials"] == static["trials"] == 40
    for mode in {"static", "mixed"} & metrics["modes"].keys():
        assert not any(row["passed"] is False for row in gates(metrics, params()["gates"], mode))
        assert metrics["modes"][mode]["throttle_mae_pct"] > 0
    assert 0.2 < static["size_mb"] / fp32["size_mb"] < 0.35


@pytest.mark.release
def test_drives_by_plans_that_are_150_ms_late_as_by_fresh_ones(demo_run):
    found = read_stage(demo_run / "drive.json", "drive")
    metrics = found["metrics"]
    rows = {r["latency_ms"]: r for r in metrics["rows"] if r["compensate"] and not r["pushes"]}
    assert rows[0]["trials"] == rows[150]["trials"] == 40 and rows[0]["hits"] >= params()["gates"]["fp32_hits"]
    assert rows[0]["plan_age_max_ms"] == 0 and rows[150]["plan_age_min_ms"] >= 150  # it really drove with late plans
    assert not any(g["passed"] is False for g in metrics["gates"])
    assert str(latency.table(found)) in shown(demo_run / "07_drive.ipynb")


@pytest.mark.release
def test_a_student_of_its_own_is_judged_beside_it(demo_run):
    metrics = read_stage(demo_run / "students.json", "students")["metrics"]
    teacher, student = metrics["students"]
    assert student["gmac"] < 0.6 * teacher["gmac"]
    assert teacher["trials"] == teacher["pushed_trials"] == student["trials"] == student["pushed_trials"] == 40
    assert teacher["hits"] >= 36 and student["hits"] >= 36  # it has learned enough to be worth a look
    assert teacher["teacher_steering_pct"] < 0.5 < student["teacher_steering_pct"] < 5
    gates = students.gates_of(student, teacher, params()["students"])
    assert metrics["recommendation"]["gates"] == gates
    assert metrics["recommendation"]["name"] == ("demo-small" if all(g["passed"] for g in gates) else "teacher")
    assert str(students.table(metrics)) in shown(demo_run / "08_distill.ipynb")


@pytest.mark.slow
def test_what_readme_says_to_type_works(demo_run, tmp_path, monkeypatch):
    """The demo has run itself and its `rover run`, test_installed looks; here the view, JupyterLab and Python start."""
    (tmp_path / "Makefile").symlink_to(ROOT / "Makefile")
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(demo_run)
    (tmp_path / "policy_static.pt").symlink_to(demo_run / "policy_static.pt")
    monkeypatch.chdir(tmp_path)
    lines = re.findall(r"^    (.*)$", (ROOT / "README.md").read_text().partition("## The map")[0], re.M)
    asked = [shlex.split(line, comments=True) for line in lines if line.startswith("make ")]
    seen = {"watch": r"http://127\.0\.0\.1:\d+/\?token=", "notebooks-open": r"http://localhost:\d+/lab/tree/01_load.ip"}
    assert [words[1] for words in asked] == ["look", "demo", "watch", "notebooks-open", "test", "run"]
    for words in (words for words in asked if words[1] in ("watch", "notebooks-open", "run")):
        dry = ["make", "-n", "--no-print-directory", f"VENV={sys.prefix}", f"--old-file={sys.prefix}/.ready"]
        printed = subprocess.run([*dry, *words[1:]], capture_output=True, text=True, check=True).stdout
        *before, command = printed.splitlines()
        if words[1] == "run":
            assert command == f"{sys.prefix}/bin/rover run 'best_model.pth' 'episodes' --name 'mine'"
            continue
        env = os.environ | {"PYTHONPATH": str(ROOT), "BROWSER": "true", "ROVER_AS_ROOT": "1", "HOME": str(tmp_path)}
        subprocess.run("\n".join(before), shell=True, check=True)
        with started(command + " --web-port 0" * (words[1] == "watch"), env) as output:
            assert any(re.search(seen[words[1]], line) for line in output), command
    assert not {"episodes", "best_model.pth"} & {path.name for path in (tmp_path / "runs" / "demo-copy").iterdir()}
    (tmp_path / "runs" / "taken").mkdir()
    for wrong in ("NAME=dmo", "NAME=demo AS=demo", "NAME=demo AS=taken"):  # no run, the run itself, no copy
        assert subprocess.run([*dry[:1], *dry[2:], "notebooks-open", *wrong.split()]).returncode == 2
    names: dict = {"frame_bgr": np.zeros((360, 640, 3), np.uint8), "state": np.zeros(2, np.float32)}
    exec("\n".join(line for line in lines if not line.startswith("make ")), names)
    assert names["chunk"].shape == (32, 2)


@contextmanager
def started(command, env):
    """Run a command until it has said what it was started for: give its lines, and end it."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(["sh", "-c", f"exec {command}"], env=env, **pipes)
    late = threading.Timer(120, process.kill)
    late.start()
    try:
        yield process.stdout
    finally:
        late.cancel()
        process.terminate()
        process.communicate(timeout=60)
