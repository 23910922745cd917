"""Policies of other robots than ours, through a whole `rover run`: the same five notebooks, in this process."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from executed import run_cells
from policies import TINY, lerobot_policy, smooth_frame

from rover_lib.onboard.drive.inference import PolicyProcess
from rover_lib.onboard.errors import PolicyError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.onboard.policy.preprocess import IMAGENET_MEAN, IMAGENET_STD
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Source
from rover_lib.workshop.run.run import NAMES
from rover_lib.workshop.run.session import load

pytestmark = pytest.mark.slow
IMAGENET = {"mean": IMAGENET_MEAN, "std": IMAGENET_STD}
RELATIVE = 1e-5  # of the largest action: LeRobot's own forward, processors included, against our FP32 artifact
EPISODES, FRAMES = 4, 12
QUICK = {"samples": 6, "choosing_frames": 2, "held_out_frames": 4, "worlds": 0, "iterations": 2}


@dataclass(frozen=True)
class Robot:
    """cameras: name -> (height, width). names: of its actions, None where its dataset does not say. units: of them."""

    cameras: dict[str, tuple[int, int]]
    names: tuple[str, ...] | None
    size: int = 2
    rate_hz: int = 30
    units: float = 0.5
    policy: dict = field(default_factory=dict)
    said: str = ""
    imagenet: bool = True


ROBOTS = {  # what else a dataset may say of a car, tests/workshop/recordings/test_lerobot_dataset.py has
    "two arms": Robot(
        {"front": (36, 64), "wrist": (48, 40)},
        tuple(f"joint_{i}" for i in range(14)),
        14,
        50,
        1.5,
        {"vision_backbone": "resnet34", "chunk_size": 100},
        imagenet=False,
    ),
    "a car without names": Robot({"cam_front": (36, 64)}, None, rate_hz=20, said="throttle,steering"),
}


def dataset(robot, root):
    """A few episodes by LeRobot's own writer."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    numbers = {"dtype": "float32", "shape": (robot.size,), "names": list(robot.names) if robot.names else None}
    pictures = {
        f"observation.images.{name}": {"dtype": "image", "shape": (*size, 3), "names": ["height", "width", "channels"]}
        for name, size in robot.cameras.items()
    }
    features = pictures | {"observation.state": numbers, "action": numbers}
    made = LeRobotDataset.create("local/odd", robot.rate_hz, features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for _ in range(EPISODES):
        for _ in range(FRAMES):
            row = {key: smooth_frame(rng, *pictures[key]["shape"][:2]) for key in pictures}
            for key in ("observation.state", "action"):
                row[key] = rng.uniform(0, robot.units, robot.size).astype(np.float32)
            made.add_frame(row | {"task": "move"})
        made.save_episode()
    made.finalize()
    return LeRobotDataset("local/odd", root)


def trained(robot, seen, folder):
    """A LeRobot policy with random weights, which moves about as its dataset does; and what LeRobot plans with it."""
    from lerobot.policies.act.processor_act import make_act_pre_post_processors

    cameras = {f"observation.images.{name}": size for name, size in robot.cameras.items()}
    shape = {**TINY, "chunk_size": 8, **robot.policy}
    policy = lerobot_policy(cameras, robot.size, robot.size, **shape)
    stats = {k: {s: torch.as_tensor(v) for s, v in seen.meta.stats[k].items()} for k in seen.meta.stats}
    if robot.imagenet:  # as lerobot-train does if nobody forbids it
        stats |= {k: {s: torch.tensor(v)[:, None, None] for s, v in IMAGENET.items()} for k in cameras}
    inner, outer = make_act_pre_post_processors(policy.config, stats)
    for part in (policy, inner, outer):
        part.save_pretrained(folder)

    def plan(row):
        item = {k: v for k, v in seen[row].items() if k.startswith("observation.")}
        with torch.inference_mode():
            return outer(policy.predict_action_chunk(inner(item))[0]).numpy()

    return plan


def run_here(run_dir, **given):
    """The five notebooks, which know each other only by files."""
    for name in NAMES:
        run_cells(name, run_dir, **(QUICK | given))


# What a car's dataset may lack has tests of its own; make check-release sees it go the whole way.
@pytest.mark.parametrize("name", ["two arms", pytest.param("a car without names", marks=pytest.mark.release)])
def test_goes_the_whole_way(name, tmp_path, monkeypatch, capsys):
    import datasets

    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "cache")
    robot, run_dir = ROBOTS[name], tmp_path / "run"
    seen = dataset(robot, tmp_path / "dataset")
    theirs = trained(robot, seen, tmp_path / "policy")
    given = {"checkpoint": str(tmp_path / "policy"), "episodes": str(tmp_path / "dataset"), "action_names": robot.said}
    run_here(run_dir, **given)
    assert "FP32 artifact and LeRobot differ by less than 1e-4: True" in capsys.readouterr().out

    policy = load_policy(run_dir / "policy_fp32.pt")
    car = robot.size == 2
    assert policy.action_names == (ACTION_NAMES if car else robot.names) and policy.rate_hz == robot.rate_hz
    assert policy.cameras == tuple(robot.cameras)
    columns = [1, 0] if car else list(range(robot.size))  # throttle comes first in both cars' files
    loaded = load(tmp_path / "policy", Source.of(tmp_path / "dataset", robot.said))
    for row in (0, 7, 30):
        sample = loaded.recordings.samples[row]
        expected = theirs(row)[:, columns]
        found = policy.predict_unclipped(sample.frame_bgr(), sample.state)
        assert np.abs(found - expected).max() <= RELATIVE * np.abs(expected).max()

    judged = read_stage(run_dir / "compare.json", "compare")["metrics"]["modes"]["static"]
    assert {k for k in judged if k.endswith("_mae_pct")} == {f"{a}_mae_pct" for a in policy.action_names}
    assert all(0 < judged[f"{a}_mae_pct"] < 20 for a in policy.action_names)
    assert [k for k in judged if k.endswith("_us")] == [k for k in judged if k.endswith("_us") and car]
    assert list(run_dir.glob("benchmark-*.json")) and len(list((run_dir / "figures").glob("*.png"))) >= 6
    if not car:  # only a car asks for [steering, throttle]
        with pytest.raises(PolicyError, match="cameras and gives"), PolicyProcess(run_dir / "policy_static.pt"):
            pass
