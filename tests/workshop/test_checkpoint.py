"""Checkpoints in, and every way in which one can be wrong."""

import json
import os
import pickle
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from policies import TINY, lerobot_policy, memory_samples, trainer_content

from rover_lib.onboard.errors import CheckpointError
from rover_lib.workshop.act import ACT
from rover_lib.workshop.checkpoint import expected_shapes, load_checkpoint
from rover_lib.workshop.compare import LerobotEager
from rover_lib.workshop.quantize import inputs_of


def write(content, path):
    torch.save(content, path)
    return path


def refused(path) -> str:
    with pytest.raises(CheckpointError) as e:
        load_checkpoint(path)
    message = str(e.value)
    assert str(path) in message and "\n" not in message
    return message


def test_reads_the_trainers_file(tiny, tiny_policy):
    c = tiny.config
    assert (c.chunk, c.dim, c.heads, c.feedforward, c.latent, c.vae_layers) == (32, 64, 4, 128, 32, 1)
    assert c.image_sizes == ((72, 128),) and c.action_names == ("steering", "throttle")
    r = tiny.report
    assert r["parameters"] == sum(p.numel() for p in tiny_policy.state_dict().values())
    assert r["parameters"] - r["parameters_acting"] == r["parameters_by_part"]["vae (training only)"] > 0
    assert r["best_val_loss"] == pytest.approx(0.15) and r["epoch"] == 7
    assert r["optimizer_mb"] > 0
    # What is not weights or optimizer is names and numbers: the sum must explain the file.
    assert r["file_mb"] == pytest.approx(r["weights_mb"] + r["optimizer_mb"], rel=0.02)


def test_without_its_optimizer_it_is_the_same_policy(tiny, tiny_policy, tmp_path):
    content = trainer_content(tiny_policy)
    for key in ("optimizer_state_dict", "scheduler_state_dict", "epoch", "best_val_loss"):
        del content[key]
    found = load_checkpoint(write(content, tmp_path / "weights.pth"))
    assert found.config == tiny.config and found.report["optimizer_mb"] == 0
    assert all(torch.equal(v, tiny.weights[k]) for k, v in found.weights.items() if k != "action_head.weight")


def test_reads_scalars_of_old_and_new_numpy(tiny_policy, tmp_path):
    """best_val_loss is a numpy float64: numpy 1 pickled it as numpy.core, numpy 2 as numpy._core."""
    new = write(trainer_content(tiny_policy), tmp_path / "new.pth")
    old = tmp_path / "old.pth"
    with zipfile.ZipFile(new) as source, zipfile.ZipFile(old, "w") as target:
        for item in source.infolist():
            target.writestr(item, source.read(item).replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    assert b"numpy._core" in zipfile.ZipFile(new).read("new/data.pkl")
    assert load_checkpoint(old).report["best_val_loss"] == load_checkpoint(new).report["best_val_loss"]


@pytest.mark.parametrize("backbone", ["resnet18", "resnet34", "resnet50"])
def test_expected_shapes_are_lerobots(tiny, backbone):
    policy = lerobot_policy(**TINY, vision_backbone=backbone)
    theirs = {k.removeprefix("model."): tuple(v.shape) for k, v in policy.state_dict().items()}
    assert expected_shapes(replace(tiny.config, backbone=backbone)) == theirs


class Evil:
    def __reduce__(self):
        return os.system, ("touch owned",)


def test_refuses_to_run_code(tiny_policy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write(trainer_content(tiny_policy) | {"notes": Evil()}, tmp_path / "evil.pth")
    assert "posix.system" in refused(path)
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("config"), "no 'config'"),
        (lambda c: c.pop("model_state_dict"), "no 'model_state_dict'"),
        (lambda c: c["config"].pop("hidden_size"), "hidden_size"),
        (lambda c: c["config"].update(chunk_size="32"), "chunk_size"),
        (lambda c: c["config"].update(n_heads=0), "n_heads"),
        (lambda c: c["config"].update(n_heads=7), "7 heads"),
        (lambda c: c["config"].update(n_obs_steps=2), "n_obs_steps"),
        (lambda c: c["config"].update(vision_encoder="vit"), "'vit'"),
        (lambda c: c["config"].update(hidden_size=128), "of another shape"),
        (lambda c: c["config"].update(n_decoder_layers=3), "missing: decoder.layers.2"),
        (lambda c: c["config"].update(n_decoder_layers=1), "unknown: decoder.layers.1"),
        (lambda c: c["config"].update(chunk_size=16), "decoder_pos_embed"),
        (lambda c: c["model_state_dict"].pop("model.action_head.bias"), "action_head.bias"),
        (lambda c: c["model_state_dict"].update({"model.extra": torch.zeros(1)}), "unknown: extra"),
        (lambda c: c["model_state_dict"].update({"other.extra": torch.zeros(1)}), "other.extra"),
        (lambda c: c["model_state_dict"].update({"model.action_head.bias": 3}), "action_head.bias"),
        (lambda c: c["model_state_dict"]["model.decoder.norm.bias"].fill_(np.nan), "NaN or Inf in decoder.norm.bias"),
        (lambda c: c["model_state_dict"]["model.decoder.norm.bias"].fill_(np.inf), "NaN or Inf"),
    ],
)
def test_refuses_what_does_not_agree(change, says, tmp_path):
    content = trainer_content(lerobot_policy(**TINY))
    change(content)
    assert says in refused(write(content, tmp_path / "bad.pth"))


def test_refuses_damaged_files(tiny_file, tmp_path):
    whole = tiny_file.read_bytes()
    path = tmp_path / "damaged.pth"
    assert "not found" in refused(path)
    path.write_bytes(b"")
    refused(path)
    path.write_bytes(whole[: len(whole) // 2])
    refused(path)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF  # one byte of one weight: torch.load would take it
    path.write_bytes(flipped)
    assert "checksum" in refused(path)
    path.write_bytes(pickle.dumps({"config": {}}))
    refused(path)
    write([1, 2], path)
    assert "list" in refused(path)


@pytest.fixture
def folder(tmp_path):
    from test_act import image_stats, saved

    policy = lerobot_policy(**TINY)
    saved(policy, tmp_path, image_stats(policy))
    return tmp_path


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.update(type="diffusion"), "'diffusion'"),
        (lambda c: c.update(feedforward_activation="glu"), "'glu'"),
        (lambda c: c.update(replace_final_stride_with_dilation=True), "resnet50"),
        (lambda c: c.update(input_features={}), "no camera"),
        (lambda c: c["input_features"].pop("observation.state"), "observation.state"),
        (lambda c: c["input_features"].update(env={"type": "ENV", "shape": [3]}), "environment state"),
        (lambda c: c["input_features"].update(x={"type": "VISUAL", "shape": [1, 8, 8]}), "(3, height, width)"),
        (lambda c: c["input_features"].update(x={"shape": "?"}), "no type and shape"),
        (lambda c: c.update(output_features={}), "'action'"),
        (lambda c: c.update(dim_model=None), "dim_model"),
    ],
)
def test_refuses_other_lerobot_policies(folder, change, says):
    edit(folder / "config.json", change)
    assert says in refused(folder)


def test_refuses_processors_that_it_does_not_know(folder):
    edit(folder / "policy_preprocessor.json", lambda c: c["steps"].append({"registry_name": "magic", "config": {}}))
    with pytest.raises(CheckpointError, match="magic"):
        load_checkpoint(folder)
    edit(folder / "policy_preprocessor.json", lambda c: c["steps"][0]["config"].update(rename_map={"a": "b"}))
    with pytest.raises(CheckpointError, match="renames"):
        load_checkpoint(folder)


def test_refuses_damaged_folders(folder):
    (folder / "model.safetensors").write_bytes(b"short")
    with pytest.raises(CheckpointError, match="safetensors"):
        load_checkpoint(folder)
    (folder / "model.safetensors").unlink()
    with pytest.raises(CheckpointError, match="not found"):
        load_checkpoint(folder)
    (folder / "config.json").write_text("{")
    with pytest.raises(CheckpointError, match="JSON"):
        load_checkpoint(folder)


@pytest.mark.parametrize("size", [(54, 96), (75, 131), (144, 256)])
def test_at_another_size_it_is_lerobots_policy_of_that_size(tiny, size):
    other = tiny.at_size(*size)
    assert other.config == replace(tiny.config, image_sizes=(size,)) and other.weights is tiny.weights
    ours, lerobot = ACT(other.config, other.weights), LerobotEager(other)
    (sample,) = memory_samples(1, *size)
    with torch.inference_mode():
        found = ours(*inputs_of(sample, other.config))[0].numpy()
    lerobot._low, lerobot._high = -np.inf, np.inf  # what is clipped would be the same anyway
    expected = lerobot.predict_chunk(sample.picture, sample.state)
    assert np.abs(found - expected).max() < 1e-5 < np.abs(found).max()


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((54.0, 96.0), "two whole numbers"),
        ((18, 32), "smaller than one feature"),
        ((96, 96), r"96x96 has another aspect ratio than 128x72"),
    ],
)
def test_a_size_that_makes_no_sense_is_refused(tiny, size, words):
    with pytest.raises(CheckpointError, match=words):
        tiny.at_size(*size)


def test_another_size_is_for_one_camera(tiny):
    two = replace(tiny, config=replace(tiny.config, cameras=("left", "right"), image_sizes=((72, 128),) * 2))
    with pytest.raises(CheckpointError, match="2 cameras"):
        two.at_size(54, 96)
