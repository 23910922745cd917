"""Check what both formats of a checkpoint hold, the config's numbers and the weights, before it is used.

Every size is bounded first: by what the file's own bytes can hold, or by a limit that no policy reaches.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_lib.onboard.checked import is_whole
from rover_lib.onboard.errors import CheckpointError
from rover_lib.workshop.act import ACTIVATIONS, BACKBONES, ActConfig
from rover_lib.workshop.untrusted import quote, quote_all

TWO_ACTIONS = ("steering", "throttle")
FLOATS = (torch.float32, torch.float16, torch.bfloat16, torch.float64)  # what weights and statistics can be

# Bounds, each far above what a policy of full size has.
LARGEST_SIZE = 1_000_000  # a whole number in a config
LARGEST_SIDE_PX = 8192  # the largest picture of a Pi's cameras has 4608 pixels a side
MOST_ACTIONS = 1000  # actions, numbers in a state, and numbers in the latent

# The remedies that help most often.
COPY_AGAIN = "copy it again, the whole folder if it is one"
FIRST_WEIGHT = "backbone.conv1.weight"  # every ACT has it once, so what is before it is before all its names
CORRECT_IT = "correct the config to what the policy was trained with"
IS_IT_WHOLE = "is it an ACTPolicy of LeRobot, and whole?"


@dataclass(frozen=True)
class Contents:
    """What a file or folder holds. `weights` have LeRobot's names without the leading `model.`."""

    format: str  # "trainer" or "lerobot"
    config: ActConfig
    weights: dict[str, Tensor]
    sha256: str  # of the trainer's file, or of model.safetensors
    file_bytes: int
    extra: dict[str, Any]  # for the report


def named_weights(path: Path, state: dict[Any, Any], file_bytes: int) -> tuple[dict[str, Tensor], list[str]]:
    """Return the weights by LeRobot's names without `model.`, and a note if they began with anything else.

    A policy saved inside torch.compile or DistributedDataParallel has `_orig_mod.` or `module.` in all its names, and
    the network alone has no `model.`. Raises CheckpointError unless all names begin alike and all weights are dense
    floats that together fit into the file.
    """
    odd = [k for k, v in state.items() if not isinstance(k, str) or not isinstance(v, Tensor)]
    if odd:
        raise CheckpointError(
            f"{path}: these weights are not tensors: {quote_all(odd)}", remedy="save policy.state_dict() as it is"
        )
    # A batch norm counts its batches; LeRobot's are frozen and drop the count.
    state = {k: v for k, v in state.items() if not str(k).endswith(".num_batches_tracked")}
    begins = {k.removesuffix(FIRST_WEIGHT) for k in state if k.endswith(FIRST_WEIGHT)}
    prefix = begins.pop() if len(begins) == 1 else "model."
    if outside := [k for k in state if not k.startswith(prefix)]:
        raise CheckpointError(f"{path}: names outside {quote(prefix)}: {quote_all(outside)}", remedy=IS_IT_WHOLE)
    weights = {k.removeprefix(prefix): v for k, v in state.items()}
    for name, weight in weights.items():
        if problem := _unusable(weight):
            raise CheckpointError(
                f"{path}: weight {quote(name)} is {problem}", remedy="save the weights as trained, dense and in floats"
            )
    claimed = sum(map(_bytes, weights.values()))
    if claimed > file_bytes:  # weights that share their values, or repeat one
        raise CheckpointError(
            f"{path}: its weights claim {claimed / 1e6:.1f} MB in a file of {file_bytes / 1e6:.1f} MB",
            remedy="save each weight with values of its own (.clone())",
        )
    return weights, [] if prefix == "model." else [f"its weights' names begin with {quote(prefix)}, which is taken off"]


def _unusable(weight: Tensor) -> str | None:
    """Say why a tensor cannot be a weight; None if it can."""
    if weight.device.type == "meta":
        return "without values, on torch's meta device"
    if weight.is_quantized:
        return "quantized"
    if not is_plain(weight):
        return f"not dense ({str(weight.layout).removeprefix('torch.')})"
    if weight.dtype not in FLOATS:
        return f"of {weight.dtype}, not of floats"
    if not weight.numel():
        return "empty"
    return None


def is_size(value: Any, most: int = LARGEST_SIZE) -> bool:
    return is_whole(value, 1, most)


def positive(path: Path, raw: dict[str, Any], key: str, most: int = LARGEST_SIZE) -> int:
    value = raw.get(key)
    if not is_whole(value, 1, most):
        raise CheckpointError(
            f"{path}: config '{key}' must be a whole number of at least 1 and at most {most}",
            found=quote(value),
            remedy=CORRECT_IT,
        )
    return value


def flag(path: Path, raw: dict[str, Any], key: str) -> bool:
    value = raw.get(key)
    if value is None or (isinstance(value, int) and value in (0, 1)):
        return bool(value)
    raise CheckpointError(f"{path}: config '{key}' must be true or false", found=quote(value), remedy=CORRECT_IT)


def one_observation(path: Path, raw: dict[str, Any]) -> None:
    steps = raw.get("n_obs_steps", 1)
    if not isinstance(steps, (int, float)) or steps != 1:
        raise CheckpointError(
            f"{path}: n_obs_steps is {quote(steps)}", remedy="ACT acts on one observation, train with 1"
        )


def _names(count: int, stem: str) -> tuple[str, ...]:
    return TWO_ACTIONS if count == 2 else tuple(f"{stem}_{i}" for i in range(count))


def config_from(path: Path, weights: dict[str, Tensor], **known: Any) -> ActConfig:
    """Make an ActConfig from what the config says (`known`) and what only the shapes of the weights say.

    Raises CheckpointError for a policy that cannot be run here.
    """
    for key, choices in (("backbone", BACKBONES), ("activation", ACTIVATIONS)):
        value = known.get(key, "relu")
        if not isinstance(value, str) or value not in choices:
            raise CheckpointError(
                f"{path}: {key} {quote(value)} is not known here", remedy=f"known are {', '.join(sorted(choices))}"
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
        # Each layer has many weights. With this bound nobody can make expected_shapes run for minutes.
        if (count := known[f"{part}_layers"]) > len(weights):
            raise CheckpointError(
                f"{path}: config and weights do not agree ({count} {part} layers, {len(weights)} weights in all)",
                remedy=CORRECT_IT,
            )
    sees_state = known.pop("sees_state", True)
    vae = {m[1] for k in weights if (m := re.match(r"vae_encoder\.layers\.(\d+)\.", k))}
    return ActConfig(
        sees_state=sees_state,
        state_names=_names(last("encoder_robot_state_input_proj.weight"), "state") if sees_state else TWO_ACTIONS,
        action_names=_names(last("action_head.bias"), "action"),
        latent=last("encoder_latent_input_proj.weight"),
        vae_layers=len(vae),
        **known,
    )


def expected_shapes(c: ActConfig) -> dict[str, tuple[int, ...]]:
    """Return the name and shape of every weight that LeRobot's ACT of this config has."""
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
    if c.sees_state:
        lin("encoder_robot_state_input_proj", d, states)
    lin("encoder_latent_input_proj", d, c.latent)
    shapes["encoder_1d_feature_pos_embed.weight"] = (1 + c.sees_state, d)
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
        shapes["vae_encoder_pos_enc"] = (1, c.chunk + 1 + c.sees_state, d)
        if c.sees_state:
            lin("vae_encoder_robot_state_input_proj", d, states)
        lin("vae_encoder_action_input_proj", d, actions)
        lin("vae_encoder_latent_output_proj", 2 * c.latent, d)
    return shapes


def _resnet_shapes(name: str) -> dict[str, tuple[int, ...]]:
    """Return the weights' shapes of torchvision's ResNet without its classifier and with frozen batch norm.

    They are written out here, because importing torchvision takes three seconds.
    """
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


def tensor_bytes(value: Any) -> int:
    """Return the bytes of all tensors in nested dicts, lists and tuples.

    Each object is counted once, because a list can contain itself.
    """
    total, seen, waiting = 0, set(), [value]
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, Tensor):
            total += _bytes(value) if is_plain(value) else 0
        elif isinstance(value, dict):
            waiting.extend(value.values())
        elif isinstance(value, (list, tuple)):
            waiting.extend(value)
    return total


def is_plain(value: Any) -> bool:
    """Whether a value is a tensor of numbers in memory: neither sparse, nor quantized, nor on torch's meta device."""
    return (
        isinstance(value, Tensor)
        and value.layout == torch.strided
        and value.device.type == "cpu"
        and not value.is_quantized
    )


def _bytes(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()
