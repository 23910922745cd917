"""Checkpoints in: the trainer's best_model.pth or LeRobot's pretrained_model/ folder, checked before they are used.

Nothing in a file is ever executed: pickles are read with weights_only=True, and what that refuses is refused by name.
"""

import json
import re
import zipfile
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.stage import sha256_of
from rover_lib.workshop.act import ACTIVATIONS, BACKBONES, ActConfig, Affine, imagenet

TRAINER_KEYS = {  # of the trainer's config: what the shape of the policy needs
    "image_width", "image_height", "chunk_size", "hidden_size", "n_encoder_layers", "n_decoder_layers", "n_heads",
    "feedforward_dim", "vision_encoder",
}  # fmt: skip
TRAINER_CAMERA = "cam_front"
TWO_ACTIONS = ("steering", "throttle")
FEATURE_PX = 32  # a ResNet sees one feature per so many pixels a side
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

    def at_size(self, height: int, width: int) -> "Checkpoint":
        """The same weights for images of another size, in pixels: none of ACT's weights depends on it.

        Positions are normalised to the feature map, so the policy runs at any size; how well it still drives is to be
        measured. Raises CheckpointError for several cameras, for less than one feature (32 pixels) a side, and for
        another aspect ratio (by more than 5 %), because the picture would be squeezed.
        """
        if len(self.config.cameras) != 1:
            raise CheckpointError(
                f"{self.path}: has {len(self.config.cameras)} cameras; another size is only known for one"
            )
        if not all(isinstance(n, int) and not isinstance(n, bool) for n in (height, width)):
            raise CheckpointError(f"an image size must be two whole numbers, found {height!r} and {width!r}")
        if min(height, width) < FEATURE_PX:
            raise CheckpointError(
                f"an image of {width}x{height} is smaller than one feature of the backbone; use at least {FEATURE_PX}"
            )
        ((trained_height, trained_width),) = self.config.image_sizes
        if abs(width * trained_height / (height * trained_width) - 1) > SQUEEZED:
            raise CheckpointError(
                f"an image of {width}x{height} has another aspect ratio than {trained_width}x{trained_height}, which "
                "the policy was trained with; choose one that squeezes the picture by less than 5 %"
            )
        return replace(self, config=replace(self.config, image_sizes=((height, width),)))


def load_checkpoint(path: Path | str) -> Checkpoint:
    """Read and check a checkpoint: a trainer's .pth file, or a LeRobot folder with config.json and model.safetensors.

    Raises CheckpointError, in one sentence, for a file that is missing, damaged, needs to run code, or whose config and
    weights do not agree, and for policies that this project cannot run.
    """
    path = Path(path)
    if not path.exists():
        raise CheckpointError(f"{path}: not found; give the trainer's .pth file or LeRobot's pretrained_model folder")
    return _load_lerobot(path) if path.is_dir() else _load_trainer(path)


# --- the trainer's file ---------------------------------------------------------------------------------------------


def _load_trainer(path: Path) -> Checkpoint:
    content = _read_pickle(path)
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: expected a dict, found {type(content).__name__}; is it a trainer checkpoint?")
    for key in ("config", "model_state_dict"):
        if not isinstance(content.get(key), dict):
            raise CheckpointError(
                f"{path}: no '{key}' in it (found {sorted(map(str, content))[:8]}); "
                "is this a trainer checkpoint, or only its weights?"
            )
    raw, weights = content["config"], _named_weights(path, content["model_state_dict"])
    if missing := sorted(TRAINER_KEYS - set(raw)):
        raise CheckpointError(f"{path}: the config lacks {missing}; it cannot be read off the weights, add them")
    if raw.get("n_obs_steps", 1) != 1:
        raise CheckpointError(
            f"{path}: n_obs_steps is {raw['n_obs_steps']!r}; ACT acts on one observation, train with 1"
        )
    height, width = (_positive(path, raw, k) for k in ("image_height", "image_width"))
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
    optimizer = content.get("optimizer_state_dict")
    extra = {
        "epoch": content.get("epoch"),
        "best_val_loss": None if content.get("best_val_loss") is None else float(content["best_val_loss"]),
        "optimizer_mb": _tensor_bytes(optimizer) / 1e6,
        "trainer_config": raw,
    }
    return _checked(path, "trainer", config, weights, sha256_of(path), path.stat().st_size, extra)


def _numpy_scalars() -> list[Any]:
    """best_val_loss is np.mean's float64; older numpys pickled it as numpy.core, newer ones as numpy._core."""
    names = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
    dtypes = [type(np.dtype(t)) for t in (np.float64, np.float32, np.int64, np.int32)]
    return [*((np._core.multiarray.scalar, n) for n in names), np.dtype, *dtypes]


def _read_pickle(path: Path) -> Any:
    try:
        with zipfile.ZipFile(path) as z:
            damaged = z.testzip()  # torch.load accepts overwritten weight bytes; the zip's CRC does not
    except (zipfile.BadZipFile, OSError, RuntimeError) as e:
        if not zipfile.is_zipfile(path):
            raise CheckpointError(
                f"{path}: not a torch checkpoint of this decade, or cut short ({e}); copy the file again"
            ) from None
        raise CheckpointError(f"{path}: damaged ({e}); copy the file again") from None
    if damaged:
        raise CheckpointError(f"{path}: damaged, the checksum of '{damaged}' does not match; copy the file again")
    try:
        with torch.serialization.safe_globals(_numpy_scalars()):
            # mmap: the optimizer's two thirds of the file are counted, never read
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as e:  # torch wraps what it meets in many types; each means the same to the user
        wanted = re.search(r"GLOBAL ([\w.]+)", str(e))
        if wanted:
            raise CheckpointError(
                f"{path}: refused, reading it would run code (it asks for '{wanted[1]}'); "
                "save only tensors, numbers and strings in a checkpoint"
            ) from None
        raise CheckpointError(f"{path}: not readable ({str(e).splitlines()[0][:200]}); copy the file again") from None


def _tensor_bytes(value: Any) -> int:
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, dict):
        return sum(_tensor_bytes(v) for v in value.values())
    if isinstance(value, (list, tuple)):
        return sum(_tensor_bytes(v) for v in value)
    return 0


# --- LeRobot's folder -----------------------------------------------------------------------------------------------


def _load_lerobot(folder: Path) -> Checkpoint:
    raw = _read_json(folder / "config.json")
    if raw.get("type") != "act":
        raise CheckpointError(f"{folder}/config.json: policy type is {raw.get('type')!r}; only 'act' is known here")
    file = folder / "model.safetensors"
    weights = _named_weights(file, _read_safetensors(file))
    inputs, outputs = raw.get("input_features") or {}, raw.get("output_features") or {}
    cameras, sizes = [], []
    for name, feature in inputs.items():
        kind, shape = _feature(folder, name, feature)
        if kind == "VISUAL":
            if len(shape) != 3 or shape[0] != 3:
                raise CheckpointError(
                    f"{folder}: camera '{name}' has shape {shape}; only (3, height, width) works here"
                )
            cameras.append(name)
            sizes.append((shape[1], shape[2]))
        elif kind == "ENV":
            raise CheckpointError(f"{folder}: input '{name}' is an environment state, which no camera car has")
    if not cameras:
        raise CheckpointError(f"{folder}: the policy has no camera input (found {sorted(inputs)}); nothing to drive by")
    if "observation.state" not in inputs:
        raise CheckpointError(f"{folder}: the policy has no 'observation.state' input; LeRobot's forward needs one too")
    if "action" not in outputs:
        raise CheckpointError(f"{folder}: the policy has no 'action' output (found {sorted(outputs)})")
    if raw.get("n_obs_steps", 1) != 1:
        raise CheckpointError(f"{folder}: n_obs_steps is {raw['n_obs_steps']!r}; ACT acts on one observation")
    keys = ("chunk_size", "dim_model", "n_heads", "dim_feedforward", "n_encoder_layers", "n_decoder_layers")
    chunk, dim, heads, feedforward, n_encoder, n_decoder = (_positive(folder, raw, k) for k in keys)
    inner = Normaliser(folder, "policy_preprocessor.json", "normalizer_processor")
    outer = Normaliser(folder, "policy_postprocessor.json", "unnormalizer_processor")
    config = _config_from(
        folder,
        weights,
        cameras=tuple(c.removeprefix("observation.images.").removeprefix("observation.") for c in cameras),
        image_sizes=tuple(sizes),
        chunk=chunk,
        dim=dim,
        heads=heads,
        feedforward=feedforward,
        encoder_layers=n_encoder,
        decoder_layers=n_decoder,
        backbone=raw.get("vision_backbone"),
        dilation=bool(raw.get("replace_final_stride_with_dilation", False)),
        pre_norm=bool(raw.get("pre_norm", False)),
        activation=raw.get("feedforward_activation", "relu"),
        image_norm=tuple(inner.affine(c, "VISUAL", 3) or Affine((1.0,) * 3, (0.0,) * 3) for c in cameras),
        state_norm=inner.affine("observation.state", "STATE", _feature(folder, "", inputs["observation.state"])[1][0]),
        action_unnorm=outer.affine("action", "ACTION", _feature(folder, "", outputs["action"])[1][0], inverse=True),
    )
    extra = {"optimizer_mb": 0.0, "normalisation": {"in": inner.modes, "out": outer.modes}}
    return _checked(folder, "lerobot", config, weights, sha256_of(file), file.stat().st_size, extra)


def _feature(folder: Path, name: str, feature: Any) -> tuple[str, list[int]]:
    with suppress(KeyError, TypeError, ValueError):
        return str(feature["type"]), [int(n) for n in feature["shape"]]
    raise CheckpointError(f"{folder}/config.json: feature '{name}' has no type and shape (found {feature!r})")


class Normaliser:
    """One of LeRobot's processor files: what it does to each feature, as an Affine.

    Older checkpoints have no processor files; then nothing is normalised, as LeRobot would.
    """

    def __init__(self, folder: Path, file: str, step_name: str):
        self.where = folder / file
        self.modes: dict[str, str] = {}
        self.stats: dict[str, Tensor] = {}
        self.eps = 1e-8
        if not self.where.exists():
            return
        steps = _read_json(self.where).get("steps", [])
        renames = [s for s in steps if (s.get("config") or {}).get("rename_map")]
        if renames:
            raise CheckpointError(
                f"{self.where}: renames observations ({renames[0]['config']}); rename the inputs instead"
            )
        known = {"rename_observations_processor", "to_batch_processor", "device_processor", step_name}
        if unknown := [str(s.get("registry_name")) for s in steps if s.get("registry_name") not in known]:
            raise CheckpointError(f"{self.where}: has processor steps that are not known here: {unknown}")
        for step in steps:
            if step.get("registry_name") == step_name:
                self.modes = dict(step["config"].get("norm_map", {}))
                self.eps = float(step["config"].get("eps", 1e-8))
                if state := step.get("state_file"):
                    if Path(state).name != state:
                        raise CheckpointError(f"{self.where}: its state file '{state}' lies outside the folder")
                    self.stats = _read_safetensors(folder / state)

    def affine(self, key: str, kind: str, size: int, inverse: bool = False) -> Affine | None:
        """LeRobot's _apply_transform as scale and shift; None where it leaves the feature alone."""
        mode = self.modes.get(kind, "IDENTITY")
        stats = {
            k.removeprefix(f"{key}."): v.double().flatten() for k, v in self.stats.items() if k.startswith(f"{key}.")
        }
        if mode == "IDENTITY" or not stats:
            return None
        pairs = {
            "MEAN_STD": ("mean", "std"),
            "MIN_MAX": ("min", "max"),
            "QUANTILES": ("q01", "q99"),
            "QUANTILE10": ("q10", "q90"),
        }
        if mode not in pairs:
            raise CheckpointError(f"{self.where}: normalisation mode '{mode}' of '{key}' is not known here")
        if missing := [p for p in pairs[mode] if p not in stats]:
            raise CheckpointError(
                f"{self.where}: mode '{mode}' of '{key}' needs {missing}, the file has {sorted(stats)}"
            )
        a, b = (stats[p] for p in pairs[mode])
        if len(a) != size or len(b) != size:
            raise CheckpointError(f"{self.where}: statistics of '{key}' have {len(a)} values, the feature has {size}")
        if mode == "MEAN_STD":
            scale, shift = (b, a) if inverse else (1 / (b + self.eps), -a / (b + self.eps))
        else:
            span = torch.where(a == b, torch.full_like(a, self.eps), b - a)
            scale, shift = (span / 2, a + span / 2) if inverse else (2 / span, -2 * a / span - 1)
        if not (torch.isfinite(scale).all() and torch.isfinite(shift).all()):
            raise CheckpointError(f"{self.where}: statistics of '{key}' are not finite; compute them again")
        return Affine(tuple(scale.tolist()), tuple(shift.tolist()))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise CheckpointError(f"{path}: not found; a LeRobot folder has config.json and model.safetensors") from None
    except (ValueError, OSError) as e:
        raise CheckpointError(f"{path}: not readable as JSON ({e}); copy the folder again") from None
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: expected a JSON object, found {type(content).__name__}")
    return content


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    try:
        return load_file(path)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: not found; a LeRobot folder has config.json and model.safetensors") from None
    except (SafetensorError, OSError) as e:
        raise CheckpointError(f"{path}: not readable as safetensors ({e}); copy the file again") from None


# --- what both have in common ---------------------------------------------------------------------------------------


def _named_weights(path: Path, state: dict[Any, Any]) -> dict[str, Tensor]:
    odd = [k for k, v in state.items() if not isinstance(k, str) or not isinstance(v, Tensor)]
    if odd:
        raise CheckpointError(f"{path}: weights that are no tensors: {odd[:5]}")
    if outside := [k for k in state if not k.startswith("model.")]:
        raise CheckpointError(f"{path}: names outside 'model.': {outside[:5]}; is it an ACTPolicy of LeRobot?")
    return {k.removeprefix("model."): v for k, v in state.items()}


def _positive(path: Path, raw: dict[str, Any], key: str) -> int:
    value = raw.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise CheckpointError(f"{path}: config '{key}' must be a whole number of at least 1, found {value!r}")
    return value


def _names(count: int, stem: str) -> tuple[str, ...]:
    return TWO_ACTIONS if count == 2 else tuple(f"{stem}_{i}" for i in range(count))


def _config_from(path: Path, weights: dict[str, Tensor], **known: Any) -> ActConfig:
    """Add to what the config says what only the weights' shapes say, and refuse what cannot be run."""
    if known["backbone"] not in BACKBONES:
        raise CheckpointError(
            f"{path}: backbone {known['backbone']!r} is not known here; known are {sorted(BACKBONES)}"
        )
    if known.get("activation", "relu") not in ACTIVATIONS:
        raise CheckpointError(
            f"{path}: activation {known['activation']!r} is not known here; known are {sorted(ACTIVATIONS)}"
        )
    if known.get("dilation") and BACKBONES[known["backbone"]][0] == "basic":
        raise CheckpointError(
            f"{path}: {known['backbone']} cannot be dilated (torchvision refuses it too); use resnet50"
        )
    if known["dim"] % known["heads"]:
        raise CheckpointError(f"{path}: {known['heads']} heads do not divide a width of {known['dim']}")
    if known["dim"] % 4:
        raise CheckpointError(f"{path}: a width of {known['dim']} has no 2-d positions; it must be a multiple of 4")

    def shape(name: str) -> tuple[int, ...]:
        if name not in weights:
            raise CheckpointError(f"{path}: no weight '{name}'; is it an ACTPolicy of LeRobot, and whole?")
        return tuple(weights[name].shape)

    vae = {m[1] for k in weights if (m := re.match(r"vae_encoder\.layers\.(\d+)\.", k))}
    return ActConfig(
        state_names=_names(shape("encoder_robot_state_input_proj.weight")[-1], "state"),
        action_names=_names(shape("action_head.bias")[0], "action"),
        latent=shape("encoder_latent_input_proj.weight")[-1],
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


def _listed(names: list[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


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
    found = {k: tuple(v.shape) for k, v in weights.items()}
    problems = []
    if missing := sorted(expected.keys() - found.keys()):
        problems.append(f"missing: {_listed(missing)}")
    if unknown := sorted(found.keys() - expected.keys()):
        problems.append(f"unknown: {_listed(unknown)}")
    if wrong := [f"{k} is {found[k]}, not {expected[k]}" for k in expected if k in found and found[k] != expected[k]]:
        problems.append(f"of another shape: {_listed(wrong)}")
    if problems:
        raise CheckpointError(f"{path}: config and weights do not agree ({'; '.join(problems)})")
    if bad := [k for k, v in weights.items() if not torch.isfinite(v).all()]:
        raise CheckpointError(f"{path}: NaN or Inf in {_listed(bad)}; training diverged, take an earlier checkpoint")
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
        **extra,
    }
    return Checkpoint(path, kind, config, weights, sha256, report)
