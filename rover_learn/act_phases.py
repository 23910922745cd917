"""The phases in which a policy learns from recordings: backbone, transformer, both together, and its own size.

    recipe = TrainingRecipe.of("small", "cpu")
    with Resumable(folder, Machine.of()) as saved:
        checkpoint, actions = train_in_phases(recordings, SIZES["small"], recipe, 0, saved, None, print)

The backbone alone, with live batch norm, learns to predict the plan; then the transformer learns on the frozen
backbone's features, which are computed once, with softened plans if the recipe says so; then both learn together at a
tenth of the rate.

A phase stops by what it sees: backbone and whole policy learn in rounds, as long as their error on recordings that they
do not learn from falls, within a budget of minutes. That error is shown by action, beside the best guess without eyes.
No weight depends on the picture's size, so the real car's policy goes through these phases at a quarter of its pixels,
and a few more steps at its own size carry it there.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from rover_learn import training as loop
from rover_learn.augment import Augmentation
from rover_learn.backbone import FEATURES, PlanFromFeatures, Pretrained, live_backbone, measure_statistics
from rover_learn.curves import ROUND
from rover_learn.judges import Judges
from rover_learn.phases import LARGE, Recipe
from rover_learn.soften import soften
from rover_learn.training import ACTION, IMAGE, IS_PAD, SOFTENED, STATE, Batch, Best, Frames, Phase, Resumable
from rover_lib.onboard.params import params
from rover_lib.workshop.act import ActConfig
from rover_lib.workshop.act_config import lerobot_act
from rover_lib.workshop.recordings.episodes import split
from rover_lib.workshop.recordings.samples import Recordings, pick_evenly

if TYPE_CHECKING:
    from lerobot.policies.act.modeling_act import ACTPolicy

SMALL_DIM = 256  # below it, a second thread saves a quarter on a quiet machine, and on a busy one trebles the time
JUDGED_AT_ONCE = 64  # frames
HELD_WEIGHT = 0.1  # of an action that hardly varies: its noise would outweigh what the picture decides
FALLS = 0.02  # a further round is worth its time while the error falls by this share
BACKBONE_SHARE = 0.75  # of the budget, for the backbone's rounds: the other phases take about as long as one of them


@dataclass(frozen=True)
class Overrides:
    """What replaces a recipe's values. steps: of all phases together, of one round each. minutes: the budget."""

    steps: int | None = None
    batch: int | None = None
    minutes: float | None = None


@dataclass(frozen=True, kw_only=True)
class TrainingRecipe(Recipe):
    """How long and how fast each phase trains: an entry of params.yml's section `train`, which explains each number.

    backbone_steps, together_steps: of a round; backbone_rounds, together_rounds: at most. minutes: a budget, of the
    processor or, on a GPU, as they pass: no further round begins that would not fit. mirrored: share of the pictures
    that are turned over. light to noise: see Augmentation. softened: share of the line's plan, as `soften` takes it,
    in what the transformer's squared errors count from; then it learns at softened_rate. at: (height, width) of the
    pictures in all phases but the last; None: the policy's own, and no last phase.
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
    softened: float = 0.0
    softened_rate: float = 2.0e-4
    at: tuple[int, int] | None = None
    carry_steps: int = 0

    @property
    def augmentation(self) -> Augmentation:
        return Augmentation(self.light, self.shift, self.blur, self.noise)

    @classmethod
    def of(cls, size: str, device: str, overrides: Overrides | None = None) -> Self:
        """Return the recipe of params.yml for that size; with cuda's own values, if it has some."""
        recipes = params()["train"]
        values = recipes[size] | (recipes.get(f"{size}_{device}") or {})
        if values.get("at"):
            values |= {"at": tuple(values["at"])}
        recipe = cls.read(f"train: {size}", values)
        overrides = overrides or Overrides()
        if overrides.steps is not None:
            recipe = recipe.of_few(overrides.steps)
        if overrides.minutes is not None:
            recipe = replace(recipe, minutes=overrides.minutes)
        if batch := overrides.batch:
            recipe = replace(recipe, batch=batch, transformer_batch=batch, together_batch=batch)
        return recipe

    def of_few(self, steps: int) -> Self:
        """Return the same recipe with `steps` steps in all, and with fewer frames: they only show that it works."""
        sizes = "batch", "transformer_batch", "together_batch"
        batches = {name: min(getattr(self, name), max(2, steps // 8)) for name in sizes}
        counts = {
            "samples": min(self.samples, max(4 * self.batch, steps * self.batch)),
            "feature_samples": min(self.feature_samples, steps * batches["transformer_batch"]),
            "judged": min(self.judged, max(8, steps)),
        }
        once = replace(self.of_steps(steps), backbone_rounds=1, together_rounds=1, transformer_warmup=0, softened=0.0)
        return replace(once, **(batches | counts))


@dataclass(frozen=True)
class PolicyTraining:
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

    def train(
        self, phase: Phase, module: nn.Module, count: int, loss: Callable[[Batch], Tensor]
    ) -> tuple[torch.optim.Optimizer, Any]:
        """Train a module on batches of `count` frames; return its optimiser and scheduler."""
        return self.saved.train(phase, module, self.rng, lambda _: self.batch(count), loss)

    def loss(self, batch: Batch) -> Tensor:
        """Return the policy's loss; pictures become its input, feature maps are that already."""
        images = loop.normalised(batch[IMAGE], batch)
        return loop.policy_loss(self.policy, {**batch, IMAGE: images}, self.weights)

    def judging_blocks(self) -> list[np.ndarray]:
        """Return the rows of what judges, in blocks that fit into memory."""
        return loop.blocks_of(len(self.judging), JUDGED_AT_ONCE)

    def plans(self, maps: loop.RowFile | None = None) -> np.ndarray:
        """Return the policy's plans on what judges it, (n, C, A). maps: as of `plans_on`."""
        blocks = self.judging_blocks()
        plans = np.concatenate([loop.plans_on(self.policy, self.judging, rows, maps) for rows in blocks])
        self.policy.train()
        return plans

    def overall_error(self, plans: np.ndarray) -> float:
        """Return one error of plans on what judges the policy, (n, C, A), in % of the range."""
        return self.judges.overall_pct(self.judges.errors_pct(plans))

    def judge(self, maps: loop.RowFile | None = None) -> np.ndarray:
        """Return the policy's errors by action, (A,), in % of the range."""
        return self.judges.errors_pct(self.plans(maps))


def train_in_phases(
    recordings: Recordings,
    size: ActConfig,
    recipe: TrainingRecipe,
    seed: int,
    saved: Resumable,
    pretrained: Pretrained | None,
    say: Callable[[str], object],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Train, and return everything in the checkpoint except its config, and what was learned of each action."""
    p = params()["calibration"]
    workers = saved.machine.workers
    parts = split(recordings, p["held_out_share"], p["seed"])
    first = replace(size, image_sizes=(recipe.at,)) if recipe.at else size
    samples = pick_evenly(parts.calibration, recipe.samples)
    judging = pick_evenly(parts.choosing, recipe.judged)
    data = Frames.of(samples, first.image_sizes[0], workers)
    frames = Frames.of(judging, first.image_sizes[0], workers)
    judges = Judges.of(recordings.layout.action_names, data.chunks, data.is_pad, frames.chunks, frames.is_pad)
    actions = data.chunks[~data.is_pad]
    mean = actions.mean(axis=0)
    spread = np.maximum(actions.std(axis=0), 1e-3)
    with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        torch.manual_seed(seed)
        policy = lerobot_act(size)
        # Start with plans near the mean action: those of an untrained head are wild.
        with torch.no_grad():
            policy.model.action_head.weight.mul_(torch.from_numpy(spread)[:, None])
            policy.model.action_head.bias.copy_(torch.from_numpy(mean))
        saved.machine.taking(policy)
        rng = np.random.default_rng([seed, 77])
        loss_weights = torch.from_numpy(loss_weights_of(judges, spread)).to(saved.machine.device)
        training = PolicyTraining(first, policy, data, frames, judges, recipe, loss_weights, rng, saved, say)
        backbone = saved.machine.taking(live_backbone(pretrained))
        head = PlanFromFeatures(backbone, mean, spread, size.chunk).to(saved.machine.device)
        _train_backbone(training, head)
        before = _train_transformer(training)
        optimizer, scheduler = _train_together(
            training, "all together", recipe.together_steps, recipe.together_rounds, before
        )
        if recipe.at:
            data = Frames.of(samples, size.image_sizes[0], workers)
            frames = Frames.of(judging, size.image_sizes[0], workers)
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


def loss_weights_of(judges: Judges, spread: np.ndarray) -> np.ndarray:
    """Return the weight of each action's error, (A,) float32. spread: (A,) of what is learned.

    Errors count in % of the range, so that a throttle that is held does not outweigh steering by its noise. The largest
    spread counts 1, as LeRobot's loss has a second part.
    """
    counting = judges.varies if judges.varies.any() else np.ones_like(judges.varies)
    weights = 1 / judges.ranges / (spread / judges.ranges)[counting].max()
    weights[~counting] *= HELD_WEIGHT
    return weights.astype(np.float32)


def _hold(
    policy: "ACTPolicy", judges: Judges, errors: np.ndarray, usual: np.ndarray, say: Callable[[str], object]
) -> bool:
    """Plan the usual value of each action that hardly varies and was not learned; return whether there was one.

    A throttle that was held in each session has nothing to do with the picture, and would be guessed from its light.
    errors: by action, (A,), in % of the range. usual: (A,), in the action's unit.
    """
    constant = np.flatnonzero(~judges.varies & (errors >= judges.blind_pct))
    head = policy.model.action_head
    with torch.no_grad():
        for i in constant.tolist():
            head.weight[i] = 0
            head.bias[i] = float(usual[i])
            say(f"{judges.names[i]} hardly varies, and is held at {usual[i]:.3f}")
    return bool(len(constant))


def _train_backbone(training: PolicyTraining, model: PlanFromFeatures) -> None:
    """Phase one: train the backbone in rounds, then measure on the data the statistics that stay frozen."""
    recipe = training.recipe
    saved = training.saved
    live = model.backbone
    at_steps = torch.from_numpy(model.steps).to(training.weights.device)

    def loss(batch: Batch) -> Tensor:
        error = (model(loop.normalised(batch[IMAGE], batch)) - batch[ACTION][:, at_steps]) * training.weights
        return (error.square() * ~batch[IS_PAD][:, at_steps][..., None]).mean()

    def judge() -> tuple[float, np.ndarray]:
        """Return the mean squared error, as of `loss`, and the errors by action, in % of the range."""
        model.eval()
        data = training.judging
        plans = []
        with torch.no_grad():
            for rows in training.judging_blocks():
                pictures = torch.from_numpy(data.pictures(rows)).to(training.weights.device)
                plans.append(model(loop.normalised(pictures)).cpu().numpy())
        model.train()
        present = ~data.is_pad[:, model.steps]
        errors = (np.concatenate(plans) - data.chunks[:, model.steps])[present]
        squared = float(np.square(errors * training.weights.cpu().numpy()).mean())
        return squared, 100 * np.abs(errors).mean(axis=0) / training.judges.ranges

    def learn(name: str, number: int) -> None:
        phase = Phase(name, recipe.backbone_steps, recipe.backbone_rate / number**0.5)
        training.train(phase, model, recipe.batch, loss)

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
    training: PolicyTraining,
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
    saved = training.saved
    history = list[list[float]]()
    best_weights = copy.deepcopy(module.state_dict())
    for number in range(1, rounds + 1):
        phase = name if number == 1 else f"{name}{ROUND}{number}"
        if number > 1 and not saved.may_begin(phase, number - 1, share * 60 * training.recipe.minutes):
            training.say(f"{name}: the budget of {training.recipe.minutes:g} minutes ends it")
            break
        learn(phase, number)
        error, errors_pct = judge()
        history.append([number, *map(float, errors_pct)])
        training.say(f"{phase}: {training.judges.words(errors_pct)}")
        falls = error < best * (1 - FALLS)
        if error < best:
            best = error
            best_weights = copy.deepcopy(module.state_dict())
        if not falls:
            break
    module.load_state_dict(best_weights)
    saved.judged[name] = history


def _train_transformer(training: PolicyTraining) -> np.ndarray:
    """Phase two: train all but the backbone on features that are computed once; every other picture is varied.

    Returns its errors by action, (A,), in % of the range.
    """
    policy = training.policy
    recipe = training.recipe
    data = training.data
    rng = training.rng
    backbone = policy.model.backbone.eval()
    sources = np.asarray(pick_evenly(range(len(data)), recipe.feature_samples))  # a row of data for each map
    varied = np.arange(len(sources)) % 2 == 1
    flipped = varied & (rng.random(len(sources)) < recipe.mirrored)
    maps = _features(training, "learned", data, sources, backbone, varied, flipped)
    judging = np.arange(len(training.judging))
    judging_maps = _features(training, "judges", training.judging, judging, backbone)

    chunks = data.chunks[sources]
    chunks[flipped, :, 0] *= -1
    extra = {}
    rate = recipe.transformer_rate
    if recipe.softened:
        rate = recipe.softened_rate
        extra[SOFTENED] = soften(maps, chunks, recipe.softened, judging_maps, training.overall_error)

    def batch(_: int) -> Batch:
        picked = rng.choice(len(sources), min(recipe.transformer_batch, len(sources)), replace=False)
        rows = sources[picked]
        states = loop.swap_states(data, rows, rng)
        states[flipped[picked], 0] *= -1
        arrays = {IMAGE: maps[picked], STATE: states, ACTION: chunks[picked], IS_PAD: data.is_pad[rows]}
        arrays |= {name: plans[picked] for name, plans in extra.items()}
        return loop.on_device(arrays, training.weights.device)

    policy.model.backbone = loop.FeatureInput()
    policy.train()
    phase = Phase("transformer", recipe.transformer_steps, rate, recipe.transformer_warmup)
    with loop.threads(1 if policy.config.dim_model < SMALL_DIM else torch.get_num_threads()):
        best = Best(lambda: training.judge(judging_maps), training.judges.overall_pct)
        training.saved.train(phase, policy, rng, batch, training.loss, best)
        errors = training.judge(judging_maps)
    training.say(f"transformer: {training.judges.words(errors)}")
    policy.model.backbone = backbone
    return errors


def _features(
    training: PolicyTraining,
    name: str,
    data: Frames,
    sources: np.ndarray,
    backbone: nn.Module,
    varied: np.ndarray | None = None,
    flipped: np.ndarray | None = None,
) -> loop.RowFile:
    """Compute the frozen backbone's maps of rows, `sources` (n,), into a file. No gradients: two batches fit at once.

    varied: (n,) bool, whose pictures are varied as the backbone's phase does; flipped: which of them are mirrored.
    """
    recipe = training.recipe
    rng = training.rng
    count = 2 * recipe.batch
    (size,) = training.size.image_sizes
    maps = loop.RowFile(training.saved.folder / f"{name}.rows", (FEATURES, *training.size.grid(*size)))

    def read(step: int) -> Batch:
        rows = slice(step * count, (step + 1) * count)
        images = data.pictures(sources[rows])
        if varied is None or flipped is None:
            return loop.on_device({IMAGE: images}, training.weights.device)
        images[flipped[rows]] = images[flipped[rows], :, ::-1]
        images[varied[rows]] = recipe.augmentation.shifted(images[varied[rows]], rng)
        variation = recipe.augmentation.draw(len(images), rng, of=varied[rows])
        return loop.on_device({IMAGE: images, **variation}, training.weights.device)

    for _, batch in training.saved.steps(f"features, {name}", -(-len(sources) // count), rng, read, maps=maps):
        variation = {key: value for key, value in batch.items() if key != IMAGE}
        with torch.no_grad():
            maps.append(backbone(loop.normalised(batch[IMAGE], variation))["feature_map"].cpu())
    return maps


def _train_together(
    training: PolicyTraining, name: str, steps: int, rounds: int = 1, before: np.ndarray | None = None
) -> tuple[torch.optim.Optimizer, Any]:
    """Phase three: all parameters at a tenth of the rate, in rounds; a round stays if it is no worse than before.

    before: the errors by action, (A,), until then, if they are known.
    """
    policy = training.policy
    last_round: tuple[torch.optim.Optimizer, Any] | None = None

    def judge() -> tuple[float, np.ndarray]:
        errors = training.judge()
        return training.judges.overall_pct(errors), errors

    def learn(name: str, _: int) -> None:
        nonlocal last_round
        policy.train()
        phase = Phase(name, steps, training.recipe.transformer_rate / 10)
        last_round = training.train(phase, policy, training.recipe.together_batch, training.loss)

    if before is None:
        before = training.judge()
    _in_rounds(training, policy, name, rounds, 1.0, learn, judge, training.judges.overall_pct(before))
    training.saved.judged[name].insert(0, [0, *map(float, before)])
    assert last_round is not None  # there is at least one
    return last_round
