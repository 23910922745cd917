"""The trainer's best_model.pth, read without running what is in it.

Pickles are read with weights_only=True, and what that refuses is refused by name.
"""

import re
import warnings
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.stage import sha256_of
from rover_lib.workshop.act import imagenet
from rover_lib.workshop.checkpoint.contents import (
    COPY_AGAIN,
    LARGEST_SIDE_PX,
    Contents,
    config_from,
    is_plain,
    named_weights,
    one_observation,
    positive,
    tensor_bytes,
)
from rover_lib.workshop.untrusted import LARGEST, quote, quote_all

TRAINER_KEYS = {  # of the trainer's config: what the shape of the policy needs
    "image_width", "image_height", "chunk_size", "hidden_size", "n_encoder_layers", "n_decoder_layers", "n_heads",
    "feedforward_dim", "vision_encoder",
}  # fmt: skip
TRAINER_CAMERA = "cam_front"
BEFORE_ZIP = bytes.fromhex("80028a0a6cfc9c46f9206aa85019")  # first bytes of what torch.save wrote before 1.6

# Bounds, each far above what a policy of full size has, and low enough to be read in a second.
PICKLE_BYTES = 2_000_000  # of a trainer's file without its tensors: 0.2 MB, and perhaps a history of losses
REPORTED = 1000  # entries of the trainer's config, in the report


def read_trainer(path: Path) -> Contents:
    """Raises CheckpointError for a file that is damaged, would run code, or lacks something."""
    content = _read_pickle(path)
    if not isinstance(content, dict):
        raise CheckpointError(
            f"{path}: expected a dict", found=type(content).__name__, remedy="is it a trainer checkpoint?"
        )
    file_bytes = path.stat().st_size
    for key in ("config", "model_state_dict"):
        if not isinstance(content.get(key), dict):
            raise CheckpointError(
                f"{path}: no '{key}' in it",
                found=quote_all(content),
                remedy="is this a trainer checkpoint, or only its weights?",
            )
    raw = {k: v.item() if isinstance(v, np.generic) else v for k, v in content["config"].items()}
    weights, notes = named_weights(path, content["model_state_dict"], file_bytes)
    if missing := sorted(TRAINER_KEYS - set(raw)):
        raise CheckpointError(
            f"{path}: the config lacks {missing}", remedy="it cannot be read off the weights, add them"
        )
    one_observation(path, raw)
    height, width = (positive(path, raw, k, LARGEST_SIDE_PX) for k in ("image_height", "image_width"))
    config = config_from(
        path,
        weights,
        cameras=(TRAINER_CAMERA,),
        image_sizes=((height, width),),
        chunk=positive(path, raw, "chunk_size"),
        dim=positive(path, raw, "hidden_size"),
        heads=positive(path, raw, "n_heads"),
        feedforward=positive(path, raw, "feedforward_dim"),
        encoder_layers=positive(path, raw, "n_encoder_layers"),
        decoder_layers=positive(path, raw, "n_decoder_layers"),
        backbone=raw["vision_encoder"],
        rate_hz=float(positive(path, raw | {"rate_hz": raw.get("rate_hz", 30)}, "rate_hz")),
        image_norm=(imagenet(),),  # the trainer scales to [0, 1] and normalises with ImageNet's statistics
    )
    extra = {
        "normalisation_from": {"in": "ImageNet's, as the trainer does", "out": "none, as the trainer does"},
        "epoch": _describe_value(content.get("epoch")),
        "best_val_loss": _loss(path, content.get("best_val_loss")),
        "optimizer_mb": tensor_bytes(content.get("optimizer_state_dict")) / 1e6,
        "trainer_config": _describe_value(raw),
        "notes": notes,
    }
    return Contents("trainer", config, weights, sha256_of(path), file_bytes, extra)


def _loss(path: Path, value: Any) -> float | None:
    """A loss as a number: None if there is none, NaN if the training had diverged."""
    if value is None or (isinstance(value, (int, float, np.number)) and not isinstance(value, bool)):
        with suppress(OverflowError):
            return None if value is None else float(value)
    if is_plain(value) and value.numel() == 1:
        return float(value)
    raise CheckpointError(
        f"{path}: best_val_loss is not a number", found=quote(value), remedy="save it as one, or leave it out"
    )


def _describe_value(value: Any, depth: int = 3) -> Any:
    """A value for the report, in JSON's types: what is endless or no number, text or list of them is only named."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (str, bool, float, type(None))) or (isinstance(value, int) and abs(value) < LARGEST):
        return value
    if depth and isinstance(value, (dict, list, tuple)) and len(value) <= REPORTED:
        if isinstance(value, dict):
            return {k if isinstance(k, str) else quote(k): _describe_value(v, depth - 1) for k, v in value.items()}
        return [_describe_value(v, depth - 1) for v in value]
    return quote(value)


def _numpy_scalars() -> list[Any]:
    """best_val_loss is np.mean's float64; older numpys pickled it as numpy.core, newer ones as numpy._core."""
    names = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
    dtypes = [type(np.dtype(t)) for t in (np.float64, np.float32, np.int64, np.int32)]
    scalar = np.float64(0).__reduce__()[0]
    return [*((scalar, n) for n in names), np.dtype, *dtypes]


def _read_pickle(path: Path) -> Any:
    try:
        with zipfile.ZipFile(path) as z:
            _check_archive(path, z)
            damaged = z.testzip()  # torch.load accepts overwritten weight bytes; the zip's CRC does not
    except CheckpointError:
        raise
    except Exception as e:  # zipfile says in many types that a file is damaged
        raise _no_archive(path, e) from None
    if damaged:
        raise CheckpointError(f"{path}: damaged, the checksum of '{damaged}' does not match", remedy=COPY_AGAIN)
    try:
        with torch.serialization.safe_globals(_numpy_scalars()), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch, about sparse tensors and the like: they are refused below
            # mmap: the optimizer's two thirds of the file are counted, never read
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as e:  # torch wraps what it meets in many types; each means the same to the user
        if wanted := re.search(r"GLOBAL ([\w.]+)", str(e)):
            raise _runs_code(path, wanted[1]) from None
        raise CheckpointError(f"{path}: not readable ({_reason(e)})", remedy=COPY_AGAIN) from None


def _no_archive(path: Path, error: Exception) -> CheckpointError:
    """What to say of a file that is no archive, or a damaged one."""
    head = b""
    with suppress(OSError), path.open("rb") as f:
        if (head := f.read(len(BEFORE_ZIP))) == BEFORE_ZIP:
            return CheckpointError(
                f"{path}: in torch's format of before 1.6, which has neither checksums nor bounds",
                remedy="load it with torch.load(path, weights_only=True) and save that again with torch.save",
            )
    try:
        archive = zipfile.is_zipfile(path)
    except zipfile.BadZipFile:  # an archive whose end says what no archive of torch's does
        archive = True
    if archive:
        return CheckpointError(f"{path}: damaged ({_reason(error)})", remedy=COPY_AGAIN)
    return CheckpointError(
        f"{path}: neither a trainer's checkpoint nor anything else that is known here, or cut short",
        found=f"a file that begins with {quote(head)}",
        remedy=COPY_AGAIN,
    )


def _reason(error: Exception) -> str:
    """The first line of an error's text, or its name if it has none."""
    text = str(error).rpartition("WeightsUnpickler error: ")[2]  # torch puts advice before it, to read it unsafely
    return (text.splitlines() or [type(error).__name__])[0][:200]


def _check_archive(path: Path, z: zipfile.ZipFile) -> None:
    """Raise CheckpointError for an archive that claims more than the file holds, before anything in it is read."""
    entries, file_bytes = z.infolist(), path.stat().st_size
    # Compressed or overlapping entries can be a thousand times the file; torch writes neither, and could not map them.
    if any(e.compress_type != zipfile.ZIP_STORED for e in entries) or sum(e.file_size for e in entries) > file_bytes:
        raise CheckpointError(
            f"{path}: its entries are compressed, or claim more than the file holds",
            remedy="use the file as torch.save wrote it",
        )
    for entry in entries:
        if not entry.filename.endswith("data.pkl"):
            continue
        if entry.file_size > PICKLE_BYTES:
            raise CheckpointError(
                f"{path}: has {entry.file_size / 1e6:.1f} MB beside its tensors, more than {PICKLE_BYTES / 1e6:g} MB",
                remedy="save fewer numbers and names in a checkpoint, or save them as tensors",
            )
        if b"bytearray\n" in z.read(entry):  # torch lets it through, and bytearray(10**11) would fill the memory
            raise _runs_code(path, "bytearray")


def _runs_code(path: Path, wanted: str) -> CheckpointError:
    return CheckpointError(
        f"{path}: refused, reading it would run code (it asks for '{wanted}')",
        remedy="save only tensors, numbers and strings in a checkpoint",
    )
