"""The command line: help that helps, one sentence for bad input, nothing half-written."""

import errno
import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rover_lib.cli import main, programs
from rover_lib.cli.prepare import Resumable
from rover_lib.onboard.cli import show
from rover_lib.onboard.columns import in_words
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import atomic_path, read_stage
from tests.helpers.command import rover

ROOT = Path(__file__).parents[2]


def test_a_run_ends_with_its_verdict(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "mine"
    shutil.copytree(ROOT / "results" / "demo", folder)
    monkeypatch.setattr("rover_lib.workshop.run.run.run", lambda *args, **options: folder)
    result = rover("run", __file__, tmp_path)
    assert result.exit_code == 0 and "Verdict: deploy policy_static.pt" in result.output
    assert "Next:" in result.output
    content = json.loads((folder / "run.json").read_text())
    assert content["metrics"]["headline"] in rover("report", folder).output
    for listed in (rover("inspect", folder.parent, "--json"), rover("inspect", "--json")):
        assert json.loads(listed.output)["runs"] == {"mine": content["metrics"]["headline"]}


def test_one_notebook_is_executed_again_with_what_is_turned(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("rover_lib.workshop.run.run.execute", lambda *args, **given: asked.append((args, given)))
    result = rover("run", "--only", "03", "--name", "try1", "--runs-dir", tmp_path, "-p", "modes", "[static]")
    assert result.exit_code == 0, result.output
    assert asked == [(("03", tmp_path / "try1"), {"modes": ["static"]})]


def test_make_hands_a_name_on_as_it_is():
    dry = ["make", "-n", "--no-print-directory", f"VENV={sys.prefix}", f"--old-file={sys.prefix}/.ready"]
    names = {
        "run": ["CHECKPOINT=my policy.pth", "EPISODES=my drives", "NAME=mine"],
        "notebooks-open": ["NAME=mine", "AS=try 1"],
    }
    lines = []
    for target, variables in names.items():
        done = subprocess.run([*dry, target, *variables], cwd=ROOT, capture_output=True, text=True, check=True)
        lines.append(shlex.split(done.stdout.splitlines()[-1])[1:])
    assert lines == [
        ["run", "my policy.pth", "my drives", "--name", "mine"],
        ["notebooks", "runs/mine", "--as", "try 1"],
    ]


def test_help_shows_what_params_yml_presets(set_params):
    set_params("calibration: {samples: 77}")
    assert "[default: 77, by params.yml]" in " ".join(rover("run", "--help").output.split())
    recipes = params()["train"].values()
    small, full = (sum(v for key, v in recipe.items() if key.endswith("_steps")) for recipe in list(recipes)[:2])
    assert f"{small} (small), {full}" in " ".join(rover("train", "--help").output.split())
    for command in main.commands:
        assert "default: params.yml]" not in " ".join(rover(command, "--help").output.split()), command
    set_params("calibration: [")
    assert "[default: params.yml]" in " ".join(rover("run", "--help").output.split())
    set_params("")


def test_a_stopped_command_says_that_it_resumes(tmp_path, monkeypatch):
    def stopped(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("rover_lib.workshop.run.run.run", stopped)
    result = rover("run", __file__, tmp_path)
    assert result.exit_code == 130 and "run the same command again to resume" in result.output
    long = ["run", "train", "distill", "finetune"]
    assert all(isinstance(main.commands[name], Resumable) for name in long)


def test_figures_of_a_drive_are_told_in_words():
    figures = {"seconds": 2.0, "plan_age_p95_ms": 12.0, "missed": None, "damaged_lines": 0}
    assert in_words(figures) == {"seconds": 2.0, "plan age p95, ms": 12.0, "damaged lines": 0}


@pytest.mark.parametrize(("module", "words"), [("aiohttp", "[view]'"), ("torch", "[workshop]'")])
def test_a_missing_package_names_the_extra(module, words, monkeypatch):
    def missing(*args):
        raise ModuleNotFoundError(name=module)

    monkeypatch.setattr("rover_lib.workshop.run.describe.describe", missing)
    assert (result := rover("inspect", "a")).exit_code == 1
    assert f"this command needs {module}; pip install 'rover-policy{words}" in result.output


def test_a_systems_error_is_a_sentence_with_its_file(tmp_path, monkeypatch):
    def full(*args):
        with atomic_path(tmp_path / "o.pt") as temporary:
            temporary.write_text("half")
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("rover_lib.workshop.run.describe.describe", full)
    assert (result := rover("inspect", "a")).exit_code == 1
    assert result.output.startswith(f"rover: {tmp_path}/o.pt: no space left on device; make room"), result.output
    assert list(tmp_path.iterdir()) == []


def test_what_a_file_says_cannot_control_the_terminal(capsys):
    show({"labels": ["drive \x1b[31mred"], "layout": "a\nb"}, False)
    assert "drive \\x1b[31mred" in (out := capsys.readouterr().out) and "a\\nb" in out and "\x1b" not in out


@pytest.mark.slow  # two processes import torch
def test_benchmark_times_two_artifacts_of_one_name(artifacts, tmp_path, monkeypatch):
    alone = "rover_lib.onboard.care.benchmark.peak_memory_alone_mb"
    monkeypatch.setattr(alone, lambda path, threads: None)  # for speed
    files = []
    for run, mode in (("a", "static"), ("b", "mixed")):
        (tmp_path / run).mkdir()
        files.append(str(shutil.copy(artifacts[mode], tmp_path / run / "policy_static.pt")))
    out, few = tmp_path / "benchmark-here.json", ("--warmup", 0, "--threads", 1, "--iterations", 2)
    result = rover("benchmark", *files, *few, "--output", out)
    assert result.exit_code == 0 and str(files[0]) in result.stdout, result.output
    stage = read_stage(out, "benchmark")
    metrics, timed = stage["metrics"], stage["metrics"]["artifacts"]
    assert {k: (v["mode"], v["n"]) for k, v in timed.items()} == {files[0]: ("static", 2), files[1]: ("mixed", 2)}
    assert (metrics["main"], metrics["threads"], stage["inputs"].keys()) == (files[0], 1, {*files})


def test_jupyterlab_is_told_to_keep_what_widgets_show(tmp_path, monkeypatch):
    told = {}
    monkeypatch.setattr(programs.os, "execve", lambda program, words, environment: told.update(environment))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "01_load.ipynb").write_text("{}")
    programs.notebooks.callback(tmp_path / "mine", None)
    (settings,) = Path(told["JUPYTER_CONFIG_PATH"].split(os.pathsep)[0]).rglob("*.json")
    assert "saveState" in settings.read_text() and (tmp_path / "mine-copy" / "01_load.ipynb").exists()
