"""What a run ends with: run.json, a page made from it, and words."""

import json
import re
import shutil
from base64 import b64decode
from html.parser import HTMLParser
from pathlib import Path

import pytest

from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage, sha256_of
from rover_lib.workshop.run import run_report as report

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


class Page(HTMLParser):
    """Tags that are open at the end, tags that were there, and what a reader sees."""

    def __init__(self, html):
        super().__init__()
        self.open, self.tags, self.text = [], [], ""
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_figures_of_another_artifact_are_no_verdict(run_dir, artifacts):
    """`rover distill --name` leaves its student's in a run that is there, `rover quantize -o` what was asked for."""
    shutil.copy(artifacts["static"], run_dir / "policy_static.pt")
    (run_dir / "run.json").write_bytes(before := b"of before")
    with pytest.raises(RoverError, match=r"policy_static\.pt: not the artifact"):
        report.write(run_dir)
    assert (run_dir / "run.json").read_bytes() == before
    stage = read_stage(run_dir / "quantize.json", "quantize")
    stage["metrics"]["modes"]["static"]["content_hash"] = content_hash(artifacts["static"])
    (run_dir / "quantize.json").write_text(json.dumps(stage))
    for path in (run_dir / "compare.json", next(run_dir.glob("benchmark-*.json"))):
        content = json.loads(path.read_text())
        content["inputs"]["policy_static.pt"] = content_hash(artifacts["static"])
        path.write_text(json.dumps(content))
    report.write(run_dir)


def of_another_run(path):
    content = json.loads(path.read_text())
    content["inputs"] = {name: "0" * 64 for name in content["inputs"]}
    for timed in content["metrics"].get("artifacts", {}).values():
        timed["latency_p50_ms"] = 9999.0
    return json.dumps(content)


def test_times_of_what_the_run_was_before_are_no_verdict(run_dir):
    """A run that is made again keeps the benchmarks of other hosts."""
    (own,) = run_dir.glob("benchmark-*.json")
    (run_dir / "benchmark-a-host.json").write_text(of_another_run(own))
    content = report.write(run_dir)
    assert own.name in content["inputs"] and "benchmark-a-host.json" not in content["inputs"]
    assert all(mode["latency_p50_ms"] < 9999 for mode in content["metrics"]["modes"])
    own.unlink()
    with pytest.raises(RoverError, match="no benchmark of its artifacts"):
        report.write(run_dir)
    (run_dir / "compare.json").write_text(of_another_run(run_dir / "compare.json"))
    with pytest.raises(RoverError, match=r"compare\.json: is of other"):
        report.write(run_dir)


def test_leaves_the_same_verdict_as_json_page_and_words(run_dir):
    content = report.write(run_dir)
    assert read_stage(run_dir / "run.json", "run") == content
    assert content["inputs"]["compare.json"] == sha256_of(run_dir / "compare.json")
    judged = content["metrics"]
    page, words = Page((run_dir / report.PAGE).read_text()), report.text(judged)
    assert page.open == []
    commands = [step["command"] for step in judged["next"]]
    for sentence in (judged["headline"], *judged["why"], *judged["cautions"], *commands):
        assert sentence.replace("`", "") in page.text and sentence in words
    assert any("`" in sentence for sentence in judged["cautions"]) and ("code", {}) in page.tags
    assert "runs/mine/policy_static.pt" in commands[0]  # as one types it here
    for mode in judged["modes"]:
        assert f"{mode['size_mb']:.1f}" in page.text and f"{mode['size_mb']:.1f}" in words


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
    (run_dir / "README.md").write_text("mine")
    with pytest.raises(RoverError, match="is not a card"):
        report.write_card(run_dir)


def test_the_page_needs_no_other_file(run_dir):
    report.write(run_dir)
    html = (run_dir / report.PAGE).read_text()
    assert not re.search(r"""src=["'](?!data:)""", html) and "<script" not in html
    links = re.findall('href="([^"]*)"', html)
    assert "compare.json" in links and all((run_dir / link).is_file() for link in links)
    (picture,) = [a["src"] for tag, a in Page(html).tags if tag == "img"]
    assert b64decode(picture.removeprefix("data:image/png;base64,")) == PNG


def test_what_others_wrote_is_no_markup(run_dir):
    evil = '<script>alert("1")</script>'
    for stage, change in {"compare": {"warnings": [evil]}, "load": {}}.items():
        path = run_dir / f"{stage}.json"
        content = json.loads(path.read_text())
        content["metrics"] |= change
        content["params"] |= {"episodes": evil} if stage == "load" else {}
        path.write_text(json.dumps(content))
    renamed = run_dir.rename(run_dir.with_name("<b>mine"))
    report.write(renamed)
    html = (renamed / report.PAGE).read_text()
    assert "<script" not in html and "<b>mine" not in html and "&lt;script&gt;" in html


def test_a_run_that_is_not_whole_has_no_verdict(run_dir, tmp_path):
    with pytest.raises(RoverError, match="no such run"):
        report.write(tmp_path / "nothing")
    (run_dir / "compare.json").unlink()
    next(run_dir.glob("benchmark-*.json")).unlink()
    with pytest.raises(RoverError, match=r"compare.json, benchmark-<host>.json"):
        report.write(run_dir)
    assert not (run_dir / "run.json").exists() and not (run_dir / report.PAGE).exists()


@pytest.mark.parametrize(("stage", "part"), [("quantize", "modes"), ("load", "checkpoint")])
def test_a_run_of_another_version_is_a_sentence(run_dir, stage, part):
    content = json.loads((run_dir / f"{stage}.json").read_text())
    for has in (content["params"], content["metrics"]):
        has.pop(part, None)
    (run_dir / f"{stage}.json").write_text(json.dumps(content))
    with pytest.raises(RoverError, match=part):
        report.write(run_dir)
    assert not (run_dir / "run.json").exists()
