"""What a deployment to an emulated Pi makes of what it sees, without a Pi: `python -m lab pi` has that."""

import io
import os

import pytest

from lab.pi import deployment, emulation
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage

RECAP = "rover1     : ok=42   changed=20   unreachable=0    failed=0    skipped=7    rescued=0    ignored=0"


def test_a_play_says_how_much_changed_and_where_it_ended():
    play = deployment.Play(0, f"ok: [rover1]\n\nPLAY RECAP ****\n{RECAP}\n")
    assert play.ok and play.changed == 20 and play.end == "ok: [rover1]"
    assert not deployment.Play(2, play.output).ok and not deployment.Play(0, "ERROR! no such playbook").ok


def test_it_begins_only_with_an_artifact_and_as_root(tmp_path, monkeypatch):
    with pytest.raises(RoverError, match="make demo"):
        deployment.deploy_and_drive(tmp_path / "pi.json", tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(RoverError, match="use sudo"):
        emulation.require()


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
