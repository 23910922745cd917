"""The trainer's best_model.pth, read without running its code.

Pickles are read with weights_only=True, and what that refuses is refused by name.
"""

import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.kinds import read_head, refuse_pointer
from rover_lib.onboard.stage import plain, read_plain
from rover_lib.workshop.act_config import ActConfig, imagenet
from rover_lib.workshop.checkpoint import files
from rover_lib.workshop.checkpoint.facts import Facts
from rover_lib.workshop.checkpoint.weights import (
    IS_IT_WHOLE,
    Weights,
    check_weights_are_whole,
    name_weights,
    tensor_bytes,
)
from rover_lib.workshop.recordings.strangers import name_stranger
from rover_lib.workshop.untrusted import quote, quote_all

TRAINER_CAMERA, OF_TRAINER = "cam_front", "the trainer's format"
KNOWN = {"epoch", "model_state_dict", "optimizer_state_dict", "scheduler_state_dict", "best_val_loss", "config"}
OF_POLICY = {"image_height", "image_width", "rate_hz"}  # of them, what no other file may contradict


def read_trainer(path: Path, facts: Facts) -> files.Contents:
    """facts: what its keys and the files beside it say is added.

    Raises CheckpointError for a file that is damaged, would run code, or lacks something.
    """
    content = _read_pickle(path)
    for key in ("config", "model_state_dict"):
        if not isinstance(content, dict) or not isinstance(content.get(key), dict):
            actual = quote_all(content) if isinstance(content, dict) else type(content).__name__
            remedy = "is it the trainer's, or only weights? those of the first ACT, ALOHA's, are of another network"
            raise CheckpointError(f"{path}: no '{key}' in it", found=actual, remedy=remedy)
    raw = {k: v.item() if isinstance(v, np.generic) else v for k, v in content["config"].items()}
    weights = check_weights_are_whole(facts, name_weights(path, content["model_state_dict"], facts.ignored))
    loss = content.get("best_val_loss")  # NaN if the training had diverged
    with files.as_checkpoint_error(path, "save best_val_loss as a number, or leave it out"):
        loss = None if loss is None else float(loss)
    facts.default("size", (raw.get("image_height"), raw.get("image_width")), "config.image_height")
    facts.default("chunk", raw.get("chunk_size"), "config.chunk_size")
    with files.as_checkpoint_error(path):
        facts.read({k: v for k, v in content.items() if k not in KNOWN}, "")
        facts.read({k: v for k, v in raw.items() if k not in KNOWN_CONFIG - OF_POLICY}, "config.")
        for file in files.check_beside(path.parent, facts):
            settings = yaml.safe_load(read_plain(file, files.JSON_BYTES)) if files.BESIDE.fullmatch(file.name) else None
            if isinstance(settings, dict) and "input_features" not in settings:  # that is LeRobot's, of another format
                facts.read({k: v for k, v in settings.items() if k not in KNOWN_CONFIG - OF_POLICY}, f"{file.name}:")
    extra = {
        "written_here": "origin" in raw or OURS.items() <= raw.items(),
        "epoch": plain(content.get("epoch")),
        "best_val_loss": loss,
        "optimizer_mb": tensor_bytes(content.get("optimizer_state_dict")) / 1e6,
        "trainer_config": plain(raw),
    }
    return _config(path, raw, weights, facts), weights, extra


def _config(path: Path, raw: dict[str, Any], weights: Weights, facts: Facts) -> ActConfig:
    """Make the config from the trainer's, from what only the shapes of the weights say, and from the facts."""

    def whole(key: str, default: int | None = None) -> int:
        if not is_whole(value := raw.get(key, default), 1, 1_000_000):
            problem = f"{path}: config '{key}' must be a whole number from 1 to a million"
            raise CheckpointError(problem, found=quote(value), remedy=files.CORRECT_IT)
        return value

    def last(name: str) -> int:
        shape = tuple(weights[name].shape) if name in weights else ()
        if not shape or not 1 <= shape[-1] <= files.MOST:
            raise CheckpointError(f"{path}: no weight '{name}' of a known shape", found=shape, remedy=IS_IT_WHOLE)
        return shape[-1]

    if raw.get("n_obs_steps", 1) != 1:
        problem = f"{path}: n_obs_steps is {quote(raw['n_obs_steps'])}"
        raise CheckpointError(problem, remedy="ACT acts on one observation, train with 1")
    size = whole("image_height"), whole("image_width")
    if not is_number(rate_hz := raw.get("rate_hz", files.RATE_HZ)):
        problem = f"{path}: config 'rate_hz' must be a number"
        raise CheckpointError(problem, found=quote(rate_hz), remedy=files.CORRECT_IT)
    actions = facts.default("actions", files.name_numbers(last("action_head.bias"), "action"), OF_TRAINER)
    if (states := facts.value("state")) not in (None, actions):
        raise facts.refusal(facts.source("state"), states, f"and its actions are {quote_all(actions)}")
    return ActConfig(
        cameras=(TRAINER_CAMERA,),
        image_sizes=(facts.default("size", size, "config.image_height"),),
        backbone=facts.default("backbone", raw.get("vision_encoder", ""), "config.vision_encoder"),
        rate_hz=facts.default("rate", files.RATE_HZ, OF_TRAINER),
        image_norm=(imagenet(),),  # the trainer scales to [0, 1] and normalises with ImageNet's statistics
        state_names=files.name_numbers(last("encoder_robot_state_input_proj.weight"), "state"),
        action_names=actions,
        latent=last("encoder_latent_input_proj.weight"),
        vae_layers=len({m[1] for k in weights if (m := re.match(r"vae_encoder\.layers\.(\d+)\.", k))}),
        chunk=whole("chunk_size"),
        dim=whole("hidden_size"),
        heads=whole("n_heads"),
        feedforward=whole("feedforward_dim"),
        encoder_layers=whole("n_encoder_layers"),
        decoder_layers=whole("n_decoder_layers"),
    )


# best_val_loss is np.mean's float64; older numpys pickled it as numpy.core, newer ones as numpy._core.
SCALAR = np.float64(0).__reduce__()[0]
NUMPY: list[Any] = [(SCALAR, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
NUMPY += [np.dtype, *(type(np.dtype(t)) for t in (np.float64, np.float32, np.int64, np.int32))]
SAVE_AGAIN = """python -c "import torch; f = {path!r}; torch.save(torch.load(f, weights_only=False), f)\""""
UNPACK = "unpack it, or give the file that the training saved"
UNKNOWN = "an unknown kind of file"
IN_DOCS = f"docs/data.md names those read here; or is it damaged? {files.COPY_AGAIN}"
OTHERS = (  # how other files begin, what they are, and what to do
    (rb"$", "an empty file", files.COPY_AGAIN),
    (rb"\s*<", "a web page", "download the file itself"),
    (rb"\s*\{|.{6}\0\0\{", "JSON or safetensors", "give the whole folder, with config.json and model.safetensors"),
    (rb"\x1f\x8b|BZh|7z|Rar|.{257}ustar", "an archive", UNPACK),
    (rb"[^P\x80]", UNKNOWN, IN_DOCS),
)


def _read_pickle(path: Path) -> Any:
    refuse_pointer(path, CheckpointError)
    head = read_head(path)
    for begins, kind, remedy in OTHERS:
        if re.match(begins, head, re.S):
            if kind == UNKNOWN:
                kind, remedy = name_stranger(path) or (kind, remedy)
            raise CheckpointError(f"{path}: {kind}, not a checkpoint of a training", remedy=remedy)
    try:
        with zipfile.ZipFile(path) as z:
            if not any(name.endswith("data.pkl") for name in z.namelist()) or any("/code/" in n for n in z.namelist()):
                problem = f"{path}: an archive or a TorchScript program, not a checkpoint of a training"
                raise CheckpointError(problem, found=quote_all(z.namelist()[:3]), remedy=UNPACK)
            # torch.load accepts overwritten weight bytes; the zip's CRC does not. torch compresses nothing.
            stored = all(e.compress_type == zipfile.ZIP_STORED for e in z.infolist())
            damaged = z.testzip() if stored else "compressed entries"
        if damaged:
            raise CheckpointError(f"{path}: damaged, the checksum of {damaged} does not match", remedy=files.COPY_AGAIN)
        with torch.serialization.safe_globals(NUMPY):
            # mmap: the optimizer's two thirds of the file are counted, never read
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except CheckpointError:
        raise
    except Exception as e:  # zipfile and torch say in many types that a file is damaged
        if match := re.search(r"GLOBAL ([\w.]+)", str(e)):
            problem = f"{path}: refused, reading it would run code (it asks for '{match[1]}')"
            raise CheckpointError(problem, remedy="save only tensors, numbers and strings in a checkpoint") from None
        # torch puts advice before it, to read it unsafely
        reason = (str(e).rpartition("WeightsUnpickler error: ")[2].splitlines() or [type(e).__name__])[0]
        problem = f"{path}: not a checkpoint as torch.save writes it since 1.6, or damaged ({reason[:160]})"
        older = f"; of an older torch: {SAVE_AGAIN.format(path=str(path))}" if head.startswith(b"\x80") else ""
        raise CheckpointError(problem, remedy=files.COPY_AGAIN + older) from None


DROPOUT = 0.1  # LeRobot's default, as the user's trainer has it; its checkpoints name what follows, too
KL_WEIGHT = 10.0
WEIGHT_DECAY = 1e-4
BETAS = (0.9, 0.999)
GRAD_CLIP = 1.0
# In a config that we wrote, as no trainer of theirs has them together.
OURS = {"num_epochs": 1, "train_split": 0.75, "log_freq": 1, "save_freq": 1, "num_workers": 0}


def trainer_config(size: ActConfig, **known: Any) -> dict[str, Any]:
    """Return the config of the user's trainer as a plain dict, key for key.

    known: learning_rate, batch_size, data_dir and output_dir (by name only: a checkpoint is shown to others), device,
    seed, and rate_hz, written if it is not the trainer's 30.
    """
    ((height, width),) = size.image_sizes
    rate_hz = known.pop("rate_hz", files.RATE_HZ)
    shape = {
        "image_width": width, "image_height": height, "n_obs_steps": 1, "chunk_size": size.chunk,
        "n_action_steps": size.chunk, "hidden_size": size.dim, "n_encoder_layers": size.encoder_layers,
        "n_decoder_layers": size.decoder_layers, "n_heads": size.heads, "feedforward_dim": size.feedforward,
        "dropout": DROPOUT, "kl_weight": KL_WEIGHT, "vision_encoder": size.backbone,
        "pretrained_backbone": True,  # as the trainer writes it, whatever the weights came from
    }  # fmt: skip
    training = {"weight_decay": WEIGHT_DECAY, "betas": BETAS, "grad_clip": GRAD_CLIP} | OURS
    return shape | training | known | ({} if rate_hz == files.RATE_HZ else {"rate_hz": rate_hz})


KNOWN_CONFIG = {*trainer_config(ActConfig()), "learning_rate", "batch_size", "data_dir", "output_dir", "device", "seed"}
KNOWN_CONFIG |= {"rate_hz", "use_vae", "origin"}
