"""What files say of a policy is used, asked about or refused, and each remedy works on the file that it is for."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from rover_lib.onboard.errors import CheckpointError
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.checkpoint.facts import WORDS, Facts
from rover_lib.workshop.checkpoint.weights import check_weights_are_whole
from rover_lib.workshop.recordings.samples import Layout
from rover_lib.workshop.recordings.source import Source
from rover_lib.workshop.run.session import load
from tests.helpers.policies import TINY, lerobot_policy, saved_normalised, trainer_content
from tests.helpers.recorded import edit_json as edit
from tests.helpers.recorded import record_drives

TURNED = {"mean": torch.tensor([0.25, 0.3]), "std": torch.tensor([0.05, 0.4])}


def remedied(path, said="", act=load_checkpoint):
    """What is refused of a policy; it is taken if the option is given that the refusal ends with."""
    with pytest.raises(CheckpointError) as e:
        act(path, said=said)
    option = shlex.split(re.findall(r"--facts (\"[^\"]+\"|\S+)", str(e.value))[-1])[0]
    act(path, said=f"{said} {option}")
    return str(e.value)


def says_more(policy, path, config=(), **more):
    """A trainer's file with more keys than the known ones."""
    content = trainer_content(policy)
    torch.save(content | {"config": content["config"] | dict(config)} | more, path)
    return path


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"action_stats": {"mean": torch.zeros(2), "std": torch.ones(2)}}, "'action_stats.mean'"),
        ({"hparams": {"std": [0.2, 0.1]}}, "how its numbers are normalised"),
        ({"config": {"normalize_actions": True}}, "normalised"),
        ({"config": {"crop_top": 100}}, "which part of its pictures"),
        ({"args": {"cropShape": [60, 100]}}, "which part of its pictures"),
        ({"config": {"color_order": "bgr"}}, "the colours"),
        ({"config": {"action_type": "delta"}}, "actions are changes"),
        ({"config": {"throttle_scale": 0.5}}, "units"),
        ({"config": {"frame_skip": 2}}, "its rate"),
        ({"config": {"input_size": 224}}, "its pictures are 128x72"),
        ({"config": {"rate_hz": 20, "fps": 30}}, "contradict each other on its rate, found '20.0' and '30.0'"),
        ({"config": {"label_names": ["gas", "steer"]}}, "are they steering and throttle?"),
        ({"mean": [0.0, 0.4]}, "units"),
        ({"config": {"invert_steering": True}}, "nobody here knows what that does to its numbers"),
        ({"config": {"camera_names": ["front", "rear"], "action_horizon": 64}}, "nobody here knows"),
        ({"config": {"use_imagenet_stats": False}}, "always done"),
        ({"config": {"output_activation": "tanh"}}, "what its network computes"),
        ({"config": {"state_names": ["speed", "yaw_rate"]}}, "the state is the last action"),
        ({"config": {"state_names": ["throttle", "steering"]}}, "its actions are steering, throttle"),
        ({"ema_state_dict": {str(i): torch.zeros(1) for i in range(65)}}, "the weights that should drive"),
    ],
)
def test_what_may_change_actions_is_refused_and_the_option_decides(tiny_policy, tmp_path, more, says):
    assert says in remedied(says_more(tiny_policy, tmp_path / "m.pth", **more))


def test_files_beside_a_checkpoint_are_asked_about_or_read(tiny_policy, tmp_path):
    path = says_more(tiny_policy, tmp_path / "m.pth")
    for name in ("dataset_stats.pt", "Statistics.json", "action_scaler.joblib"):
        (tmp_path / name).touch()
        assert "normalised" in remedied(path)
        (tmp_path / name).rename(tmp_path / f"._{name}")  # as a Mac leaves it
    (tmp_path / "._config.json").write_bytes(b"\0\5\26\7\xff")
    (tmp_path / "Settings.yaml").write_text("fps: 15\nimage_width: 128\nlearning_rate: 1")
    found = load_checkpoint(path)
    assert found.report["known"]["rate"] == "15 steps a second (Settings.yaml:fps)" and found.identity != found.sha256


def test_a_rate_and_an_order_are_used_and_other_keys_are_named(tiny_policy, tmp_path):
    said = {"fps": 15, "input_size": [3, 72, 128], "crop_top": 0, "random_flip_prob": 0.5, "image_channels": 3}
    said |= {"action_dim": 2, "use_state": True, "camera_names": ["front"], "output_order": "throttle, steering"}
    more = {"normalize_images": True, "image_mean": [0.485, 0.456, 0.406], "history": {"throttle_max": [1]}}
    found = load_checkpoint(says_more(tiny_policy, tmp_path / "m.pth", config=said, **more))
    (note,) = found.report["notes"]
    assert found.config.rate_hz == 15 and "config.image_channels" in note and found.identity == found.sha256
    turned = found.recorded_as(Layout())
    assert turned.config.action_names == ("steering", "throttle") and turned.report["guesses"] == []
    assert torch.equal(turned.weights["action_head.bias"], found.weights["action_head.bias"].flip(0))


@pytest.fixture
def lerobots(tmp_path):
    """A policy whose second number swings from -0.3 to 0.9: LeRobot's files do not say that it is steering."""
    saved_normalised(lerobot_policy(**TINY), tmp_path / "lerobot")
    for file in (tmp_path / "lerobot").glob("policy_*.safetensors"):
        flat = {f"{key}.{name}": v for key in ("action", "observation.state") for name, v in TURNED.items()}
        save_file(load_file(file) | {k: v.clone() for k, v in flat.items()}, file)
    return tmp_path / "lerobot"


def test_order_and_rate_are_asked_and_never_assumed(lerobots, tmp_path):
    """With the rover's own recordings, which are not the dataset that it was trained on."""
    own = record_drives(tmp_path / "episodes", frames=40)
    say = remedied(lerobots, act=lambda path, said: load(path, Source.of(own, facts=said)))
    assert "nothing says its actions and rate" in say
    loaded = load(lerobots, Source.of(own, facts="rate=20 actions=throttle,steering"))
    found = load_checkpoint(lerobots, said="rate=20 actions=throttle,steering").recorded_as(Layout())
    assert loaded.checkpoint.config.rate_hz == 20
    assert found.config.rate_hz == 20 and found.config.action_unnorm.scale == pytest.approx((0.4, 0.05))
    # of a dataset whose actions vary as the policy's in the other order
    rng, straight = np.random.default_rng(0), Layout(("cam_front",), rate_hz=20.0)
    samples = [replace(s, chunk=rng.normal(size=(1, 2)) * (0.4, 0.05)) for s in loaded.recordings.samples]
    with pytest.raises(CheckpointError, match=r"contradict the order .* --facts actions=throttle,steering"):
        load_checkpoint(lerobots).recorded_as(straight, samples)
    right = load_checkpoint(lerobots).recorded_as(replace(straight, action_order=(1, 0)), samples)
    assert right.config.action_unnorm == found.config.action_unnorm


def transformed(kind, **how):
    return {"dataset": {"image_transforms": {"enable": True, "tfs": {"it": {"type": kind, "kwargs": how}}}}}


@pytest.mark.parametrize(
    ("said", "size", "refused"),
    [
        (transformed("Resize", size=[36, 64]), (36, 64), ""),
        (transformed("Resize", size=36), (36, 64), ""),
        (transformed("ColorJitter"), (72, 128), ""),
        (transformed("CenterCrop", size=8), (72, 128), "'CenterCrop'"),
        ({"policy": {"chunk_size": 100}}, (72, 128), "on its chunk_size"),
        ({"dataset": {"fps": 15, "rename_map": {"a": "b"}}}, (72, 128), "which camera is which"),
    ],
)
def test_what_train_config_says(lerobots, said, size, refused):
    path = lerobots / "train_config.json"
    path.write_text(json.dumps(said))
    if refused:
        with pytest.raises(CheckpointError, match=refused) as e:
            load_checkpoint(lerobots)
        assert "train_config.json" in str(e.value)
        path.unlink()  # as the sentence says
    assert load_checkpoint(lerobots).config.image_sizes == (size,)


def test_a_forks_keys_are_asked_about(lerobots):
    """When it is read, as by `rover inspect`: not only before a run's recordings."""
    edit(lerobots / "config.json", lambda c: c.update(use_coord_conv=True, resize_imgs=None))
    assert "'use_coord_conv' is 'True', and nobody here knows" in remedied(lerobots)
    edit(lerobots / "config.json", lambda c: c.update(use_coord_conv=None, resize_imgs=[48, 64]))
    assert "its pictures are 128x72: pass --facts size=WxH" in remedied(lerobots)
    assert load_checkpoint(lerobots, said="size=64x48").config.image_sizes == ((48, 64),)
    edit(lerobots / "config.json", lambda c: c.update(use_coord_conv=True, resize_imgs=None))
    weights, key = load_file(lerobots / "model.safetensors"), "model.backbone.conv1.weight"
    weights[key] = torch.cat([weights[key], weights[key][:, :2]], 1)
    save_file(weights, lerobots / "model.safetensors")
    with pytest.raises(CheckpointError, match="nobody here knows use_coord_conv"):
        load_checkpoint(lerobots)


def test_processors_and_adapters_that_change_actions_are_refused(lerobots):
    unused = {"registry_name": "relative_actions_processor", "config": {"enabled": False}}
    edit(lerobots / "policy_preprocessor.json", lambda c: c["steps"].append(unused))
    file, adapter = next(lerobots.glob("policy_post*.safetensors")), lerobots / "adapter_config.json"
    save_file(load_file(file) | {"action.std": torch.tensor([9.0, 9.0])}, file)
    assert "contradict each other on its 'action.std'" in remedied(lerobots)
    assert "of other units" in load_checkpoint(lerobots, said="ignore=policy_preprocessor.json").report["notes"][-1]
    with pytest.raises(CheckpointError, match="of other units than a rover's"):
        load_checkpoint(lerobots, said="ignore=policy_preprocessor.json").recorded_as(Layout(("it",), rate_hz=20.0))
    adapter.touch()
    with pytest.raises(CheckpointError, match=r"merge_and_unload.* and remove its files$"):
        load_checkpoint(lerobots)


def test_a_config_of_2024_is_read(lerobots):
    """With its statistics in LeRobot's processors, or among the weights."""
    expected = load_checkpoint(lerobots).config

    def in_2024(c):
        del c["type"], c["normalization_mapping"]
        for part in ("input", "output"):
            shapes = {key: feature["shape"] for key, feature in c.pop(f"{part}_features").items()}
            c |= {f"{part}_shapes": shapes, f"{part}_normalization_modes": dict.fromkeys(shapes, "mean_std")}

    edit(lerobots / "config.json", in_2024)
    assert load_checkpoint(lerobots).config == expected
    weights = load_file(lerobots / "model.safetensors")
    for name, value in load_file(next(lerobots.glob("policy_pre*.safetensors"))).items():
        key, _, stat = name.rpartition(".")
        part = "unnormalize_outputs" if key == "action" else "normalize_inputs"
        weights[f"{part}.buffer_{key.replace('.', '_')}.{stat}"] = value.clone()
    save_file(weights, lerobots / "model.safetensors")
    assert "may mean how its numbers are normalised" in remedied(lerobots)  # beside processors
    for file in lerobots.glob("policy_p*processor.json"):
        file.unlink()
    assert load_checkpoint(lerobots).config == expected


def test_an_older_torchs_file_is_refused_and_saved_again_it_is_read(tiny, tiny_policy, tmp_path):
    torch.save(trainer_content(tiny_policy), tmp_path / "m.pth", _use_new_zipfile_serialization=False)
    with pytest.raises(CheckpointError, match=r"python -c") as e:
        load_checkpoint(tmp_path / "m.pth")
    exec(shlex.split(str(e.value).partition("python ")[2])[1], {})
    assert load_checkpoint(tmp_path / "m.pth").config == tiny.config


def test_the_network_is_found_under_any_prefix_and_twice_it_is_asked_about(lerobots):
    right, file = load_checkpoint(lerobots).weights, lerobots / "model.safetensors"
    same = {name: weight.clone() for name, weight in right.items()}
    wrappers = ("", "module.model.", "model._orig_mod.", "_orig_mod.module.", "_orig_mod.policy.model.")
    for prefix in (*wrappers, "ema_model.", "actor.", "a.b._fsdp_wrapped_module.c."):
        counted = {f"{prefix}{name}": weight for name, weight in right.items()} | {"n_averaged": torch.tensor(7)}
        save_file(counted, file)
        found = load_checkpoint(lerobots).weights
        assert all(torch.equal(found[name], weight) for name, weight in right.items())
    twice = {f"model.{name}": weight for name, weight in right.items()}
    save_file(twice | {f"policy.model.{name}": weight for name, weight in same.items()}, file)
    assert load_checkpoint(lerobots).weights.keys() == right.keys()
    other = {f"ema.model.{name}": weight + 1 for name, weight in right.items()}
    save_file(twice | other, file)
    assert "several networks" in remedied(lerobots)
    kept = load_checkpoint(lerobots, said="ignore=model").weights["action_head.bias"]
    assert torch.equal(kept, right["action_head.bias"] + 1)
    save_file({f"net.{name}": weight for name, weight in right.items() if "action_head" not in name}, file)
    with pytest.raises(CheckpointError, match=r"no ACT, which has an 'action_head\.weight'"):
        load_checkpoint(lerobots)


def test_averaged_weights_are_asked_about_in_any_form_and_beside(tiny, tiny_policy, lerobots, tmp_path):
    weights = list(tiny.weights.values())
    averages = [{"ema": weights}, {"ema": {"shadow_params": weights, "decay": 0.99}}, {"best_weights": tuple(weights)}]
    averages.append({"flat_params": torch.cat([weight.flatten() for weight in weights])})
    for number, more in enumerate(averages):
        path = says_more(tiny_policy, tmp_path / f"m{number}.pth", **more)
        assert "the weights that should drive" in remedied(path)
    files = {"norm_stats.json": "normalised", "ema.safetensors": "should drive", "model_swa.pt": "should"}
    files |= {"best_avg.pth": "should drive", "min_max.csv": "normalised", "assets/car/normstats.json": "normalised"}
    (lerobots / "assets/car").mkdir(parents=True)
    for name, words in files.items():
        (lerobots / name).write_text("{}")
        assert words in remedied(lerobots)
        (lerobots / name).unlink()
    (lerobots / "ema").mkdir()
    assert "should drive" in remedied(lerobots)
    torch.save(trainer_content(tiny_policy), lerobots / "ema.pth")
    assert load_checkpoint(lerobots / "ema.pth", said="ignore=ema").format == "trainer", "it is the one that is given"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("ema_model_action_head_weight", "the weights that should drive"),
        ("model_ema.modelaction_headweight", "the weights that should drive"),
        ("normalizer.mean", "how its numbers are normalised"),
        ("aux_head.weight", "nobody here knows what that does"),
    ],
)
def test_weights_that_no_act_has_are_called_what_they_may_be(lerobots, name, words):
    file = lerobots / "model.safetensors"
    counts = {"model_ema.num_updates": torch.tensor(7)} if name.startswith("model_ema") else {}
    save_file(load_file(file) | counts | {name: torch.zeros(2)}, file)
    assert words in remedied(lerobots)


def test_what_only_some_weights_lack_is_damage(lerobots):
    file = lerobots / "model.safetensors"
    whole = file.read_bytes()
    file.write_bytes(whole[:-100_000] + b"\xff" * 100_000)
    with pytest.raises(CheckpointError, match="is the file damaged"):
        load_checkpoint(lerobots)
    file.rename(file.with_suffix(".safetensors.part"))
    with pytest.raises(CheckpointError, match=r"found model\.safetensors\.part"):
        load_checkpoint(lerobots)


def test_statistics_of_two_trainings_are_refused(lerobots):
    file = next(lerobots.glob("policy_post*.safetensors"))
    stats = load_file(file)
    save_file(stats | {"observation.state.mean": stats["observation.state.mean"] + 1}, file)
    assert "contradict each other on its 'observation.state.mean'" in remedied(lerobots)


def test_a_config_is_read_as_lerobot_does():
    from lerobot.policies.act.configuration_act import ACTConfig

    usual = vars(ACTConfig(device="cpu"))
    assert usual.keys() <= {*WORDS["act"], *WORDS["of_lerobot"]}
    assert {name: usual[name] for name in WORDS["act"]} == WORDS["act"]


def test_weights_that_were_not_copied_to_their_end_are_called_damaged(lerobots):
    file = lerobots / "model.safetensors"
    whole = file.read_bytes()
    for begin, end in ((0.7, 1.0), (0.4, 0.5), (0.98, 1.0)):
        first, last = (int(len(whole) * share) for share in (begin, end))
        file.write_bytes(whole[:first] + bytes(last - first) + whole[last:])
        with pytest.raises(CheckpointError, match=r"damaged, its weights are zeros .* copied to its end\?"):
            load_checkpoint(lerobots)


@pytest.mark.parametrize(("held", "torn", "damaged"), [([1], 0, False), ([0, 1], 0, False), ([1], 64, True)])
def test_actions_that_are_held_have_rows_of_zeros(held, torn, damaged):
    whole = {"model.action_head.weight": torch.ones(2, 128)}
    whole["model.action_head.weight"][held] = 0
    whole["model.action_head.weight"][0, :torn] = 0
    if damaged:
        with pytest.raises(CheckpointError, match="damaged"):
            check_weights_are_whole(Facts(Path("p")), whole)
    else:
        assert set(check_weights_are_whole(Facts(Path("p")), whole)) == {"action_head.weight"}


def test_a_state_that_never_varied_is_given_to_the_network_as_it_was(lerobots):
    """The car's last action, in deviations of 1e-8, made of a policy that drove one that hit 4 of 8 balloons."""
    files, state = [*lerobots.glob("policy_p*.safetensors")], "observation.state"
    stats = load_file(files[0])
    whole = load_checkpoint(lerobots)
    was = stats[f"{state}.mean"].clone()
    for std in (0.0, 1e-8):
        for file in files:
            save_file(stats | {f"{state}.std": torch.tensor([std, 0.3])}, file)
        found = load_checkpoint(lerobots)
        (note,) = (each for each in found.report["notes"] if "never varied" in each)
        assert "its state (steering)" in note
        norm = found.config.state_norm
        assert (norm.scale[0], norm.shift[0]) == (1, 0)
        project = "encoder_robot_state_input_proj"
        given = torch.tensor([0.7, was[1] + 0.3]) * torch.tensor(norm.scale) + torch.tensor(norm.shift)
        seen = found.weights[f"{project}.weight"] @ given + found.weights[f"{project}.bias"]
        trained = whole.weights[f"{project}.weight"] @ torch.tensor([0.0, 1.0]) + whole.weights[f"{project}.bias"]
        assert torch.allclose(seen, trained, atol=1e-5)
    for file in files:
        save_file(stats | {f"{state}.mean": was * 100, f"{state}.std": stats[f"{state}.std"] * 100}, file)
    assert any("not its last action" in note for note in load_checkpoint(lerobots).report["notes"])
    assert not whole.report["notes"]
