"""Train LeRobot's own ACTPolicy on recordings, and write a checkpoint in the format of the user's trainer.

    train("episodes", "best_model.pth")

Nothing is downloaded, so the ResNet starts from random weights, and with frozen batch norm it would learn nothing. So
there are three phases: the backbone alone, with live batch norm, learns to predict the chunk; then the transformer
learns on the frozen backbone's features, which are computed once; then both learn together at a tenth of the rate.

ACT's position codes are relative to the picture, and no weight depends on the picture's size. So the real car's policy
goes through these phases at a quarter of its pixels, which takes a quarter of the time, and a few more steps at its own
size carry it there.

Few recordings are soon learned by heart. So while the transformer learns, episodes that it does not learn from are held
against it again and again, and the best weights are kept. Recordings whose pictures are mirrored beside the others' are
turned over.
"""

import math
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from rover_learn import training as training_module
from rover_learn.training import (
    ACTION,
    IMAGE,
    IS_PAD,
    STATE,
    Frames,
    Given,
    Resumable,
    RowFile,
    batch_of,
    driving_error,
    error_of,
    frames_of,
    in_memory,
    optimiser,
    policy_loss,
    recorded_spread,
    seed_inside,
    swap_states,
    threads,
    to_cpu,
)
from rover_lib.onboard.errors import EpisodeError, TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.onboard.policy.preprocess import normalise
from rover_lib.onboard.stage import atomic_path
from rover_lib.workshop import act as act_module
from rover_lib.workshop.act import ActConfig, lerobot_act
from rover_lib.workshop.cache import cache_folder, cache_root, key_of
from rover_lib.workshop.checkpoint.files import save_torch, trainer_config
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings import episodes as episodes_module
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.lerobot_dataset import lerobot_train
from rover_lib.workshop.recordings.samples import (
    ACTION_NAMES,
    Recordings,
    Source,
    car_of,
    frame_rate_hz,
    is_another_rate,
    pick_evenly,
)
from rover_lib.workshop.recordings.turning import measure_sides
from rover_lib.workshop.run.session import training_device

if TYPE_CHECKING:
    from lerobot.policies.act.modeling_act import ACTPolicy

# Below this width, two threads wait for each other longer than they compute: 40 times slower on a busy machine.
SMALL_DIM = 256
RESNET18_MACS = 37e3  # multiply-accumulates per pixel of the picture
PLANNED_HZ = 30.0  # of the user's trainer
JUDGE_EVERY, PATIENCE = 50, 8  # steps of the transformer; judgements without a better one, after which it stops


@dataclass(frozen=True)
class TrainingRecipe:
    """How long and how fast each phase trains.

    *_rate: the learning rates. samples: how many of the recordings' samples are used at most; feature_samples: how many
    of these train the transformer. judged: how many other samples give best_val_loss. at: (height, width) of the
    pictures in all three phases; then `carry_steps` follow at the policy's own size. None: its own size from the start.
    """

    backbone_steps: int
    transformer_steps: int
    together_steps: int
    batch: int
    transformer_batch: int
    together_batch: int
    samples: int
    feature_samples: int
    judged: int
    backbone_rate: float = 1e-3
    transformer_rate: float = 5e-4
    transformer_warmup: int = 0  # in steps; 0 stands for a twentieth of transformer_steps
    at: tuple[int, int] | None = None
    carry_steps: int = 0

    def of_steps(self, steps: int) -> "TrainingRecipe":
        """Return the same recipe with `steps` steps in all, and at least one in each phase that it has."""
        names = "backbone_steps", "transformer_steps", "together_steps", "carry_steps"
        planned = {name: getattr(self, name) for name in names if getattr(self, name)}
        shorter = {name: max(1, round(steps * n / sum(planned.values()))) for name, n in planned.items()}
        # So few steps only show that training works, so a few frames are enough for each.
        sizes = "batch", "transformer_batch", "together_batch"
        batches = {name: min(getattr(self, name), max(2, steps // 8)) for name in sizes}
        samples = min(self.samples, max(4 * self.batch, steps * self.batch))
        features = min(self.feature_samples, steps * batches["transformer_batch"])
        judged = min(self.judged, max(8, steps))
        counts: dict[str, Any] = {**shorter, **batches}
        return replace(self, **counts, samples=samples, feature_samples=features, judged=judged, transformer_warmup=0)


SIZES = {
    "small": ActConfig(
        image_sizes=((72, 128),), dim=128, heads=4, feedforward=512, encoder_layers=1, decoder_layers=1, vae_layers=1
    ),
    "full": ActConfig(),
}
SMALL = TrainingRecipe(200, 600, 40, 16, 16, 16, samples=4000, feature_samples=2400, judged=500)
FULL = TrainingRecipe(
    *(200, 250, 20),
    *(32, 32, 8),
    samples=100_000,
    feature_samples=2400,
    judged=96,
    transformer_rate=2e-4,
    transformer_warmup=75,
    at=(180, 320),
    carry_steps=30,
)
FULL_GPU = replace(
    FULL,
    backbone_steps=1000,
    transformer_steps=3000,
    transformer_warmup=300,
    together_steps=200,
    together_batch=16,
    carry_steps=200,
    feature_samples=6000,
    judged=500,
)
RECIPES = {
    ("small", "cpu"): SMALL,
    ("small", "cuda"): SMALL,
    ("full", "cpu"): FULL,
    ("full", "cuda"): FULL_GPU,
}
# A cached checkpoint that takes minutes is made anew after each change of the code that makes it. One that takes an
# hour or more is made anew only when this number is raised. Raise it when you change what the same recipe results in.
FULL_VERSION = 1


def train(
    episodes: Path | str | Source,
    out_path: Path | str,
    size: str = "small",
    seed: int = 0,
    steps: int | None = None,
    device: str | None = None,
    progress: Progress = silent,
) -> Path:
    """Train a policy on recordings and write its checkpoint in the format of the user's trainer.

    size: 'small' (72x128, minutes on two cores) or 'full' (the user's policy, 360x640).
    steps: optimiser steps of all phases together; those of the recipe when left out.
    device: 'cpu', 'cuda', or None for cuda where torch finds it and cpu elsewhere.
    The calibration part of params.yml's split trains the policy, the choosing part gives best_val_loss, and the
    held-out part is left alone, so that it can judge the policy later.
    Returns out_path, which appears complete or not at all. On one machine the same input gives the same weights, even
    if training was ended at any moment and started again, as it goes on where it was. A checkpoint that was made before
    is taken from the cache.
    episodes: our recordings of one car, or a LeRobotDataset of steering, throttle and one camera. The plans have their
    rate: 30 steps a second if that is within a fifth of it.
    Raises TrainingError for a size, device, steps or seed that it cannot use, and if another process trains the same,
    and EpisodeError for recordings that cannot be used.
    """
    out_path, source = Path(out_path), Source.of(episodes)
    device = training_device(device, TrainingError).type
    if size not in SIZES:
        raise TrainingError(f"a policy's size must be one of {', '.join(SIZES)}", found=repr(size))
    if (steps is not None and steps < 1) or seed < 0:
        raise TrainingError("training needs at least 1 step and a seed from 0", found=f"{steps} and {seed}")
    recipe = RECIPES[size, device]
    if steps is not None:
        recipe = recipe.of_steps(steps)
    p = params()["calibration"]
    recordings = load_recordings(source, SIZES[size].chunk, p["sync_s"], progress)
    rate_hz = _rate_hz(recordings)
    made_of = {
        "size": asdict(SIZES[size]),
        "recipe": asdict(recipe),
        "seed": seed,
        "device": device,
        "versions": [version(name) for name in ("torch", "lerobot", "torchvision", "numpy")],
        "episodes": recordings.hashes(),
        "rate_hz": rate_hz,
        "split": p,
        "version": FULL_VERSION,
    }
    sources = sys.modules[__name__], training_module, preprocess, act_module, episodes_module
    key = key_of(made_of, *(() if size == "full" and steps is None else sources))
    unfinished = cache_root() / f"training-{key}"

    def make(folder: Path) -> None:
        with Resumable(unfinished, progress) as saved:
            trained = _train(_turned(recordings, progress), SIZES[size], recipe, seed, torch.device(device), saved)
            config = trainer_config(
                SIZES[size],
                learning_rate=recipe.transformer_rate,
                batch_size=recipe.batch,
                data_dir="episodes",
                output_dir="checkpoints",
                device=device,
                seed=seed,
                rate_hz=int(rate_hz),
            )
            # It must be on the disk before the unfinished training, which it comes from, is removed.
            save_torch(folder / "best_model.pth", {**trained, "config": config})

    made = cache_folder("checkpoint", key, make) / "best_model.pth"
    shutil.rmtree(unfinished, ignore_errors=True)
    with atomic_path(out_path) as temporary:
        shutil.copyfile(made, temporary)
    return out_path


def _rate_hz(recordings: Recordings) -> float:
    """Return the steps per second of plans. Raises EpisodeError for recordings that this training is not for."""
    layout = recordings.layout
    car_of(recordings.samples)
    if layout.action_names != ACTION_NAMES or layout.state_names != ACTION_NAMES or len(layout.cameras) != 1:
        raise EpisodeError(
            f"{recordings.root}: rover train is for cars of steering and throttle with one camera",
            found=layout.words(),
            remedy=f"name them, as in --action-names steering,throttle, or: {lerobot_train(recordings.root)}",
        )
    rates = [found for e in recordings.episodes if (found := frame_rate_hz(e.samples)) is not None]
    found_hz = layout.rate_hz or (float(np.median(rates)) if rates else PLANNED_HZ)
    return float(round(found_hz)) if layout.rate_hz or is_another_rate(found_hz, PLANNED_HZ) else PLANNED_HZ


def _turned(recordings: Recordings, progress: Progress) -> Recordings:
    """Return the recordings with the pictures of those that are mirrored beside most others turned over."""
    mirrored = measure_sides(recordings, progress).mirrored
    return replace(
        recordings,
        episodes=tuple(
            replace(e, samples=tuple(replace(s, mirrored=True) for s in e.samples)) if e.id in mirrored else e
            for e in recordings.episodes
        ),
    )


@dataclass
class _Best:
    """The best weights so far, by their error on other episodes. A part of a training's saved state.

    stale: how often they were not beaten since.
    """

    error: float = math.inf
    stale: int = 0
    weights: dict[str, Tensor] = field(default_factory=dict)

    def see(self, error: float, module: nn.Module) -> None:
        self.stale += 1
        if error < self.error:
            weights = {k: v.detach().clone() for k, v in module.state_dict().items()}
            self.error, self.stale, self.weights = error, 0, weights

    def state_dict(self) -> dict[str, Any]:
        return dict(vars(self))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        vars(self).update(state)


@dataclass(frozen=True)
class _Training:
    """What every phase works with. plan: the number of steps and the cost of a step of each phase; see `_plan`."""

    size: ActConfig  # with the pictures' size in the three phases; the policy's own may be larger
    policy: "ACTPolicy"
    data: Frames
    judges: Frames  # of other episodes
    recipe: TrainingRecipe
    loss_weights: Tensor  # (2,), on the device where training takes place
    rng: np.random.Generator
    saved: Resumable
    plan: dict[str, tuple[int, int]]

    @property
    def device(self) -> torch.device:
        return self.loss_weights.device

    def rows(self, batch: int, of: int) -> np.ndarray:
        """Draw `batch` of the numbers below `of`, each at most once."""
        return self.rng.choice(of, min(batch, of), replace=False)

    def batch(self, count: int) -> dict[str, Tensor]:
        """Draw the next batch of `count` frames."""
        return batch_of(self.data, self.rows(count, len(self.data)), self.rng, self.device)

    def steps(self, phase: str, **parts: Any) -> Iterator[int]:
        count, cost = self.plan[phase]
        return self.saved.steps(phase, count, self.rng, cost, **parts)

    def judge(self, policy: "ACTPolicy", maps: Any = None) -> float:
        """Return the policy's mean error on the judges, in units of the spreads.

        maps: a RowFile of their features, for a policy that takes those.
        """
        judges = self.judges if maps is None else replace(self.judges, images=maps)
        units = self.loss_weights.cpu().numpy()
        every = [np.arange(a, min(a + 64, len(judges))) for a in range(0, len(judges), 64)]
        errors = [driving_error(policy, judges, rows, units, maps is not None) for rows in every]
        return float(np.average(errors, weights=[len(rows) for rows in every]))

    def train(
        self, phase: str, rate: float, module: nn.Module, loss: Callable[[], Tensor]
    ) -> tuple[torch.optim.Optimizer, Any]:
        count, cost = self.plan[phase]
        return self.saved.train(phase, count, rate, module, self.rng, loss, cost)


def _train(
    recordings: Recordings,
    size: ActConfig,
    recipe: TrainingRecipe,
    seed: int,
    device: torch.device,
    saved: Resumable,
) -> dict[str, Any]:
    """Train, and return everything in the checkpoint except its config."""
    p = params()["calibration"]
    parts = split(recordings, p["held_out_share"], p["seed"])
    rng = np.random.default_rng([seed, 77])
    first = replace(size, image_sizes=(recipe.at,)) if recipe.at else size
    samples = pick_evenly(parts.calibration, recipe.samples)
    data = frames_of(samples, *first.image_sizes[0])
    if not recipe.at:  # a small policy's step is so short that reading its frames from the disk would take longer
        data = in_memory(data, "reading frames", saved.progress)
    judging = pick_evenly(parts.choosing, recipe.judged)
    judges = frames_of(judging, *size.image_sizes[0])
    spread = recorded_spread(data)
    loss_weights = torch.from_numpy(1 / spread).to(device)
    plan = _plan(size, first, recipe, len(data), len(judges))
    saved.work = sum(count * cost for count, cost in plan.values())

    with seed_inside(seed):
        policy = lerobot_act(size)
        # Start with plans near the mean action: those of an untrained head are wild.
        with torch.no_grad():
            policy.model.action_head.weight.mul_(torch.from_numpy(spread)[:, None])
            policy.model.action_head.bias.copy_(torch.from_numpy(data.chunks[~data.is_pad].mean(axis=0)))
        policy.to(device)
        judges_first = frames_of(judging, *first.image_sizes[0])
        training = _Training(first, policy, data, judges_first, recipe, loss_weights, rng, saved, plan)
        _train_backbone(training)
        _train_transformer(training)
        last = "all together"
        apart = to_cpu({k: v.clone() for k, v in policy.state_dict().items()})
        if recipe.at:
            _train_together(training, last)  # do not keep its optimiser, which is twice as large as the policy
            training = replace(training, data=frames_of(samples, *size.image_sizes[0]))
            last = "at full size"
        optimizer, scheduler = _train_together(training, last)
        if not recipe.at:  # at another size, what was before is no alternative
            together = training.judge(policy)
            after = {k: v.clone() for k, v in policy.state_dict().items()}
            policy.load_state_dict(apart)
            if together <= training.judge(policy):
                policy.load_state_dict(after)
        for step in training.steps("judging"):
            rows = np.arange(len(judges))[step * recipe.batch : (step + 1) * recipe.batch]
            saved.losses["judging"].append(driving_error(policy, judges, rows))
    return {
        "epoch": recipe.carry_steps or recipe.together_steps,
        "model_state_dict": {k: v.cpu() for k, v in policy.state_dict().items()},
        "optimizer_state_dict": to_cpu(optimizer.state_dict()),
        "scheduler_state_dict": scheduler.state_dict(),
        "best_val_loss": np.mean(saved.losses["judging"]),
    }


def _plan(
    size: ActConfig, first: ActConfig, recipe: TrainingRecipe, frames: int, judges: int
) -> dict[str, tuple[int, int]]:
    """Return each phase's number of steps, and the cost of one in 10^9 multiply-accumulates.

    The costs are only for the progress bar, so they are rough.
    """

    def g(config: ActConfig, passes: int, batch: int, backbone: bool = True, transformer: bool = True) -> int:
        ((height, width),) = config.image_sizes
        tokens = math.prod(config.grid(height, width)) + 2
        per_token = 4 * config.dim**2 + 2 * config.dim * config.feedforward
        seen = config.encoder_layers * tokens + config.vae_layers * (config.chunk + 2)
        seen += config.decoder_layers * config.chunk
        macs = backbone * RESNET18_MACS * height * width + transformer * per_token * seen
        return max(1, round(passes * batch * macs / 1e9))

    batch = recipe.batch
    features = -(-min(frames, recipe.feature_samples) // batch)
    forward = g(first, 1, batch, transformer=False)
    train = 3  # passes: forward, backward to the inputs, and backward to the weights
    return {
        "backbone": (recipe.backbone_steps, train * forward),
        "statistics": (16 if frames >= 16 * batch else 4, forward),
        "features, plain": (features, forward),
        "features, mirrored": (features, forward),
        "features, judges": (-(-judges // batch), forward),
        "transformer": (recipe.transformer_steps, g(first, train, recipe.transformer_batch, backbone=False)),
        "all together": (recipe.together_steps, g(first, train, recipe.together_batch)),
        "at full size": (recipe.carry_steps, g(size, train, recipe.together_batch)),
        "judging": (-(-judges // batch), g(size, 1, batch)),
    }


class _ChunkFromFeatures(nn.Module):
    """The backbone with the first phase's throw-away head, which maps the features at all positions to a chunk."""

    def __init__(self, backbone: nn.Module, size: ActConfig, features: int = 512, width_after: int = 32):
        super().__init__()
        self.backbone, self.chunk = backbone, size.chunk
        convolution = nn.Conv2d(features, width_after, 1)
        last = nn.Linear(width_after * math.prod(size.grid(*size.image_sizes[0])), 2 * size.chunk)
        nn.init.zeros_(last.weight)  # start with "no action": real actions are small, and an untrained head's are not
        nn.init.zeros_(last.bias)
        self.head = nn.Sequential(convolution, nn.ReLU(), nn.Flatten(), last)

    def forward(self, image: Tensor) -> Tensor:
        return self.head(self.backbone(image)["feature_map"]).unflatten(1, (self.chunk, 2))


def _train_backbone(training: _Training) -> None:
    """Phase one: train the backbone with live batch norm, then measure on the data the statistics that stay frozen."""
    recipe = training.recipe
    import torchvision

    resnet = torchvision.models.resnet18(weights=None)
    live = torchvision.models._utils.IntermediateLayerGetter(resnet, {"layer4": "feature_map"})
    model = _ChunkFromFeatures(live, training.size).to(training.device).train()

    def loss() -> Tensor:
        batch = training.batch(recipe.batch)
        return error_of(model(batch[IMAGE]), batch, training.loss_weights)

    training.train("backbone", recipe.backbone_rate, model, loss)
    norms = [m for m in live.modules() if isinstance(m, nn.BatchNorm2d)]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # torch then takes the plain mean over the batches below
    for _ in training.steps("statistics", backbone=live):
        with torch.no_grad():
            live(training.batch(recipe.batch)[IMAGE])
    weights = {k: v for k, v in live.state_dict().items() if not k.endswith("num_batches_tracked")}
    training.policy.model.backbone.load_state_dict(weights)


def _train_transformer(training: _Training) -> None:
    """Phase two: train all but the backbone on features that are computed once, of each frame as it is and mirrored."""
    policy, backbone = training.policy, training.policy.model.backbone.eval()
    chosen = np.asarray(pick_evenly(range(len(training.data)), training.recipe.feature_samples))
    views = {view: _features(training, view, chosen, backbone) for view in ("plain", "mirrored")}
    judged = _features(replace(training, data=training.judges), "judges", np.arange(len(training.judges)), backbone)
    policy.model.backbone = Given()
    with threads(1 if policy.config.dim_model < SMALL_DIM else torch.get_num_threads()):
        _transformer_steps(training, chosen, views, judged)
    policy.model.backbone = backbone


def _features(training: _Training, view: str, chosen: np.ndarray, backbone: nn.Module) -> RowFile:
    """Compute the frozen backbone's feature maps of the chosen rows' frames, into a file.

    view: 'plain', 'mirrored', or 'judges', which are plain too. chosen: (n,) row numbers.
    """
    batch, (size,) = training.recipe.batch, training.size.image_sizes
    channels = training.policy.model.encoder_img_feat_input_proj.in_channels
    maps = RowFile(training.saved.folder / f"{view}.rows", (channels, *training.size.grid(*size)))
    for step in training.steps(f"features, {view}", maps=maps):
        images = training.data.images[chosen[step * batch : (step + 1) * batch]]
        images = images[:, :, ::-1] if view == "mirrored" else images
        with torch.no_grad():
            maps.append(backbone(torch.from_numpy(normalise(images)).to(training.device))["feature_map"].cpu())
    return maps


def _transformer_steps(training: _Training, chosen: np.ndarray, views: dict[str, RowFile], judged: RowFile) -> None:
    policy, data, recipe = training.policy, training.data, training.recipe
    parameters = [p for p in policy.parameters() if p.requires_grad]
    optimizer, scheduler = optimiser(
        parameters, recipe.transformer_rate, recipe.transformer_steps, recipe.transformer_warmup
    )
    best = _Best()
    for step in training.steps("transformer", policy=policy, optimizer=optimizer, scheduler=scheduler, best=best):
        if best.stale >= PATIENCE:
            continue  # it learns by heart
        policy.train()
        kept = training.rows(recipe.transformer_batch, len(chosen))
        rows = chosen[kept]
        states, chunks = swap_states(data, rows, training.rng), data.chunks[rows].copy()
        if step % 2:
            states[:, 0] *= -1
            chunks[:, :, 0] *= -1
        batch = {
            IMAGE: torch.from_numpy(views["mirrored" if step % 2 else "plain"][kept]).to(training.device),
            STATE: torch.from_numpy(states).to(training.device),
            ACTION: torch.from_numpy(chunks).to(training.device),
            IS_PAD: torch.from_numpy(data.is_pad[rows]).to(training.device),
        }
        loss = policy_loss(policy, batch, training.loss_weights)
        training.saved.losses["transformer"].append(training_module.descend(loss, policy, optimizer, scheduler))
        if (step + 1) % JUDGE_EVERY == 0:
            best.see(training.judge(policy, judged), policy)
    if best.weights:
        policy.load_state_dict(best.weights)


def _train_together(training: _Training, phase: str) -> tuple[torch.optim.Optimizer, Any]:
    """Phase three: train all parameters at a tenth of the rate. Returns the optimiser and scheduler, to be saved."""
    policy, recipe = training.policy, training.recipe
    policy.train()
    return training.train(
        phase,
        recipe.transformer_rate / 10,
        policy,
        lambda: policy_loss(policy, training.batch(recipe.together_batch), training.loss_weights),
    )
