"""`rover inspect` describes everything that this project writes."""

import shutil
from pathlib import Path

import pytest

from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.recordings.samples import Source
from rover_lib.workshop.run import run_report as report
from rover_lib.workshop.run.describe import describe, runs

DEMO = Path(__file__).parents[3] / "results" / "demo"


@pytest.fixture
def runs_dir(tmp_path):
    shutil.copytree(DEMO, tmp_path / "runs" / "demo")
    return tmp_path / "runs"


def test_a_run_and_its_reports(runs_dir):
    (runs_dir / "demo" / "policy_static.pt").write_bytes(b"x" * 1_200_000)
    described = describe(Source(runs_dir / "demo"))["run"]
    assert described["artifacts"] == {"policy_static.pt": "1.2 MB"} and "compare" in described["stages"]
    described = describe(Source(runs_dir / "demo" / "compare.json"))["report"]
    assert described["stage"] == "compare" and described["metrics"]["modes"] == "4 values, see the file"


def test_runs_are_listed_with_their_verdicts(runs_dir):
    content = report.write(runs_dir / "demo")
    for name in ("new", "fast", "broken", "other", ".mine.new"):
        (runs_dir / name).mkdir()
    shutil.copy(DEMO / "compare.json", runs_dir / "new")
    shutil.copy(DEMO / "load.json", runs_dir / "new")
    (runs_dir / "fast" / "pretrained_model").mkdir()
    (runs_dir / "fast" / "best_model.pth").touch()
    (runs_dir / "broken" / "run.json").write_text("{")
    found = {row["name"]: row["verdict"] for row in runs(runs_dir)}
    assert found.keys() == {"demo", "new", "fast", "broken"}
    assert found["demo"] == content["metrics"]["headline"] and found["demo"].startswith("deploy policy_static.pt")
    assert f"rover report {runs_dir / 'new'}" in found["new"] and "rover report" in found["broken"]
    assert "rover run" in found["fast"] and "best_model.pth" in found["fast"]
    (runs_dir / "demo" / "compare.json").write_text("{}")  # as a notebook that is executed again leaves another
    assert "compare.json made again since its verdict: rover report" in runs(runs_dir)[1]["verdict"]
    with pytest.raises(RoverError, match="no such folder"):
        runs(runs_dir / "nothing")


def test_a_flight_log(tmp_path):
    with FlightLog(tmp_path / "flight.log", header={"hz": 30}, max_bytes=1_000_000, keep=1):
        pass
    assert "drives" in describe(Source(tmp_path / "flight.log"))["flight log"]


def test_a_calibration(calibration, tmp_path):
    calibration.save(tmp_path / "calibration.pt")
    described = describe(Source(tmp_path / "calibration.pt"))["calibration"]
    assert described["samples"] == calibration.samples and described["tensors"] == len(calibration.frames)
