"""What a run ends with: run.json, words, and a card."""

import re
import shutil
import sys
from pathlib import Path

import pytest
import yaml

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage, sha256_of
from rover_lib.workshop.run import run_report as report
from rover_lib.workshop.run.describe import runs
from tests.helpers.recorded import edit_json

DEMO = Path(__file__).parents[3] / "results" / "demo"


@pytest.fixture
def run_dir(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "mine"
    shutil.copytree(DEMO, folder)
    return folder


def test_figures_of_another_artifact_are_no_verdict(run_dir, artifacts):
    """`rover distill --name` leaves its student's in a run that is there."""
    shutil.copy(artifacts["static"], run_dir / "policy_static.pt")
    (run_dir / "run.json").write_bytes(before := b"of before")
    with pytest.raises(RoverError, match=r"policy_static\.pt: not the artifact"):
        report.write(run_dir)
    assert (run_dir / "run.json").read_bytes() == before


DRIVES = re.compile(
    r"ansible-playbook|rover (?:drive|view|release|playbook d)|lerobot_robot_rover |one to deploy"
    r"|[Vv]erdict: deploy|put it on the rover|first metres"
)


def test_what_is_not_ready_is_never_asked_to_drive(run_dir):
    """Nothing that a user sees of its end says so."""
    guesses = {"warnings": ["this policy is no better than a guess without eyes: the mean plan"]}
    edit_json(run_dir / "compare.json", lambda content: content["metrics"].update(guesses=guesses))
    judged = report.write(run_dir)["metrics"]
    (listed,) = runs(run_dir.parent)
    seen = {"end": report.text(judged), "list": listed["verdict"]}
    assert judged["headline"].startswith("not ready to drive") and judged["deploy"] is judged["artifact"] is None
    assert {where: found.group() for where, words in seen.items() if (found := DRIVES.search(words))} == {}


def of_another_run(content):
    content["inputs"] = dict.fromkeys(content["inputs"], "0" * 64)


def test_times_of_what_the_run_was_before_are_no_verdict(run_dir):
    """A run that is made again keeps the benchmarks of other hosts."""
    (own,) = run_dir.glob("benchmark-*.json")
    shutil.copy(own, run_dir / "benchmark-a-host.json")
    edit_json(run_dir / "benchmark-a-host.json", of_another_run)
    inputs = report.write(run_dir)["inputs"]
    assert own.name in inputs and "benchmark-a-host.json" not in inputs
    own.unlink()
    with pytest.raises(RoverError, match="no benchmark of its artifacts"):
        report.write(run_dir)
    edit_json(run_dir / "compare.json", of_another_run)
    with pytest.raises(RoverError, match=r"compare\.json: is of other"):
        report.write(run_dir)


def test_leaves_the_same_verdict_as_json_and_in_words(run_dir):
    content = report.write(run_dir)
    assert read_stage(run_dir / "run.json", "run") == content
    assert content["inputs"]["compare.json"] == sha256_of(run_dir / "compare.json")
    judged, words = content["metrics"], report.text(content["metrics"])
    commands = [step["command"] for step in judged["next"]]
    for sentence in (judged["headline"], *judged["why"], *judged["cautions"], *commands):
        assert sentence in words
    assert "runs/mine/policy_static.pt" in commands[0]  # as one types it here
    assert all(f"{mode['size_mb']:.1f}" in words for mode in judged["modes"])


def test_commands_work_as_they_are_printed(run_dir, monkeypatch):
    """`make demo` activates no environment, so `rover` alone would be another program, or none."""
    programs = run_dir.parents[1] / ".venv" / "bin"
    programs.mkdir(parents=True)
    (programs / "rover").touch(0o755)
    monkeypatch.setattr(sys, "executable", str(programs / "python"))
    monkeypatch.setenv("PATH", "/usr/bin")
    assert report.typed("rover doctor") == ".venv/bin/rover doctor" and report.typed("make watch") == "make watch"
    assert "\n  .venv/bin/rover view runs/mine" in report.text(report.write(run_dir)["metrics"])
    monkeypatch.setenv("PATH", str(programs))
    assert report.typed("rover doctor") == "rover doctor"


def test_a_card_says_what_the_verdict_says_and_replaces_only_cards(run_dir):
    content = report.write(run_dir)["metrics"]
    for _ in range(2):
        text = report.write_card(run_dir).read_text()
    assert text.startswith("---\nlibrary_name: lerobot\n") and content["headline"] in text
    assert f"`rover drive {content['artifact']}`" in text and all(line in text for line in content["cautions"])
    assert "license" not in text  # none is invented
    text = report.write_card(run_dir, license="mit\n---", base_model="me/act").read_text()
    head = yaml.safe_load(text.split("\n---\n")[0])
    assert head["license"] == "mit\n---" and head["base_model_relation"] == "quantized"
    (run_dir / "README.md").write_text("mine")
    with pytest.raises(RoverError, match="is not a card"):
        report.write_card(run_dir)


def test_a_run_that_is_not_whole_or_of_another_version_has_no_verdict(run_dir, tmp_path):
    edit_json(run_dir / "quantize.json", lambda content: content["metrics"].pop("modes"))
    with pytest.raises(RoverError, match="lack 'modes'"):
        report.write(run_dir)
    (run_dir / "compare.json").unlink()
    for folder, missing in ((run_dir, "without compare.json"), (tmp_path / "nothing", "without load.json")):
        with pytest.raises(RoverError, match=missing):
            report.write(folder)
    assert not (run_dir / "run.json").exists()
