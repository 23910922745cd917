"""Make a smaller policy that begins with its teacher's weights.

    shape = StudentShape(height=180, width=320, decoder_layers=2, feedforward=1600)
    config = student_config(teacher, shape)
    weights = initial_weights(teacher, config, inputs)

No weight of ACT depends on the picture's size, so a student takes the backbone, the projections and the attention as
they are, the first of the decoder's layers, and the most important units of every feed-forward. The VAE's encoder is
left out, as only training on recordings needs it. A layer that reads fewer inputs than before is refitted to the output
that all of them gave.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from rover_lib.onboard.errors import TrainingError
from rover_lib.workshop.act import ACT, FeedForward, multiply_accumulates
from rover_lib.workshop.act_config import BACKBONES, ActConfig, weight_shapes
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.hooks import watched
from rover_lib.workshop.recordings.samples import ACTION_NAMES
from rover_lib.workshop.untrusted import quote_all

RIDGE = 1e-4  # times an input's mean square: it keeps the weights as they were where the rows say nothing
ROWS = 4096  # rows that are multiplied at once; few, because they become double and memory is small


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
    for name, value, upper in zip(("height", "width", "decoder layers", "feed-forward"), own, teachers, strict=True):
        if value is not None and not 1 <= value <= upper:
            raise TrainingError(f"a student's {name} must be from 1 to its teacher's, {upper}", found=value)
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
        actual = f"{len(c.cameras)} cameras, states {quote_all(c.state_names)}, actions {quote_all(c.action_names)}"
        remedy = "if it is of one camera, steering and throttle, name them so in the dataset's meta/info.json"
        raise TrainingError(f"{policy.path}: is not a car's policy", found=actual, remedy=remedy)


def gmac(config: ActConfig, weights: dict[str, Tensor] | None = None) -> float:
    """Return the multiply-accumulates of one inference, in 10^9. weights: None means a policy without dead channels."""
    weights = weights or {name: torch.ones(shape) for name, shape in weight_shapes(config).items()}
    return sum(multiply_accumulates(ACT(config, weights)).values()) / 1e9


def initial_weights(teacher: Checkpoint, config: ActConfig, inputs: Iterable[tuple[Tensor, ...]]) -> dict[str, Tensor]:
    """Return the teacher's weights in the student's shape, by LeRobot's names without the leading `model.`.

    inputs: calibration frames as the student sees them (`act.inputs_of`); they are only run if units are left out.
    """
    init = {name: weight.detach().float().clone() for name, weight in teacher.weights.items() if _is_kept(name, config)}
    if config.feedforward == teacher.config.feedforward:
        return init
    wide = ACT(replace(config, feedforward=teacher.config.feedforward), teacher.weights)
    downs = {}
    for name, module in wide.named_modules():
        if isinstance(module, FeedForward):
            part, index, _ = name.split(".")
            downs[f"{part}.layers.{index}"] = module.down
    for name, gram in grams_of(downs, lambda x: x[:1], lambda: [wide(*x)[0] for x in inputs]).items():
        init |= _narrow(init, name, gram, config.feedforward)
    return init


def _is_kept(name: str, config: ActConfig) -> bool:
    if name.startswith("vae_"):
        return False
    part, _, rest = name.partition(".layers.")
    return part != "decoder" or not rest or int(rest.split(".")[0]) < config.decoder_layers


def _narrow(weights: dict[str, Tensor], layer: str, gram: Tensor, units: int) -> dict[str, Tensor]:
    """Keep one feed-forward's most important units, and refit `down` to the output that all units gave.

    A unit's importance is its mean magnitude, or, where activations may be negative, the root of its mean square.
    """
    down = weights[f"{layer}.linear2.weight"].double()
    bias = weights[f"{layer}.linear2.bias"].double()
    magnitude = gram[-1, :-1].abs() if (gram[-1, :-1] >= 0).all() else gram.diagonal()[:-1].sqrt()
    best = (magnitude * down.norm(dim=0)).topk(units).indices.sort().values
    refit = refit_layer(torch.cat([down, bias[:, None]], 1).T, gram, best)
    return {
        f"{layer}.linear1.weight": weights[f"{layer}.linear1.weight"][best].clone(),
        f"{layer}.linear1.bias": weights[f"{layer}.linear1.bias"][best].clone(),
        f"{layer}.linear2.weight": refit[:-1].T.float().contiguous(),
        f"{layer}.linear2.bias": refit[-1].float(),
    }


# --- layers that read fewer inputs ------------------------------------------------------------------------------------


class Gram:
    """The mean of x x^T over rows that come a few at a time. x is a row with a 1 appended."""

    def __init__(self) -> None:
        self._sum: Tensor | None = None
        self._waiting: list[Tensor] = []
        self._count = 0

    def add(self, rows: Tensor) -> None:
        """Add rows, (n, inputs), on any device."""
        self._waiting.append(rows.cpu().clone())
        if sum(map(len, self._waiting)) >= ROWS:
            self._multiply()

    def mean(self) -> Tensor:
        """Return the mean, (inputs + 1, inputs + 1) float64, once: for 512 channels of 3x3 it has 170 MB."""
        if self._waiting:
            self._multiply()
        assert self._sum is not None
        mean = self._sum.div_(self._count)
        self._sum = None
        return mean

    def _multiply(self) -> None:
        rows = torch.cat(self._waiting)
        self._waiting = []
        x = torch.ones(len(rows), rows.shape[1] + 1, dtype=torch.float64)
        x[:, :-1] = rows
        if self._sum is None:
            self._sum = x.new_zeros(x.shape[1], x.shape[1])
        self._sum.addmm_(x.T, x)
        self._count += len(x)


@torch.no_grad()
def grams_of(
    layers: Mapping[str, nn.Module], rows_of: Callable[[Tensor], Iterable[Tensor]], run: Callable[[], object]
) -> dict[str, Tensor]:
    """Return `Gram.mean` of what each layer reads in run(). rows_of: rows, (n, inputs) each, of a layer's input."""
    grams = {name: Gram() for name in layers}

    def watch(name: str, _: nn.Module, inputs: tuple[Tensor]) -> None:
        for rows in rows_of(inputs[0]):
            grams[name].add(rows)

    with watched(layers, watch, before=True):
        run()
    return {name: gram.mean() for name, gram in grams.items()}


def refit_layer(whole: Tensor, gram: Tensor, kept: Tensor) -> Tensor:
    """Compute the weights of the inputs that stay, by least squares.

    whole: (inputs + 1, outputs) float64, the bias last. gram: from `Gram.mean`. kept: (n,), the inputs that stay.
    Returns the weights, (n + 1, outputs) float64.
    """
    rows = torch.cat([kept, torch.tensor([len(gram) - 1])])  # and the 1 that carries the bias
    cut = whole[rows]
    inside = gram[rows][:, rows]
    # The least squares are of what is missing, so that the old weights stay where the rows say nothing.
    ridge = RIDGE * inside.diagonal()[:-1].mean() * torch.eye(len(rows), dtype=gram.dtype)
    return cut + torch.linalg.solve(inside + ridge, gram[rows] @ whole - inside @ cut)
