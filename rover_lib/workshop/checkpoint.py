"""Checkpoints in: the trainer's best_model.pth or what `lerobot-train` leaves, checked before they are used.

Nothing in a file is ever executed: pickles are read with weights_only=True, and what that refuses is refused by name.
Nothing is built from a number that a file only claims: every size is bounded first, by what the file's own bytes can
hold or by what no policy reaches.
"""

import hashlib
import json
import re
import stat
import warnings
import zipfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor

from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.stage import sha256_of
from rover_lib.workshop import hub
from rover_lib.workshop.act import ACTIVATIONS, BACKBONES, ActConfig, Affine, imagenet
from rover_lib.workshop.samples import Layout, camera_name
from rover_lib.workshop.untrusted import LARGEST, listed, shown

TRAINER_KEYS = {  # of the trainer's config: what the shape of the policy needs
    "image_width", "image_height", "chunk_size", "hidden_size", "n_encoder_layers", "n_decoder_layers", "n_heads",
    "feedforward_dim", "vision_encoder",
}  # fmt: skip
TRAINER_CAMERA = "cam_front"
TWO_ACTIONS = ("steering", "throttle")
RATE_HZ = 30.0  # of a plan's steps, where nothing says it: the trainer's recordings
FLOATS = (torch.float32, torch.float16, torch.bfloat16, torch.float64)  # what weights and statistics can be
BEFORE_ZIP = bytes.fromhex("80028a0a6cfc9c46f9206aa85019")  # first bytes of what torch.save wrote before 1.6

# Bounds, each far above what a policy of full size has, and low enough to be read in a second.
PICKLE_BYTES = 2_000_000  # of a trainer's file without its tensors: 0.2 MB, and perhaps a history of losses
JSON_BYTES = 1_000_000  # LeRobot's config.json: 3 kB
HEADER_BYTES = 1_000_000  # of model.safetensors: 100 bytes for each of some 300 tensors
STATISTICS_BYTES = 16_000_000  # LeRobot's: a few kB
LARGEST_SIZE = 1_000_000  # a whole number in a config
LARGEST_SIDE_PX = 8192  # the largest picture of a Pi's cameras has 4608 pixels a side
MOST_ACTIONS = 1000  # and numbers in a state
REPORTED = 1000  # entries of the trainer's config, in the report

# What helps most often.
COPY_AGAIN = "copy it again, the whole folder if it is one"
CORRECT_IT = "correct the config to what the policy was trained with"
IS_IT_WHOLE = "is it an ACTPolicy of LeRobot, and whole?"

# What LeRobot calls its files. By a processor's: where its statistics lay before 0.4, and the step that normalises.
PRETRAINED = "pretrained_model"
ORIGIN = "origin.json"  # which we leave in a folder of that format: its config.json refuses what it does not know
ADAPTER = "adapter_config.json"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"
STEPS = {
    PREPROCESSOR: ("normalize_inputs.buffer_", "normalizer_processor"),
    POSTPROCESSOR: ("unnormalize_outputs.buffer_", "unnormalizer_processor"),
}
BUFFERS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")

FEATURE_PX = 32  # a ResNet sees one feature for 32 pixels a side
SQUEEZED = 0.05  # of the aspect ratio: 432x240 for 640x360 is 0.013


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint whose config and weights agree. `weights` have LeRobot's names without the leading `model.`."""

    path: Path
    format: str  # "trainer" or "lerobot"
    config: ActConfig
    weights: dict[str, Tensor] = field(repr=False)
    sha256: str  # of the trainer's file, or of model.safetensors
    report: dict[str, Any] = field(repr=False)

    @property
    def identity(self) -> str:
        """Hex digits of all that it computes by: the sha256 of a trainer's file, which holds everything.

        Beside the weights of LeRobot's folder lie its config and its statistics, in files of their own: who puts other
        statistics there has another policy of the same sha256.
        """
        if self.format == "trainer":
            return self.sha256
        said = json.dumps([self.sha256, asdict(self.config)], sort_keys=True)
        return hashlib.sha256(said.encode()).hexdigest()

    def at_size(self, height: int, width: int) -> "Checkpoint":
        """The same weights for images of another size, in pixels: none of ACT's weights depends on it.

        Positions are normalised to the feature map, so the policy runs at any size; how well it still drives is to be
        measured. Raises CheckpointError for several cameras, for less than one feature (32 pixels) a side, and for
        another aspect ratio (by more than 5 %), because the picture would be squeezed.
        """
        if len(self.config.cameras) != 1:
            raise CheckpointError(
                f"{self.path}: has {len(self.config.cameras)} cameras", remedy="another size is only known for one"
            )
        if not all(isinstance(n, int) and not isinstance(n, bool) for n in (height, width)):
            raise CheckpointError(
                "an image size must be two whole numbers",
                found=f"{shown(height)} and {shown(width)}",
                remedy="give height and width in pixels",
            )
        if min(height, width) < FEATURE_PX:
            raise CheckpointError(
                f"an image of {width}x{height} is smaller than one feature of the backbone",
                remedy=f"use at least {FEATURE_PX}",
            )
        ((trained_height, trained_width),) = self.config.image_sizes
        if abs(width * trained_height / (height * trained_width) - 1) > SQUEEZED:
            raise CheckpointError(
                f"an image of {width}x{height} has another aspect ratio than {trained_width}x{trained_height}, which "
                "the policy was trained with",
                remedy="choose one that squeezes the picture by less than 5 %",
            )
        return replace(self, config=replace(self.config, image_sizes=((height, width),)))

    def recorded_as(self, layout: Layout) -> "Checkpoint":
        """The same policy, speaking of states and actions as the recordings do.

        LeRobot's checkpoints say neither what their numbers are, nor in what order, nor how many plans' steps make a
        second: the dataset that they were trained on does. So their weights are put into the recordings' order. The
        trainer's files, and what we write, are always of [steering, throttle] and of a known rate, the trainer's 30 a
        second.

        Raises CheckpointError for another count of cameras, states or actions than recorded, and for one of those
        policies if the recordings have another rate or other names.
        """
        c, rate_hz = self.config, layout.rate_hz
        has = len(c.cameras), len(c.state_names), len(c.action_names)
        recorded = len(layout.cameras), len(layout.state_names), len(layout.action_names)
        if has != recorded:
            raise CheckpointError(
                f"{self.path}: a policy of cameras, states and actions {', '.join(map(str, has))}",
                found=f"recordings of {', '.join(map(str, recorded))}",
                remedy="give the dataset that it was trained on",
            )
        if rate_hz is None:  # our own recordings
            return self
        if self.format != "lerobot" or self.report["written_here"]:
            if rate_hz != c.rate_hz:
                raise CheckpointError(
                    f"{self.path}: plans {c.rate_hz:g} steps a second",
                    found=f"recordings of {rate_hz:g} frames a second",
                    remedy="give recordings of that rate",
                )
            pairs = (c.state_names, layout.state_names), (c.action_names, layout.action_names)
            if any(own == TWO_ACTIONS != recorded_names for own, recorded_names in pairs):
                raise CheckpointError(
                    f"{self.path}: a policy of {listed(TWO_ACTIONS)}",
                    found=f"recordings of state {listed(layout.state_names)} and action {listed(layout.action_names)}",
                    remedy="if they are the same, say so in the order of the recordings' numbers: --action-names",
                )
            return self

        def taken(norm: Affine | None, order: tuple[int, ...]) -> Affine | None:
            return norm and Affine(tuple(norm.scale[i] for i in order), tuple(norm.shift[i] for i in order))

        states, actions = list(layout.state_order), list(layout.action_order)
        weights = dict(self.weights)
        for name, order, axis in (
            ("encoder_robot_state_input_proj.weight", states, 1),
            ("vae_encoder_robot_state_input_proj.weight", states, 1),
            ("vae_encoder_action_input_proj.weight", actions, 1),
            ("action_head.weight", actions, 0),
            ("action_head.bias", actions, 0),
        ):
            if name in weights:
                weights[name] = weights[name].index_select(axis, torch.tensor(order))
        config = replace(
            c,
            cameras=c.cameras if set(c.cameras) == set(layout.cameras) else layout.cameras,
            state_names=layout.state_names,
            action_names=layout.action_names,
            rate_hz=rate_hz,
            state_norm=taken(c.state_norm, layout.state_order),
            action_unnorm=taken(c.action_unnorm, layout.action_order),
        )
        return replace(
            self, config=config, weights=weights, report=self.report | {"normalisation": normalisation(config)}
        )


def load_checkpoint(path: Path | str) -> Checkpoint:
    """Read and check a checkpoint: a trainer's .pth file, or a LeRobot folder with config.json and model.safetensors,
    which may also be given by the output folder of `lerobot-train` (its last checkpoint is read), a checkpoint of it,
    or the Hub's id user/name@revision.

    Raises CheckpointError, in one sentence, for a file that is missing, damaged, needs to run code, or whose config and
    weights do not agree, and for policies that this project cannot run.
    """
    path = hub.fetched(path, "model", CheckpointError) if hub.is_hub_id(path) else Path(path)
    if path.is_dir():
        return _load_lerobot(lerobot_folder(path) or path)
    if not path.is_file():
        what = "neither a file nor a folder" if path.exists() else "not found"
        raise CheckpointError(
            f"{path}: {what}",
            remedy="give the trainer's .pth file, LeRobot's pretrained_model folder, or user/name@revision of the Hub",
        )
    return _load_trainer(path)


# --- the trainer's file ---------------------------------------------------------------------------------------------


def _load_trainer(path: Path) -> Checkpoint:
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
                found=listed(content),
                remedy="is this a trainer checkpoint, or only its weights?",
            )
    raw, weights = content["config"], _named_weights(path, content["model_state_dict"], file_bytes)
    if missing := sorted(TRAINER_KEYS - set(raw)):
        raise CheckpointError(
            f"{path}: the config lacks {missing}", remedy="it cannot be read off the weights, add them"
        )
    _one_observation(path, raw)
    height, width = (_positive(path, raw, k, LARGEST_SIDE_PX) for k in ("image_height", "image_width"))
    config = _config_from(
        path,
        weights,
        cameras=(TRAINER_CAMERA,),
        image_sizes=((height, width),),
        chunk=_positive(path, raw, "chunk_size"),
        dim=_positive(path, raw, "hidden_size"),
        heads=_positive(path, raw, "n_heads"),
        feedforward=_positive(path, raw, "feedforward_dim"),
        encoder_layers=_positive(path, raw, "n_encoder_layers"),
        decoder_layers=_positive(path, raw, "n_decoder_layers"),
        backbone=raw["vision_encoder"],
        image_norm=(imagenet(),),  # the trainer scales to [0, 1] and normalises with ImageNet's statistics
    )
    extra = {
        "normalisation_from": {"in": "ImageNet's, as the trainer does", "out": "none, as the trainer does"},
        "epoch": _reported(content.get("epoch")),
        "best_val_loss": _loss(path, content.get("best_val_loss")),
        "optimizer_mb": _tensor_bytes(content.get("optimizer_state_dict")) / 1e6,
        "trainer_config": _reported(raw),
    }
    return _checked(path, "trainer", config, weights, sha256_of(path), file_bytes, extra)


def _loss(path: Path, value: Any) -> float | None:
    """A loss as a number: None if there is none, NaN if the training had diverged."""
    if value is None or (isinstance(value, (int, float, np.number)) and not isinstance(value, bool)):
        with suppress(OverflowError):
            return None if value is None else float(value)
    if _is_plain(value) and value.numel() == 1:
        return float(value)
    raise CheckpointError(
        f"{path}: best_val_loss is not a number", found=shown(value), remedy="save it as one, or leave it out"
    )


def _reported(value: Any, depth: int = 3) -> Any:
    """A value for the report, in JSON's types: what is endless or no number, text or list of them is only named."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (str, bool, float, type(None))) or (isinstance(value, int) and abs(value) < LARGEST):
        return value
    if depth and isinstance(value, (dict, list, tuple)) and len(value) <= REPORTED:
        if isinstance(value, dict):
            return {k if isinstance(k, str) else shown(k): _reported(v, depth - 1) for k, v in value.items()}
        return [_reported(v, depth - 1) for v in value]
    return shown(value)


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
    with suppress(OSError), path.open("rb") as f:
        if f.read(len(BEFORE_ZIP)) == BEFORE_ZIP:
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
        f"{path}: not a torch checkpoint of this decade, or cut short ({_reason(error)})", remedy=COPY_AGAIN
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


def _tensor_bytes(value: Any) -> int:
    """Bytes of all tensors in dicts, lists and tuples, each object counted once: lists can hold themselves."""
    total, seen, waiting = 0, set(), [value]
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, Tensor):
            total += _bytes(value) if _is_plain(value) else 0
        elif isinstance(value, dict):
            waiting.extend(value.values())
        elif isinstance(value, (list, tuple)):
            waiting.extend(value)
    return total


def _is_plain(value: Any) -> bool:
    """Whether it is a tensor of numbers in memory: neither sparse, nor quantized, nor on torch's meta device."""
    return (
        isinstance(value, Tensor)
        and value.layout == torch.strided
        and value.device.type == "cpu"
        and not value.is_quantized
    )


def _bytes(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()


# --- LeRobot's folder -----------------------------------------------------------------------------------------------


def lerobot_folder(path: Path) -> Path | None:
    """The folder with a policy's config that `path` is or holds, as `lerobot-train` arranges them; None without one.

    Raises CheckpointError for an output folder that has steps but none that is said to be the last.
    """
    for inner in ("", PRETRAINED, f"last/{PRETRAINED}", f"checkpoints/last/{PRETRAINED}"):
        if any((path / inner / name).exists() for name in ("config.json", ADAPTER)):
            return path / inner
    for steps in (path / "checkpoints", path):
        if found := sorted(p.parent.name for p in steps.glob(f"*/{PRETRAINED}")):
            raise CheckpointError(
                f"{steps}: which of its checkpoints is the last is not said",
                found=listed(found),
                remedy=f"give one of them, as in {steps / found[-1]}",
            )
    return None


def _act_config(folder: Path) -> dict[str, Any]:
    """config.json of a whole ACT policy. Raises CheckpointError for an adapter and for other policies."""
    raw = {} if (folder / ADAPTER).exists() else _read_json(folder / "config.json")
    if not raw or raw.get("use_peft"):
        raise CheckpointError(
            f"{folder}: a PEFT adapter, which holds changes to another policy's weights and no policy",
            remedy="merge it into its policy (PEFT's merge_and_unload) and save that",
        )
    if raw.get("type") != "act":
        raise CheckpointError(
            f"{folder}/config.json: policy type is {shown(raw.get('type'))}",
            remedy="only 'act' is known here"
            if raw.get("type")
            else "only 'act' is known here; if it is one from before 2025, convert it by LeRobot's "
            "lerobot.processor.migrate_policy_normalization",
        )
    return raw


def _picture_sizes(folder: Path, inputs: Mapping[str, tuple[str, list[int]]]) -> dict[str, tuple[int, int]]:
    """(height, width) by camera. Raises CheckpointError for inputs that no camera car has."""
    sizes: dict[str, tuple[int, int]] = {}
    for name, (kind, shape) in inputs.items():
        if kind == "VISUAL":
            if len(shape) != 3 or shape[0] != 3 or max(shape) > LARGEST_SIDE_PX:
                raise CheckpointError(
                    f"{folder}: camera {shown(name)} has shape {shape[:4]}",
                    remedy=f"only (3, height, width) works here, up to {LARGEST_SIDE_PX} pixels a side",
                )
            sizes[name] = (shape[1], shape[2])
        elif kind == "ENV":
            raise CheckpointError(
                f"{folder}: input {shown(name)} is an environment state, which no camera car has",
                remedy="train a policy without it",
            )
    if not sizes:
        raise CheckpointError(
            f"{folder}: the policy has no camera input (it has {listed(inputs) or 'none'})",
            remedy="nothing to drive by",
        )
    return sizes


def _load_lerobot(folder: Path) -> Checkpoint:
    raw = _act_config(folder)
    file = folder / "model.safetensors"
    _refuse_shards(folder, file)
    state = _read_safetensors(file)
    buffers = {name: state.pop(name) for name in list(state) if name.startswith(BUFFERS)}
    weights = _named_weights(file, state, file.stat().st_size)
    inputs, outputs = (_features(folder, raw, key) for key in ("input_features", "output_features"))
    sizes = _picture_sizes(folder, inputs)
    if "observation.state" not in inputs:
        raise CheckpointError(
            f"{folder}: the policy has no 'observation.state' input", remedy="LeRobot's forward needs one too"
        )
    if "action" not in outputs:
        raise CheckpointError(
            f"{folder}: the policy has no 'action' output",
            found=listed(outputs) or "none",
            remedy="train one that acts",
        )
    _one_observation(folder, raw)
    keys = ("chunk_size", "dim_model", "n_heads", "dim_feedforward", "n_encoder_layers", "n_decoder_layers")
    chunk, dim, heads, feedforward, n_encoder, n_decoder = (_positive(folder, raw, k) for k in keys)
    asked = raw.get("normalization_mapping", dict.fromkeys(("VISUAL", "STATE", "ACTION"), "MEAN_STD"))
    inner = Normaliser(folder, PREPROCESSOR, asked, buffers)
    outer = Normaliser(folder, POSTPROCESSOR, asked, buffers)
    states, actions = inputs["observation.state"][1], outputs["action"][1]
    config = _config_from(
        folder,
        weights,
        cameras=tuple(camera_name(c) for c in sizes),
        image_sizes=tuple(sizes.values()),
        chunk=chunk,
        dim=dim,
        heads=heads,
        feedforward=feedforward,
        encoder_layers=n_encoder,
        decoder_layers=n_decoder,
        backbone=raw.get("vision_backbone"),
        dilation=_flag(folder, raw, "replace_final_stride_with_dilation"),
        pre_norm=_flag(folder, raw, "pre_norm"),
        activation=raw.get("feedforward_activation", "relu"),
        image_norm=tuple(inner.affine(c, "VISUAL", 3) or Affine((1.0,) * 3, (0.0,) * 3) for c in sizes),
        state_norm=inner.affine("observation.state", "STATE", states[0]),
        action_unnorm=outer.affine("action", "ACTION", actions[0], inverse=True),
        rate_hz=_own_rate_hz(folder),
    )
    for name, shape, size in (
        ("observation.state", states, len(config.state_names)),
        ("action", actions, len(config.action_names)),
    ):
        if shape != [size]:
            raise CheckpointError(
                f"{folder}: config and weights do not agree ('{name}' has shape {shape}, the weights are for {size})",
                remedy=COPY_AGAIN,
            )
    extra = {
        "optimizer_mb": 0.0,
        "normalisation_from": {"in": inner.source, "out": outer.source},
        "written_here": (folder / ORIGIN).exists(),
    }
    return _checked(folder, "lerobot", config, weights, sha256_of(file), file.stat().st_size, extra)


def _own_rate_hz(folder: Path) -> float:
    """Steps of a plan in a second: what we noted in a folder that we wrote, else the usual."""
    if not (folder / ORIGIN).exists():
        return RATE_HZ
    rate_hz = _read_json(folder / ORIGIN).get("rate_hz", RATE_HZ)
    if isinstance(rate_hz, bool) or not isinstance(rate_hz, (int, float)) or not 0 < rate_hz <= 1000:
        raise CheckpointError(
            f"{folder / ORIGIN}: 'rate_hz' must be above 0 and at most 1000", found=shown(rate_hz), remedy=COPY_AGAIN
        )
    return float(rate_hz)


def _features(folder: Path, raw: Mapping[str, Any], key: str) -> dict[str, tuple[str, list[int]]]:
    """Type and shape of each of the config's features, by name."""
    features = raw.get(key) or {}
    if not isinstance(features, dict):
        raise CheckpointError(f"{folder}/config.json: '{key}' is no object", found=shown(features), remedy=COPY_AGAIN)
    checked = {}
    for name, feature in features.items():
        kind, shape = (feature.get("type"), feature.get("shape")) if isinstance(feature, dict) else (None, None)
        if not isinstance(kind, str) or not isinstance(shape, list) or not shape or not all(map(_is_size, shape)):
            raise CheckpointError(
                f"{folder}/config.json: feature {shown(name)} has no type and shape",
                found=f"{shown(kind)} and {shown(shape)}",
                remedy=COPY_AGAIN,
            )
        checked[name] = kind, shape
    return checked


def _refuse_shards(folder: Path, file: Path) -> None:
    """Raise CheckpointError for weights in pieces: torch's distributed format (DCP), or an index of safetensors."""
    if file.exists():
        return
    checkpoint = folder.parent if folder.name == PRETRAINED else folder
    pieces = [
        p for place in (folder, checkpoint) for pattern in ("*.distcp", "*/*.distcp") for p in place.glob(pattern)
    ]
    if pieces or file.with_suffix(".safetensors.index.json").exists():
        what = "a sharded checkpoint (DCP)" if pieces else "weights in several files"
        raise CheckpointError(
            f"{folder}: {what}, and no model.safetensors",
            remedy="merge them where it was trained, and save the policy by its save_pretrained",
        )


class Normaliser:
    """What LeRobot does to each feature, in or out, as an Affine.

    A processor file says it; before LeRobot 0.4 the config and buffers beside the weights did. A feature whose mode is
    not IDENTITY and that has no statistics is refused: LeRobot 0.4 then normalised nothing, without a word, and what a
    policy gives in standard deviations would have become a servo's pulse.

    asked: the config's normalization_mapping. buffers: the weights' names that begin with BUFFERS.
    """

    def __init__(self, folder: Path, file: str, asked: Any, buffers: Mapping[str, Tensor]):
        self.where = folder / file
        self.modes, self.eps = asked, 1e-8
        self.stats: dict[str, Tensor] = {}
        self.features: list[str] | None = None  # those that the processor's step names; the others it leaves alone
        prefix, step_name = STEPS[file]
        self.old = not self.where.exists()
        if self.old:
            self.stats = {k.removeprefix(prefix): v for k, v in buffers.items() if k.startswith(prefix)}
            self.where = folder / "config.json"
        else:
            self._read_steps(folder, step_name)
        self.source = f"{file}, LeRobot's processor"
        if self.old:
            self.source = "the weights' file, as LeRobot did before 0.4" if self.stats else "config.json: IDENTITY"
        texts = isinstance(self.modes, dict) and all(isinstance(v, str) for v in self.modes.values())
        if not texts or not isinstance(self.eps, (int, float)) or not 0 <= self.eps <= 1:
            raise CheckpointError(
                f"{self.where}: a norm_map of texts and an eps from 0 to 1 are expected",
                found=f"{shown(self.modes)} and {shown(self.eps)}",
                remedy=COPY_AGAIN,
            )

    def _read_steps(self, folder: Path, step_name: str) -> None:
        known = {"rename_observations_processor", "to_batch_processor", "device_processor", step_name}
        count = 0
        for step in self._steps():
            config = step["config"]
            if renames := config.get("rename_map"):
                raise CheckpointError(
                    f"{self.where}: renames observations ({shown(renames)})", remedy="rename the inputs instead"
                )
            if step["registry_name"] not in known:
                raise CheckpointError(
                    f"{self.where}: has a processor step that is not known here: {shown(step['registry_name'])}",
                    remedy="train without it, or do in the recordings what it does",
                )
            if step["registry_name"] == step_name:
                count += 1
                self.modes, self.eps = config.get("norm_map", {}), config.get("eps", 1e-8)
                features = config.get("features")
                self.features = list(features) if isinstance(features, dict) else []
                if config.get("normalize_observation_keys") is not None:
                    raise CheckpointError(
                        f"{self.where}: normalises some of the observations only (normalize_observation_keys)",
                        remedy="give the others IDENTITY, or train without it",
                    )
                if state := step.get("state_file"):
                    self.stats = self._read_statistics(folder, state)
        if count > 1:
            raise CheckpointError(f"{self.where}: normalises {count} times", remedy="train with one such step")

    def _steps(self) -> list[dict[str, Any]]:
        """The processor's steps, each with a name and a config."""
        steps = _read_json(self.where).get("steps", [])
        named = isinstance(steps, list) and all(
            isinstance(s, dict) and isinstance(s.get("registry_name"), str) and isinstance(s.get("config") or {}, dict)
            for s in steps
        )
        if not named:
            raise CheckpointError(
                f"{self.where}: its steps are no list of objects with a registry_name and a config", remedy=COPY_AGAIN
            )
        return [{**s, "config": s.get("config") or {}} for s in steps]

    def _read_statistics(self, folder: Path, name: Any) -> dict[str, Tensor]:
        if not isinstance(name, str) or Path(name).name != name or not name.isprintable():
            raise CheckpointError(
                f"{self.where}: its state file {shown(name)} is no file of the folder", remedy=COPY_AGAIN
            )
        return _read_safetensors(folder / name, STATISTICS_BYTES)

    def affine(self, key: str, kind: str, size: int, inverse: bool = False) -> Affine | None:
        """LeRobot's _apply_transform as scale and shift; None where it leaves the feature alone."""
        mode = self.modes.get(kind)
        if mode == "IDENTITY":
            return None
        name = key.replace(".", "_") if self.old else key
        stats = {k.removeprefix(f"{name}."): v for k, v in self.stats.items() if k.startswith(f"{name}.")}
        left_out = not inverse and self.features is not None and key not in self.features
        if mode is None or not stats or left_out:
            raise self._would_be_raw(key, kind, mode, stats)
        pairs = {
            "MEAN_STD": ("mean", "std"),
            "MIN_MAX": ("min", "max"),
            "QUANTILES": ("q01", "q99"),
            "QUANTILE10": ("q10", "q90"),
        }
        if mode not in pairs:
            raise CheckpointError(
                f"{self.where}: normalisation mode {shown(mode)} of '{key}' is not known here",
                remedy=f"known are IDENTITY, {', '.join(pairs)}",
            )
        if missing := [p for p in pairs[mode] if p not in stats]:
            raise CheckpointError(
                f"{self.where}: mode '{mode}' of '{key}' needs {missing}",
                found=listed(sorted(stats)),
                remedy="copy the whole folder again, or compute the statistics again",
            )
        if odd := [p for p in pairs[mode] if stats[p].dtype not in FLOATS]:
            raise CheckpointError(
                f"{self.where}: statistics of '{key}' are no floats ({odd})", remedy="compute them again"
            )
        a, b = (stats[p].double().flatten() for p in pairs[mode])
        if len(a) != size or len(b) != size:
            raise CheckpointError(
                f"{self.where}: statistics of '{key}' have {len(a)} values, the feature has {size}", remedy=COPY_AGAIN
            )
        if mode == "MEAN_STD":
            scale, shift = (b, a) if inverse else (1 / (b + self.eps), -a / (b + self.eps))
        else:
            span = torch.where(a == b, torch.full_like(a, self.eps), b - a)
            if self.old:
                span = b - a if inverse else b - a + self.eps
            scale, shift = (span / 2, a + span / 2) if inverse else (2 / span, -2 * a / span - 1)
        if not (torch.isfinite(scale.float()).all() and torch.isfinite(shift.float()).all()):  # as they are used
            raise CheckpointError(f"{self.where}: statistics of '{key}' are not finite", remedy="compute them again")
        if (wrong := b < 0 if mode == "MEAN_STD" else b < a).any():
            what = "a negative std" if mode == "MEAN_STD" else f"a {pairs[mode][0]} above its {pairs[mode][1]}"
            raise CheckpointError(
                f"{self.where}: statistics of '{key}' have {what}, which would turn it around",
                found=f"{a[wrong].tolist()} and {b[wrong].tolist()}",
                remedy="compute them again",
            )
        return Affine(tuple(scale.tolist()), tuple(shift.tolist()))

    def _would_be_raw(self, key: str, kind: str, mode: str | None, stats: Mapping[str, Tensor]) -> CheckpointError:
        """What to say of a feature that LeRobot would leave as it is without having been told to."""
        remedy = (
            "copy the folder again from where it was trained, with all policy_preprocessor* and policy_postprocessor* "
            "files, or say IDENTITY where it was trained on raw values"
        )
        if mode is None:
            return CheckpointError(f"{self.where}: no normalisation mode for '{key}' ({kind})", remedy=remedy)
        needs = f"no statistics of '{key}', whose mode is {shown(mode)}"
        if stats:
            needs = f"'{key}' is not among the features that it normalises, and its mode is {shown(mode)}"
        beside = "no processor file beside it, and " if self.old and not self.stats else ""
        return CheckpointError(f"{self.where}: {beside}{needs}", remedy=remedy)


def _of_folder(path: Path, most_bytes: int | None = None) -> Path:
    """The path of a file of a LeRobot folder, once it is known to be one, and not larger than it can sensibly be."""
    try:
        status = path.stat()
    except OSError as e:
        reason = "not found" if isinstance(e, FileNotFoundError) else f"cannot be read ({e.strerror})"
        raise CheckpointError(
            f"{path}: {reason}", remedy="a LeRobot folder has config.json and model.safetensors"
        ) from None
    if not stat.S_ISREG(status.st_mode):
        raise CheckpointError(f"{path}: not a file", remedy="a LeRobot folder has config.json and model.safetensors")
    if most_bytes is not None and status.st_size > most_bytes:
        raise CheckpointError(
            f"{path}: has {status.st_size / 1e6:.1f} MB, at most {most_bytes / 1e6:g} are read", remedy=COPY_AGAIN
        )
    return path


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(_of_folder(path, JSON_BYTES).read_bytes())
    except (ValueError, OSError, RecursionError) as e:  # RecursionError: brackets nested without end
        raise CheckpointError(f"{path}: not readable as JSON ({e})", remedy=COPY_AGAIN) from None
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: expected a JSON object", found=type(content).__name__, remedy=COPY_AGAIN)
    return content


def _read_safetensors(path: Path, most_bytes: int | None = None) -> dict[str, Tensor]:
    try:
        with _of_folder(path, most_bytes).open("rb") as f:
            header_bytes = int.from_bytes(f.read(8), "little")
        if header_bytes > HEADER_BYTES:
            raise CheckpointError(
                f"{path}: not readable as safetensors (its header claims {header_bytes / 1e6:.1f} MB, "
                f"at most {HEADER_BYTES / 1e6:g} are read)",
                remedy=COPY_AGAIN,
            )
        return load_file(path)
    except CheckpointError:
        raise
    except Exception as e:  # whatever its Rust or torch says of a header that lies
        raise CheckpointError(f"{path}: not readable as safetensors ({shown(str(e))})", remedy=COPY_AGAIN) from None


# --- what both have in common ---------------------------------------------------------------------------------------


def _named_weights(path: Path, state: dict[Any, Any], file_bytes: int) -> dict[str, Tensor]:
    """The weights by LeRobot's names without `model.`: dense floats that together fit into the file."""
    odd = [k for k, v in state.items() if not isinstance(k, str) or not isinstance(v, Tensor)]
    if odd:
        raise CheckpointError(
            f"{path}: weights that are no tensors: {listed(odd)}", remedy="save policy.state_dict() as it is"
        )
    if outside := [k for k in state if not k.startswith("model.")]:
        raise CheckpointError(f"{path}: names outside 'model.': {listed(outside)}", remedy=IS_IT_WHOLE)
    weights = {k.removeprefix("model."): v for k, v in state.items()}
    for name, weight in weights.items():
        if problem := _unusable(weight):
            raise CheckpointError(
                f"{path}: weight {shown(name)} is {problem}", remedy="save the weights as trained, dense and in floats"
            )
    claimed = sum(map(_bytes, weights.values()))
    if claimed > file_bytes:  # weights that share their values, or repeat one
        raise CheckpointError(
            f"{path}: its weights claim {claimed / 1e6:.1f} MB in a file of {file_bytes / 1e6:.1f} MB",
            remedy="save each weight with values of its own (.clone())",
        )
    return weights


def _unusable(weight: Tensor) -> str | None:
    """Why a tensor is no weight."""
    if weight.device.type == "meta":
        return "without values, on torch's meta device"
    if weight.is_quantized:
        return "quantized"
    if not _is_plain(weight):
        return f"not dense ({str(weight.layout).removeprefix('torch.')})"
    if weight.dtype not in FLOATS:
        return f"of {weight.dtype}, not of floats"
    if not weight.numel():
        return "empty"
    return None


def _is_size(value: Any, most: int = LARGEST_SIZE) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= most


def _positive(path: Path, raw: dict[str, Any], key: str, most: int = LARGEST_SIZE) -> int:
    value = raw.get(key)
    if not isinstance(value, int) or not _is_size(value, most):
        raise CheckpointError(
            f"{path}: config '{key}' must be a whole number of at least 1 and at most {most}",
            found=shown(value),
            remedy=CORRECT_IT,
        )
    return value


def _flag(path: Path, raw: dict[str, Any], key: str) -> bool:
    value = raw.get(key)
    if value is None or (isinstance(value, int) and value in (0, 1)):
        return bool(value)
    raise CheckpointError(f"{path}: config '{key}' must be true or false", found=shown(value), remedy=CORRECT_IT)


def _one_observation(path: Path, raw: dict[str, Any]) -> None:
    steps = raw.get("n_obs_steps", 1)
    if not isinstance(steps, (int, float)) or steps != 1:
        raise CheckpointError(
            f"{path}: n_obs_steps is {shown(steps)}", remedy="ACT acts on one observation, train with 1"
        )


def _names(count: int, stem: str) -> tuple[str, ...]:
    return TWO_ACTIONS if count == 2 else tuple(f"{stem}_{i}" for i in range(count))


def _config_from(path: Path, weights: dict[str, Tensor], **known: Any) -> ActConfig:
    """Add to what the config says what only the weights' shapes say, and refuse what cannot be run."""
    for key, choices in (("backbone", BACKBONES), ("activation", ACTIVATIONS)):
        value = known.get(key, "relu")
        if not isinstance(value, str) or value not in choices:
            raise CheckpointError(
                f"{path}: {key} {shown(value)} is not known here", remedy=f"known are {', '.join(sorted(choices))}"
            )
    if known.get("dilation") and BACKBONES[known["backbone"]][0] == "basic":
        raise CheckpointError(
            f"{path}: {known['backbone']} cannot be dilated (torchvision refuses it too)", remedy="use resnet50"
        )
    if known["dim"] % known["heads"]:
        raise CheckpointError(
            f"{path}: {known['heads']} heads do not divide a width of {known['dim']}", remedy=CORRECT_IT
        )
    if known["dim"] % 4:
        raise CheckpointError(
            f"{path}: a width of {known['dim']} has no 2-d positions", remedy="it must be a multiple of 4"
        )

    def shape(name: str) -> tuple[int, ...]:
        if name not in weights:
            raise CheckpointError(f"{path}: no weight '{name}'", remedy=IS_IT_WHOLE)
        return tuple(weights[name].shape)

    def last(name: str) -> int:
        size = shape(name)[-1] if shape(name) else 0
        if not 1 <= size <= MOST_ACTIONS:
            raise CheckpointError(
                f"{path}: weight '{name}' has shape {shape(name)}, with no size from 1 to {MOST_ACTIONS} at its end",
                remedy=IS_IT_WHOLE,
            )
        return size

    for part in ("encoder", "decoder"):
        # each layer has many weights: what builds the expected shapes cannot be made to build for a minute
        if (count := known[f"{part}_layers"]) > len(weights):
            raise CheckpointError(
                f"{path}: config and weights do not agree ({count} {part} layers, {len(weights)} weights in all)",
                remedy=CORRECT_IT,
            )
    vae = {m[1] for k in weights if (m := re.match(r"vae_encoder\.layers\.(\d+)\.", k))}
    return ActConfig(
        state_names=_names(last("encoder_robot_state_input_proj.weight"), "state"),
        action_names=_names(last("action_head.bias"), "action"),
        latent=last("encoder_latent_input_proj.weight"),
        vae_layers=len(vae),
        **known,
    )


def expected_shapes(c: ActConfig) -> dict[str, tuple[int, ...]]:
    """Every weight that LeRobot's ACT of this config has, and its shape."""
    d, states, actions = c.dim, len(c.state_names), len(c.action_names)
    shapes: dict[str, tuple[int, ...]] = {}

    def lin(name: str, out: int, inp: int, *rest: int) -> None:
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (out, inp, *rest), (out,)

    def norm(name: str) -> None:
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (d,), (d,)

    def attention(name: str) -> None:
        shapes[f"{name}.in_proj_weight"], shapes[f"{name}.in_proj_bias"] = (3 * d, d), (3 * d,)
        lin(f"{name}.out_proj", d, d)

    def layers(name: str, count: int, attentions: tuple[str, ...]) -> None:
        for i in range(count):
            at = f"{name}.layers.{i}"
            for a in attentions:
                attention(f"{at}.{a}")
            lin(f"{at}.linear1", c.feedforward, d)
            lin(f"{at}.linear2", d, c.feedforward)
            for n in range(len(attentions) + 1):
                norm(f"{at}.norm{n + 1}")

    shapes |= {f"backbone.{k}": v for k, v in _resnet_shapes(c.backbone).items()}
    lin("encoder_img_feat_input_proj", d, BACKBONES[c.backbone][2], 1, 1)
    lin("encoder_robot_state_input_proj", d, states)
    lin("encoder_latent_input_proj", d, c.latent)
    shapes["encoder_1d_feature_pos_embed.weight"] = (2, d)
    shapes["decoder_pos_embed.weight"] = (c.chunk, d)
    layers("encoder", c.encoder_layers, ("self_attn",))
    layers("decoder", c.decoder_layers, ("self_attn", "multihead_attn"))
    norm("decoder.norm")
    if c.pre_norm:
        norm("encoder.norm")
    lin("action_head", actions, d)
    if c.vae_layers:
        layers("vae_encoder", c.vae_layers, ("self_attn",))
        if c.pre_norm:
            norm("vae_encoder.norm")
        shapes["vae_encoder_cls_embed.weight"] = (1, d)
        shapes["vae_encoder_pos_enc"] = (1, c.chunk + 2, d)
        lin("vae_encoder_robot_state_input_proj", d, states)
        lin("vae_encoder_action_input_proj", d, actions)
        lin("vae_encoder_latent_output_proj", 2 * c.latent, d)
    return shapes


def _resnet_shapes(name: str) -> dict[str, tuple[int, ...]]:
    """torchvision's ResNet without its classifier, with frozen batch norm (importing that takes three seconds)."""
    kind, depths, _ = BACKBONES[name]
    shapes: dict[str, tuple[int, ...]] = {}

    def conv_bn(conv: str, bn: str, out: int, inp: int, size: int) -> None:
        shapes[f"{conv}.weight"] = (out, inp, size, size)
        shapes.update({f"{bn}.{k}": (out,) for k in ("weight", "bias", "running_mean", "running_var")})

    conv_bn("conv1", "bn1", 64, 3, 7)
    inp = 64
    for stage, depth in enumerate(depths, 1):
        width = 64 * 2 ** (stage - 1)
        out = width if kind == "basic" else 4 * width
        sizes = (3, 3) if kind == "basic" else (1, 3, 1)
        for i in range(depth):
            at = f"layer{stage}.{i}"
            channels = [inp, *(width for _ in sizes[1:]), out]
            for n, size in enumerate(sizes, 1):
                conv_bn(f"{at}.conv{n}", f"{at}.bn{n}", channels[n], channels[n - 1], size)
            if i == 0 and (stage > 1 or out != inp):
                conv_bn(f"{at}.downsample.0", f"{at}.downsample.1", out, inp, 1)
            inp = out
    return shapes


def normalisation(c: ActConfig) -> dict[str, str]:
    """What happens to each input before the policy sees it, and to its output before it is an action, in words."""

    def numbers(values: Iterable[float]) -> str:
        return f"({', '.join(f'{v:.4g}' for v in values)})"

    def taken(name: str, norm: Affine | None) -> str:
        if norm is None or (set(norm.scale), set(norm.shift)) == ({1.0}, {0.0}):
            return f"{name}, as it is"
        centre = numbers(-b / a for a, b in zip(norm.scale, norm.shift, strict=True))
        return f"({name} - {centre}) / {numbers(1 / a for a in norm.scale)}"

    words = {name: taken("pixel / 255", norm) for name, norm in zip(c.cameras, c.image_norm, strict=True)}
    words["state"] = taken("state", c.state_norm)
    out = c.action_unnorm
    words["action"] = "output, as it is" if out is None else f"output * {numbers(out.scale)} + {numbers(out.shift)}"
    return words


def _checked(
    path: Path,
    kind: str,
    config: ActConfig,
    weights: dict[str, Tensor],
    sha256: str,
    size: int,
    extra: dict[str, Any],
) -> Checkpoint:
    expected = expected_shapes(config)
    shapes = {k: tuple(v.shape) for k, v in weights.items()}
    problems = []
    if missing := sorted(expected.keys() - shapes.keys()):
        problems.append(f"missing: {listed(missing)}")
    if unknown := sorted(shapes.keys() - expected.keys()):
        problems.append(f"unknown: {listed(unknown)}")
    if wrong := [
        f"{k} is {shapes[k]}, not {expected[k]}" for k in expected if k in shapes and shapes[k] != expected[k]
    ]:
        problems.append(f"of another shape: {listed(wrong)}")
    if problems:
        raise CheckpointError(f"{path}: config and weights do not agree ({'; '.join(problems)})", remedy=CORRECT_IT)
    if bad := [k for k, v in weights.items() if not torch.isfinite(v.float()).all()]:
        raise CheckpointError(
            f"{path}: NaN or Inf in {listed(bad)}", remedy="training diverged, take an earlier checkpoint"
        )
    parts: dict[str, int] = {}
    for k, v in weights.items():
        part = "vae (training only)" if k.startswith("vae_") else k.split(".")[0].removesuffix("_embed")
        parts[part] = parts.get(part, 0) + v.numel()
    total = sum(parts.values())
    acts = total - parts.get("vae (training only)", 0)
    report = {
        "format": kind,
        "file_mb": size / 1e6,
        "weights_mb": _tensor_bytes(weights) / 1e6,
        "parameters": total,
        "parameters_acting": acts,
        "parameters_by_part": parts,
        "int8_floor_mb": acts / 1e6,
        "normalisation": normalisation(config),
        **extra,
    }
    return Checkpoint(path, kind, config, weights, sha256, report)
