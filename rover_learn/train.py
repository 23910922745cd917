"""Train LeRobot's own ACTPolicy on recordings, and write a checkpoint in the format of the user's trainer.

    train("episodes", "best_model.pth")

The ResNet starts from random weights, and with frozen batch norm it would learn nothing. So there are three phases: the
backbone alone, with live batch norm, learns to predict the chunk; then the transformer learns on the frozen backbone's
features, which are computed once; then both learn together at a tenth of the rate.

No weight depends on the picture's size, so the real car's policy goes through these phases at a quarter of its pixels,
and a few more steps at its own size carry it there. While the transformer learns, it is judged by episodes that it does
not learn from, and the best weights are kept. Recordings that are mirrored beside the others are turned over.
"""

import math
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from rover_exchange.export_dataset import lerobot_train
from rover_learn import training as loop
from rover_learn.curves import leave_curves
from rover_learn.phases import VERSIONS, Recipe
from rover_learn.training import ACTION, GAIN, IMAGE, IS_PAD, STATE, Batch, Best, Frames, Machine, Phase, Resumable
from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import EpisodeError, TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.onboard.stage import atomic_path
from rover_lib.workshop import act as act_module
from rover_lib.workshop import act_config
from rover_lib.workshop.act import ActConfig
from rover_lib.workshop.act_config import lerobot_act
from rover_lib.workshop.cache import cache_folder, cache_root, key_of
from rover_lib.workshop.checkpoint.files import save_torch, trainer_config
from rover_lib.workshop.checkpoint.lerobot import write_lerobot
from rover_lib.workshop.pictures.turning import measure_sides
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings import controls
from rover_lib.workshop.recordings import episodes as episodes_module
from rover_lib.workshop.recordings import samples as recorded
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Recordings, Source, pick_evenly

if TYPE_CHECKING:
    from lerobot.policies.act.modeling_act import ACTPolicy

FEATURES, HEAD_WIDTH = 512, 32  # of ResNet18's last stage, and of the first phase's head
SMALL_DIM = 256  # below it, a second thread saves a quarter on a quiet machine, and on a busy one trebles the time
PLANNED_HZ = 30.0  # of the user's trainer
SIZES = {
    "small": ActConfig(
        image_sizes=((72, 128),), dim=128, heads=4, feedforward=512, encoder_layers=1, decoder_layers=1, vae_layers=1
    ),
    "full": ActConfig(),
}
# A cached checkpoint that takes minutes is made anew after each change of the code that makes it. One that takes an
# hour or more is made anew only when this number is raised. Raise it when you change what the same recipe results in.
FULL_VERSION = 2


@dataclass(frozen=True, kw_only=True)
class TrainingRecipe(Recipe):
    """How long and how fast each phase trains: an entry of params.yml's section `train`, which explains each number.

    at: (height, width) of the pictures in all phases but the last; None: the policy's own, and no last phase.
    """

    PHASES = ("backbone", "transformer", "together", "carry")

    backbone_steps: int
    transformer_steps: int
    together_steps: int
    transformer_batch: int
    together_batch: int
    feature_samples: int
    judged: int
    backbone_rate: float
    transformer_rate: float
    transformer_warmup: int = 0
    at: tuple[int, int] | None = None
    carry_steps: int = 0

    @classmethod
    def of(cls, size: str, device: str, steps: int | None = None, batch: int | None = None) -> Self:
        """Return the recipe of params.yml for that size; with cuda's own values, if it has some. steps: in all."""
        recipes = params()["train"]
        values = recipes[size] | (recipes.get(f"{size}_{device}") or {})
        recipe = cls.read(f"train: {size}", values | {"at": tuple(values["at"]) if values.get("at") else None})
        recipe = recipe if steps is None else recipe.of_few(steps)
        return replace(recipe, batch=batch, transformer_batch=batch, together_batch=batch) if batch else recipe

    def of_few(self, steps: int) -> Self:
        """Return the same recipe with `steps` steps in all, and with fewer frames: they only show that it works."""
        sizes = "batch", "transformer_batch", "together_batch"
        batches = {name: min(getattr(self, name), max(2, steps // 8)) for name in sizes}
        counts = {
            "samples": min(self.samples, max(4 * self.batch, steps * self.batch)),
            "feature_samples": min(self.feature_samples, steps * batches["transformer_batch"]),
            "judged": min(self.judged, max(8, steps)),
        }
        return replace(self.of_steps(steps), **batches, **counts, transformer_warmup=0)


def train(
    episodes: Path | str | Source,
    out_path: Path | str,
    size: str = "small",
    seed: int = 0,
    steps: int | None = None,
    batch: int | None = None,
    *,
    machine: Machine | None = None,
    progress: Progress = silent,
    say: Callable[[str], object] = silent,
) -> Path:
    """Train a policy on recordings and write its checkpoint in the format of the user's trainer.

    episodes: our recordings of one car, or a LeRobotDataset of steering, throttle and one camera. Their calibration
    part trains the policy, the choosing part gives best_val_loss, and the held-out part is left for its judgement.
    size: 'small' (72x128) or 'full' (the user's policy, 360x640). steps: of all phases together, batch: of each phase;
    None: the recipe's. machine: None takes the best that there is. say: is told what it trains on, and how that went.

    Returns out_path, which appears complete or not at all; beside it are its <name>_curves/, and the same policy as
    LeRobot's folder, <name>_pretrained_model/. On one machine the same input gives the same weights, even if training
    was ended at any moment and started again. A checkpoint that was made before is taken from the cache.
    Raises TrainingError for a size, device, steps or seed that it cannot use, EpisodeError for recordings.
    """
    out_path = Path(out_path)
    machine = machine or Machine.of()
    kind = machine.device.type
    say(f"training on {machine.words()}")
    if size not in SIZES:
        raise TrainingError(f"a policy's size must be one of {', '.join(SIZES)}", found=repr(size))
    if seed < 0:
        raise TrainingError("training needs a seed from 0", found=seed)
    recipes = {each: TrainingRecipe.of(size, each, steps, batch) for each in ("cpu", "cuda")}
    recipe = recipes[kind]
    p = params()["calibration"]
    recordings = load_recordings(episodes, SIZES[size].chunk, p["sync_s"], progress)
    rate_hz = _rate_hz(recordings)
    made_of = {"size": asdict(SIZES[size]), "seed": seed, "split": p}
    made_of |= {"versions": [version(name) for name in VERSIONS], "version": FULL_VERSION}
    made_of |= {"episodes": recordings.hashes(), "rate_hz": rate_hz} | ({"amp": True} if machine.amp else {})
    learners = sys.modules[__name__], loop, preprocess, act_module, act_config, episodes_module, controls
    sources = () if size == "full" and steps is None else learners
    keys = {each: made_of | {"recipe": asdict(made_by)} for each, made_by in recipes.items()}
    begun = {each: cache_root() / f"training-{key_of(key, *sources)}" for each, key in keys.items()}
    unfinished = begun.pop(kind)  # which another device goes on with if its recipe is the same, else:
    if not unfinished.exists() and any(folder.exists() for folder in begun.values()):
        say(f"begins anew: what {', '.join(begun)} has begun is of another recipe (params.yml)")

    def make(folder: Path) -> None:
        known = {"learning_rate": recipe.transformer_rate, "batch_size": recipe.batch, "device": kind, "seed": seed}
        known |= {"data_dir": "episodes", "output_dir": "checkpoints", "rate_hz": int(rate_hz)}
        known |= {"pretrained_backbone": False}
        with machine.computing(), Resumable(unfinished, machine, progress) as saved:
            began_s = time.monotonic()
            trained = _train(_turned(recordings, progress), SIZES[size], recipe, seed, saved)
            say(f"in {time.monotonic() - began_s:.0f} s, held-out error {trained['best_val_loss']:.4f}")
            leave_curves(folder / "curves", saved.losses, saved.judged)
            weights = {name.removeprefix("model."): v for name, v in trained["model_state_dict"].items()}
            config, origin = replace(SIZES[size], rate_hz=rate_hz), {"trained_by": asdict(recipe), "device": kind}
            write_lerobot(folder / "pretrained_model", config, weights, origin)
            # It must be on the disk before the unfinished training, which it comes from, is removed.
            save_torch(folder / "best_model.pth", {**trained, "config": trainer_config(SIZES[size], **known)})

    made = cache_folder("checkpoint", key_of({**keys[kind], "device": kind}, *sources), make)
    shutil.rmtree(unfinished, ignore_errors=True)
    for folder in (each for each in made.iterdir() if each.is_dir()):  # those of older programs have none
        with build_folder(out_path.with_name(f"{out_path.stem}_{folder.name}")) as new:
            shutil.copytree(folder, new, dirs_exist_ok=True)
    with atomic_path(out_path) as temporary:
        shutil.copyfile(made / "best_model.pth", temporary)
    return out_path


def _rate_hz(recordings: Recordings) -> float:
    """Return the steps per second of plans: the recordings', but 30 if those are within a fifth of it.

    Raises EpisodeError for recordings that this training is not for.
    """
    layout = recordings.layout
    recorded.car_of(recordings.samples)
    if layout.action_names != ACTION_NAMES or layout.state_names != ACTION_NAMES or len(layout.cameras) != 1:
        what = f"{recordings.root}: rover train is for cars of steering and throttle with one camera"
        remedy = f"name them, as in --action-names steering,throttle, or: {lerobot_train(recordings.root)}"
        raise EpisodeError(what, found=layout.words(), remedy=remedy)
    rates = [found for e in recordings.episodes if (found := recorded.frame_rate_hz(e.samples)) is not None]
    found_hz = layout.rate_hz or (float(np.median(rates)) if rates else PLANNED_HZ)
    return float(round(found_hz)) if layout.rate_hz or recorded.is_another_rate(found_hz, PLANNED_HZ) else PLANNED_HZ


def _turned(recordings: Recordings, progress: Progress) -> Recordings:
    """Return the recordings with the pictures of those that are mirrored beside most others turned over."""
    mirrored, episodes = measure_sides(recordings, progress).mirrored, []
    for e in recordings.episodes:
        samples = tuple(replace(s, mirrored=True) for s in e.samples) if e.id in mirrored else e.samples
        episodes.append(replace(e, samples=samples))
    return replace(recordings, episodes=tuple(episodes))


@dataclass(frozen=True)
class _Training:
    """What every phase works with. weights: (2,), one divided by each action's spread, on the training's device."""

    size: ActConfig  # with the pictures' size in the first phases; the policy's own may be larger
    policy: "ACTPolicy"
    data: Frames
    judges: Frames  # of other episodes
    recipe: TrainingRecipe
    weights: Tensor
    rng: np.random.Generator
    saved: Resumable

    def batch(self, count: int) -> Batch:
        """Draw the next batch of `count` frames, each at most once."""
        rows = self.rng.choice(len(self.data), min(count, len(self.data)), replace=False)
        return loop.batch_of(self.data, rows, self.rng, self.weights.device)

    def loss(self, batch: Batch) -> Tensor:
        """Return the policy's loss; pictures in their light become its input, feature maps are that already."""
        seen = loop.normalised(batch[IMAGE], batch[GAIN]) if GAIN in batch else batch[IMAGE]
        return loop.policy_loss(self.policy, {**batch, IMAGE: seen}, self.weights)

    def judge(self, maps: loop.RowFile | None = None, units: np.ndarray | float | None = None) -> float:
        """Return the policy's mean error on the judges, in units of the spreads. maps, units: as of `driving_error`."""
        judges, units = self.judges, self.weights.cpu().numpy() if units is None else units
        every = [np.arange(a, min(a + 64, len(judges))) for a in range(0, len(judges), 64)]
        errors = [loop.driving_error(self.policy, judges, rows, units, maps) for rows in every]
        self.policy.train()
        return float(np.average(errors, weights=[len(rows) for rows in every]))


def _train(
    recordings: Recordings, size: ActConfig, recipe: TrainingRecipe, seed: int, saved: Resumable
) -> dict[str, Any]:
    """Train, and return everything in the checkpoint except its config."""
    p, device, workers = params()["calibration"], saved.machine.device, saved.machine.workers
    parts = split(recordings, p["held_out_share"], p["seed"])
    first = replace(size, image_sizes=(recipe.at,)) if recipe.at else size
    samples, judging = pick_evenly(parts.calibration, recipe.samples), pick_evenly(parts.choosing, recipe.judged)
    data = Frames.of(samples, first.image_sizes[0], workers)
    judges = Frames.of(judging, size.image_sizes[0], workers)
    spread = np.maximum(data.chunks[~data.is_pad].std(axis=0), 1e-3)  # of each action, (2,): errors count in it
    with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        torch.manual_seed(seed)
        policy = lerobot_act(size)
        # Start with plans near the mean action: those of an untrained head are wild.
        with torch.no_grad():
            policy.model.action_head.weight.mul_(torch.from_numpy(spread)[:, None])
            policy.model.action_head.bias.copy_(torch.from_numpy(data.chunks[~data.is_pad].mean(axis=0)))
        saved.machine.taking(policy)
        weights, rng = torch.from_numpy(1 / spread).to(device), np.random.default_rng([seed, 77])
        judged = Frames.of(judging, first.image_sizes[0], workers) if recipe.at else judges
        training = _Training(first, policy, data, judged, recipe, weights, rng, saved)
        _train_backbone(training)
        _train_transformer(training)
        before = min((error for _, error in saved.judged.get("transformer", ())), default=None)
        optimizer, scheduler = _train_together_or_not(training, "all together", recipe.together_steps, before)
        if recipe.at:
            training = replace(training, data=Frames.of(samples, size.image_sizes[0], workers), judges=judges)
            optimizer, scheduler = _train_together_or_not(training, "at full size", recipe.carry_steps)
    return {
        "epoch": recipe.carry_steps or recipe.together_steps,
        "model_state_dict": {k: v.cpu().contiguous() for k, v in policy.state_dict().items()},
        "optimizer_state_dict": loop.to_cpu(optimizer.state_dict()),
        "scheduler_state_dict": scheduler.state_dict(),
        "best_val_loss": np.float64(training.judge(units=1.0)),
    }


class _ChunkFromFeatures(nn.Module):
    """The backbone with the first phase's throw-away head, which maps the features at all positions to a chunk."""

    def __init__(self, backbone: nn.Module, size: ActConfig):
        super().__init__()
        self.backbone, self.chunk = backbone, size.chunk
        convolution = nn.Conv2d(FEATURES, HEAD_WIDTH, 1)
        last = nn.Linear(HEAD_WIDTH * math.prod(size.grid(*size.image_sizes[0])), 2 * size.chunk)
        nn.init.zeros_(last.weight)  # start with "no action": real actions are small, and an untrained head's are not
        nn.init.zeros_(last.bias)
        self.head = nn.Sequential(convolution, nn.ReLU(), nn.Flatten(), last)

    def forward(self, image: Tensor) -> Tensor:
        return self.head(self.backbone(image)["feature_map"]).unflatten(1, (self.chunk, 2))


def _train_backbone(training: _Training) -> None:
    """Phase one: train the backbone with live batch norm, then measure on the data the statistics that stay frozen."""
    import torchvision

    recipe, saved = training.recipe, training.saved
    resnet = torchvision.models.resnet18(weights=None)
    live = torchvision.models._utils.IntermediateLayerGetter(resnet, {"layer4": "feature_map"})
    model = saved.machine.taking(_ChunkFromFeatures(live, training.size)).train()
    saved.train(
        Phase("backbone", recipe.backbone_steps, recipe.backbone_rate),
        model,
        training.rng,
        batch=lambda _: training.batch(recipe.batch),
        loss=lambda batch: loop.error_of(model(loop.normalised(batch[IMAGE], batch[GAIN])), batch, training.weights),
    )
    for norm in (m for m in live.modules() if isinstance(m, nn.BatchNorm2d)):
        norm.reset_running_stats()
        norm.momentum = None  # torch then takes the plain mean over the batches below
    count = 16 if len(training.data) >= 16 * recipe.batch else 4
    drawn = saved.steps("statistics", count, training.rng, lambda _: training.batch(recipe.batch), backbone=live)
    for _, batch in drawn:
        with torch.no_grad():
            live(loop.normalised(batch[IMAGE], batch[GAIN]))
    weights = {k: v for k, v in live.state_dict().items() if not k.endswith("num_batches_tracked")}
    training.policy.model.backbone.load_state_dict(weights)


def _train_transformer(training: _Training) -> None:
    """Phase two: train all but the backbone on features that are computed once, of each frame as it is and mirrored."""
    policy, recipe, data = training.policy, training.recipe, training.data
    backbone = policy.model.backbone.eval()
    chosen = np.asarray(pick_evenly(range(len(data)), recipe.feature_samples))
    views = [_features(training, view, data, chosen, backbone) for view in ("plain", "mirrored")]
    judged = _features(training, "judges", training.judges, np.arange(len(training.judges)), backbone)

    def batch(step: int) -> Batch:
        kept = training.rng.choice(len(chosen), min(recipe.transformer_batch, len(chosen)), replace=False)
        rows = chosen[kept]
        states, chunks = loop.swap_states(data, rows, training.rng), data.chunks[rows].copy()
        if step % 2:  # mirrored
            states[:, 0] *= -1
            chunks[:, :, 0] *= -1
        arrays = {IMAGE: views[step % 2][kept], STATE: states, ACTION: chunks, IS_PAD: data.is_pad[rows]}
        return loop.on_device(arrays, training.weights.device)

    policy.model.backbone = loop.Given()
    policy.train()
    phase = Phase("transformer", recipe.transformer_steps, recipe.transformer_rate, recipe.transformer_warmup)
    with loop.threads(1 if policy.config.dim_model < SMALL_DIM else torch.get_num_threads()):
        best = Best(lambda: training.judge(judged))
        training.saved.train(phase, policy, training.rng, batch, training.loss, best)
    policy.model.backbone = backbone


def _features(training: _Training, view: str, data: Frames, chosen: np.ndarray, backbone: nn.Module) -> loop.RowFile:
    """Compute the frozen backbone's maps of chosen rows, (n,), into a file. No gradients: two batches fit at once."""
    batch, (size,), device = 2 * training.recipe.batch, training.size.image_sizes, training.weights.device
    maps = loop.RowFile(training.saved.folder / f"{view}.rows", (FEATURES, *training.size.grid(*size)))

    def read(step: int) -> np.ndarray:
        images = data.pictures(chosen[step * batch : (step + 1) * batch])
        return np.ascontiguousarray(images[:, :, ::-1]) if view == "mirrored" else images

    for _, images in training.saved.steps(f"features, {view}", -(-len(chosen) // batch), training.rng, read, maps=maps):
        with torch.no_grad():
            maps.append(backbone(loop.normalised(torch.from_numpy(images).to(device)))["feature_map"].cpu())
    return maps


def _train_together_or_not(
    training: _Training, name: str, steps: int, before: float | None = None
) -> tuple[torch.optim.Optimizer, Any]:
    """Phase three: all parameters at a tenth of the rate; stays if it is no worse than what was, `before` if known."""
    policy, saved = training.policy, training.saved
    apart = {k: v.clone() for k, v in policy.state_dict().items()}
    before = training.judge() if before is None else before
    policy.train()
    made = saved.train(
        Phase(name, steps, training.recipe.transformer_rate / 10),
        policy,
        training.rng,
        batch=lambda _: training.batch(training.recipe.together_batch),
        loss=training.loss,
    )
    after = training.judge()
    saved.judged[name] = [[0, before], [steps, after]]
    if after > before:
        policy.load_state_dict(apart)
    return made
