"""The policy of another robot than ours, through a whole `rover run`: the same five notebooks, in this process."""

import numpy as np
import pytest
import torch

from rover_lib.onboard.drive.inference import PolicyProcess
from rover_lib.onboard.errors import PolicyError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.run.run import NAMES
from rover_lib.workshop.run.session import load
from tests.helpers.executed import run_cells
from tests.helpers.policies import TINY, lerobot_policy, saved
from tests.helpers.recorded import lerobot_dataset

pytestmark = pytest.mark.slow
RELATIVE = 1e-5  # of the largest action: LeRobot's own forward, processors included, against our FP32 artifact
QUICK = {"samples": 6, "choosing_frames": 2, "held_out_frames": 4, "worlds": 0, "iterations": 2, "modes": ["static"]}
# Two arms; what a dataset may say of a car, tests/workshop/recordings/test_lerobot_dataset.py has.
CAMERAS, RATE_HZ = {"front": (36, 64), "wrist": (48, 40)}, 50
JOINTS = tuple(f"joint_{i}" for i in range(14))
EPISODES, FRAMES, RADIANS = 4, 12, 1.5


def trained(root, folder):
    """A LeRobot policy of random weights that moves about as its dataset does. Returns what LeRobot plans with it."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    seen = LeRobotDataset("local/odd", root)
    cameras = {f"observation.images.{name}": size for name, size in CAMERAS.items()}
    shape = {**TINY, "vision_backbone": "resnet34", "chunk_size": 100}
    policy = lerobot_policy(cameras, len(JOINTS), len(JOINTS), **shape)
    stats = {k: {s: torch.as_tensor(v) for s, v in seen.meta.stats[k].items()} for k in seen.meta.stats}
    inner, outer = saved(policy, folder, stats)

    def plan(row):
        item = {k: v for k, v in seen[row].items() if k.startswith("observation.")}
        with torch.inference_mode():
            return outer(policy.predict_action_chunk(inner(item))[0]).numpy()

    return plan


def test_goes_the_whole_way(tmp_path, capsys):
    run_dir = tmp_path / "run"
    dataset = lerobot_dataset(tmp_path / "dataset", CAMERAS, JOINTS, RATE_HZ, [FRAMES] * EPISODES, "image", RADIANS)
    theirs = trained(dataset, tmp_path / "policy")
    given = {"checkpoint": str(tmp_path / "policy"), "episodes": str(tmp_path / "dataset")}
    for name in NAMES:  # which know each other only by files
        run_cells(name, run_dir, **QUICK, **given)
    assert "FP32 artifact and LeRobot differ by less than 1e-4: True" in capsys.readouterr().out

    policy = load_policy(run_dir / "policy_fp32.pt")
    assert (policy.action_names, policy.rate_hz, policy.cameras) == (JOINTS, RATE_HZ, tuple(CAMERAS))
    samples = load(tmp_path / "policy", tmp_path / "dataset").recordings.samples
    for row in (0, 7, 30):
        expected = theirs(row)
        found = policy.predict_unclipped(samples[row].frame_bgr(), samples[row].state)
        assert np.abs(found - expected).max() <= RELATIVE * np.abs(expected).max()

    judged = read_stage(run_dir / "compare.json", "compare")["metrics"]["modes"]["static"]
    assert {k for k in judged if k.endswith("_mae_pct")} == {f"{joint}_mae_pct" for joint in JOINTS}
    assert all(0 < judged[f"{joint}_mae_pct"] < 20 for joint in JOINTS)
    assert list(run_dir.glob("benchmark-*.json"))
    assert {path.name[:2] for path in (run_dir / "figures").glob("*.png")} == {"01", "02", "03", "04", "05"}
    # only a car asks for [steering, throttle]
    with pytest.raises(PolicyError, match="cameras and gives"), PolicyProcess(run_dir / "policy_static.pt"):
        pass
