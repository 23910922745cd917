"""Train LeRobot's own ACTPolicy on recordings, and write a checkpoint in the format of the user's trainer.

    train("episodes", "best_model.pth")

There are three phases: the backbone alone, with live batch norm, learns to predict the plan; then the transformer
learns on the frozen backbone's features, which are computed once; then both learn together at a tenth of the rate.

A phase stops by what it sees: backbone and whole policy learn in rounds, as long as their error on recordings that they
do not learn from falls, within a budget of minutes. That error is shown by action, beside the best guess without eyes.
No weight depends on the picture's size, so the real car's policy goes through these phases at a quarter of its pixels,
and a few more steps at its own size carry it there. Recordings that are mirrored beside the others are turned over.
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
from rover_learn import augment as augment_module
from rover_learn import backbone as backbone_module
from rover_learn import judges as judges_module
from rover_learn import training as loop
from rover_learn.augment import Augmentation
from rover_learn.backbone import FEATURES, PlanFromFeatures, Pretrained, live_backbone, measure_statistics
from rover_learn.curves import ROUND, leave_curves
from rover_learn.judges import Judges
from rover_learn.phases import LARGE, VERSIONS, Recipe
from rover_learn.training import ACTION, IMAGE, IS_PAD, STATE, Batch, Best, Frames, Machine, Phase, Resumable
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
from rover_lib.workshop.checkpoint.files import save_torch
from rover_lib.workshop.checkpoint.lerobot import write_lerobot
from rover_lib.workshop.checkpoint.trainer import trainer_config
from rover_lib.workshop.pictures.turning import measure_sides
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings import controls
from rover_lib.workshop.recordings import episodes as episodes_module
from rover_lib.workshop.recordings import samples as recorded
from rover_lib.workshop.recordings.blocks import usual_rate_hz
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Recordings, pick_evenly
from rover_lib.workshop.recordings.source import Source

if TYPE_CHECKING:
    from lerobot.policies.act.modeling_act import ACTPolicy

SMALL_DIM = 256  # below it, a second thread saves a quarter on a quiet machine, and on a busy one trebles the time
PLANNED_HZ = 30.0  # of the user's trainer
SIZES = {
    "small": ActConfig(
        image_sizes=((72, 128),), dim=128, heads=4, feedforward=512, encoder_layers=1, decoder_layers=1, vae_layers=1
    ),
    "full": ActConfig(),
}
JUDGED_AT_ONCE = 64  # frames
FALLS = 0.02  # a further round is worth its time while the error falls by this share
BACKBONE_SHARE = 0.75  # of the budget, for the backbone's rounds: the other phases take about as long as one of them
# A cached checkpoint that takes minutes is made anew after each change of the code that makes it. One that takes an
# hour or more is made anew only when this number is raised. Raise it when you change what the same recipe results in.
FULL_VERSION = 3


@dataclass(frozen=True, kw_only=True)
class TrainingRecipe(Recipe):
    """How long and how fast each phase trains: an entry of params.yml's section `train`, which explains each number.

    backbone_steps, together_steps: of a round; backbone_rounds, together_rounds: at most. minutes: a budget, of the
    processor or, on a GPU, as they pass: no further round begins that would not fit. mirrored: share of the pictures
    that are turned over. light to noise: see Augmentation. at: (height, width) of the pictures in all phases but the
    last; None: the policy's own, and no last phase.
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
    backbone_rounds: int = 1
    together_rounds: int = 1
    minutes: float = float(LARGE)
    mirrored: float = 0.0
    light: float = 0.25
    shift: float = 0.0
    blur: float = 0.0
    noise: float = 0.0
    at: tuple[int, int] | None = None
    carry_steps: int = 0

    @property
    def augmentation(self) -> Augmentation:
        return Augmentation(self.light, self.shift, self.blur, self.noise)

    @classmethod
    def of(
        cls, size: str, device: str, steps: int | None = None, batch: int | None = None, minutes: float | None = None
    ) -> Self:
        """Return the recipe of params.yml for that size; with cuda's own values, if it has some.

        steps: in all, of one round each. minutes: the budget instead of the recipe's.
        """
        recipes = params()["train"]
        values = recipes[size] | (recipes.get(f"{size}_{device}") or {})
        recipe = cls.read(f"train: {size}", values | {"at": tuple(values["at"]) if values.get("at") else None})
        recipe = recipe if steps is None else recipe.of_few(steps)
        recipe = recipe if minutes is None else replace(recipe, minutes=minutes)
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
        once = replace(self.of_steps(steps), backbone_rounds=1, together_rounds=1, transformer_warmup=0)
        return replace(once, **(batches | counts))


def train(
    episodes: Path | str | Source,
    out_path: Path | str,
    size: str = "small",
    seed: int = 0,
    steps: int | None = None,
    batch: int | None = None,
    minutes: float | None = None,
    *,
    backbone: Path | str | None = None,
    machine: Machine | None = None,
    progress: Progress = silent,
    say: Callable[[str], object] = silent,
) -> Path:
    """Train a policy on recordings and write its checkpoint in the format of the user's trainer.

    episodes: our recordings of one car, or a LeRobotDataset of steering, throttle and one camera. Their calibration
    part trains the policy, the choosing part gives best_val_loss, and the held-out part is left for its judgement.
    size: 'small' (72x128) or 'full' (the user's policy, 360x640). steps: of all phases together, batch: of each phase;
    minutes: its budget; None: the recipe's. backbone: weights that it begins with, as Pretrained.of takes them; None:
    random ones. machine: None takes the best that there is. say: is told what it trains on, and how that goes.

    Returns out_path, which appears complete or not at all; beside it are its <name>_curves/, which say of each action
    how far it is off, and the same policy as LeRobot's folder, <name>_pretrained_model/. On one machine the same input
    gives the same weights, even if training was ended at any moment and started again, unless the budget ended it. A
    checkpoint that was made before is taken from the cache.
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
    recipes = {each: TrainingRecipe.of(size, each, steps, batch, minutes) for each in ("cpu", "cuda")}
    recipe = recipes[kind]
    pretrained = None if backbone is None else Pretrained.of(backbone, say)
    p = params()["calibration"]
    recordings = load_recordings(episodes, SIZES[size].chunk, p["sync_s"], progress)
    rate_hz = _rate_hz(recordings)
    made_of = {"size": asdict(SIZES[size]), "seed": seed, "split": p}
    made_of |= {"versions": [version(name) for name in VERSIONS], "version": FULL_VERSION}
    made_of |= {"episodes": recordings.hashes(), "rate_hz": rate_hz} | ({"amp": True} if machine.amp else {})
    made_of |= pretrained.origin if pretrained else {}
    phases = backbone_module, augment_module, judges_module, loop, act_module, act_config
    learners = sys.modules[__name__], *phases, preprocess, episodes_module, controls
    sources = () if size == "full" and steps is None else learners
    keys = {each: made_of | {"recipe": asdict(made_by)} for each, made_by in recipes.items()}
    begun = {each: cache_root() / f"training-{key_of(key, *sources)}" for each, key in keys.items()}
    unfinished = begun.pop(kind)  # which another device goes on with if its recipe is the same, else:
    if not unfinished.exists() and any(folder.exists() for folder in begun.values()):
        say(f"begins anew: what {', '.join(begun)} has begun is of another recipe (params.yml)")

    def make(folder: Path) -> None:
        known = {"learning_rate": recipe.transformer_rate, "batch_size": recipe.batch, "device": kind, "seed": seed}
        known |= {"data_dir": "episodes", "output_dir": "checkpoints", "pretrained_backbone": pretrained is not None}
        known |= {"rate_hz": int(rate_hz) if rate_hz.is_integer() else rate_hz}
        with machine.computing(), Resumable(unfinished, machine, progress) as saved:
            began_s = time.monotonic()
            trained, actions = _train(_turned(recordings, progress), SIZES[size], recipe, seed, saved, pretrained, say)
            say(f"in {time.monotonic() - began_s:.0f} s")
            leave_curves(folder / "curves", saved.losses, saved.judged, actions)
            weights = {name.removeprefix("model."): v for name, v in trained["model_state_dict"].items()}
            config, origin = replace(SIZES[size], rate_hz=rate_hz), {"trained_by": asdict(recipe), "device": kind}
            origin |= pretrained.origin if pretrained else {}
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


def curves_of(checkpoint: Path) -> Path:
    """Return the folder of the curves of a checkpoint that `train` wrote."""
    return checkpoint.with_name(f"{checkpoint.stem}_curves")


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
    found_hz = layout.rate_hz or usual_rate_hz(recordings.episodes) or PLANNED_HZ
    as_recorded = layout.rate_hz or recorded.is_another_rate(found_hz, PLANNED_HZ)
    return float(recorded.round_rate_hz(found_hz)) if as_recorded else PLANNED_HZ


def _turned(recordings: Recordings, progress: Progress) -> Recordings:
    """Return the recordings with the pictures of those that are mirrored beside most others turned over."""
    mirrored, episodes = measure_sides(recordings, progress).mirrored, []
    for e in recordings.episodes:
        samples = tuple(replace(s, mirrored=True) for s in e.samples) if e.id in mirrored else e.samples
        episodes.append(replace(e, samples=samples))
    return replace(recordings, episodes=tuple(episodes))


@dataclass(frozen=True)
class _Training:
    """What every phase works with. weights: (2,), what an error of 1 in each action counts, on the device."""

    size: ActConfig  # with the pictures' size in the first phases; the policy's own may be larger
    policy: "ACTPolicy"
    data: Frames
    judging: Frames  # of other episodes
    judges: Judges
    recipe: TrainingRecipe
    weights: Tensor
    rng: np.random.Generator
    saved: Resumable
    say: Callable[[str], object]

    def batch(self, count: int) -> Batch:
        """Draw the next batch of `count` frames, each at most once."""
        rows = self.rng.choice(len(self.data), min(count, len(self.data)), replace=False)
        recipe = self.recipe
        return loop.batch_of(self.data, rows, self.rng, self.weights.device, recipe.augmentation, recipe.mirrored)

    def loss(self, batch: Batch) -> Tensor:
        """Return the policy's loss; pictures become its input, feature maps are that already."""
        seen = loop.normalised(batch[IMAGE], batch) if batch[IMAGE].dtype == torch.uint8 else batch[IMAGE]
        return loop.policy_loss(self.policy, {**batch, IMAGE: seen}, self.weights)

    def judging_blocks(self) -> list[np.ndarray]:
        """Return the rows of what judges, in blocks that fit into memory."""
        count = len(self.judging)
        return [np.arange(first, min(first + JUDGED_AT_ONCE, count)) for first in range(0, count, JUDGED_AT_ONCE)]

    def plans(self, maps: loop.RowFile | None = None) -> np.ndarray:
        """Return the policy's plans on what judges it, (n, C, A). maps: as of `plans_on`."""
        blocks = self.judging_blocks()
        plans = np.concatenate([loop.plans_on(self.policy, self.judging, rows, maps) for rows in blocks])
        self.policy.train()
        return plans

    def judge(self, maps: loop.RowFile | None = None) -> np.ndarray:
        """Return the policy's errors by action, (A,), in % of the range."""
        return self.judges.errors_pct(self.plans(maps))


def _train(
    recordings: Recordings,
    size: ActConfig,
    recipe: TrainingRecipe,
    seed: int,
    saved: Resumable,
    pretrained: Pretrained | None,
    say: Callable[[str], object],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Train, and return everything in the checkpoint except its config, and what was learned of each action."""
    p, device, workers = params()["calibration"], saved.machine.device, saved.machine.workers
    parts = split(recordings, p["held_out_share"], p["seed"])
    first = replace(size, image_sizes=(recipe.at,)) if recipe.at else size
    samples, judging = pick_evenly(parts.calibration, recipe.samples), pick_evenly(parts.choosing, recipe.judged)
    data = Frames.of(samples, first.image_sizes[0], workers)
    frames = Frames.of(judging, first.image_sizes[0], workers)
    judges = Judges.of(recordings.layout.action_names, data.chunks, data.is_pad, frames.chunks, frames.is_pad)
    actions = data.chunks[~data.is_pad]
    mean, spread = actions.mean(axis=0), np.maximum(actions.std(axis=0), 1e-3)
    # Errors count in % of the range, so that a throttle that is held does not outweigh steering by its noise. The
    # largest spread counts 1, as LeRobot's loss has a second part.
    weights = torch.from_numpy((1 / judges.ranges / (spread / judges.ranges).max()).astype(np.float32)).to(device)
    with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        torch.manual_seed(seed)
        policy = lerobot_act(size)
        # Start with plans near the mean action: those of an untrained head are wild.
        with torch.no_grad():
            policy.model.action_head.weight.mul_(torch.from_numpy(spread)[:, None])
            policy.model.action_head.bias.copy_(torch.from_numpy(mean))
        saved.machine.taking(policy)
        rng = np.random.default_rng([seed, 77])
        training = _Training(first, policy, data, frames, judges, recipe, weights, rng, saved, say)
        backbone = saved.machine.taking(live_backbone(pretrained))
        head = PlanFromFeatures(backbone, mean, spread, size.chunk).to(device)
        _train_backbone(training, head)
        before = _train_transformer(training)
        optimizer, scheduler = _train_together(
            training, "all together", recipe.together_steps, recipe.together_rounds, before
        )
        if recipe.at:
            data, frames = (Frames.of(each, size.image_sizes[0], workers) for each in (samples, judging))
            training = replace(training, data=data, judging=frames)
            optimizer, scheduler = _train_together(training, "at full size", recipe.carry_steps)
        plans = training.plans()
        if _hold(policy, judges, judges.errors_pct(plans), np.median(actions, axis=0), say):
            plans = training.plans()
    errors = judges.errors_pct(plans)
    say(f"on recordings that it did not learn from: {judges.words(errors)}")
    checkpoint = {
        "epoch": recipe.carry_steps or recipe.together_steps,
        "model_state_dict": {k: v.cpu().contiguous() for k, v in policy.state_dict().items()},
        "optimizer_state_dict": loop.to_cpu(optimizer.state_dict()),
        "scheduler_state_dict": scheduler.state_dict(),
        "best_val_loss": np.float64(np.abs(plans - judges.chunks)[~judges.is_pad].mean()),
    }
    return checkpoint, judges.summary(errors)


def _hold(
    policy: "ACTPolicy", judges: Judges, errors: np.ndarray, usual: np.ndarray, say: Callable[[str], object]
) -> bool:
    """Plan the usual value of each action that hardly varies and was not learned; return whether there was one.

    A throttle that was held in each session has nothing to do with the picture, and would be guessed from its light.
    errors: by action, (A,), in % of the range. usual: (A,), in the action's unit.
    """
    held = np.flatnonzero(~judges.varies & (errors >= judges.blind_pct))
    head = policy.model.action_head
    with torch.no_grad():
        for i in held.tolist():
            head.weight[i] = 0
            head.bias[i] = float(usual[i])
            say(f"{judges.names[i]} hardly varies, and is held at {usual[i]:.3f}")
    return bool(len(held))


def _train_backbone(training: _Training, model: PlanFromFeatures) -> None:
    """Phase one: train the backbone in rounds, then measure on the data the statistics that stay frozen."""
    recipe, saved, live = training.recipe, training.saved, model.backbone
    at_steps = torch.from_numpy(model.steps).to(training.weights.device)

    def loss(batch: Batch) -> Tensor:
        error = (model(loop.normalised(batch[IMAGE], batch)) - batch[ACTION][:, at_steps]) * training.weights
        return (error.square() * ~batch[IS_PAD][:, at_steps][..., None]).mean()

    def judge() -> tuple[float, np.ndarray]:
        """Return the mean squared error, as of `loss`, and the errors by action, in % of the range."""
        model.eval()
        data, plans = training.judging, []
        with torch.no_grad():
            for rows in training.judging_blocks():
                pictures = torch.from_numpy(data.pictures(rows)).to(training.weights.device)
                plans.append(model(loop.normalised(pictures)).cpu().numpy())
        model.train()
        recorded, known = data.chunks[:, model.steps], ~data.is_pad[:, model.steps]
        errors = (np.concatenate(plans) - recorded)[known]
        squared = float(np.square(errors * training.weights.cpu().numpy()).mean())
        return squared, 100 * np.abs(errors).mean(axis=0) / training.judges.ranges

    def learn(phase: str, number: int) -> None:
        saved.train(
            Phase(phase, recipe.backbone_steps, recipe.backbone_rate / number**0.5),
            model,
            training.rng,
            batch=lambda _: training.batch(recipe.batch),
            loss=loss,
        )

    model.train()
    _in_rounds(training, model, "backbone", recipe.backbone_rounds, BACKBONE_SHARE, learn, judge)
    model.train()
    measure_statistics(live)
    count = 16 if len(training.data) >= 16 * recipe.batch else 4
    drawn = saved.steps("statistics", count, training.rng, lambda _: training.batch(recipe.batch), backbone=live)
    for _, batch in drawn:
        with torch.no_grad():
            live(loop.normalised(batch[IMAGE], batch))
    weights = {k: v for k, v in live.state_dict().items() if not k.endswith("num_batches_tracked")}
    training.policy.model.backbone.load_state_dict(weights)


def _in_rounds(
    training: _Training,
    module: nn.Module,
    name: str,
    rounds: int,
    share: float,
    learn: Callable[[str, int], None],
    judge: Callable[[], tuple[float, np.ndarray]],
    best: float = math.inf,
) -> None:
    """Train a module in rounds while its error falls and the budget lasts, and leave it with its best weights.

    share: of the budget, that this phase and those before it may take. learn: does a round, by its phase's name and its
    number from 1. judge: the error that counts, and the errors by action. best: the error before the first round.
    """
    saved, judged = training.saved, list[list[float]]()
    kept = {k: v.clone() for k, v in module.state_dict().items()}
    for number in range(1, rounds + 1):
        phase = name if number == 1 else f"{name}{ROUND}{number}"
        if number > 1 and not saved.may_begin(phase, number - 1, share * 60 * training.recipe.minutes):
            training.say(f"{name}: the budget of {training.recipe.minutes:g} minutes ends it")
            break
        learn(phase, number)
        error, errors_pct = judge()
        judged.append([number, *map(float, errors_pct)])
        training.say(f"{phase}: {training.judges.words(errors_pct)}")
        falls, before = error < best * (1 - FALLS), best
        if error < before:
            best, kept = error, {k: v.clone() for k, v in module.state_dict().items()}
        if not falls:
            break
    module.load_state_dict(kept)
    saved.judged[name] = judged


def _train_transformer(training: _Training) -> np.ndarray:
    """Phase two: train all but the backbone on features that are computed once, of each frame as it is and varied.

    Returns its errors by action, (A,), in % of the range.
    """
    policy, recipe, data, rng = training.policy, training.recipe, training.data, training.rng
    backbone = policy.model.backbone.eval()
    chosen = np.asarray(pick_evenly(range(len(data)), recipe.feature_samples))
    flipped = rng.random(len(chosen)) < recipe.mirrored  # in the second view
    views = [_features(training, view, data, chosen, backbone, flipped) for view in ("plain", "varied")]
    judged = _features(training, "judges", training.judging, np.arange(len(training.judging)), backbone)

    def batch(step: int) -> Batch:
        kept = rng.choice(len(chosen), min(recipe.transformer_batch, len(chosen)), replace=False)
        rows = chosen[kept]
        states, chunks = loop.swap_states(data, rows, rng), data.chunks[rows].copy()
        if step % 2:
            states[flipped[kept], 0] *= -1
            chunks[flipped[kept], :, 0] *= -1
        arrays = {IMAGE: views[step % 2][kept], STATE: states, ACTION: chunks, IS_PAD: data.is_pad[rows]}
        return loop.on_device(arrays, training.weights.device)

    policy.model.backbone = loop.Given()
    policy.train()
    phase = Phase("transformer", recipe.transformer_steps, recipe.transformer_rate, recipe.transformer_warmup)
    with loop.threads(1 if policy.config.dim_model < SMALL_DIM else torch.get_num_threads()):
        best = Best(lambda: training.judge(judged))
        training.saved.train(phase, policy, rng, batch, training.loss, best)
        errors = training.judge(judged)
    training.say(f"transformer: {training.judges.words(errors)}")
    policy.model.backbone = backbone
    return errors


def _features(
    training: _Training,
    view: str,
    data: Frames,
    chosen: np.ndarray,
    backbone: nn.Module,
    flipped: np.ndarray | None = None,
) -> loop.RowFile:
    """Compute the frozen backbone's maps of chosen rows, (n,), into a file. No gradients: two batches fit at once.

    flipped: (n,) bool, which are mirrored in the view "varied", whose pictures are varied as the backbone's phase does.
    """
    count, (size,), device, rng = (
        2 * training.recipe.batch,
        training.size.image_sizes,
        training.weights.device,
        training.rng,
    )
    maps = loop.RowFile(training.saved.folder / f"{view}.rows", (FEATURES, *training.size.grid(*size)))
    augmentation = training.recipe.augmentation

    def read(step: int) -> Batch:
        rows = slice(step * count, (step + 1) * count)
        images, variation = data.pictures(chosen[rows]), dict[str, np.ndarray]()
        if view == "varied" and flipped is not None:
            images[flipped[rows]] = images[flipped[rows], :, ::-1]
            images, variation = augmentation.shifted(images, rng), augmentation.draw(len(images), rng)
        return loop.on_device({IMAGE: images, **variation}, device)

    for _, batch in training.saved.steps(f"features, {view}", -(-len(chosen) // count), rng, read, maps=maps):
        variation = {name: value for name, value in batch.items() if name != IMAGE}
        with torch.no_grad():
            maps.append(backbone(loop.normalised(batch[IMAGE], variation))["feature_map"].cpu())
    return maps


def _train_together(
    training: _Training, name: str, steps: int, rounds: int = 1, before: np.ndarray | None = None
) -> tuple[torch.optim.Optimizer, Any]:
    """Phase three: all parameters at a tenth of the rate, in rounds; a round stays if it is no worse than before.

    before: the errors by action, (A,), until then, if they are known.
    """
    policy, saved, made = training.policy, training.saved, list[Any]()

    def judge() -> tuple[float, np.ndarray]:
        errors = training.judge()
        return float(errors.mean()), errors

    def learn(phase: str, _: int) -> None:
        policy.train()
        made[:] = saved.train(
            Phase(phase, steps, training.recipe.transformer_rate / 10),
            policy,
            training.rng,
            batch=lambda _: training.batch(training.recipe.together_batch),
            loss=training.loss,
        )

    before = training.judge() if before is None else before
    _in_rounds(training, policy, name, rounds, 1.0, learn, judge, float(before.mean()))
    saved.judged[name].insert(0, [0, *map(float, before)])
    optimizer, scheduler = made
    return optimizer, scheduler
