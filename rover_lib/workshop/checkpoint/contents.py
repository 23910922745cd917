"""What both formats of a checkpoint hold: named weights, checked against what LeRobot builds of the config."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_lib.onboard.checked import is_whole
from rover_lib.onboard.errors import CheckpointError
from rover_lib.workshop.act import ACTIVATIONS, BACKBONES, ActConfig
from rover_lib.workshop.act_config import expected_shapes
from rover_lib.workshop.untrusted import quote, quote_all

# Config, weights by LeRobot's names without the leading `model.`, and more for the report.
Contents = tuple[ActConfig, dict[str, Tensor], dict[str, Any]]

TWO_ACTIONS = ("steering", "throttle")
# Bounds, each far above what a policy of full size has.
LARGEST_SIDE_PX = 8192  # the largest picture of a Pi's cameras has 4608 pixels a side
MOST_NUMBERS = 1000  # actions, and numbers in a state

# The remedies that help most often.
COPY_AGAIN = "copy it again, the whole folder if it is one"
CORRECT_IT = "correct the config to what the policy was trained with"
IS_IT_WHOLE = "is it an ACTPolicy of LeRobot, and whole?"
FIRST_WEIGHT = "backbone.conv1.weight"  # every ACT has it once, so what is before it is before all its names


def name_weights(path: Path, state: dict[Any, Any]) -> tuple[dict[str, Tensor], list[str]]:
    """Return the weights by LeRobot's names without `model.`, and a note if they began with anything else.

    A policy saved inside torch.compile or DistributedDataParallel has `_orig_mod.` or `module.` in all its names, and
    the network alone has no `model.`. Raises CheckpointError unless all names begin alike and all weights are dense
    floats with values.
    """
    # A batch norm counts its batches; LeRobot's are frozen and drop the count.
    state = {k: v for k, v in state.items() if not str(k).endswith(".num_batches_tracked")}
    if odd := [k for k, v in state.items() if not isinstance(k, str) or not _is_weight(v)]:
        raise CheckpointError(
            f"{path}: these weights are not dense tensors of floats: {quote_all(odd)}",
            remedy="save policy.state_dict() as it was trained",
        )
    begins = {k.removesuffix(FIRST_WEIGHT) for k in state if k.endswith(FIRST_WEIGHT)}
    prefix = begins.pop() if len(begins) == 1 else "model."
    if outside := [k for k in state if not k.startswith(prefix)]:
        raise CheckpointError(f"{path}: names outside {quote(prefix)}: {quote_all(outside)}", remedy=IS_IT_WHOLE)
    notes = [] if prefix == "model." else [f"its weights' names begin with {quote(prefix)}, which is taken off"]
    return {k.removeprefix(prefix): v for k, v in state.items()}, notes


def _is_weight(value: Any) -> bool:
    dense = isinstance(value, Tensor) and value.layout == torch.strided and value.device.type == "cpu"
    return dense and value.is_floating_point()  # a quantized tensor is not


def name_numbers(count: int, stem: str) -> tuple[str, ...]:
    """Return names for `count` numbers of which nothing but their count is known: two are a car's."""
    return TWO_ACTIONS if count == 2 else tuple(f"{stem}_{i}" for i in range(count))


def check_weights(path: Path, c: ActConfig, weights: dict[str, Tensor]) -> None:
    """Raise CheckpointError unless LeRobot's ACT of this config has exactly these weights, and all are finite.

    What is checked first either cannot run here, or would let LeRobot build something without end.
    """
    for key, value, known in (("backbone", c.backbone, BACKBONES), ("activation", c.activation, ACTIVATIONS)):
        if not isinstance(value, str) or value not in known:
            raise CheckpointError(
                f"{path}: {key} {quote(value)} is not known here", remedy=f"known are {', '.join(sorted(known))}"
            )
    sizes = (c.chunk, c.dim, c.heads, c.feedforward, c.encoder_layers, c.decoder_layers)
    positions = tuple(weights["decoder_pos_embed.weight"].shape) if "decoder_pos_embed.weight" in weights else None
    whole = all(is_whole(size, 1) for size in sizes)  # LeRobot 0.6 lets None pass
    if not whole or positions != (c.chunk, c.dim) or c.encoder_layers + c.decoder_layers > len(weights):
        raise CheckpointError(
            f"{path}: config and weights do not agree (decoder_pos_embed is {positions}, {len(weights)} weights)",
            found=f"chunk, width, heads, feed-forward, encoder and decoder layers of {quote_all(sizes)}",
            remedy=CORRECT_IT,
        )
    if c.dim % 4:
        raise CheckpointError(f"{path}: a width of {c.dim} has no 2-d positions", remedy="use a multiple of 4")
    try:
        expected = expected_shapes(c)
    except Exception as e:  # torch, torchvision and LeRobot raise types of their own
        raise CheckpointError(f"{path}: LeRobot cannot build it ({quote(str(e))})", remedy=CORRECT_IT) from None
    shapes = {name: tuple(w.shape) for name, w in weights.items()}
    problems = {
        "missing": sorted(expected.keys() - shapes.keys()),
        "unknown": sorted(shapes.keys() - expected.keys()),
        "of another shape": [
            f"{k} is {shapes[k]}, not {expected[k]}" for k in expected if shapes.get(k, expected[k]) != expected[k]
        ],
    }
    if said := [f"{what}: {quote_all(names)}" for what, names in problems.items() if names]:
        raise CheckpointError(f"{path}: config and weights do not agree ({'; '.join(said)})", remedy=CORRECT_IT)
    if bad := [k for k, v in weights.items() if not torch.isfinite(v.float()).all()]:
        raise CheckpointError(
            f"{path}: NaN or Inf in {quote_all(bad)}", remedy="training diverged, take an earlier checkpoint"
        )


def tensor_bytes(value: Any) -> int:
    """Return the bytes of all tensors in nested dicts, lists and tuples."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, (dict, list, tuple)):
        return sum(map(tensor_bytes, value.values() if isinstance(value, dict) else value))
    return 0
