"""Checkpoints are read, and every way in which one can be wrong is refused."""

import json
import math
import os
import pickle
import shutil
import time
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from policies import TINY, check_is, lerobot_policy, memory_samples, normalised, trainer_content
from safetensors.torch import load_file, save_file

from rover_lib.cli import main
from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.kinds import KindError, kinds_of
from rover_lib.workshop.act import ACT, example_inputs, inputs_of
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.checkpoint.contents import expected_shapes
from rover_lib.workshop.checkpoint.files import write_lerobot
from rover_lib.workshop.checkpoint.lerobot import Normaliser, lerobot_folder
from rover_lib.workshop.checkpoint.trainer import PICKLE_BYTES
from rover_lib.workshop.judge.compare import LerobotEager
from rover_lib.workshop.recordings.samples import Layout


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
    # Beside weights and optimizer a file has only names and a few numbers, so the sum must explain its size.
    assert r["file_mb"] == pytest.approx(r["weights_mb"] + r["optimizer_mb"], rel=0.02)


def test_without_its_optimizer_it_is_the_same_policy(tiny, tiny_policy, tmp_path):
    content = trainer_content(tiny_policy)
    for key in ("optimizer_state_dict", "scheduler_state_dict", "epoch", "best_val_loss"):
        del content[key]
    found = load_checkpoint(write(content, tmp_path / "weights.pth"))
    assert found.config == tiny.config and found.report["optimizer_mb"] == 0
    assert all(torch.equal(v, tiny.weights[k]) for k, v in found.weights.items() if k != "action_head.weight")


def test_numbers_of_numpy_and_counts_of_batches_are_no_obstacle(tiny_policy, tmp_path):
    """The config's whole numbers were "a int64", and the count that LeRobot drops was a weight that is no float."""
    content = trainer_content(tiny_policy)
    content["config"] = {k: np.int64(v) if type(v) is int else v for k, v in content["config"].items()}
    content["model_state_dict"]["model.backbone.bn1.num_batches_tracked"] = torch.tensor(7)
    (tmp_path / "a").mkdir()
    write(content, tmp_path / "a/best_model.pth")
    assert load_checkpoint(tmp_path / "a/best_model.pth").config.chunk == 32
    for place in ("", "a"):  # a folder that holds it, and one that holds that
        with pytest.raises(KindError, match=r"contains a trainer's checkpoint but is not one, found .*best_model.pth"):
            load_checkpoint(tmp_path / place)


def test_reads_scalars_of_old_and_new_numpy(tiny_policy, tmp_path):
    """best_val_loss is a numpy float64, which numpy 1 pickles as numpy.core and numpy 2 as numpy._core."""
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


BIAS = "model.decoder.norm.bias"


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
        (lambda c: c["model_state_dict"].pop("model.action_head.bias"), "action_head.bias"),
        (lambda c: c["model_state_dict"].update({"other.extra": torch.zeros(1)}), "other.extra"),
        (lambda c: c["model_state_dict"].update({"model.action_head.bias": 3}), "action_head.bias"),
    ],
)
def test_refuses_what_makes_no_policy(change, says, tmp_path):
    content = small()
    change(content)
    assert says in refused(write(content, tmp_path / "bad.pth"))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c["config"].update(hidden_size=128), "of another shape"),
        (lambda c: c["config"].update(n_decoder_layers=3), "missing: decoder.layers.2"),
        (lambda c: c["config"].update(n_decoder_layers=1), "unknown: decoder.layers.1"),
        (lambda c: c["config"].update(chunk_size=16), "decoder_pos_embed"),
        (lambda c: c["model_state_dict"].update({"model.extra": torch.zeros(1)}), "unknown: extra"),
        (lambda c: c["model_state_dict"].update({BIAS: torch.full((64,), np.nan)}), "NaN or Inf in decoder.norm.bias"),
        (lambda c: c["model_state_dict"].update({BIAS: torch.full((64,), np.inf)}), "NaN or Inf"),
        # finite here, but not in float32, in which the policy drives
        (lambda c: c["model_state_dict"].update({BIAS: torch.full((64,), 1e300, dtype=torch.float64)}), "NaN or Inf"),
    ],
)
def test_refuses_what_does_not_agree(change, says, tiny_policy, tmp_path):
    content = trainer_content(tiny_policy)
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
    flipped[len(whole) // 2] ^= 0xFF  # one byte of one weight: torch.load would accept it
    path.write_bytes(flipped)
    assert "checksum" in refused(path)
    path.write_bytes(pickle.dumps({"config": {}}))
    refused(path)
    write([1, 2], path)
    assert "list" in refused(path)


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        *((lambda c, t=t: c.update(type=t), f"policy type is '{t}'") for t in ("diffusion", "pi0", "smolvla", "vqbet")),
        (lambda c: c.pop("type"), "migrate_policy_normalization"),
        (lambda c: c.update(use_peft=True), "a PEFT adapter"),
        (lambda c: c.update(feedforward_activation="glu"), "'glu'"),
        (lambda c: c.update(replace_final_stride_with_dilation=True), "resnet50"),
        (lambda c: c.update(input_features={}), "no camera"),
        (lambda c: c["input_features"].pop("observation.state"), "unknown: encoder_robot_state_input_proj"),
        (lambda c: c["input_features"].update(env={"type": "ENV", "shape": [3]}), "environment state"),
        (lambda c: c["input_features"].update(x={"type": "VISUAL", "shape": [1, 8, 8]}), "(3, height, width)"),
        (lambda c: c["input_features"].update(x={"shape": "?"}), "no type and shape"),
        (lambda c: c.update(output_features={}), "'action'"),
        (lambda c: c["output_features"]["action"].update(type="STATE"), "no 'action' output of type ACTION"),
        (lambda c: c.update(dim_model=None), "dim_model"),
    ],
)
def test_refuses_other_lerobot_policies(copied, change, says):
    edit(copied / "config.json", change)
    assert says in refused(copied)


def test_refuses_processors_that_it_does_not_know(copied):
    edit(copied / "policy_preprocessor.json", lambda c: c["steps"].append({"registry_name": "magic", "config": {}}))
    with pytest.raises(CheckpointError, match="magic"):
        load_checkpoint(copied)
    edit(copied / "policy_preprocessor.json", lambda c: c["steps"].pop())
    edit(copied / "policy_preprocessor.json", lambda c: c["steps"][0]["config"].update(rename_map={"a": "b"}))
    with pytest.raises(CheckpointError, match="renames 'a' to 'b'; only one camera to another"):
        load_checkpoint(copied)


def test_refuses_damaged_folders(copied):
    (copied / "model.safetensors").write_bytes(b"short")
    with pytest.raises(CheckpointError, match="safetensors"):
        load_checkpoint(copied)
    (copied / "model.safetensors").unlink()
    with pytest.raises(CheckpointError, match="not found"):
        load_checkpoint(copied)
    (copied / "config.json").write_text("{")
    with pytest.raises(CheckpointError, match="JSON"):
        load_checkpoint(copied)


@pytest.mark.parametrize("size", [(54, 96), (75, 131), (144, 256)])
def test_at_another_size_it_is_lerobots_policy_of_that_size(tiny, size):
    other = tiny.at_size(*size)
    assert other.config == replace(tiny.config, image_sizes=(size,)) and other.weights is tiny.weights
    ours, lerobot = ACT(other.config, other.weights), LerobotEager(other)
    (sample,) = memory_samples(1, *size)
    with torch.inference_mode():
        found = ours(*inputs_of(sample, other.config))[0].numpy()
    lerobot._low, lerobot._high = -np.inf, np.inf  # clipped plans would be equal in any case
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


# ---- files that lie: refused in a sentence with a remedy, in less than a second or two -------------------------------

QUICKLY_S = 2.0  # of this process's CPU time: no more than an honest file of the same size takes
WILD = settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))


def refused_quickly(path) -> CheckpointError:
    start_s = time.process_time()
    with pytest.raises(CheckpointError) as e:
        load_checkpoint(path)
    assert time.process_time() - start_s < QUICKLY_S
    message = str(e.value)
    assert str(path) in message and "\n" not in message and len(message) < 1000
    assert e.value.remedy
    return e.value


def small(**changes):
    """Return a trainer's content with only three small weights: an incomplete policy that is quick to write."""
    config = {"image_width": 128, "image_height": 72, "chunk_size": 32, "hidden_size": 64, "n_encoder_layers": 1,
              "n_decoder_layers": 2, "n_heads": 4, "feedforward_dim": 128, "vision_encoder": "resnet18"}  # fmt: skip
    weights = {
        "model.encoder_robot_state_input_proj.weight": torch.zeros(64, 2),
        "model.encoder_latent_input_proj.weight": torch.zeros(64, 32),
        "model.action_head.bias": torch.ones(2),
    }
    config |= changes.pop("config", {})
    return {"config": config, "model_state_dict": weights | changes.pop("weights", {}), **changes}


@pytest.mark.parametrize(
    ("weight", "says"),
    [
        (torch.eye(3).to_sparse(), "not dense (sparse_coo)"),
        (torch.empty(10**9, device="meta"), "meta device"),
        (torch.quantize_per_tensor(torch.ones(3), 0.1, 0, torch.qint8), "quantized"),
        (torch.ones(3, dtype=torch.complex64), "of torch.complex64"),
        (torch.ones(3, dtype=torch.bool), "of torch.bool"),
        (torch.ones(3, dtype=torch.int64), "of torch.int64"),
        (torch.ones(3).to(torch.float8_e4m3fn), "of torch.float8_e4m3fn"),
        (torch.zeros(0, 10**12), "empty"),
        (torch.zeros(1).expand(10**6, 10**5), "claim 400000.0 MB"),
    ],
)
def test_a_weight_that_is_no_dense_float_is_refused(weight, says, tmp_path):
    path = write(small(weights={"model.action_head.bias": weight}), tmp_path / "bad.pth")
    assert says in str(refused_quickly(path))


def test_weights_that_share_a_storage_claim_more_than_the_file_holds(tmp_path):
    shared = torch.zeros(1000, 1000)
    path = write(small(weights={f"model.w{i}": shared.view(-1)[: 10**6] for i in range(100)}), tmp_path / "bad.pth")
    assert "its weights claim 400.0 MB" in str(refused_quickly(path))


@pytest.mark.parametrize("key", ["encoder", "decoder"])
def test_a_million_layers_are_not_built(key, tmp_path):
    path = write(small(config={f"n_{key}_layers": 10**6}), tmp_path / "bad.pth")
    assert f"1000000 {key} layers, 3 weights" in str(refused_quickly(path))


HOLDS_ITSELF: list = []
HOLDS_ITSELF.append(HOLDS_ITSELF)
DOUBLED: list = [1]
for _ in range(60):  # 2**60 numbers if walked, in sixty lists
    DOUBLED = [DOUBLED, DOUBLED]


def test_a_loss_that_is_no_number_is_refused(tmp_path):
    for value in ("low", "0.1", True, 10**500, [0.1], torch.ones(2), HOLDS_ITSELF, DOUBLED):
        path = write(small(best_val_loss=value), tmp_path / "bad.pth")
        assert "best_val_loss is not a number" in str(refused_quickly(path)), type(value)


def test_a_config_of_odd_values_is_refused(tmp_path):
    """Whole numbers have one reader: each odd value is tried at one of them and at a name, two at each other key."""
    odd = [10**500, -1, True, 2.5, "a\nb" * 999, HOLDS_ITSELF, DOUBLED, torch.ones(2), torch.eye(2).to_sparse()]
    for key, values in (("hidden_size", odd), ("vision_encoder", odd), ("n_obs_steps", odd[:2]),
                        ("image_height", odd[:2]), ("n_decoder_layers", odd[:2])):  # fmt: skip
        for value in values:
            refused_quickly(write(small(config={key: value}), tmp_path / "bad.pth"))


def test_the_report_is_finite_and_plain(tiny_policy, tmp_path):
    """The other content of a trainer's file is reported as far as JSON can hold it, and is never walked without end."""
    content = trainer_content(tiny_policy)
    content["config"] |= {
        "history": HOLDS_ITSELF,
        "all": DOUBLED,
        "huge": 10**500,
        "mean": torch.ones(3),
        "size": (1, 2),
    }
    content |= {"epoch": np.int64(7), "optimizer_state_dict": [DOUBLED, HOLDS_ITSELF, torch.eye(2).to_sparse()]}
    report = load_checkpoint(write(content, tmp_path / "odd.pth")).report
    text = json.dumps(report)
    assert len(text) < 20_000 and report["optimizer_mb"] == 0 and report["epoch"] == 7
    assert report["trainer_config"]["betas"] == [0.9, 0.999] and report["trainer_config"]["size"] == [1, 2]
    assert report["trainer_config"]["huge"] == "an integer of 1661 bits"


def test_the_format_before_zip_files_is_refused_by_its_name(tmp_path):
    path = tmp_path / "old.pth"
    torch.save(small(), path, _use_new_zipfile_serialization=False)
    error = refused_quickly(path)
    assert "torch's format of before 1.6" in error.what and "torch.save" in error.remedy


def rewritten(path, change, compression=zipfile.ZIP_STORED):
    """Copy an archive with its pickle changed, and with correct checksums."""
    other = path.with_suffix(".changed.pth")
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(other, "w", compression) as target:
        for name in source.namelist():
            data = source.read(name)
            target.writestr(name, change(data) if name.endswith("data.pkl") else data)
    return other


def test_archives_that_unfold_to_more_than_the_file_are_refused(tmp_path):
    path = write(small(), tmp_path / "a.pth")
    assert "compressed" in str(refused_quickly(rewritten(path, bytes, zipfile.ZIP_DEFLATED)))
    assert "it asks for 'bytearray'" in str(
        refused_quickly(rewritten(path, lambda _: b"\x80\x02cbuiltins\nbytearray\nJ\x00\x00\x00\x40\x85R."))
    )
    assert "MB beside its tensors" in str(refused_quickly(rewritten(path, lambda d: d + bytes(PICKLE_BYTES))))
    assert "not readable" in str(refused_quickly(rewritten(path, lambda _: b"\x80\x02" + b"]" * 10**5)))


def test_a_pipe_is_no_checkpoint(tmp_path):
    os.mkfifo(tmp_path / "pipe.pth")
    assert "neither a file nor a folder" in str(refused_quickly(tmp_path / "pipe.pth"))


@pytest.fixture(scope="module")
def small_file(tmp_path_factory):
    return write(small(), tmp_path_factory.mktemp("small") / "small.pth")


CHANGES = st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=5)


def changed(data: bytes, changes) -> bytes:
    data = bytearray(data)
    for at, value in changes:
        data[at % len(data)] = value
    return bytes(data)


@WILD
@given(changes=CHANGES)
@example(changes=[(-38, 1)])  # the end of this archive says that it is on another disk
def test_wild_bytes_in_an_archive(small_file, changes):
    path = small_file.with_name("wild.pth")
    path.write_bytes(changed(small_file.read_bytes(), changes))
    refused_quickly(path)


@WILD
@given(changes=CHANGES)
def test_wild_bytes_in_a_pickle(small_file, changes):
    refused_quickly(rewritten(small_file, lambda data: changed(data, changes)))


def test_inspecting_a_damaged_archive_is_a_sentence(small_file, tmp_path):
    path = tmp_path / "damaged.pth"
    data = small_file.read_bytes()
    at = data.index(b"PK\x01\x02")  # where the archive's directory begins
    path.write_bytes(data[:at] + b"PK\xff\xff" + data[at + 4 :])
    result = CliRunner().invoke(main, ["inspect", str(path)])
    assert result.exit_code == 1 and "damaged (Bad magic number for central directory)" in result.output


# ---- the same for LeRobot's folder -------------------------------------------------------------------------------


def safetensors(header: bytes, data: bytes = b"", length: int | None = None) -> bytes:
    return (len(header) if length is None else length).to_bytes(8, "little") + header + data


@pytest.fixture(scope="module")
def small_folder(tmp_path_factory):
    """Write LeRobot's files with only three weights: an incomplete policy that is quick to read."""
    path = tmp_path_factory.mktemp("lerobot")
    features = {"observation.images.front": {"type": "VISUAL", "shape": [3, 72, 128]},
                "observation.state": {"type": "STATE", "shape": [2]}}  # fmt: skip
    config = {"type": "act", "n_obs_steps": 1, "chunk_size": 32, "dim_model": 64, "n_heads": 4, "dim_feedforward": 128,
              "n_encoder_layers": 1, "n_decoder_layers": 2, "vision_backbone": "resnet18", "pre_norm": False,
              "replace_final_stride_with_dilation": False, "feedforward_activation": "relu",
              "input_features": features, "output_features": {"action": {"type": "ACTION", "shape": [2]}}}  # fmt: skip
    (path / "config.json").write_text(json.dumps(config))
    save_file({k: v.clone() for k, v in small()["model_state_dict"].items()}, path / "model.safetensors")
    norm = {"norm_map": {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MIN_MAX"}, "eps": 1e-8,
            "features": features}  # fmt: skip
    for file, name in (
        ("policy_preprocessor", "normalizer_processor"),
        ("policy_postprocessor", "unnormalizer_processor"),
    ):
        steps = [{"registry_name": name, "config": norm, "state_file": "stats.safetensors"}]
        (path / f"{file}.json").write_text(json.dumps({"steps": steps}))
    two = torch.tensor([1.0, 2.0])
    keys = [f"{key}.{stat}" for key in ("observation.state", "action") for stat in ("mean", "std", "min", "max")]
    save_file({key: two + len(key) for key in keys}, path / "stats.safetensors")
    return path


def test_the_small_folder_lacks_only_weights(small_folder):
    assert "config and weights do not agree (missing: " in str(refused_quickly(small_folder))


@pytest.fixture
def copied(small_folder, tmp_path):
    return shutil.copytree(small_folder, tmp_path / "copied")


@pytest.mark.parametrize("file", ["config.json", "policy_preprocessor.json"])
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{"a":' * 20_000 + "1" + "}" * 20_000, "not readable as JSON"),  # Python 3.13 reads 5,000
        ("[" * 100_000, "not readable as JSON"),
        (json.dumps({str(i): i for i in range(10**5)}), "MB, at most 1 are read"),
        ("[]", "expected a JSON object"),
        ('{"a": 1' + "0" * 5000 + "}", "not readable as JSON"),
        ("\ud800", "not readable as JSON"),
    ],
    ids=["deep", "cut short", "many entries", "list", "huge number", "no text"],
)
def test_json_that_is_too_deep_or_too_large_is_refused(copied, file, text, says):
    (copied / file).write_bytes(text.encode(errors="surrogatepass"))
    assert says in str(refused_quickly(copied))


@pytest.mark.parametrize("file", ["config.json", "model.safetensors", "policy_preprocessor.json"])
def test_a_pipe_in_a_folder_is_refused(copied, file):
    (copied / file).unlink()
    os.mkfifo(copied / file)
    assert "not a file" in str(refused_quickly(copied))


ODD = st.one_of(
    st.sampled_from([None, True, -1, 0, 1, 10**6, 10**400, 2**63, 0.5, math.nan, math.inf, "", "relu", "..", "a\nb"]),
    st.sampled_from([[], {}, [[]], [1], [3, -72, 128], [3, 10**9, 10**9], {"a": {}}, {"type": "VISUAL", "shape": []}]),
)


def places(content, path=()):
    """Yield the path of every value in nested JSON."""
    yield path
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        yield from places(value, (*path, key))


@WILD
@given(data=st.data(), file=st.sampled_from(["config.json", "policy_preprocessor.json", "policy_postprocessor.json"]))
def test_wild_values_in_a_folder(small_folder, data, file):
    """With one value of its JSON replaced by an odd one it is refused, if not for this then for its missing weights."""
    path = small_folder / file
    before = path.read_text()
    content = json.loads(before)
    *parents, last = data.draw(st.sampled_from([p for p in places(content) if p]))
    inner = content
    for key in parents:
        inner = inner[key]
    inner[last] = data.draw(ODD)
    path.write_text(json.dumps(content))
    try:
        refused_quickly(small_folder)
    finally:
        path.write_text(before)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (safetensors(b"{}", length=2**40), "its header claims 1099511.6 MB"),
        (safetensors(b"{" * 100_000), "not readable as safetensors"),
        (safetensors(b'{"model.a":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}}', bytes(4)), "not readable"),
        (safetensors(b'{"model.a":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,4]}}', bytes(4)),
         "not readable"),
        (safetensors(b'{"model.a":{"dtype":"F32","shape":[10],"data_offsets":[0,40]}}', bytes(4)), "not readable"),
        (safetensors(b'{"model.a":{"dtype":"F32","shape":[0,99999999999],"data_offsets":[0,0]}}'), "is empty"),
        (safetensors(b'{"model.a":{"dtype":"I64","shape":[1],"data_offsets":[0,8]}}', bytes(8)), "of torch.int64"),
        (safetensors(b'{"model.a":{"dtype":"X9","shape":[1],"data_offsets":[0,8]}}', bytes(8)), "not readable"),
    ],
)  # fmt: skip
def test_a_header_that_lies_is_refused(copied, content, says):
    (copied / "model.safetensors").write_bytes(content)
    assert says in str(refused_quickly(copied))


@pytest.mark.slow
def test_two_cameras_of_one_name_keep_their_own(tmp_path):
    cameras = {"observation.image": (32, 64), "observation.images.image": (64, 32)}
    lerobot_policy(**TINY, cameras=cameras).save_pretrained(tmp_path)
    edit(tmp_path / "config.json", lambda c: c.update(normalization_mapping=RAW))
    config = load_checkpoint(tmp_path).config
    assert dict(zip(config.cameras, config.image_sizes, strict=True)) == cameras


def test_features_that_the_weights_do_not_have_are_refused(copied):
    edit(copied / "config.json", lambda c: c["input_features"]["observation.state"].update(shape=[3]))
    edit(copied / "config.json", lambda c: c.update(normalization_mapping=RAW))
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (copied / name).unlink()
    assert "'observation.state' has shape [3], the weights are for 2" in refused(copied)


# ---- normalisation: never left out without a word ---------------------------------------------------------------

RAW = dict.fromkeys(("VISUAL", "STATE", "ACTION"), "IDENTITY")
INNER, OUTER = "policy_preprocessor.json", "policy_postprocessor.json"
ONLY_WEIGHTS = "config and weights do not agree (missing: "  # the small folder's only remaining fault


def in_step(change):
    """Return an edit of a processor file that applies `change` to its normaliser."""
    return lambda content: change(content["steps"][0])


@pytest.mark.parametrize(
    ("file", "change", "says"),
    [
        (INNER, in_step(lambda s: s["config"]["norm_map"].pop("STATE")), "no normalisation mode for 'observation."),
        (INNER, in_step(lambda s: s["config"]["norm_map"].update(VISUAL="MEAN_STD")),
         "no statistics of 'observation.images.front', whose mode is 'MEAN_STD'"),
        (INNER, in_step(lambda s: s["config"]["features"].pop("observation.state")),
         "'observation.state' is not among the features that it normalises"),
        (INNER, in_step(lambda s: s["config"].update(normalize_observation_keys=[])), "some of the observations only"),
        (INNER, in_step(lambda s: s.pop("state_file")), "no statistics of 'observation.state'"),
        (OUTER, in_step(lambda s: s.pop("state_file")), "no statistics of 'action', whose mode is 'MIN_MAX'"),
        (OUTER, lambda c: c["steps"].clear(), "no statistics of 'action', whose mode is 'MEAN_STD'"),
        (OUTER, lambda c: c["steps"].append(c["steps"][0]), "normalises 2 times"),
        (INNER, in_step(lambda s: s["config"]["features"]["observation.state"].update(type="ACTION")),
         "'observation.state' is not among the features that it normalises"),
    ],
)  # fmt: skip
def test_a_feature_that_would_be_left_raw_is_refused(copied, file, change, says):
    edit(copied / file, change)
    assert says in str(refused_quickly(copied))


@pytest.mark.parametrize("feature", ["observation.state", "action"])
def test_statistics_of_one_feature_missing(copied, feature):
    stats = load_file(copied / "stats.safetensors")
    save_file({k: v for k, v in stats.items() if not k.startswith(feature)}, copied / "stats.safetensors")
    assert f"no statistics of '{feature}'" in str(refused_quickly(copied))
    for file in (INNER, OUTER):
        edit(copied / file, in_step(lambda s: s["config"].update(norm_map=RAW)))
    assert ONLY_WEIGHTS in str(refused_quickly(copied))


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("observation.state.std", [0.5, -0.5], "a negative std, which would turn it around, found ["),
        ("action.max", [0.5, 9.0], "'action' have a min above its max, which would turn it around, found ["),
        ("observation.state.mean", [1e300, 0.0], "statistics of 'observation.state' are not finite"),
        ("action.min", [[0.5], [9.0]], "statistics of 'action' have shapes min [2, 1], not [2]"),
    ],
)
def test_statistics_that_nothing_has_are_refused(copied, key, value, says):
    stats = load_file(copied / "stats.safetensors")
    save_file(stats | {key: torch.tensor(value, dtype=torch.float64)}, copied / "stats.safetensors")
    assert says in str(refused_quickly(copied))
    constant = {"observation.state.std": torch.zeros(2), "action.max": stats["action.min"].clone()}
    save_file(stats | constant, copied / "stats.safetensors")
    assert ONLY_WEIGHTS in str(refused_quickly(copied))


@pytest.mark.parametrize("value", [0.3, -7.7, 1234.5, 0.0])
def test_a_state_that_never_changed_is_minus_one(copied, value):
    """The result is LeRobot's, without float32's rounding.

    LeRobot takes 1e-8 for a range of zero, so the scale is 2e8; near 2e8 * 0.3, float32's numbers are 4 apart.
    """
    edit(copied / INNER, in_step(lambda s: s["config"]["norm_map"].update(STATE="MIN_MAX")))
    same, stats = torch.tensor([value, 0.5]), load_file(copied / "stats.safetensors")
    ends = {"observation.state.min": same, "observation.state.max": torch.tensor([value, 2.5])}
    save_file(stats | ends, copied / "stats.safetensors")
    norm = Normaliser(copied, INNER, {}, {}).affine("observation.state", "STATE", 2)
    scale, shift = torch.tensor(norm.scale), torch.tensor(norm.shift)
    assert (same * scale + shift).tolist() == [-1, -1]
    assert ((same + torch.tensor([0, 1])) * scale + shift).tolist() == [-1, 0]


def test_the_steps_own_type_of_a_feature_decides_how_it_is_normalised(tmp_path):
    """LeRobot's step has types and modes of its own, whatever config.json says."""
    policy = lerobot_policy(**TINY)
    inner, outer, _ = normalised(policy, "MEAN_STD")
    for part in (policy, inner, outer):
        part.save_pretrained(tmp_path)
    normaliser = next(i for i, s in enumerate(inner.steps) if type(s).__name__ == "NormalizerProcessorStep")

    def change(content):
        config = content["steps"][normaliser]["config"]
        config["features"]["observation.state"]["type"] = "ENV"
        config["norm_map"]["ENV"] = "MIN_MAX"

    edit(tmp_path / INNER, change)
    theirs = type(inner).from_pretrained(tmp_path, config_filename=INNER)
    check_is(load_checkpoint(tmp_path), policy, theirs, outer)


@pytest.mark.parametrize("missing", [(INNER,), (OUTER,), (INNER, OUTER)])
def test_a_folder_without_its_processors_is_refused_unless_it_says_identity(copied, missing):
    for file in missing:
        (copied / file).unlink()
    error = refused_quickly(copied)
    assert "no processor file beside it" in error.what and "policy_preprocessor*" in error.remedy
    edit(copied / "config.json", lambda c: c.update(normalization_mapping=RAW))
    assert ONLY_WEIGHTS in str(refused_quickly(copied))


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX"])
def test_statistics_in_the_weights_are_read_as_lerobot_did_before_processors(mode, tmp_path):
    from lerobot.processor.migrate_policy_normalization import extract_normalization_stats

    policy = lerobot_policy(**TINY)
    inner, outer, stats = normalised(policy, mode)
    policy.save_pretrained(tmp_path)
    with pytest.raises(CheckpointError, match="no processor file beside it"):
        load_checkpoint(tmp_path)
    kept = ("mean", "std") if mode == "MEAN_STD" else ("min", "max")
    weights = load_file(tmp_path / "model.safetensors")
    for part, keys in (
        ("normalize_inputs", [k for k in stats if k != "action"]),
        ("normalize_targets", ["action"]),
        ("unnormalize_outputs", ["action"]),
    ):
        for key in keys:
            name = f"{part}.buffer_{key.replace('.', '_')}"
            weights |= {f"{name}.{stat}": stats[key][stat].clone() for stat in kept}
    save_file(weights, tmp_path / "model.safetensors")
    checkpoint = load_checkpoint(tmp_path)
    check_is(checkpoint, policy, inner, outer)
    assert checkpoint.report["normalisation_from"]["out"] == "the weights' file, as LeRobot did before 0.4"
    theirs = extract_normalization_stats(weights)["action"]  # LeRobot's own migration
    assert all(torch.equal(theirs[stat], stats["action"][stat]) for stat in kept)
    weights[f"unnormalize_outputs.buffer_action.{kept[0]}"] = torch.full((2,), torch.inf)  # LeRobot's mark: never set
    save_file(weights, tmp_path / "model.safetensors")
    assert "not finite" in str(refused_quickly(tmp_path))


def rename(folder, change):
    """Gives each weight the name change(name)."""
    weights = load_file(folder / "model.safetensors")
    save_file({change(name): value for name, value in weights.items()}, folder / "model.safetensors")


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda f: rename(f, "_orig_mod.{}".format), "begin with '_orig_mod.model.', which is taken off"),
        (lambda f: rename(f, "module.{}".format), "begin with 'module.model.', which is taken off"),
        (lambda f: rename(f, lambda n: n.replace("model.", "policy.model._orig_mod.", 1)), "'policy.model._orig_mod.'"),
        (lambda f: rename(f, lambda n: n.removeprefix("model.")), "begin with '', which is taken off"),
        (
            lambda f: edit(
                f / INNER,
                lambda c: c["steps"][0]["config"].update(
                    rename_map={"observation.images.top": "observation.images.cam_front"}
                ),
            ),
            None,
        ),
        (
            lambda f: edit(f / "config.json", lambda c: c.update(temporal_ensemble_coeff=0.01)),
            "temporal_ensemble_coeff is 0.01: LeRobot would drive by averages",
        ),
        (lambda f: edit(f / "config.json", lambda c: c.update(use_film=True)), "0.6 has, not used: use_film"),
    ],
    ids=["compiled", "in DDP", "in Lightning", "the network alone", "renamed camera", "ensembling", "unknown field"],
)
def test_what_changes_nothing_of_a_policy_is_said_or_needs_no_word(tmp_path, damage, says):
    policy = lerobot_policy(**TINY)
    inner, outer, _ = normalised(policy, "MEAN_STD")
    for part in (policy, inner, outer):
        part.save_pretrained(tmp_path)
    damage(tmp_path)
    checkpoint = load_checkpoint(tmp_path)
    assert [says in note for note in checkpoint.report["notes"]] == [True] * bool(says)
    assert checkpoint.config.cameras == ("cam_front" if says else "top",)
    if says:
        check_is(checkpoint, policy, inner, outer)


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
    arm = Layout(("cam_front",), tuple("abc"), ("steering", "throttle"), 30.0, (0, 1, 2))
    assert load_checkpoint(tmp_path / "policy").recorded_as(arm).config.state_names == ("a", "b", "c")
    trainers = trainer_content(lerobot_policy(**TINY))
    trainers["model_state_dict"] = policy.state_dict()
    torch.save(trainers, tmp_path / "best_model.pth")
    with pytest.raises(CheckpointError, match="no weight 'encoder_robot_state_input_proj"):
        load_checkpoint(tmp_path / "best_model.pth")


def test_what_lerobot_train_leaves_is_found(tmp_path):
    policy = lerobot_policy(**TINY)
    inner, outer, _ = normalised(policy, "MEAN_STD")
    folder = tmp_path / "out/checkpoints/000020/pretrained_model"
    for part in (policy, inner, outer):
        part.save_pretrained(folder)
    # as copied by a program that leaves links out
    assert load_checkpoint(tmp_path / "out").report["notes"] == [
        "'last' leads nowhere: taken is 000020, the only one there"
    ]
    other = shutil.copytree(folder.parent, folder.parents[1] / "000010")
    with pytest.raises(CheckpointError, match="does not say which of its checkpoints is the last, found 000010, 00002"):
        load_checkpoint(tmp_path / "out")
    assert kinds_of(tmp_path / "out/checkpoints") == ("pretrained",)
    shutil.rmtree(other)
    (tmp_path / "out/checkpoints/last").symlink_to("000020")
    assert lerobot_folder(tmp_path) is None
    for place in ("out", "out/checkpoints", "out/checkpoints/last", "out/checkpoints/last/pretrained_model"):
        assert lerobot_folder(tmp_path / place)[0].resolve() == folder
    (tmp_path / "out/checkpoints/last").unlink()
    (tmp_path / "out/checkpoints/last").write_text("000020")  # what Git makes of a link on Windows
    for place in ("out", "out/checkpoints", "out/checkpoints/last"):
        assert lerobot_folder(tmp_path / place)[0] == folder
    checkpoint = load_checkpoint(tmp_path / "out/checkpoints/last")
    check_is(checkpoint, policy, inner, outer)
    words = checkpoint.report["normalisation"]
    assert words["state"] == "(state - (0.3, 0.25)) / (1.2, 0.3)"
    assert words["action"] == "output * (1.2, 0.3) + (0.3, 0.25)"
    result = CliRunner().invoke(main, ["inspect", str(tmp_path / "out")])
    assert result.exit_code == 0 and "output * (1.2, 0.3) + (0.3, 0.25)" in result.output


def test_a_trainers_normalisation_is_said(tiny):
    assert tiny.report["normalisation"] == {
        "cam_front": "(pixel / 255 - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)",
        "state": "state, as it is",
        "action": "output, as it is",
    }


def test_weights_in_pieces_and_adapters_are_refused_by_their_names(copied):
    (copied / "model.safetensors").unlink()
    (copied / "model.safetensors.index.json").write_text("{}")
    assert "weights in several files" in str(refused_quickly(copied))
    (copied / "model").mkdir()
    (copied / "model/__0_0.distcp").write_bytes(b"x")
    assert "a sharded checkpoint (DCP)" in str(refused_quickly(copied))
    (copied / "adapter_config.json").write_text("{}")
    assert "a PEFT adapter" in str(refused_quickly(copied))
    (copied / "config.json").unlink()
    assert "a PEFT adapter" in str(refused_quickly(copied))
