"""The command line: help that helps, one sentence for bad input, nothing half-written."""

import errno
import json
import shutil
from pathlib import Path

import pytest
from command import rover

from rover_lib.onboard.cli import show
from rover_lib.onboard.stage import atomic_path, read_stage


def test_a_run_ends_with_its_verdict(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "mine"
    shutil.copytree(Path(__file__).parents[2] / "results" / "demo", folder)
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
