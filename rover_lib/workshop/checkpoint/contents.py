"""What both formats of a checkpoint hold: named weights, checked against what LeRobot builds of the config."""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_lib.onboard.artifact.manifest import RULES
from rover_lib.onboard.checked import broken_rule, is_whole
from rover_lib.onboard.errors import CheckpointError, printable
from rover_lib.workshop.act import ACTIVATIONS, BACKBONES, ActConfig, Affine
from rover_lib.workshop.act_config import lerobot_act
from rover_lib.workshop.untrusted import quote, quote_all

# Config, weights by LeRobot's names without the leading `model.`, and more for the report.
Contents = tuple[ActConfig, dict[str, Tensor], dict[str, Any]]

TWO_ACTIONS = ("steering", "throttle")
MOST = 8192  # pixels a side, or numbers of a state or an action, before `check_limits` has seen them all
COPY_AGAIN = "copy it again, the whole folder if it is one"
CORRECT_IT = "correct the config to what the policy was trained with"
IS_IT_WHOLE = "is it an ACTPolicy of LeRobot, and whole? If its weights hold statistics, remove policy_p*processor.json"
# Names that torch.compile, DataParallel and trainers put around a policy's own, which change nothing.
WRAPPERS = r"^(module\.|policy\.)+|_orig_mod\."
RATE_HZ = 30.0  # steps of a plan in a second if nothing says it: the rate of the trainer's recordings


def name_weights(path: Path, state: dict[Any, Any]) -> dict[str, Tensor]:
    """Return the weights by LeRobot's names without `model.`.

    Raises CheckpointError unless all names begin so and all weights are dense floats with values.
    """
    # A batch norm counts its batches; LeRobot's are frozen and drop the count.
    state = {k: v for k, v in state.items() if not str(k).endswith(".num_batches_tracked")}
    if all(isinstance(k, str) for k in state):
        state = {re.sub(WRAPPERS, "", k): v for k, v in state.items()}
        if "action_head.weight" in state:  # those of the network, without the policy around it
            state = {f"model.{k}": v for k, v in state.items()}
    if odd := [k for k, v in state.items() if not isinstance(k, str) or not _is_weight(v)]:
        what = f"{path}: these weights are not dense tensors of floats: {quote_all(odd)}"
        raise CheckpointError(what, remedy="save policy.state_dict() as it was trained")
    if outside := [k for k in state if not k.startswith("model.")]:
        raise CheckpointError(f"{path}: names outside 'model.': {quote_all(outside)}", remedy=IS_IT_WHOLE)
    return {k.removeprefix("model."): v for k, v in state.items()}


def _is_weight(value: Any) -> bool:
    dense = isinstance(value, Tensor) and value.layout == torch.strided and value.device.type == "cpu"
    return dense and value.is_floating_point()  # a quantized tensor is not


def put_in_order(
    c: ActConfig, weights: dict[str, Tensor], states: tuple[int, ...], actions: tuple[int, ...]
) -> tuple[ActConfig, dict[str, Tensor]]:
    """Return the policy with its numbers in another order. states, actions: for each number, where it is now."""

    def reorder(norm: Affine | None, order: tuple[int, ...]) -> Affine | None:
        return norm and Affine(tuple(norm.scale[i] for i in order), tuple(norm.shift[i] for i in order))

    weights = dict(weights)
    for name, order, axis in (
        ("encoder_robot_state_input_proj.weight", states, 1),
        ("vae_encoder_robot_state_input_proj.weight", states, 1),
        ("vae_encoder_action_input_proj.weight", actions, 1),
        ("action_head.weight", actions, 0),
        ("action_head.bias", actions, 0),
    ):
        if name in weights:
            weights[name] = weights[name].index_select(axis, torch.tensor(order))
    c = replace(c, state_norm=reorder(c.state_norm, states), action_unnorm=reorder(c.action_unnorm, actions))
    return c, weights


def name_numbers(count: int, stem: str) -> tuple[str, ...]:
    """Return names for `count` numbers of which nothing but their count is known: two are a car's."""
    return TWO_ACTIONS if count == 2 else tuple(f"{stem}_{i}" for i in range(count))


@contextmanager
def as_checkpoint_error(path: Path, remedy: str = COPY_AGAIN) -> Iterator[None]:
    """Turn whatever LeRobot, or a reader below it, raises into a CheckpointError of one sentence."""
    try:
        yield
    except CheckpointError:
        raise
    except Exception as e:  # each library raises types of its own
        said = e.__cause__ or e  # draccus wraps what a config's own check says
        reason = printable(" ".join(f"{type(said).__name__}: {said}".split())[:200])
        raise CheckpointError(f"{path}: LeRobot cannot use it ({reason})", remedy=remedy) from None


def check_limits(path: Path, c: ActConfig) -> None:
    """Raise CheckpointError for sizes, names or a rate that no artifact's manifest may hold.

    Plans of a million steps, from a file of a few megabytes, would fill the memory with the samples of a drive.
    """
    cameras = [{"name": n, "height": h, "width": w} for n, (h, w) in zip(c.cameras, c.image_sizes, strict=True)]
    names = {"state_names": list(c.state_names), "action_names": list(c.action_names)}
    values = {"cameras": cameras, **names, "chunk": c.chunk, "rate_hz": c.rate_hz}
    if broken := broken_rule(values, {name: RULES[name] for name in values}):
        name, must, found = broken
        raise CheckpointError(f"{path}: {name} must be {must}", found=found, remedy=CORRECT_IT)


def check_weights(path: Path, c: ActConfig, weights: dict[str, Tensor], unknown: Iterable[str] = ()) -> None:
    """Raise CheckpointError unless LeRobot's ACT of this config has exactly these weights, and all are finite.

    unknown: keys that nobody here knows, and that may be why.

    What is checked first either cannot run here, or would let LeRobot build something without end.
    """
    for key, value, known in (("backbone", c.backbone, BACKBONES), ("activation", c.activation, ACTIVATIONS)):
        if not isinstance(value, str) or value not in known:
            what = f"{path}: {key} {quote(value)} is not known here"
            raise CheckpointError(what, remedy=f"known are {', '.join(sorted(known))}")
    sizes = (c.chunk, c.dim, c.heads, c.feedforward, c.encoder_layers, c.decoder_layers)
    positions = tuple(weights["decoder_pos_embed.weight"].shape) if "decoder_pos_embed.weight" in weights else None
    whole = all(is_whole(size, 1) for size in sizes)  # LeRobot 0.6 lets None pass
    deep = not whole or c.encoder_layers + c.decoder_layers > len(weights)
    if deep or positions != (c.chunk, c.dim) or c.dim % 4:  # a quarter of the width for each sine and cosine
        what = f"{path}: config and weights do not agree (decoder_pos_embed is {positions}, {len(weights)} weights)"
        found = f"chunk, width, heads, feed-forward, encoder and decoder layers of {quote_all(sizes)}"
        raise CheckpointError(what, found=found, remedy=CORRECT_IT)
    keys = quote_all(unknown)
    forked = f"; nobody here knows {keys}: train with LeRobot's own ACT if that asks for other weights" if keys else ""
    with as_checkpoint_error(path, CORRECT_IT + forked):
        lerobot_act(c, {}).model.load_state_dict(weights, assign=True)
    if bad := [k for k, v in weights.items() if not torch.isfinite(v.float()).all()]:
        what = f"{path}: NaN or Inf in {quote_all(bad)}"
        raise CheckpointError(what, remedy="training diverged, take an earlier checkpoint")


def tensor_bytes(value: Any) -> int:
    """Return the bytes of all tensors in nested dicts, lists and tuples."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, (dict, list, tuple)):
        return sum(map(tensor_bytes, value.values() if isinstance(value, dict) else value))
    return 0
