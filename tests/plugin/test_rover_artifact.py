"""An artifact as a policy of LeRobot: the same actions as by our own loader, from LeRobot's own factories."""

import importlib
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_policy, make_pre_post_processors

from lerobot_robot_rover import RoverArtifactConfig, modeling_rover_artifact
from lerobot_robot_rover.__main__ import main, pack
from lerobot_robot_rover.line import ENDING
from rover_lib.onboard.drive.pilot import unfamiliar
from rover_lib.onboard.errors import DriveFault, ParamsError, PolicyError
from rover_lib.onboard.policy.load import load_policy

moved = "common" if ENDING else "utils"
predict_action = importlib.import_module(f"lerobot.{moved}.control_utils").predict_action
NUMBERS = {"dtype": "float32", "shape": (2,), "names": ["steering", "throttle"]}


def dataset(fps=30, camera="cam_front", size=(36, 64)):
    """What make_policy reads of one."""
    picture = {"dtype": "video", "shape": (*size, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": NUMBERS, "action": NUMBERS, f"observation.images.{camera}": picture}
    return SimpleNamespace(fps=fps, features=features, stats={})


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ParamsError):
        RoverArtifactConfig(n_action_steps=0)
    with pytest.raises(ParamsError):
        make_policy(RoverArtifactConfig(artifact="none.pt"), ds_meta=dataset())
    path = tmp_path / "policy.pt"
    path.write_text("hello")
    with pytest.raises(PolicyError):
        pack(path, tmp_path / "packed")
    assert not (tmp_path / "packed").exists()


@pytest.mark.slow
def test_it_gives_what_our_own_loader_gives(artifacts, monkeypatch, caplog):
    """Of the tiny policy, through LeRobot's whole path from a robot's observation to an action."""
    now = [1000.0]
    monkeypatch.setattr(modeling_rover_artifact, "boottime", lambda: now[0])
    ours = load_policy(artifacts["static"])
    height, width = (ours.manifest["cameras"][0][side] for side in ("height", "width"))
    config = RoverArtifactConfig(artifact=str(artifacts["static"]), n_action_steps=3)
    policy = make_policy(config, ds_meta=dataset(camera=ours.cameras[0], size=(height, width)))
    before, after = make_pre_post_processors(config)
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (height, width, 3), np.uint8) for _ in range(4)]
    state = np.array([0.1, 0.05], np.float32)

    def act(picture):
        observation = {f"observation.images.{ours.cameras[0]}": picture, "observation.state": state}
        action = predict_action(observation, policy, torch.device("cpu"), before, after, use_amp=False, task="drive")
        assert action.shape == (1, 2)
        return action[0].numpy()

    with pytest.raises(PolicyError, match="outside the range"):  # it never learned anything
        act(pictures[0])
    policy._limits = np.array([[-9.0, -9.0], [9.0, 9.0]])
    policy.reset()
    chunks = [ours.predict_unclipped(cv2.cvtColor(p, cv2.COLOR_RGB2BGR), state) for p in (pictures[0], pictures[3])]
    assert not np.array_equal(*chunks)
    for i, picture in enumerate(pictures):  # three of the first chunk, then a new one
        expected = chunks[0][i] if i < 3 else chunks[1][0]
        np.testing.assert_allclose(act(picture), expected, atol=1e-6)
    now[0] += 2.0  # after a pause in a chunk, the rest of it is too old
    np.testing.assert_allclose(act(pictures[3]), chunks[1][0], atol=1e-6)
    policy.reset()
    policy._process = SimpleNamespace(predict=policy._process.predict, strange=1.01)
    batch = {f"observation.images.{ours.cameras[0]}": torch.zeros(1, 3, height, width)}
    batch["observation.state"] = torch.zeros(1, 2)
    for ask in (lambda: act(pictures[0]), lambda: policy.predict_action_chunk(batch)):
        with pytest.raises(DriveFault, match="seen nothing like these pictures"):
            ask()
    policy._settings = replace(policy._settings, unfamiliar="warn")
    for _ in range(2):
        policy.predict_action_chunk(batch)
    assert [r.message for r in caplog.records if "seen nothing like" in r.message] == [unfamiliar(1.01)]


@pytest.mark.slow
def test_what_it_cannot_be_run_with(artifact):
    for steps, fps, error in ((31, 30, ParamsError), (8, 15, PolicyError)):
        with pytest.raises(error):
            make_policy(RoverArtifactConfig(artifact=str(artifact), n_action_steps=steps), ds_meta=dataset(fps))
    policy = make_policy(RoverArtifactConfig(artifact=str(artifact)), ds_meta=dataset())
    with pytest.raises(PolicyError, match=r"observation.images.cam_front"):
        policy.predict_action_chunk({"observation.images.wrist": torch.rand(1, 3, 36, 64)})


@pytest.mark.slow
def test_a_packed_folder_is_a_pretrained_policy(artifact, tmp_path, monkeypatch):
    folder, moved = tmp_path / "packed", tmp_path / "elsewhere"
    done = CliRunner().invoke(main, [str(artifact), str(folder)])
    assert done.exit_code == 0, done.output
    assert CliRunner().invoke(main, [str(artifact), str(folder)]).exit_code == 1
    folder.rename(moved)
    monkeypatch.chdir(tmp_path)
    config = PreTrainedConfig.from_pretrained(moved)
    config.pretrained_path = moved  # as lerobot-record does
    assert isinstance(config, RoverArtifactConfig) and config.n_action_steps == 8
    assert config.input_features["observation.images.cam_front"].shape == (3, 48, 96)
    policy = make_policy(config, ds_meta=dataset())
    overrides = {"device_processor": {"device": "cpu"}, "rename_observations_processor": {"rename_map": {}}}
    given = {"pretrained_path": str(moved), "dataset_stats": {}, "preprocessor_overrides": overrides}
    before, after = make_pre_post_processors(config, **given)
    picture, state = np.zeros((36, 64, 3), np.uint8), np.zeros(2, np.float32)
    observation = {"observation.images.cam_front": picture, "observation.state": state}
    action = predict_action(observation, policy, torch.device("cpu"), before, after, use_amp=False)
    np.testing.assert_allclose(action[0], [0.2, 0.15], atol=1e-6)
    with pytest.raises(ParamsError, match="not a folder"):
        type(policy).from_pretrained("someone/something")
