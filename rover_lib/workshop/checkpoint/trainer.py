"""The trainer's best_model.pth, read without running what is in it.

Pickles are read with weights_only=True, and what that refuses is refused by name.
"""

import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_lib.onboard.checked import is_whole
from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.stage import plain
from rover_lib.workshop.act import ActConfig
from rover_lib.workshop.act_config import imagenet
from rover_lib.workshop.checkpoint.contents import (
    COPY_AGAIN,
    CORRECT_IT,
    IS_IT_WHOLE,
    MOST,
    Contents,
    as_checkpoint_error,
    name_numbers,
    name_weights,
    tensor_bytes,
)
from rover_lib.workshop.untrusted import quote, quote_all

TRAINER_CAMERA = "cam_front"


def read_trainer(path: Path) -> Contents:
    """Raises CheckpointError for a file that is damaged, would run code, or lacks something."""
    content = _read_pickle(path)
    for key in ("config", "model_state_dict"):
        if not isinstance(content, dict) or not isinstance(content.get(key), dict):
            found = quote_all(content) if isinstance(content, dict) else type(content).__name__
            remedy = "is this a trainer checkpoint, or only its weights?"
            raise CheckpointError(f"{path}: no '{key}' in it", found=found, remedy=remedy)
    raw = {k: v.item() if isinstance(v, np.generic) else v for k, v in content["config"].items()}
    weights = name_weights(path, content["model_state_dict"])
    loss = content.get("best_val_loss")  # NaN if the training had diverged
    with as_checkpoint_error(path, "save best_val_loss as a number, or leave it out"):
        loss = None if loss is None else float(loss)
    extra = {
        "epoch": plain(content.get("epoch")),
        "best_val_loss": loss,
        "optimizer_mb": tensor_bytes(content.get("optimizer_state_dict")) / 1e6,
        "trainer_config": plain(raw),
        "notes": [],
    }
    return _config(path, raw, weights), weights, extra


def _config(path: Path, raw: dict[str, Any], weights: dict[str, Tensor]) -> ActConfig:
    """Make the config from what the trainer's says, and from what only the shapes of the weights say."""

    def whole(key: str, default: int | None = None) -> int:
        if not is_whole(value := raw.get(key, default), 1, 1_000_000):
            what = f"{path}: config '{key}' must be a whole number from 1 to a million"
            raise CheckpointError(what, found=quote(value), remedy=CORRECT_IT)
        return value

    def last(name: str) -> int:
        shape = tuple(weights[name].shape) if name in weights else ()
        if not shape or not 1 <= shape[-1] <= MOST:
            raise CheckpointError(f"{path}: no weight '{name}' of a known shape", found=shape, remedy=IS_IT_WHOLE)
        return shape[-1]

    if raw.get("n_obs_steps", 1) != 1:
        what = f"{path}: n_obs_steps is {quote(raw['n_obs_steps'])}"
        raise CheckpointError(what, remedy="ACT acts on one observation, train with 1")
    return ActConfig(
        cameras=(TRAINER_CAMERA,),
        image_sizes=((whole("image_height"), whole("image_width")),),
        backbone=raw.get("vision_encoder", ""),
        rate_hz=float(whole("rate_hz", default=30)),
        image_norm=(imagenet(),),  # the trainer scales to [0, 1] and normalises with ImageNet's statistics
        state_names=name_numbers(last("encoder_robot_state_input_proj.weight"), "state"),
        action_names=name_numbers(last("action_head.bias"), "action"),
        latent=last("encoder_latent_input_proj.weight"),
        vae_layers=len({m[1] for k in weights if (m := re.match(r"vae_encoder\.layers\.(\d+)\.", k))}),
        chunk=whole("chunk_size"),
        dim=whole("hidden_size"),
        heads=whole("n_heads"),
        feedforward=whole("feedforward_dim"),
        encoder_layers=whole("n_encoder_layers"),
        decoder_layers=whole("n_decoder_layers"),
    )


def _numpy_scalars() -> list[Any]:
    """best_val_loss is np.mean's float64; older numpys pickled it as numpy.core, newer ones as numpy._core."""
    names = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
    dtypes = [type(np.dtype(t)) for t in (np.float64, np.float32, np.int64, np.int32)]
    scalar = np.float64(0).__reduce__()[0]
    return [*((scalar, n) for n in names), np.dtype, *dtypes]


def _read_pickle(path: Path) -> Any:
    try:
        with zipfile.ZipFile(path) as z:
            # torch.load accepts overwritten weight bytes; the zip's CRC does not. torch compresses nothing.
            stored = all(e.compress_type == zipfile.ZIP_STORED for e in z.infolist())
            damaged = z.testzip() if stored else "compressed entries"
        if damaged:
            raise CheckpointError(f"{path}: damaged, the checksum of {damaged} does not match", remedy=COPY_AGAIN)
        with torch.serialization.safe_globals(_numpy_scalars()):
            # mmap: the optimizer's two thirds of the file are counted, never read
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except CheckpointError:
        raise
    except Exception as e:  # zipfile and torch say in many types that a file is damaged
        if wanted := re.search(r"GLOBAL ([\w.]+)", str(e)):
            what = f"{path}: refused, reading it would run code (it asks for '{wanted[1]}')"
            raise CheckpointError(what, remedy="save only tensors, numbers and strings in a checkpoint") from None
        # torch puts advice before it, to read it unsafely
        reason = (str(e).rpartition("WeightsUnpickler error: ")[2].splitlines() or [type(e).__name__])[0]
        what = f"{path}: not a checkpoint as torch.save writes it since 1.6, or damaged ({reason[:160]})"
        raise CheckpointError(what, remedy=COPY_AGAIN) from None
