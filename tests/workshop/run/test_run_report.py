"""What a run ends with: run.json, a page made from it, and words."""

import json
import re
import shutil
from base64 import b64decode
from html import unescape
from pathlib import Path

import pytest
import yaml

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage, sha256_of
from rover_lib.workshop.run import run_report as report
from rover_lib.workshop.run.describe import runs

DEMO = Path(__file__).parents[3] / "results" / "demo"
PNG = b"\x89PNG a picture"


@pytest.fixture
def run_dir(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "mine"
    shutil.copytree(DEMO, folder)
    (folder / "figures").mkdir()
    (folder / "figures" / "04_action_error.png").write_bytes(PNG)
    return folder


def change_stage(path, part, **values):
    content = json.loads(path.read_text())
    content[part] |= values
    path.write_text(json.dumps(content))


def test_figures_of_another_artifact_are_no_verdict(run_dir, artifacts):
    """`rover distill --name` leaves its student's in a run that is there."""
    shutil.copy(artifacts["static"], run_dir / "policy_static.pt")
    (run_dir / "run.json").write_bytes(before := b"of before")
    with pytest.raises(RoverError, match=r"policy_static\.pt: not the artifact"):
        report.write(run_dir)
    assert (run_dir / "run.json").read_bytes() == before


DRIVES = re.compile(
    r"ansible-playbook|deploy\.yml|drive\.yml|rover (?:drive|view|release)|lerobot_robot_rover |one to deploy"
    r"|[Vv]erdict: deploy|put it on the rover|first metres"
)


def test_what_is_not_ready_is_never_asked_to_drive(run_dir):
    """Nothing that a user sees of its end says so."""
    guesses = {"warnings": ["this policy is no better than a guess without eyes: the mean plan"]}
    change_stage(run_dir / "compare.json", "metrics", guesses=guesses)
    judged = report.write(run_dir)["metrics"]
    (listed,) = runs(run_dir.parent)
    seen = {"end": report.text(judged), "page": (run_dir / report.PAGE).read_text(), "list": listed["verdict"]}
    assert judged["headline"].startswith("not ready to drive") and judged["deploy"] is judged["artifact"] is None
    assert {where: found.group() for where, words in seen.items() if (found := DRIVES.search(words))} == {}


def of_another_run(path):
    content = json.loads(path.read_text())
    content["inputs"] = {name: "0" * 64 for name in content["inputs"]}
    return json.dumps(content)


def test_times_of_what_the_run_was_before_are_no_verdict(run_dir):
    """A run that is made again keeps the benchmarks of other hosts."""
    (own,) = run_dir.glob("benchmark-*.json")
    (run_dir / "benchmark-a-host.json").write_text(of_another_run(own))
    inputs = report.write(run_dir)["inputs"]
    assert own.name in inputs and "benchmark-a-host.json" not in inputs
    own.unlink()
    with pytest.raises(RoverError, match="no benchmark of its artifacts"):
        report.write(run_dir)
    (run_dir / "compare.json").write_text(of_another_run(run_dir / "compare.json"))
    with pytest.raises(RoverError, match=r"compare\.json: is of other"):
        report.write(run_dir)


def test_leaves_the_same_verdict_as_json_words_and_a_page_that_needs_no_other_file(run_dir):
    content = report.write(run_dir)
    assert read_stage(run_dir / "run.json", "run") == content
    assert content["inputs"]["compare.json"] == sha256_of(run_dir / "compare.json")
    judged, html = content["metrics"], (run_dir / report.PAGE).read_text()
    page, words = unescape(re.sub("<[^>]*>", "", html)), report.text(judged)
    commands = [step["command"] for step in judged["next"]]
    for sentence in (judged["headline"], *judged["why"], *judged["cautions"], *commands):
        assert sentence.replace("`", "") in page and sentence in words
    assert any("`" in sentence for sentence in judged["cautions"]) and "<code>" in html
    assert "runs/mine/policy_static.pt" in commands[0]  # as one types it here
    for mode in judged["modes"]:
        assert f"{mode['size_mb']:.1f}" in page and f"{mode['size_mb']:.1f}" in words
    links = re.findall('href="([^"]*)"', html)
    assert "compare.json" in links and all((run_dir / link).is_file() for link in links) and "<script" not in html
    (picture,) = re.findall('src="([^"]*)"', html)
    assert b64decode(picture.removeprefix("data:image/png;base64,")) == PNG


def test_commands_work_as_they_are_printed(run_dir, monkeypatch):
    """`make demo` activates no environment, so `rover` alone would be another program, or none."""
    programs = run_dir.parents[1] / ".venv" / "bin"
    programs.mkdir(parents=True)
    (programs / "rover").touch(0o755)
    monkeypatch.setattr(report.sys, "executable", str(programs / "python"))
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


def test_what_others_wrote_is_no_markup(run_dir):
    change_stage(run_dir / "compare.json", "metrics", warnings=["<script>"])
    change_stage(run_dir / "load.json", "params", episodes="<script>")
    renamed = run_dir.rename(run_dir.with_name("<b>mine"))
    report.write(renamed)
    html = (renamed / report.PAGE).read_text()
    assert "<script>" not in html and "<b>mine" not in html and "&lt;script&gt;" in html


def test_a_run_that_is_not_whole_or_of_another_version_has_no_verdict(run_dir, tmp_path):
    content = json.loads((run_dir / "quantize.json").read_text())
    del content["metrics"]["modes"]
    (run_dir / "quantize.json").write_text(json.dumps(content))
    with pytest.raises(RoverError, match="lack 'modes'"):
        report.write(run_dir)
    (run_dir / "compare.json").unlink()
    for folder, missing in ((run_dir, "without compare.json"), (tmp_path / "nothing", "without load.json")):
        with pytest.raises(RoverError, match=missing):
            report.write(folder)
    assert not (run_dir / "run.json").exists() and not (run_dir / report.PAGE).exists()
