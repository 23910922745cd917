"""Make a smaller policy that begins with its teacher's weights.

    shape = StudentShape(height=180, width=320, decoder_layers=2, feedforward=1600)
    config = student_config(teacher, shape)
    weights = initial_weights(teacher, config, inputs)

No weight of ACT depends on the picture's size, so a student takes the backbone, the projections and the attention as
they are, the first of the decoder's layers, and the most important units of every feed-forward. The VAE's encoder is
left out, as only training on recordings needs it.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rover_learn.refit import grams_of, refit_layer
from rover_lib.onboard.errors import TrainingError
from rover_lib.workshop.act import ACT, BACKBONES, ActConfig, FeedForward, expected_shapes, multiply_accumulates
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.recordings.samples import ACTION_NAMES
from rover_lib.workshop.untrusted import quote_all


@dataclass(frozen=True)
class StudentShape:
    """What may differ between a student's shape and its teacher's. None keeps the teacher's value.

    backbone_channels: the share of the channels inside the backbone's blocks that the student computes. Its files still
    have all channels, the others as zeros; see `channels`.
    """

    height: int | None = None
    width: int | None = None
    decoder_layers: int | None = None
    feedforward: int | None = None
    backbone_channels: float | None = None


def student_config(teacher: Checkpoint, shape: StudentShape) -> ActConfig:
    """Return the student's config.

    Raises TrainingError for a student that exceeds its teacher in anything, a backbone whose channels cannot be left
    out, and a teacher of no car; CheckpointError for an image size at which the teacher's weights do not run.
    """
    c = teacher.config
    refuse_no_car(teacher)
    ((height, width),) = c.image_sizes
    own = (shape.height, shape.width, shape.decoder_layers, shape.feedforward)
    teachers = (height, width, c.decoder_layers, c.feedforward)
    for name, value, most in zip(("height", "width", "decoder layers", "feed-forward"), own, teachers, strict=True):
        if value is not None and not 1 <= value <= most:
            raise TrainingError(f"a student's {name} must be from 1 to its teacher's, {most}", found=value)
    if (share := shape.backbone_channels) is not None:
        if not 0 < share <= 1:
            raise TrainingError("the share of the backbone's channels must be above 0, at most 1", found=share)
        if BACKBONES[c.backbone][0] != "basic":
            raise TrainingError("channels can be left out of ResNets of basic blocks only", found=c.backbone)
    smaller = teacher.at_size(shape.height or height, shape.width or width).config
    return replace(
        smaller,
        decoder_layers=shape.decoder_layers or c.decoder_layers,
        feedforward=shape.feedforward or c.feedforward,
        vae_layers=0,
    )


def refuse_no_car(policy: Checkpoint) -> None:
    """Raise TrainingError unless a policy has one camera, and steering and throttle as its states and actions.

    A policy that we teach is also shown mirrored samples, with the first number negated, and is stored so named.
    """
    c = policy.config
    if len(c.cameras) != 1 or not c.state_names == c.action_names == ACTION_NAMES:
        found = f"{len(c.cameras)} cameras, states {quote_all(c.state_names)}, actions {quote_all(c.action_names)}"
        remedy = "if it is of one camera, steering and throttle, name them so in the dataset's meta/info.json"
        raise TrainingError(f"{policy.path}: is not a car's policy", found=found, remedy=remedy)


def gmac(config: ActConfig, weights: dict[str, Tensor] | None = None) -> float:
    """Return the multiply-accumulates of one inference, in 10^9. weights: None means a policy without dead channels."""
    weights = weights or {name: torch.ones(shape) for name, shape in expected_shapes(config).items()}
    return sum(multiply_accumulates(ACT(config, weights)).values()) / 1e9


def initial_weights(teacher: Checkpoint, config: ActConfig, inputs: Iterable[tuple[Tensor, ...]]) -> dict[str, Tensor]:
    """Return the teacher's weights in the student's shape, by LeRobot's names without the leading `model.`.

    inputs: calibration frames as the student sees them (`act.inputs_of`); they are only run if units are left out.
    """
    kept = {name: weight.detach().float().clone() for name, weight in teacher.weights.items() if _is_kept(name, config)}
    if config.feedforward == teacher.config.feedforward:
        return kept
    wide, downs = ACT(replace(config, feedforward=teacher.config.feedforward), teacher.weights), {}
    for name, module in wide.named_modules():
        if isinstance(module, FeedForward):
            part, index, _ = name.split(".")
            downs[f"{part}.layers.{index}"] = module.down
    for name, gram in grams_of(downs, lambda x: x[:1], lambda: [wide(*x)[0] for x in inputs]).items():
        kept |= _narrow(kept, name, gram, config.feedforward)
    return kept


def _is_kept(name: str, config: ActConfig) -> bool:
    if name.startswith("vae_"):
        return False
    part, _, rest = name.partition(".layers.")
    return part != "decoder" or not rest or int(rest.split(".")[0]) < config.decoder_layers


def _narrow(weights: dict[str, Tensor], layer: str, gram: Tensor, units: int) -> dict[str, Tensor]:
    """Keep one feed-forward's most important units, and refit `down` to the output that all units gave.

    A unit's importance is its mean magnitude, or, where activations may be negative, the root of its mean square.
    """
    down, bias = weights[f"{layer}.linear2.weight"].double(), weights[f"{layer}.linear2.bias"].double()
    magnitude = gram[-1, :-1].abs() if (gram[-1, :-1] >= 0).all() else gram.diagonal()[:-1].sqrt()
    best = (magnitude * down.norm(dim=0)).topk(units).indices.sort().values
    refit = refit_layer(torch.cat([down, bias[:, None]], 1).T, gram, best)
    return {
        f"{layer}.linear1.weight": weights[f"{layer}.linear1.weight"][best].clone(),
        f"{layer}.linear1.bias": weights[f"{layer}.linear1.bias"][best].clone(),
        f"{layer}.linear2.weight": refit[:-1].T.float().contiguous(),
        f"{layer}.linear2.bias": refit[-1].float(),
    }
