"""An artifact as a policy of LeRobot: the same actions as by our own loader, from LeRobot's own factories."""

import importlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy, make_pre_post_processors

from lab.driving.policy import make_artifact
from lerobot_robot_rover import RoverArtifactConfig, modeling_rover_artifact
from lerobot_robot_rover.line import ENDING, line_to
from lerobot_robot_rover.pack import pack
from rover_lib.onboard.errors import ArtifactError, ParamsError, PolicyError
from rover_lib.onboard.policy.load import load_policy

moved = "common" if ENDING else "utils"
predict_action = importlib.import_module(f"lerobot.{moved}.control_utils").predict_action
NUMBERS = {"dtype": "float32", "shape": (2,), "names": ["steering", "throttle"]}


def dataset(fps=30, camera="cam_front", size=(36, 64)):
    """What make_policy reads of one."""
    picture = {"dtype": "video", "shape": (*size, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": NUMBERS, "action": NUMBERS}
    if camera:
        features[f"observation.images.{camera}"] = picture
    return SimpleNamespace(fps=fps, features=features, stats={})


@pytest.fixture(scope="module")
def artifact(tmp_path_factory):
    """A constant one, whose process starts fast."""
    path = tmp_path_factory.mktemp("constant") / "policy_fp32.pt"
    make_artifact(path, camera="cam_front")
    return path


def test_the_config_is_found_by_its_name():
    assert PreTrainedConfig.get_choice_class("rover_artifact") is RoverArtifactConfig
    config = RoverArtifactConfig()
    assert config.type == "rover_artifact" and config.device == "cpu"
    assert get_policy_class("rover_artifact").config_class is RoverArtifactConfig


@pytest.mark.parametrize("wrong", [{"n_action_steps": 0}, {"threads": 0}])
def test_numbers_that_make_no_sense(wrong):
    with pytest.raises(ParamsError, match="from 1, found"):
        RoverArtifactConfig(**wrong)


@pytest.mark.parametrize(("named", "sentence"), [("", "no artifact is named"), ("none.pt", "none.pt: not found")])
def test_an_artifact_that_is_not_there(named, sentence):
    with pytest.raises(ParamsError, match=sentence):
        make_policy(RoverArtifactConfig(artifact=named), ds_meta=dataset())


def test_a_file_that_is_no_artifact(tmp_path):
    path = tmp_path / "policy.pt"
    path.write_text("hello")
    with pytest.raises(PolicyError):
        make_policy(RoverArtifactConfig(artifact=str(path)), ds_meta=dataset())
    with pytest.raises(ArtifactError):
        pack(path, tmp_path / "packed")
    assert not (tmp_path / "packed").exists()


@pytest.mark.slow
def test_it_gives_what_our_own_loader_gives(artifacts):
    """Of the tiny policy, through LeRobot's whole path from a robot's observation to an action."""
    ours = load_policy(artifacts["static"])
    height, width = ours.image_size
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

    with pytest.raises(PolicyError, match="outside the range of a servo"):  # it never learned anything
        act(pictures[0])
    policy._limits = np.array([[-9.0, -9.0], [9.0, 9.0]])
    policy.reset()
    chunks = [ours.predict_unclipped(cv2.cvtColor(p, cv2.COLOR_RGB2BGR), state) for p in (pictures[0], pictures[3])]
    assert not np.array_equal(*chunks)
    for i, picture in enumerate(pictures):  # three of the first chunk, then a new one
        expected = chunks[0][i] if i < 3 else chunks[1][0]
        np.testing.assert_allclose(act(picture), expected, atol=1e-6)
    policy.reset()
    np.testing.assert_allclose(act(pictures[3]), chunks[1][0], atol=1e-6)


@pytest.mark.slow
def test_a_batch_is_a_plan_for_each(artifact):
    policy = make_policy(RoverArtifactConfig(artifact=str(artifact)), ds_meta=dataset())
    batch = {"observation.images.cam_front": torch.rand(3, 3, 36, 64), "observation.state": torch.zeros(3, 2)}
    chunk = policy.predict_action_chunk(batch)
    assert chunk.shape == (3, 32, 2) and chunk.dtype == torch.float32
    np.testing.assert_allclose(chunk[2, 5], [0.2, 0.15], atol=1e-6)
    assert policy.select_action(batch).shape == (3, 2)
    with pytest.raises(PolicyError, match=r"the policy needs observation.images.cam_front"):
        policy.predict_action_chunk({"observation.state": torch.zeros(1, 2)})
    with pytest.raises(PolicyError, match="is not trained"):
        policy.forward(batch)
    with pytest.raises(PolicyError, match="is not trained"):
        policy.get_optim_params()


@pytest.mark.slow
@pytest.mark.parametrize("paused", ["for two seconds", "until the car was disarmed", "not at all"])
def test_actions_of_a_chunk_have_an_age(artifact, monkeypatch, paused):
    """After a pause inside a chunk, LeRobot's loop went on with 29 actions of before."""
    now = [1000.0]
    monkeypatch.setattr(modeling_rover_artifact, "boottime", lambda: now[0])
    policy = make_policy(RoverArtifactConfig(artifact=str(artifact), n_action_steps=30), ds_meta=dataset())
    batch = {"observation.images.cam_front": torch.rand(1, 3, 36, 64), "observation.state": torch.zeros(1, 2)}
    line = line_to("/dev/no-rover")
    for _ in range(3):
        policy.select_action(batch)
    now[0] += 2.0 if paused == "for two seconds" else 0.1
    line.drives_ended += paused == "until the car was disarmed"
    policy.select_action(batch)
    assert policy._plans == (1 if paused == "not at all" else 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "meta", "sentence"),
    [
        ({"n_action_steps": 31}, {}, r"n_action_steps may be 30 at most: `rover drive` stops by a plan of 1 s"),
        ({}, {"fps": 15}, r"30 a second, found a dataset of 15 frames a second; --dataset.fps=30"),
        ({}, {"camera": "wrist"}, r"looks through cam_front, found .*wrist.*; --robot.camera_name=cam_front"),
        ({}, {"camera": ""}, r"found a dataset of no pictures; --dataset.video=true"),
    ],
)
def test_what_it_cannot_be_run_with(artifact, config, meta, sentence):
    with pytest.raises((ParamsError, PolicyError), match=sentence):
        make_policy(RoverArtifactConfig(artifact=str(artifact), **config), ds_meta=dataset(**meta))


@pytest.mark.slow
def test_a_packed_folder_is_a_pretrained_policy(artifact, tmp_path, monkeypatch):
    folder = pack(artifact, tmp_path / "packed", n_action_steps=5)
    assert sorted(p.name for p in folder.iterdir()) == [
        *("config.json", artifact.name, "policy_postprocessor.json", "policy_preprocessor.json")
    ]
    with pytest.raises(ParamsError, match="is there already; name a new folder"):
        pack(artifact, folder)
    moved = tmp_path / "elsewhere"
    folder.rename(moved)
    monkeypatch.chdir(tmp_path)
    config = PreTrainedConfig.from_pretrained(moved)
    config.pretrained_path = moved  # as lerobot-record does
    assert isinstance(config, RoverArtifactConfig) and config.n_action_steps == 5
    policy = make_policy(config, ds_meta=dataset())
    before, after = make_pre_post_processors(
        config,
        pretrained_path=str(moved),
        dataset_stats={},
        preprocessor_overrides={
            "device_processor": {"device": "cpu"},
            "rename_observations_processor": {"rename_map": {}},
        },
    )
    observation = {
        "observation.images.cam_front": np.zeros((36, 64, 3), np.uint8),
        "observation.state": np.zeros(2, np.float32),
    }
    action = predict_action(observation, policy, torch.device("cpu"), before, after, use_amp=False)
    np.testing.assert_allclose(action[0], [0.2, 0.15], atol=1e-6)
    policy.save_pretrained(tmp_path / "saved")
    assert (tmp_path / "saved" / artifact.name).read_bytes() == artifact.read_bytes()
    with pytest.raises(ParamsError, match="not a folder; `python -m lerobot_robot_rover`"):
        type(policy).from_pretrained("someone/something")


def test_packing_by_hand(artifact, tmp_path):
    from lerobot_robot_rover.pack import main

    done = CliRunner().invoke(main, [str(artifact), str(tmp_path / "packed"), "--n-action-steps", "4"])
    assert done.exit_code == 0 and "packed: " in done.output
    again = CliRunner().invoke(main, [str(artifact), str(tmp_path / "packed")])
    assert again.exit_code == 1 and again.output.startswith("Error: ") and "is there already" in again.output
    nowhere = CliRunner().invoke(main, [str(artifact), str(artifact / "packed")])  # a file is no folder
    assert nowhere.exit_code == 1 and nowhere.output.startswith("Error: ") and str(artifact) in nowhere.output
