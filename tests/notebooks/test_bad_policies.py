"""Policies that must not drive, each through a whole `rover run`: nothing that a user sees may ask to drive them."""

import re

import numpy as np
import pytest
import torch
from policies import TINY, lerobot_policy, trainer_content
from recorded import real_recordings
from test_odd_policies import run_here

from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.workshop.act import ACT, inputs_of
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.recordings.controls import OLD
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.describe import runs
from rover_lib.workshop.run.run_report import PAGE, text, write, write_card

pytestmark = pytest.mark.slow
LEARNED, RIDGE = 200, 1e-2  # frames; of the features' variance
DRIVES = re.compile(
    r"ansible-playbook|deploy\.yml|drive\.yml|rover (?:drive|view|release)|lerobot_robot_rover |one to deploy"
    r"|[Vv]erdict: deploy|put it on the rover|first metres"
)


def in_old_units(actions):
    """The actions, (n, 2), as an older firmware wrote them: a stopped car is 0.1687."""
    now = PwmCalibration()
    duties = [c.neutral_pct + c.span_pct * actions[:, i] for i, c in enumerate((now.steering, now.throttle))]
    lines = [(duty - OLD[name].neutral_pct) / OLD[name].span_pct for name, duty in zip(OLD, duties, strict=True)]
    return np.stack(lines, 1)


def learned(path, samples, of, state=1.0):
    """Write a policy of random weights whose last layer alone has learned, by least squares. state: its weight."""
    policy = lerobot_policy({"observation.images.cam_front": (36, 64)}, **TINY)
    content = trainer_content(policy)
    weights = content["model_state_dict"]
    weights["model.encoder_robot_state_input_proj.weight"] *= state
    torch.save(content, path)
    checkpoint = load_checkpoint(path)
    model = ACT(checkpoint.config, checkpoint.weights).eval()
    kept = []
    head = model.head
    head.register_forward_pre_hook(lambda module, given: kept.append(given[0].detach().reshape(-1, TINY["dim_model"])))
    few = pick_evenly(samples, LEARNED)
    with torch.inference_mode():
        for sample in few:
            model(*inputs_of(sample, checkpoint.config))
    x = torch.cat([torch.cat(kept), torch.ones(len(few) * TINY["chunk_size"], 1)], 1).double().numpy()
    y, w = np.concatenate([of(s) for s in few]), ~np.concatenate([s.is_pad for s in few])
    x, y = x[w], y[w]
    solved = np.linalg.solve(x.T @ x + RIDGE * len(x) * np.eye(x.shape[1]), x.T @ y)
    weights["model.action_head.weight"] = torch.from_numpy(solved[:-1].T.astype(np.float32).copy())
    weights["model.action_head.bias"] = torch.from_numpy(solved[-1].astype(np.float32))
    torch.save(content, path)


def make(kind, path):
    """Write the policy of that kind to `path`."""
    recordings = real_recordings()
    if kind == "random":
        torch.save(trainer_content(lerobot_policy({"observation.images.cam_front": (36, 64)}, **TINY)), path)
    else:
        samples = load_recordings(recordings).samples
        mean = np.concatenate([s.chunk for s in samples]).mean(0)
        answer = {
            "in old units": lambda s: in_old_units(s.chunk),
            "collapsed": lambda s: np.broadcast_to(mean, s.chunk.shape),
            "copies its state": lambda s: s.chunk,
        }
        learned(path, samples, answer[kind], 30.0 if kind == "copies its state" else 1.0)


KINDS = ("in old units", "collapsed", "copies its state", "random")


# Yardsticks with tests of their own hold the other kinds back; make check-release sees them go the whole way.
@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.release] * (k != "in old units")) for k in KINDS])
def test_what_is_not_ready_is_never_asked_to_drive(kind, tmp_path, capsys, monkeypatch):
    folder = tmp_path / "runs" / "bad"
    make(kind, tmp_path / "best_model.pth")
    given = {"checkpoint": str(tmp_path / "best_model.pth"), "episodes": str(real_recordings())}
    run_here(folder, **given, held_out_frames=60)
    judged = write(folder)["metrics"]
    (listed,) = runs(tmp_path / "runs")
    seen = {"notebooks": capsys.readouterr().out, "end": text(judged), "page": (folder / PAGE).read_text()}
    seen |= {"card": write_card(folder).read_text(), "list": listed["verdict"]}
    assert judged["headline"].startswith("not ready to drive") and judged["deploy"] is judged["artifact"] is None
    assert {where: found.group() for where, words in seen.items() if (found := DRIVES.search(words))} == {}
