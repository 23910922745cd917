"""Checkpoints are read as LeRobot reads them, and what LeRobot accepts without a word is refused."""

import json
import math
import os
import pickle
import resource
import shutil
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from rover_lib.onboard.errors import CheckpointError, RoverError
from rover_lib.workshop.act import ACT, Affine, example_inputs, inputs_of, predictions
from rover_lib.workshop.act_config import BACKBONES, ActConfig, lerobot_act, weight_shapes
from rover_lib.workshop.checkpoint import trainer
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint, write_both
from rover_lib.workshop.checkpoint.files import save_torch
from rover_lib.workshop.checkpoint.lerobot import lerobot_folder, write_lerobot
from rover_lib.workshop.judge.compare import LerobotEager
from rover_lib.workshop.recordings.samples import Layout
from tests.helpers.archives import rewritten
from tests.helpers.policies import TINY, check_is, lerobot_policy, memory_samples, saved_normalised, trainer_content
from tests.helpers.recorded import edit_json as edit

RAW = dict.fromkeys(("VISUAL", "STATE", "ACTION"), "IDENTITY")
RENAMES = {"registry_name": "rename_observations_processor", "config": {"rename_map": {"a": "b"}}}
STATE = "observation.state"
INNER, OUTER, STATS = "policy_preprocessor.json", "policy_postprocessor.json", "stats.safetensors"
CONFIG = "config.json"


def write(content, path):
    torch.save(content, path)
    return path


def refused(path) -> str:
    """Check that it is refused in one sentence with a remedy, and return that."""
    with pytest.raises(CheckpointError) as e:
        load_checkpoint(path)
    message = str(e.value)
    assert str(path) in message and "\n" not in message and len(message) < 1000 and e.value.remedy
    return message


def test_reads_the_trainers_file(tiny, tiny_file, tiny_policy, tmp_path):
    c, r = tiny.config, tiny.report
    assert (c.chunk, c.dim, c.heads, c.feedforward, c.latent, c.vae_layers) == (32, 64, 4, 128, 32, 1)
    assert c.image_sizes == ((72, 128),) and c.action_names == ("steering", "throttle") and c.rate_hz == 30
    assert r["parameters"] == sum(p.numel() for p in tiny_policy.state_dict().values())
    assert r["parameters"] - r["parameters_acting"] > 0
    assert r["best_val_loss"] == pytest.approx(0.15) and r["epoch"] == 7 and json.dumps(r)
    assert r["file_mb"] == pytest.approx(r["weights_mb"] + r["optimizer_mb"], rel=0.02)
    pixels = "(pixel / 255 - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)"
    assert r["normalisation"] == {"cam_front": pixels, "state": "state, as it is", "action": "output, as it is"}
    # numpy 1 pickles the float64 as numpy.core, and numpy 2 as numpy._core
    older = {"data.pkl": lambda data: data.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")}
    path = rewritten(tiny_file, tmp_path / "older.pth", older)
    assert load_checkpoint(path).report["best_val_loss"] == r["best_val_loss"]


@pytest.mark.parametrize(("no", "backbone"), zip(("pre_norm", "vae_layers", "sees_state"), BACKBONES, strict=True))
def test_shapes_are_lerobots(no, backbone):
    every = {"pre_norm": True, "vae_layers": 2, "sees_state": True} | {no: 0}
    config = ActConfig(dim=32, feedforward=64, latent=5, state_names=("a",), backbone=backbone, **every)
    lerobots = lerobot_act(config, {}).model.state_dict()
    assert weight_shapes(config) == {name: tuple(weight.shape) for name, weight in lerobots.items()}


def test_a_trainers_file_is_checked_without_lerobots_seconds(tiny_file, monkeypatch):
    monkeypatch.delattr("rover_lib.workshop.act_config.lerobot_act")
    assert load_checkpoint(tiny_file).config.chunk == 32


def test_what_is_not_needed_may_be_missing_or_odd(tiny, tiny_policy, tmp_path):
    content = trainer_content(tiny_policy)
    for key in ("optimizer_state_dict", "scheduler_state_dict", "best_val_loss"):
        del content[key]
    content["config"] = {k: np.int64(v) if type(v) is int else v for k, v in content["config"].items()}
    content["config"] |= {"size": (1, 2), "mean": torch.ones(3)}
    content["model_state_dict"]["model.backbone.bn1.num_batches_tracked"] = torch.tensor(7)
    path = write(content, tmp_path / "best_model.pth")
    found = load_checkpoint(path)
    assert found.config == tiny.config and found.report["trainer_config"]["size"] == [1, 2]
    assert all(torch.equal(v, tiny.weights[k]) for k, v in found.weights.items() if k != "action_head.weight")
    assert "best_model.pth" in refused(tmp_path)  # a folder that holds it


class Evil:
    def __reduce__(self):
        return os.system, ("touch owned",)


def test_refuses_to_run_code(tiny_policy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write(trainer_content(tiny_policy) | {"notes": Evil()}, tmp_path / "evil.pth")
    assert "posix.system" in refused(path)
    assert not (tmp_path / "owned").exists()


BIAS = "model.decoder.norm.bias"


def weight(value):
    return lambda c: c["model_state_dict"].update({BIAS: value})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("config"), "no 'config'"),
        (lambda c: c["config"].update(chunk_size="32"), "chunk_size"),
        (lambda c: c["config"].update(image_height=8), "cameras must be"),
        (lambda c: c["config"].update(n_obs_steps=2), "n_obs_steps"),
        (lambda c: c["config"].update(vision_encoder="vit"), "'vit'"),
        (lambda c: c["config"].update(n_decoder_layers=10**6), "1000000"),
        (lambda c: c.update(best_val_loss="low"), "'low'"),
        (lambda c: c["model_state_dict"].pop("model.action_head.bias"), "action_head.bias"),
        (lambda c: c["model_state_dict"].update({"model.extra": torch.zeros(1)}), "Unexpected key"),
        (weight(torch.eye(8).to_sparse()), BIAS),
        # finite here, but not in float32, in which the policy drives
        (weight(torch.full((64,), 1e300, dtype=torch.float64)), "NaN"),
    ],
)
def test_refuses_what_makes_no_policy(change, says, tiny_policy, tmp_path):
    content = trainer_content(tiny_policy)
    change(content)
    assert says in refused(write(content, tmp_path / "bad.pth"))


def test_refuses_damaged_files(tiny_file, tmp_path):
    whole, path = tiny_file.read_bytes(), tmp_path / "damaged.pth"
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF  # one byte of one weight: torch.load would accept it
    for data in (b"", whole[: len(whole) // 2], pickle.dumps({"config": {}}), bytes(flipped)):
        path.write_bytes(data)
        refused(path)
    assert "checksum" in refused(path)
    torch.save([1], path, _use_new_zipfile_serialization=False)
    assert "1.6" in refused(path)
    assert "list" in refused(write([1, 2], path))
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as whole:
        whole.writestr("archive/more", bytes(1000))
    assert "compressed entries" in refused(path)
    refused(rewritten(tiny_file, path, {"data.pkl": lambda _: b"\x80\x02" + b"]" * 10**5}))
    others = (b"version https://git-lfs", "git lfs pull"), (b"<html>", "web page"), (b"PK\5\6" + bytes(18), "unpack it")
    folders = [(start + b'{"a"}', "whole folder") for start in (b"", bytes(8))]
    for other, says in (*others, *folders, (b"\x1f\x8b\x08", "unpack it")):
        path.write_bytes(other)
        assert says in refused(path)
    path.unlink()
    refused(path)


def test_at_another_size_it_is_lerobots_policy_of_that_size(tiny):
    size = (75, 131)
    other = tiny.at_size(*size)
    ours, lerobot = ACT(other.config, other.weights), LerobotEager(other)
    (sample,) = memory_samples(1, *size)
    with torch.inference_mode():
        found = ours(*inputs_of(sample, other.config))[0].numpy()
    lerobot._low, lerobot._high = -np.inf, np.inf  # clipped plans would be equal in any case
    expected = lerobot.predict_chunk(sample.picture, sample.state)
    assert np.abs(found - expected).max() < 1e-5 < np.abs(found).max()
    two = replace(tiny, config=replace(tiny.config, cameras=("left", "right"), image_sizes=((72, 128),) * 2))
    for policy, size in ((tiny, (54.0, 96.0)), (tiny, (18, 32)), (tiny, (96, 96)), (two, (54, 96))):
        with pytest.raises(CheckpointError, match="cannot run at"):
            policy.at_size(*size)


@pytest.fixture(scope="module")
def policy():
    return lerobot_policy(**TINY)


@pytest.fixture(scope="module")
def folder(policy, tmp_path_factory):
    """A policy that normalises its state by MEAN_STD and its actions by MIN_MAX, and its pictures not at all."""
    path = tmp_path_factory.mktemp("lerobot")
    saved_normalised(policy, path)
    for name in (INNER, OUTER):
        edit(path / name, in_step(lambda s: s.update(state_file=STATS)))
        edit(path / name, in_step(lambda s: s["config"]["norm_map"].update(VISUAL="IDENTITY", ACTION="MIN_MAX")))
    save_file(load_file(next(path.glob("policy_pre*.safetensors"))), path / STATS)
    return path


@pytest.fixture
def copied(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copied")


def in_step(change):
    """Return an edit of a processor file that applies `change` to its normaliser."""
    return lambda content: [change(s) for s in content["steps"] if s["registry_name"].endswith("normalizer_processor")]


def test_refuses_damaged_and_divided_folders(copied):
    weights = copied / "model.safetensors"
    for data in (b"short", (2**40).to_bytes(8, "little"), (2).to_bytes(8, "little") + b"{}"):
        weights.write_bytes(data)
        refused(copied)
    weights.unlink()
    assert "merge an adapter or pieces" in refused(copied)
    os.mkfifo(weights)
    refused(copied)
    for text in ("{", "[]", "[" * 100_000, " " * 2_000_000):
        (copied / "config.json").write_text(text)
        refused(copied)


@pytest.mark.parametrize(
    ("file", "change", "says"),
    [
        (CONFIG, lambda c: c.pop("type"), 'write "type": "act" into it'),
        (CONFIG, lambda c: c.update(feedforward_activation="glu"), "'glu'"),
        (CONFIG, lambda c: c.update(replace_final_stride_with_dilation=True), "LeRobot cannot use it"),
        (CONFIG, lambda c: c.update(n_obs_steps=2), "LeRobot cannot use it"),
        (CONFIG, lambda c: c.update(input_features={}), "features"),
        (CONFIG, lambda c: c["input_features"]["observation.state"].update(shape=[3]), "LeRobot cannot use it"),
        (CONFIG, lambda c: c["input_features"].pop("observation.state"), "encoder_robot_state_input_proj"),
        (CONFIG, lambda c: c["input_features"]["observation.images.cam_front"].update(shape=[3, -72, 128]), "features"),
        (CONFIG, lambda c: c.update(chunk_size=16, n_action_steps=16), "config and weights do not agree"),
        (CONFIG, lambda c: c["output_features"]["action"].update(type="STATE"), "features"),
        # what would leave a feature raw
        (INNER, in_step(lambda s: s["config"]["norm_map"].pop("STATE")), "would not be normalised"),
        (INNER, in_step(lambda s: s["config"]["features"].pop(STATE)), "would not be normalised"),
        (INNER, in_step(lambda s: s["config"]["features"][STATE].update(type="ACTION")), "would not be normalised"),
        (INNER, in_step(lambda s: s["config"].update(normalize_observation_keys=[])), "some of the observations only"),
        (INNER, in_step(lambda s: s.update(registry_name="magic")), "'magic'"),
        (INNER, in_step(lambda s: s["config"].update(rename_map={"a": "b"})), "LeRobot cannot use it"),
        (INNER, lambda c: c["steps"].append(RENAMES), "'rename_observations_processor'"),
        (OUTER, in_step(lambda s: s.pop("state_file")), "would not be normalised"),
        (OUTER, lambda c: c["steps"].clear(), "normalises 0 times"),
        (OUTER, lambda c: c["steps"].append(c["steps"][0]), "normalises 2 times"),
    ],
)
def test_refuses_other_lerobot_policies(copied, file, change, says):
    edit(copied / file, change)
    assert says in refused(copied)
    if "write" in says:
        edit(copied / CONFIG, lambda c: c.update(type="act"))
        load_checkpoint(copied)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("observation.state.std", [0.5, -0.5]),
        ("observation.state.mean", [math.inf, 0.0]),
        ("action.max", [0.5, -9.0]),
        ("action.max", None),
    ],
)
def test_statistics_that_nothing_has_are_refused(copied, key, value):
    stats = load_file(copied / STATS)
    wrong = {k: v for k, v in stats.items() if k != key} | ({key: torch.tensor(value)} if value else {})
    save_file(wrong, copied / STATS)
    refused(copied)
    constant = {"observation.state.std": torch.zeros(2), "action.max": stats["action.min"].clone()}
    save_file(stats | constant, copied / STATS)
    assert load_checkpoint(copied).config.action_unnorm.shift == pytest.approx((-0.3, 0.1))


@pytest.mark.parametrize("value", [0.3, 1234.5, 0.0])
def test_a_state_that_never_changed_is_minus_one(copied, value):
    """The result is LeRobot's, without float32's rounding.

    LeRobot takes 1e-8 for a range of zero, so the scale is 2e8; near 2e8 * 0.3, float32's numbers are 4 apart.
    """
    edit(copied / INNER, in_step(lambda s: s["config"]["norm_map"].update(STATE="MIN_MAX")))
    same, stats = torch.tensor([value, 0.5]), load_file(copied / STATS)
    ends = {"observation.state.min": same, "observation.state.max": torch.tensor([value, 2.5])}
    save_file(stats | ends, copied / STATS)
    found, project = load_checkpoint(copied), "encoder_robot_state_input_proj"
    scale, shift = (torch.tensor(part) for part in (found.config.state_norm.scale, found.config.state_norm.shift))
    trained = {name: weight.float() for name, weight in load_file(copied / "model.safetensors").items()}
    for step in (0, 1):
        given = (same + torch.tensor([5 * step, step])) * scale + shift  # whatever the car gives for what never changed
        saw = torch.tensor([-1.0, step - 1.0])
        seen = [
            weights[f"{stem}{project}.weight"] @ x + weights[f"{stem}{project}.bias"]
            for stem, weights, x in (("", found.weights, given), ("model.", trained, saw))
        ]
        assert torch.allclose(*seen, atol=1e-5)


def test_the_steps_own_type_of_a_feature_decides_how_it_is_normalised(policy, tmp_path):
    """LeRobot's step has types and modes of its own, whatever config.json says."""
    inner, outer = saved_normalised(policy, tmp_path)
    edit(tmp_path / INNER, in_step(lambda s: s["config"]["features"][STATE].update(type="ENV")))
    edit(tmp_path / INNER, in_step(lambda s: s["config"]["norm_map"].update(ENV="MIN_MAX")))
    theirs = type(inner).from_pretrained(tmp_path, config_filename=INNER)
    check_is(load_checkpoint(tmp_path), policy, theirs, outer)


def test_a_folder_without_its_processors_is_refused_unless_it_says_identity(copied):
    for file in (INNER, OUTER):
        (copied / file).unlink()
        assert "policy_preprocessor*" in refused(copied)
    edit(copied / "config.json", lambda c: c.update(normalization_mapping=RAW))
    assert "stats.safetensors" in refused(copied), "is that how its numbers are normalised?"
    (copied / STATS).unlink()
    assert load_checkpoint(copied).config.state_norm is None


def test_a_policy_that_sees_no_state_plans_as_lerobots(tmp_path):
    policy = lerobot_policy(**TINY, states=0)
    policy.save_pretrained(tmp_path / "policy")
    edit(tmp_path / "policy/config.json", lambda c: c.update(normalization_mapping=RAW))
    checkpoint = load_checkpoint(tmp_path / "policy")
    assert not checkpoint.config.sees_state and checkpoint.report["normalisation"]["state"] == "not looked at"
    check_is(checkpoint, policy, lambda raw: {k: v[None] for k, v in raw.items()}, lambda actions: actions)
    state, *frames = example_inputs(checkpoint.config)
    model = ACT(checkpoint.config, checkpoint.weights, for_int8=True)
    assert torch.equal(model(state, *frames), model(state + 1, *frames))
    write_lerobot(tmp_path / "ours", checkpoint.config, checkpoint.weights, {})
    again = load_checkpoint(tmp_path / "ours")
    assert replace(again.config, image_norm=checkpoint.config.image_norm) == checkpoint.config


def test_what_lerobot_train_leaves_is_found(policy, tmp_path):
    folder = tmp_path / "out/checkpoints/000020/pretrained_model"
    inner, outer = saved_normalised(policy, folder)
    newer = {"pretrained_revision": "v1"}  # of LeRobot 0.6, and needs no word
    edit(folder / "config.json", lambda c: c.update(temporal_ensemble_coeff=0.01, n_action_steps=1, **newer))
    with pytest.raises(CheckpointError, match="000020"):  # as copied by a program that leaves links out
        load_checkpoint(tmp_path / "out")
    (tmp_path / "out/checkpoints/last").symlink_to("000020")
    for place in ("out", "out/checkpoints", "out/checkpoints/last/pretrained_model"):
        assert lerobot_folder(tmp_path / place).resolve() == folder
    checkpoint = load_checkpoint(tmp_path / "out/checkpoints/last")
    check_is(checkpoint, policy, inner, outer)
    (note,) = checkpoint.report["notes"]
    assert "temporal_ensemble_coeff is 0.01" in note
    assert checkpoint.report["normalisation"]["state"] == "(state - (0.3, 0.25)) / (1.2, 0.3)"
    assert checkpoint.report["normalisation"]["action"] == "output * (1.2, 0.3) + (0.3, 0.25)"


SETTINGS = {"learning_rate": 1e-4, "batch_size": 4, "data_dir": "in", "output_dir": "out", "device": "cpu", "seed": 0}
ORIGIN = {"teacher_sha256": "ab" * 32, "steps": 3}


@pytest.fixture(scope="module")
def weights():
    policy = lerobot_policy(**TINY, use_vae=False)
    return {k.removeprefix("model."): v for k, v in policy.state_dict().items()}


@pytest.fixture(scope="module")
def config(tiny):
    return replace(tiny.config, vae_layers=0)


def test_what_we_write_is_read_back(config, weights, tmp_path):
    """In both formats where the trainer's can hold it: the same weights have one hash."""
    hashes = write_both(tmp_path, config, weights, 0.25, ORIGIN, **SETTINGS)
    assert hashes == write_both(tmp_path / "again", config, weights, 0.25, ORIGIN, **SETTINGS)
    read = load_checkpoint(tmp_path / "best_model.pth")
    assert read.config == config and read.report["best_val_loss"] == 0.25
    assert read.report["trainer_config"]["origin"] == ORIGIN
    assert all(torch.equal(read.weights[name], weight) for name, weight in weights.items())
    for other in ({"rate_hz": 15.0}, {"action_unnorm": Affine((0.4, 0.02), (0.1, 0.05))}):
        written = write_both(tmp_path / "other", replace(config, **other), weights, 0.25, ORIGIN, **SETTINGS)
        assert written.keys() == {"model.safetensors"}


def test_lerobots_folder(config, weights, tmp_path):
    """Driven at 30 steps a second, a student of 15 would drive twice as fast; the trainer's file cannot hold a rate."""
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    norms = {"state_norm": Affine((2.0, 9.0), (-0.1, 0.4)), "action_unnorm": Affine((0.4, 0.02), (0.1, 0.05))}
    config = replace(config, rate_hz=15.0, **norms)
    write_lerobot(tmp_path / "pretrained_model", config, weights, ORIGIN)
    read = load_checkpoint(tmp_path / "pretrained_model")
    (sample,) = memory_samples(1)
    expected = predictions(ACT(config, weights), [inputs_of(sample, config)])[0]
    ours = predictions(ACT(read.config, read.weights), [inputs_of(sample, config)])[0]
    assert (ours - expected).abs().max() < 1e-5
    policy = ACTPolicy.from_pretrained(tmp_path / "pretrained_model")
    check_is(read, policy, *make_pre_post_processors(policy.config, str(tmp_path / "pretrained_model")))
    assert read.config.rate_hz == read.recorded_as(Layout()).config.rate_hz == 15
    swapped = Layout(("cam_front",), rate_hz=15.0, state_order=(1, 0), action_order=(1, 0))
    assert read.recorded_as(swapped) is read  # it is in our order, and is not turned again
    with pytest.raises(CheckpointError, match="15 steps"):
        read.recorded_as(Layout(("cam_front",), rate_hz=30.0))
    assert json.loads((tmp_path / "pretrained_model/origin.json").read_text()) == ORIGIN | {"rate_hz": 15.0}
    (tmp_path / "pretrained_model/origin.json").write_text('{"rate_hz": NaN}')
    with pytest.raises(CheckpointError, match="rate_hz must be a number from 1 to 120, found nan"):
        load_checkpoint(tmp_path / "pretrained_model")


def test_a_full_disk_is_one_sentence(config, weights, tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
        with pytest.raises(RoverError, match="disk full"):
            save_torch(tmp_path / "policy", weights)
        with pytest.raises(RoverError, match="disk full"):
            write_lerobot(tmp_path / "folder", config, weights, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_the_size_of_what_was_trained_here_is_not_guessed(tiny, tmp_path):
    """Our trainings squeeze pictures to the policy's size; of another trainer's that is not known."""
    wide = replace(memory_samples(1, 120, 160)[0], picture=np.zeros((120, 160, 3), np.uint8))
    for ours in (False, True):
        read = replace(tiny, report=tiny.report | {"written_here": ours})
        assert bool(read.recorded_as(Layout(), [wide]).report["guesses"]) != ours
    known = trainer.trainer_config(tiny.config, learning_rate=1e-3)
    assert trainer.OURS.items() <= known.items() and not tiny.report["written_here"]


def test_a_rate_between_whole_ones_is_read_as_it_was_written(tiny, tmp_path):
    """`rover train` keeps a tub's 4.283 Hz, as plans at 4 Hz would be 7 % slower."""
    content = torch.load(tiny.path, weights_only=False)
    content["config"]["rate_hz"] = 4.283
    torch.save(content, tmp_path / "policy.pth")
    assert load_checkpoint(tmp_path / "policy.pth").config.rate_hz == 4.283
