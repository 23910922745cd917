"""A network's weights: which of them drive, by LeRobot's names, and whether all are there."""

import re
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_lib.onboard.errors import CheckpointError
from rover_lib.workshop.checkpoint.facts import USER, Facts, meaning_of
from rover_lib.workshop.checkpoint.files import COPY_AGAIN
from rover_lib.workshop.untrusted import quote_all

Weights = dict[str, Tensor]
IS_IT_WHOLE = "is it an ACTPolicy of LeRobot, and whole?"
# Parts of names that torch.compile, DataParallel, FSDP and checkpointing put anywhere, which change nothing.
WRAPPERS = r"(?<![^.])(module|_orig_mod|_(fsdp|checkpoint)_wrapped_module)\."
COUNTS = r"(.*\.)?(num_batches_tracked|n_averaged)"  # a batch norm's, and AveragedModel's; LeRobot's norms are frozen
OF_ACT = "action_head.weight"  # every ACT has one: what stands before it stands before all its names
TORN, TORN_ROW = 1024, 64  # zeros that no training leaves in a matrix: one after the other, and in one of its rows


def name_weights(path: Path, state: Mapping[Any, Any], ignored: Container[str] = ()) -> Weights:
    """Return the weights by LeRobot's names, which begin with `model.`, without what others put before that.

    ignored: prefixes of networks in it that the user does not want. Raises CheckpointError if there is no ACT in it, or
    several that differ.
    """
    named: dict[str, Any] = {}
    for key, weight in state.items():
        name = re.sub(WRAPPERS, "", str(key))
        if not _is_same(named.setdefault(name, weight), weight):
            raise CheckpointError(f"{path}: has two '{name}', which differ", remedy="save one policy.state_dict()")
    prefixes = sorted(name.removesuffix(OF_ACT) for name in named if re.fullmatch(rf"(.*\.)?{OF_ACT}", name))
    candidates = [prefix for prefix in prefixes if not prefix or prefix.rstrip(".") not in ignored]
    if not candidates:
        remedy = "give an ACTPolicy of LeRobot's; of another network, nothing can be used"
        raise CheckpointError(f"{path}: no ACT, which has an '{OF_ACT}'", found=quote_all(named), remedy=remedy)

    def network(prefix: str) -> dict[str, Any]:
        inner = tuple(other for other in prefixes if other.startswith(prefix) and other != prefix)
        inside = [name for name in named if name.startswith(prefix) and not name.startswith(inner or ("\0",))]
        return {name.removeprefix(prefix): named[name] for name in inside}

    own = network(candidates[0])
    for candidate in candidates[1:]:
        if not all(_is_same(own.get(name), weight) for name, weight in network(candidate).items()):
            option = " or ".join(f"{USER} ignore={prefix.rstrip('.')}" for prefix in candidates if prefix)
            problem = f"{path}: several networks are in it, that differ: which one drives?"
            actual = f"names with {quote_all(candidates)}"
            raise CheckpointError(problem, found=actual, remedy=f"name the one that does not: {option}")
    around = candidates[0].removesuffix("model.")  # before the names of the policy's other parts, such as statistics
    networks = tuple(prefix for prefix in prefixes if prefix) or ("\0",)
    rest = {name.removeprefix(around): named[name] for name in named if candidates[0] and not name.startswith(networks)}
    return {f"model.{name}": weight for name, weight in own.items()} | rest


def _is_same(a: Any, b: Any) -> bool:
    return a is b or (isinstance(a, Tensor) and isinstance(b, Tensor) and torch.equal(a, b))


def check_weights_are_whole(facts: Facts, weights: Mapping[str, Any]) -> Weights:
    """Return a network's weights without `model.`, and without what the user ignores.

    Raises CheckpointError for other names, what is no dense tensor of floats with values, and for matrices with a long
    row of zeros, as in files that were not copied to their end.
    """
    path = facts.path
    outside = dict[str, str]()  # and what stands before their names, by which they can be ignored
    for name in weights:
        begins = name.split("." if "." in name else "_")[0]
        if not (name.startswith("model.") or re.fullmatch(COUNTS, name) or begins in facts.ignored):
            outside[name] = begins
    if outside:
        first = next(filter(meaning_of, outside), next(iter(outside)))
        meaning = meaning_of(first) or "and nobody here knows what that does"
        value = f"one of {len(outside)} that LeRobot's ACT does not have"
        raise facts.refusal(first, value, meaning, ",".join(sorted({*outside.values()})))
    weights = {name: weights[name] for name in weights if name.startswith("model.") and not re.fullmatch(COUNTS, name)}
    odd = []
    torn = []
    for name, weight in weights.items():
        dense = isinstance(weight, Tensor) and weight.layout == torch.strided and weight.device.type == "cpu"
        if not dense or not weight.is_floating_point():  # as a quantized tensor is not
            odd.append(name)
        elif weight.dim() > 1 and "state_input" not in name and _is_torn(name, weight):
            torn.append(name)
    if odd:
        problem = f"{path}: these weights are not dense tensors of floats: {quote_all(odd)}"
        raise CheckpointError(problem, remedy="save policy.state_dict() as it was trained")
    if torn:
        problem = f"{path}: damaged, its weights are zeros where a training leaves none: {quote_all(torn)}"
        raise CheckpointError(problem, remedy=f"was it copied to its end? {COPY_AGAIN}")
    return {name.removeprefix("model."): weight for name, weight in weights.items()}


def _is_torn(name: str, weight: Tensor) -> bool:
    """Whether a matrix has TORN zeros in a row, or only zeros.

    In the backbone, channels may be left out: rows of zeros, and the same columns of all others. An action that is
    held has a row of zeros in the head, and all may be held.
    """
    zero = (weight.detach().flatten(1) == 0).numpy()
    head = name.endswith(OF_ACT)
    if head or ".backbone." in name or zero.size < TORN:
        rows = zero[~zero.all(1)]
        if not len(rows):
            return not head
        return int((rows if head else rows & ~rows.all(0)).sum(1).max()) >= TORN_ROW
    whole = zero.ravel()
    blocks = whole[: whole.size // TORN * TORN].reshape(-1, TORN).all(1)
    return bool(blocks.any() or whole[-TORN:].all())


def tensor_bytes(value: Any) -> int:
    """Return the bytes of all tensors in nested dicts, lists and tuples."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, (dict, list, tuple)):
        return sum(map(tensor_bytes, value.values() if isinstance(value, dict) else value))
    return 0
