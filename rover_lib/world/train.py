"""Train LeRobot's own ACTPolicy on recordings; write a checkpoint as the user's trainer writes it.

From scratch, without downloads, a ResNet with frozen batch norm learns nothing. So there are three phases:
the backbone alone with live batch norm, predicting the chunk; the transformer on the frozen backbone's
features, computed once; then all together at a tenth of the rate.
"""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from rover_lib.onboard import preprocess
from rover_lib.onboard.errors import WorldError
from rover_lib.onboard.params import params
from rover_lib.onboard.preprocess import normalise, prepare_frame
from rover_lib.onboard.stage import atomic_path, sha256_of
from rover_lib.workshop import act as act_module
from rover_lib.workshop import episodes as episodes_module
from rover_lib.workshop.act import ActConfig, lerobot_act
from rover_lib.workshop.cache import cached_folder, key_of
from rover_lib.workshop.episodes import Sample, load_recordings, split
from rover_lib.workshop.progress import Progress, silent
from rover_lib.world import record

if TYPE_CHECKING:
    from lerobot.policies.act.modeling_act import ACTPolicy

IMAGE, STATE, ACTION, IS_PAD = "observation.images.cam_front", "observation.state", "action", "action_is_pad"
DROPOUT = 0.1  # LeRobot's default
KL_WEIGHT = 10.0
WEIGHT_DECAY = 1e-4
BETAS = (0.9, 0.999)
GRAD_CLIP = 1.0
SWAPPED_STATES = 0.5  # the share of samples that get another's state, so that it does not give the action away
# Below it two threads wait for each other longer than they compute: 40 times slower on a busy machine.
SMALL_DIM = 256
STANDING_THROTTLE = 0.01  # below it the car stands, which no frame shows: these states are never swapped


@dataclass(frozen=True)
class Recipe:
    """How long and how fast each phase trains. samples: how many of the recordings' are used at most."""

    backbone_steps: int
    transformer_steps: int
    together_steps: int
    batch: int
    transformer_batch: int
    samples: int
    backbone_rate: float = 1e-3
    transformer_rate: float = 5e-4

    def of_steps(self, steps: int) -> Recipe:
        """The same recipe with that many steps in all, at least one in each phase."""
        planned = self.backbone_steps, self.transformer_steps, self.together_steps
        backbone, transformer, together = (max(1, round(steps * p / sum(planned))) for p in planned)
        # few steps cannot use many frames
        samples = min(self.samples, max(4 * self.batch, steps * self.batch))
        return Recipe(**{
            **asdict(self),
            "backbone_steps": backbone,
            "transformer_steps": transformer,
            "together_steps": together,
            "samples": samples,
        })  # fmt: skip


SIZES = {
    "small": ActConfig(
        image_sizes=((72, 128),), dim=128, heads=4, feedforward=512, encoder_layers=1, decoder_layers=1, vae_layers=1
    ),
    "full": ActConfig(),
}
RECIPES = {
    ("small", "cpu"): Recipe(300, 900, 60, batch=16, transformer_batch=16, samples=4000),
    ("small", "cuda"): Recipe(300, 900, 60, batch=16, transformer_batch=16, samples=4000),
    # a processor can only show that it runs: minutes for these few steps
    ("full", "cpu"): Recipe(20, 30, 10, batch=2, transformer_batch=2, samples=100, transformer_rate=1e-4),
    ("full", "cuda"): Recipe(1500, 4000, 500, batch=16, transformer_batch=16, samples=4000, transformer_rate=1e-4),
}


@dataclass
class Frames:
    """Samples in memory, aligned by row.

    images: (n, height, width, 3) uint8 RGB. states: (n, 2) and chunks: (n, chunk, 2) float32.
    is_pad: (n, chunk) bool, true where the drive had ended.
    """

    images: np.ndarray
    states: np.ndarray
    chunks: np.ndarray
    is_pad: np.ndarray

    def __len__(self) -> int:
        return len(self.images)


def train(
    episodes_dir: Path | str,
    out_path: Path | str,
    size: str = "small",
    seed: int = 0,
    steps: int | None = None,
    device: str | None = None,
    progress: Progress = silent,
) -> Path:
    """Train a policy on recordings and write its checkpoint in the format of the user's trainer.

    size: 'small' (72x128, minutes on two cores) or 'full' (the user's policy, 360x640).
    steps: optimiser steps of all three phases together; the recipe's when left out.
    device: 'cpu', 'cuda' or None for the best there is.
    The calibration part of params.yml's split is trained on, the choosing part gives best_val_loss, and the
    held-out part is left alone, so that it may judge later.
    Returns out_path, which appears complete or not at all. The same input gives the same weights on one
    machine; a checkpoint that was made before is taken from the cache.
    Raises WorldError for an unknown size, device or steps, EpisodeError for recordings that cannot be used.
    """
    out_path, episodes_dir = Path(out_path), Path(episodes_dir)
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    if size not in SIZES:
        raise WorldError(f"a policy's size must be one of {', '.join(SIZES)}", found=repr(size))
    if device not in ("cpu", "cuda") or (device == "cuda" and not torch.cuda.is_available()):
        raise WorldError("device must be cpu, or cuda where torch finds one", found=repr(device), remedy="leave it out")
    if (steps is not None and steps < 1) or seed < 0:
        raise WorldError("training needs at least 1 step and a seed from 0", found=f"{steps} and {seed}")
    recipe = RECIPES[size, device]
    if steps is not None:
        recipe = recipe.of_steps(steps)
    made_of = {
        "size": asdict(SIZES[size]),
        "recipe": asdict(recipe),
        "seed": seed,
        "device": device,
        "versions": [version(name) for name in ("torch", "lerobot", "torchvision", "numpy")],
        "episodes": {p.relative_to(episodes_dir).as_posix(): sha256_of(p) for p in _files(episodes_dir)},
        "split": params()["calibration"],
        "names": [episodes_dir.name, out_path.parent.name],
    }
    key = key_of(made_of, sys.modules[__name__], preprocess, act_module, episodes_module)

    def make(folder: Path) -> None:
        checkpoint = _train(episodes_dir, out_path, SIZES[size], recipe, seed, torch.device(device), progress)
        torch.save(checkpoint, folder / "best_model.pth")

    made = cached_folder("checkpoint", key, make) / "best_model.pth"
    with atomic_path(out_path) as temporary:
        shutil.copyfile(made, temporary)
    return out_path


def make_checkpoint(
    out_path: Path | str,
    size: str = "full",
    episodes_dir: Path | str | None = None,
    seed: int = 0,
    steps: int = 12,
    progress: Progress = silent,
) -> Path:
    """A checkpoint of a few steps: real in format, size and ranges, but it cannot drive.

    episodes_dir: trained on these; without it, on three drives of the expert that are recorded for it.
    """
    if episodes_dir is None:

        def make(folder: Path) -> None:
            for index in range(3):
                record.record_drive(folder, index, seed)

        key = key_of({"seed": seed, "drives": 3}, record, episodes_module)
        episodes_dir = cached_folder("drives", key, make)
    return train(episodes_dir, out_path, size, seed, steps, progress=progress)


def _files(episodes_dir: Path) -> list[Path]:
    """All files of the recordings, hidden ones left out."""
    return sorted(p for p in episodes_dir.rglob("*") if p.is_file() and not p.name.startswith("."))


@dataclass(frozen=True)
class _Training:
    """What every phase works with."""

    size: ActConfig
    policy: ACTPolicy
    data: Frames
    recipe: Recipe
    loss_weights: Tensor  # (2,), on the device that is trained on
    rng: np.random.Generator
    progress: Progress

    def rows(self, batch: int) -> np.ndarray:
        return self.rng.choice(len(self.data), min(batch, len(self.data)), replace=False)

    def batch(self) -> dict[str, Tensor]:
        """The next one of frames."""
        return _batch(self.data, self.rows(self.recipe.batch), self.rng, self.loss_weights.device)

    def steps(self, count: int, desc: str) -> Iterable[int]:
        return self.progress(range(count), desc=desc, total=count)


def _train(
    episodes_dir: Path,
    out_path: Path,
    size: ActConfig,
    recipe: Recipe,
    seed: int,
    device: torch.device,
    progress: Progress,
) -> dict[str, Any]:
    p = params()["calibration"]
    recordings = load_recordings(episodes_dir, size.chunk, p["sync_s"], progress)
    parts = split(recordings, p["held_out_share"], p["seed"])
    rng = np.random.default_rng([seed, 77])
    data = _load(parts.calibration, recipe.samples, size, "reading frames", progress)
    held_out = _load(parts.choosing, max(8, recipe.samples // 8), size, "reading held-out frames", progress)
    # errors count in units of what was recorded: throttle's whole range is a tenth of steering's
    recorded = data.chunks[~data.is_pad]
    spread = np.maximum(recorded.std(axis=0), 1e-3)
    loss_weights = torch.from_numpy(1 / spread).to(device)

    with _seeded(seed):
        policy = lerobot_act(size)
        with torch.no_grad():  # starts at the mean action, give or take: a fresh head plans wild ones
            policy.model.action_head.weight.mul_(torch.from_numpy(spread)[:, None])
            policy.model.action_head.bias.copy_(torch.from_numpy(recorded.mean(axis=0)))
        policy.to(device)
        training = _Training(size, policy, data, recipe, loss_weights, rng, progress)
        _train_backbone(training)
        _train_transformer(training)
        optimizer, scheduler = _train_together(training)
    return {
        "epoch": recipe.together_steps,
        "model_state_dict": {k: v.cpu() for k, v in policy.state_dict().items()},
        "optimizer_state_dict": _to_cpu(optimizer.state_dict()),
        "scheduler_state_dict": scheduler.state_dict(),
        "best_val_loss": np.mean(_losses(policy, held_out, recipe.batch)),
        "config": _config(size, recipe, seed, device, episodes_dir, out_path),
    }


def _config(
    size: ActConfig, recipe: Recipe, seed: int, device: torch.device, episodes_dir: Path, out_path: Path
) -> dict[str, Any]:
    """The trainer's plain dict, key for key. Folders by name only: a checkpoint is shown to others."""
    ((height, width),) = size.image_sizes
    return {
        "image_width": width,
        "image_height": height,
        "n_obs_steps": 1,
        "chunk_size": size.chunk,
        "n_action_steps": size.chunk,
        "hidden_size": size.dim,
        "n_encoder_layers": size.encoder_layers,
        "n_decoder_layers": size.decoder_layers,
        "n_heads": size.heads,
        "feedforward_dim": size.feedforward,
        "dropout": DROPOUT,
        "kl_weight": KL_WEIGHT,
        "vision_encoder": size.backbone,
        "pretrained_backbone": True,  # as the trainer writes it, whatever the weights came from
        "learning_rate": recipe.transformer_rate,
        "weight_decay": WEIGHT_DECAY,
        "betas": BETAS,
        "grad_clip": GRAD_CLIP,
        "num_epochs": 1,
        "batch_size": recipe.batch,
        "train_split": 0.75,
        "data_dir": episodes_dir.name,
        "output_dir": out_path.parent.name,
        "device": device.type,
        "seed": seed,
        "log_freq": 1,
        "save_freq": 1,
        "num_workers": 0,
    }


def _load(samples: tuple[Sample, ...], most: int, size: ActConfig, desc: str, progress: Progress) -> Frames:
    """At most `most` samples, evenly over all drives, with their frames at the policy's size."""
    if len(samples) > most:
        samples = tuple(samples[i] for i in np.linspace(0, len(samples) - 1, most).round().astype(int))
    images = []
    for sample in progress(samples, desc=desc, total=len(samples)):
        images.append(prepare_frame(sample.frame_bgr(), *size.image_sizes[0]))
    return Frames(
        np.stack(images),
        np.stack([s.state for s in samples]).astype(np.float32),
        np.stack([s.chunk for s in samples]).astype(np.float32),
        np.stack([s.is_pad for s in samples]),
    )


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """torch's random numbers follow from the seed inside, and are as before outside."""
    devices = list(range(torch.cuda.device_count()))
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(seed)
        yield


def _batch(data: Frames, rows: np.ndarray, rng: np.random.Generator, device: torch.device) -> dict[str, Tensor]:
    """What the policy trains on: light changed, half of the drives mirrored, half of the states swapped."""
    flipped = rng.random(len(rows)) < 0.5
    images, states, chunks = data.images[rows], _swapped_states(data, rows, rng), data.chunks[rows].copy()
    images[flipped] = images[flipped, :, ::-1]
    states[flipped, 0] *= -1
    chunks[flipped, :, 0] *= -1
    gain = rng.uniform(0.8, 1.25, (len(rows), 1, 1, 1)).astype(np.float32)
    return {
        IMAGE: torch.from_numpy(normalise(np.minimum(images * gain, 255))).to(device),
        STATE: torch.from_numpy(states).to(device),
        ACTION: torch.from_numpy(chunks).to(device),
        IS_PAD: torch.from_numpy(data.is_pad[rows]).to(device),
    }


def _swapped_states(data: Frames, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    states = data.states[rows].copy()
    moving = np.flatnonzero(data.states[:, 1] >= STANDING_THROTTLE)
    if len(moving):
        swap = (rng.random(len(rows)) < SWAPPED_STATES) & (states[:, 1] >= STANDING_THROTTLE)
        states[swap] = data.states[rng.choice(moving, swap.sum())]
    return states


def _error(predicted: Tensor, batch: dict[str, Tensor], loss_weights: Tensor) -> Tensor:
    """Mean absolute error of the actions that were recorded, each in its own unit."""
    recorded = ~batch[IS_PAD][..., None]
    error = (predicted - batch[ACTION]).abs() * loss_weights * recorded
    return error.sum() / (recorded.sum() * loss_weights.numel())


def _optimiser(
    parameters: Iterable[nn.Parameter], rate: float, steps: int
) -> tuple[torch.optim.AdamW, torch.optim.lr_scheduler.LRScheduler]:
    optimizer = torch.optim.AdamW(parameters, lr=rate, betas=BETAS, weight_decay=WEIGHT_DECAY)
    warmup = max(1, steps // 20)

    def share(step: int) -> float:
        return min(1.0, (step + 1) / warmup) * (0.01 + 0.99 * (1 + math.cos(math.pi * min(1, step / steps))) / 2)

    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, share)
    return optimizer, scheduler


def _descend(loss: Tensor, module: nn.Module, optimizer: torch.optim.Optimizer, scheduler: Any) -> None:
    if not torch.isfinite(loss):
        raise WorldError(f"training went wrong: the loss is {loss.item()}", remedy="try another seed")
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(module.parameters(), GRAD_CLIP)
    optimizer.step()
    scheduler.step()


class _ChunkFromFeatures(nn.Module):
    """The throw-away head of the first phase: feature map to chunk, position by position."""

    def __init__(self, backbone: nn.Module, size: ActConfig, features: int = 512, width_after: int = 32):
        super().__init__()
        self.backbone, self.chunk = backbone, size.chunk
        ((height, width),) = size.image_sizes
        convolution = nn.Conv2d(features, width_after, 1)
        last = nn.Linear(width_after * -(-height // size.stride) * -(-width // size.stride), 2 * size.chunk)
        nn.init.zeros_(last.weight)  # from "no action": actions are small, and an untrained head's are not
        nn.init.zeros_(last.bias)
        self.head = nn.Sequential(convolution, nn.ReLU(), nn.Flatten(), last)

    def forward(self, image: Tensor) -> Tensor:
        return self.head(self.backbone(image)["feature_map"]).unflatten(1, (self.chunk, 2))


def _train_backbone(training: _Training) -> None:
    """Phase one: live batch norm; its statistics, measured on the data, become the frozen ones."""
    recipe, data = training.recipe, training.data
    import torchvision

    resnet = torchvision.models.resnet18(weights=None)
    live = torchvision.models._utils.IntermediateLayerGetter(resnet, {"layer4": "feature_map"})
    model = _ChunkFromFeatures(live, training.size).to(training.loss_weights.device).train()
    optimizer, scheduler = _optimiser(model.parameters(), recipe.backbone_rate, recipe.backbone_steps)
    for _ in training.steps(recipe.backbone_steps, "training the backbone"):
        batch = training.batch()
        _descend(_error(model(batch[IMAGE]), batch, training.loss_weights), model, optimizer, scheduler)

    norms = [m for m in live.modules() if isinstance(m, nn.BatchNorm2d)]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a plain mean over the batches below
    with torch.no_grad():
        for _ in range(16 if len(data) >= 16 * recipe.batch else 4):
            live(training.batch()[IMAGE])
    weights = {k: v for k, v in live.state_dict().items() if not k.endswith("num_batches_tracked")}
    training.policy.model.backbone.load_state_dict(weights)


class _Given(nn.Module):
    """Stands in for the backbone while the transformer trains: its 'image' is the feature map already."""

    def forward(self, features: Tensor) -> dict[str, Tensor]:
        return {"feature_map": features}


def _train_transformer(training: _Training) -> None:
    """Phase two: all but the backbone, on features computed once, of each frame as it is and mirrored."""
    policy, data, batch = training.policy, training.data, training.recipe.batch
    device = training.loss_weights.device
    backbone = policy.model.backbone.eval()
    views = {}
    for name in ("plain", "mirrored"):
        maps = []
        with torch.no_grad():
            firsts = range(0, len(data), batch)
            for first in training.progress(firsts, desc=f"computing features, {name}", total=len(firsts)):
                images = data.images[first : first + batch]
                images = images[:, :, ::-1] if name == "mirrored" else images
                maps.append(backbone(torch.from_numpy(normalise(images)).to(device))["feature_map"].cpu())
        views[name] = torch.cat(maps)
    policy.model.backbone = _Given()
    policy.train()
    with _threads(1 if policy.config.dim_model < SMALL_DIM else torch.get_num_threads()):
        _transformer_steps(training, views)
    policy.model.backbone = backbone


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _transformer_steps(training: _Training, views: dict[str, Tensor]) -> None:
    policy, data, recipe = training.policy, training.data, training.recipe
    device = training.loss_weights.device
    parameters = [p for p in policy.parameters() if p.requires_grad]
    optimizer, scheduler = _optimiser(parameters, recipe.transformer_rate, recipe.transformer_steps)
    for step in training.steps(recipe.transformer_steps, "training the transformer"):
        rows = training.rows(recipe.transformer_batch)
        states, chunks = _swapped_states(data, rows, training.rng), data.chunks[rows].copy()
        if step % 2:
            states[:, 0] *= -1
            chunks[:, :, 0] *= -1
        batch = {
            IMAGE: views["mirrored" if step % 2 else "plain"][rows].to(device),
            STATE: torch.from_numpy(states).to(device),
            ACTION: torch.from_numpy(chunks).to(device),
            IS_PAD: torch.from_numpy(data.is_pad[rows]).to(device),
        }
        _descend(_policy_loss(policy, batch, training.loss_weights), policy, optimizer, scheduler)


def _policy_loss(policy: ACTPolicy, batch: dict[str, Tensor], loss_weights: Tensor) -> Tensor:
    """ACT's loss, as LeRobot's forward has it, with each action in its own unit."""
    actions, (mean, log_variance) = policy.model({**batch, "observation.images": [batch[IMAGE]]})
    divergence = -0.5 * (1 + log_variance - mean.pow(2) - log_variance.exp()).sum(-1).mean()
    return _error(actions, batch, loss_weights) + KL_WEIGHT * divergence


def _train_together(training: _Training) -> tuple[torch.optim.Optimizer, Any]:
    """Phase three: all parameters, at a tenth of the rate. Returns what the checkpoint keeps of it."""
    policy, recipe = training.policy, training.recipe
    policy.train()
    optimizer, scheduler = _optimiser(policy.parameters(), recipe.transformer_rate / 10, recipe.together_steps)
    for _ in training.steps(recipe.together_steps, "training all together"):
        loss = _policy_loss(policy, training.batch(), training.loss_weights)
        _descend(loss, policy, optimizer, scheduler)
    return optimizer, scheduler


def _losses(policy: ACTPolicy, data: Frames, batch: int) -> list[float]:
    """Mean absolute error per batch, in action units, of what the policy would drive (no latent sampled)."""
    policy.eval()
    device = next(policy.parameters()).device
    losses = []
    for first in range(0, len(data), batch):
        rows = slice(first, first + batch)
        chunks = policy.predict_action_chunk(
            {
                IMAGE: torch.from_numpy(normalise(data.images[rows])).to(device),
                STATE: torch.from_numpy(data.states[rows]).to(device),
            }
        )
        error = np.abs(chunks.cpu().numpy() - data.chunks[rows])[~data.is_pad[rows]]
        losses.append(float(error.mean()))
    return losses


def _to_cpu(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.cpu()
    if isinstance(value, dict):
        return {k: _to_cpu(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_to_cpu(v) for v in value)
    return value
