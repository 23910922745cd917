"""A policy that must not drive, through a whole `rover run`: nothing that a user sees may ask to drive it."""

import re

import pytest
import torch
from policies import TINY, lerobot_policy, trainer_content
from recorded import record_drives
from test_odd_policies import run_here

from rover_lib.workshop.run.describe import runs
from rover_lib.workshop.run.run_report import PAGE, text, write, write_card

DRIVES = re.compile(
    r"ansible-playbook|deploy\.yml|drive\.yml|rover (?:drive|view|release)|lerobot_robot_rover |one to deploy"
    r"|[Vv]erdict: deploy|put it on the rover|first metres"
)


# Policies that copy their state or always plan the same are tests/workshop/judge/test_verdict.py's.
@pytest.mark.slow
def test_what_is_not_ready_is_never_asked_to_drive(tmp_path, capsys):
    """Random weights on drives of a car."""
    folder, drives = tmp_path / "runs" / "bad", record_drives(tmp_path / "episodes", drives=6, frames=40)
    policy = lerobot_policy({"observation.images.cam_front": (36, 64)}, **TINY)
    torch.save(trainer_content(policy), tmp_path / "best_model.pth")
    run_here(folder, checkpoint=str(tmp_path / "best_model.pth"), episodes=str(drives), held_out_frames=60)
    judged = write(folder)["metrics"]
    (listed,) = runs(tmp_path / "runs")
    seen = {"notebooks": capsys.readouterr().out, "end": text(judged), "page": (folder / PAGE).read_text()}
    seen |= {"card": write_card(folder).read_text(), "list": listed["verdict"]}
    assert judged["headline"].startswith("not ready to drive") and judged["deploy"] is judged["artifact"] is None
    assert {where: found.group() for where, words in seen.items() if (found := DRIVES.search(words))} == {}
