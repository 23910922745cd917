"""What a deployment to an emulated Pi makes of what it sees, without a Pi: `python -m lab pi` has that."""

import io

import pytest

from lab.pi import deployment
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage


def test_what_fails_is_said_and_written(tmp_path):
    said = []
    report = deployment.Deployment(tmp_path / "pi.json", {"a.pt": "00"}, said.append, tmp_path, io.StringIO())
    report.gate("provision again", "changed=0", 0, True)
    report.gate("rollback", "model a in use", "b", False)
    with pytest.raises(RoverError), report.step("deploy"):
        raise RoverError("no")
    metrics = read_stage(tmp_path / "pi.json", "pi")["metrics"]
    assert metrics["wrong"] == report.wrong and len(report.wrong) == 1
    assert [gate["holds"] for gate in metrics["gates"]] == [True, False]
    assert [(s["step"], s["ok"]) for s in metrics["steps"]] == [("deploy", False)] and "failed" in said[-1]
