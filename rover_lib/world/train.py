"""Train LeRobot's own ACTPolicy on recordings; write a checkpoint as the user's trainer writes it.

From scratch, without downloads, a ResNet with frozen batch norm learns nothing. So there are three phases:
the backbone alone with live batch norm, predicting the chunk; the transformer on the frozen backbone's
features, computed once; then all together at a tenth of the rate.
"""

import shutil
import sys
from collections.abc import Iterator
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
from rover_lib.onboard.preprocess import normalise
from rover_lib.onboard.stage import atomic_path, sha256_of
from rover_lib.workshop import act as act_module
from rover_lib.workshop import episodes as episodes_module
from rover_lib.workshop import training as training_module
from rover_lib.workshop.act import ActConfig, lerobot_act
from rover_lib.workshop.cache import cache_root, cached_folder, key_of
from rover_lib.workshop.compare import thinned
from rover_lib.workshop.episodes import load_recordings, split
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.training import (
    ACTION,
    IMAGE,
    IS_PAD,
    STATE,
    Frames,
    Given,
    Resumable,
    RowFile,
    batch_of,
    descend,
    error_of,
    frames_of,
    in_memory,
    losses_of,
    optimiser,
    policy_loss,
    recorded_spread,
    seeded,
    swapped_states,
    threads,
    to_cpu,
    trainer_config,
)
from rover_lib.world import record

if TYPE_CHECKING:
    from lerobot.policies.act.modeling_act import ACTPolicy

# Below it two threads wait for each other longer than they compute: 40 times slower on a busy machine.
SMALL_DIM = 256


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

    def of_steps(self, steps: int) -> "Recipe":
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
    machine, also when it was ended at any moment and started again: it goes on where it was. A checkpoint that was
    made before is taken from the cache.
    Raises WorldError for an unknown size, device or steps, EpisodeError for recordings that cannot be used,
    TrainingError if another process trains the same.
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
    key = key_of(made_of, sys.modules[__name__], training_module, preprocess, act_module, episodes_module)
    unfinished = cache_root() / f"training-{key}"

    def make(folder: Path) -> None:
        with Resumable(unfinished, progress) as saved:
            trained = _train(episodes_dir, SIZES[size], recipe, seed, torch.device(device), saved)
            config = trainer_config(
                SIZES[size],
                learning_rate=recipe.transformer_rate,
                batch_size=recipe.batch,
                data_dir=episodes_dir.name,
                output_dir=out_path.parent.name,
                device=device,
                seed=seed,
            )
            torch.save({**trained, "config": config}, folder / "best_model.pth")

    made = cached_folder("checkpoint", key, make) / "best_model.pth"
    shutil.rmtree(unfinished, ignore_errors=True)
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
    policy: "ACTPolicy"
    data: Frames
    recipe: Recipe
    loss_weights: Tensor  # (2,), on the device that is trained on
    rng: np.random.Generator
    saved: Resumable

    @property
    def device(self) -> torch.device:
        return self.loss_weights.device

    def rows(self, batch: int) -> np.ndarray:
        return self.rng.choice(len(self.data), min(batch, len(self.data)), replace=False)

    def batch(self) -> dict[str, Tensor]:
        """The next one of frames."""
        return batch_of(self.data, self.rows(self.recipe.batch), self.rng, self.device)

    def steps(self, phase: str, count: int, **parts: Any) -> Iterator[int]:
        return self.saved.steps(phase, count, self.rng, **parts)


def _train(
    episodes_dir: Path, size: ActConfig, recipe: Recipe, seed: int, device: torch.device, saved: Resumable
) -> dict[str, Any]:
    """All of the checkpoint but its config."""
    p = params()["calibration"]
    recordings = load_recordings(episodes_dir, size.chunk, p["sync_s"], saved.progress)
    parts = split(recordings, p["held_out_share"], p["seed"])
    rng = np.random.default_rng([seed, 77])
    data = frames_of(thinned(parts.calibration, recipe.samples), *size.image_sizes[0])
    data = in_memory(data, "reading frames", saved.progress)
    held_out = frames_of(thinned(parts.choosing, max(8, recipe.samples // 8)), *size.image_sizes[0])
    spread = recorded_spread(data)
    loss_weights = torch.from_numpy(1 / spread).to(device)

    with seeded(seed):
        policy = lerobot_act(size)
        with torch.no_grad():  # starts at the mean action, give or take: a fresh head plans wild ones
            policy.model.action_head.weight.mul_(torch.from_numpy(spread)[:, None])
            policy.model.action_head.bias.copy_(torch.from_numpy(data.chunks[~data.is_pad].mean(axis=0)))
        policy.to(device)
        training = _Training(size, policy, data, recipe, loss_weights, rng, saved)
        _train_backbone(training)
        _train_transformer(training)
        optimizer, scheduler = _train_together(training)
    return {
        "epoch": recipe.together_steps,
        "model_state_dict": {k: v.cpu() for k, v in policy.state_dict().items()},
        "optimizer_state_dict": to_cpu(optimizer.state_dict()),
        "scheduler_state_dict": scheduler.state_dict(),
        "best_val_loss": np.mean(losses_of(policy, held_out, recipe.batch)),
    }


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
    model = _ChunkFromFeatures(live, training.size).to(training.device).train()
    optimizer, scheduler = optimiser(model.parameters(), recipe.backbone_rate, recipe.backbone_steps)
    parts = {"model": model, "optimizer": optimizer, "scheduler": scheduler}
    for _ in training.steps("backbone", recipe.backbone_steps, **parts):
        batch = training.batch()
        loss = error_of(model(batch[IMAGE]), batch, training.loss_weights)
        training.saved.losses["backbone"].append(descend(loss, model, optimizer, scheduler))

    norms = [m for m in live.modules() if isinstance(m, nn.BatchNorm2d)]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a plain mean over the batches below
    batches = 16 if len(data) >= 16 * recipe.batch else 4
    for _ in training.steps("statistics", batches, backbone=live):
        with torch.no_grad():
            live(training.batch()[IMAGE])
    weights = {k: v for k, v in live.state_dict().items() if not k.endswith("num_batches_tracked")}
    training.policy.model.backbone.load_state_dict(weights)


def _train_transformer(training: _Training) -> None:
    """Phase two: all but the backbone, on features computed once, of each frame as it is and mirrored."""
    policy, backbone = training.policy, training.policy.model.backbone.eval()
    views = {name: _features(training, name, backbone) for name in ("plain", "mirrored")}
    policy.model.backbone = Given()
    policy.train()
    with threads(1 if policy.config.dim_model < SMALL_DIM else torch.get_num_threads()):
        _transformer_steps(training, views)
    policy.model.backbone = backbone


def _features(training: _Training, view: str, backbone: nn.Module) -> RowFile:
    """The frozen backbone's feature map of every frame, on disk."""
    data, batch = training.data, training.recipe.batch
    height, width = data.images[:1].shape[1:3]
    stride = training.size.stride
    channels = training.policy.model.encoder_img_feat_input_proj.in_channels
    rows = RowFile(training.saved.folder / f"{view}.rows", (channels, -(-height // stride), -(-width // stride)))
    for step in training.steps(f"features, {view}", -(-len(data) // batch), rows=rows):
        images = data.images[step * batch : (step + 1) * batch]
        images = images[:, :, ::-1] if view == "mirrored" else images
        with torch.no_grad():
            rows.append(backbone(torch.from_numpy(normalise(images)).to(training.device))["feature_map"].cpu())
    return rows


def _transformer_steps(training: _Training, views: dict[str, RowFile]) -> None:
    policy, data, recipe = training.policy, training.data, training.recipe
    parameters = [p for p in policy.parameters() if p.requires_grad]
    optimizer, scheduler = optimiser(parameters, recipe.transformer_rate, recipe.transformer_steps)
    parts = {"policy": policy, "optimizer": optimizer, "scheduler": scheduler}
    for step in training.steps("transformer", recipe.transformer_steps, **parts):
        rows = training.rows(recipe.transformer_batch)
        states, chunks = swapped_states(data, rows, training.rng), data.chunks[rows].copy()
        if step % 2:
            states[:, 0] *= -1
            chunks[:, :, 0] *= -1
        batch = {
            IMAGE: torch.from_numpy(views["mirrored" if step % 2 else "plain"][rows]).to(training.device),
            STATE: torch.from_numpy(states).to(training.device),
            ACTION: torch.from_numpy(chunks).to(training.device),
            IS_PAD: torch.from_numpy(data.is_pad[rows]).to(training.device),
        }
        loss = policy_loss(policy, batch, training.loss_weights)
        training.saved.losses["transformer"].append(descend(loss, policy, optimizer, scheduler))


def _train_together(training: _Training) -> tuple[torch.optim.Optimizer, Any]:
    """Phase three: all parameters, at a tenth of the rate. Returns what the checkpoint keeps of it."""
    policy, recipe = training.policy, training.recipe
    policy.train()
    optimizer, scheduler = optimiser(policy.parameters(), recipe.transformer_rate / 10, recipe.together_steps)
    parts = {"policy": policy, "optimizer": optimizer, "scheduler": scheduler}
    for _ in training.steps("all together", recipe.together_steps, **parts):
        loss = policy_loss(policy, training.batch(), training.loss_weights)
        training.saved.losses["all together"].append(descend(loss, policy, optimizer, scheduler))
    return optimizer, scheduler
