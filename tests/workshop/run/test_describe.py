"""`rover inspect` describes everything that this project writes."""

import shutil
from pathlib import Path

import pytest

from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.recordings.source import Source
from rover_lib.workshop.run import run_report as report
from rover_lib.workshop.run.describe import describe, runs
from tests.helpers.recorded import record_drives

DEMO = Path(__file__).parents[3] / "results" / "demo"


@pytest.fixture
def demo(tmp_path):
    return shutil.copytree(DEMO, tmp_path / "runs" / "demo")


def test_a_run_its_report_and_a_flight_log(demo, tmp_path):
    (demo / "policy_static.pt").write_bytes(b"x" * 1_200_000)
    described = describe(Source(demo))["run"]
    assert described["artifacts"] == {"policy_static.pt": "1.2 MB"} and "compare" in described["stages"]
    described = describe(Source(demo / "compare.json"))["report"]
    assert described["stage"] == "compare" and "modes" in described["metrics"]
    with FlightLog(tmp_path / "flight.log", header={"hz": 30}, max_bytes=1_000_000, keep=1):
        pass
    assert "drives" in describe(Source(tmp_path / "flight.log"))["flight log"]


def test_an_artifact_a_checkpoint_and_recordings(artifacts, tiny_file, tmp_path):
    found = describe(Source(artifacts["static"]))["artifact"]
    assert found["mode"] == "static" and len(found["content_hash"]) == 64
    found = describe(Source(tiny_file))["checkpoint"]
    assert found["format"] == "trainer" and "parameters_acting" in found
    assert describe(Source(record_drives(tmp_path, drives=2)))["recordings"]["episodes"] == 2


def test_runs_are_listed_with_their_verdicts(demo):
    content, folder = report.write(demo), demo.parent
    for name in ("new", "fast", "broken", "other", ".mine.new"):
        (folder / name).mkdir()
    for name in ("compare.json", "load.json"):
        shutil.copy(DEMO / name, folder / "new")
    (folder / "fast" / "pretrained_model").mkdir()
    (folder / "fast" / "best_model.pth").touch()
    (folder / "broken" / "run.json").write_text("{")
    found = {row["name"]: row["verdict"] for row in runs(folder)}
    assert found.keys() == {"demo", "new", "fast", "broken"}
    assert found["demo"] == content["metrics"]["headline"] and found["demo"].startswith("deploy policy_static.pt")
    assert f"rover report {folder / 'new'}" in found["new"] and "rover run CHECKPOINT" in found["broken"]
    assert f"rover run {folder / 'fast' / 'best_model.pth'}" in found["fast"]
    (demo / "compare.json").write_text("{}")  # as a notebook that is executed again leaves another
    assert f"rover report {demo}" in runs(folder)[1]["verdict"]
    with pytest.raises(RoverError, match="no such folder"):
        runs(folder / "nothing")
