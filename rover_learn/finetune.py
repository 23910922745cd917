"""Let a policy go on learning, from what it was trained on and from what a human did where it drove wrong.

    folder = finetune("best_model.pth", ["episodes", "corrected"], "better")

The policy learns what humans did, and nothing else. If a policy drove in an episode too, the human's frames in it are
corrections: they show what to do in places that only that policy reaches, so they are drawn more often. Frames that a
policy or nobody drove are not imitated, and a plan ends where its human let go. The second before a takeover is not
imitated either: the human answers what the policy has done by then, so a plan that begins earlier would have to make
the same mistake first. Published methods do the same: HG-DAgger learns from the human's states alone, and Sirius gives
no weight to the moments before an intervention.

It learns in phases, as a student does (see `distill`): first the transformer on what its backbone sees, then everything
together at a fiftieth of the rate. The run's folder gets best_model.pth, pretrained_model/ and finetune.json.

Letters: n samples, B batch, C chunk, A actions.
"""

import math
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from torch import Tensor

from rover_learn import lessons as lessons_module
from rover_learn import phases, training
from rover_learn.acceptance import Judged, verdict
from rover_learn.lessons import Batch, BatchedPolicy, Lessons, Part, judged_ranges, plans_of
from rover_learn.phases import FromZero, Positive, Recipe, Room, Share, Taught, Weight, Within, Work, make_run
from rover_learn.student import not_a_cars
from rover_learn.training import Resumable
from rover_lib.onboard.car.picture import is_squeezed
from rover_lib.onboard.errors import FinetuneError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.onboard.recording.episode import HUMAN
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop import act
from rover_lib.workshop.cache import cache_root, key_of
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, load_checkpoint
from rover_lib.workshop.judge.recorded_range import not_judged, pct_of_range
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import (
    Episode,
    Recordings,
    Sample,
    Source,
    frame_rate_hz,
    is_another_rate,
    pick_evenly,
)
from rover_lib.workshop.run.run_folder import run_folder
from rover_lib.workshop.run.session import check_sizes, training_device

OLD, NEW = "old", "new"
TOGETHER_SLOWER = 50  # the second phase's rate is this much smaller, so that the backbone does not unlearn to see
DEMONSTRATIONS, ADDITIONS, CORRECTIONS = KINDS = ("demonstrations", "new_demonstrations", "corrections")


@dataclass(frozen=True, kw_only=True)
class FinetuneRecipe(Recipe):
    """How a policy goes on learning: the section `finetune` of params.yml.

    samples: at most this many frames of each folder's demonstrations, and as many of its corrections. rate: the second
    phase has a fiftieth of it. correction_weight: a frame of a correction is drawn this many times as often as one of a
    demonstration. focus: new frames on which the policy planned something else than the human did are drawn more often,
    in proportion to this power of how far off it was; with 0 all are drawn alike.
    to_parent: the share of an old demonstration's loss that is the distance to what the policy planned there before;
    the rest, and all of the loss elsewhere, is the distance to what was recorded. held_out_share: the share of new
    episodes that judge; the old ones are split as for everything else. judged_frames: of each held-out episode.
    """

    SECTION, ERROR, PHASES = "finetune", FinetuneError, ("transformer", "together")

    transformer_steps: FromZero
    together_steps: FromZero
    correction_weight: Positive
    focus: Weight
    to_parent: Share
    held_out_share: Annotated[float, Within("from 0 to below 1", 0, math.nextafter(1, 0))]


def finetune(
    checkpoint: Path | str,
    episodes: Sequence[Path | str | Source],
    name: str,
    *,
    runs_dir: Path | str = "runs",
    recipe: FinetuneRecipe | None = None,
    device: str | None = None,
    progress: Progress = silent,
) -> Path:
    """Let a checkpoint go on learning from old and new recordings, and return the run's folder.

    episodes: folders of recordings. The first has the old ones, which the checkpoint was trained on; the others have
    the new ones. An episode in which a policy drove is new in whichever folder it is. recipe: None takes that of
    params.yml. device: 'cpu', 'cuda', or None for the best that there is.

    If it is ended at any moment and started again with the same arguments, it goes on and gives the same policy. The
    folder appears only when it is complete. Raises FinetuneError for a name, a device or recordings that cannot be
    used; CheckpointError, EpisodeError, TrainingError; RoverError while another process makes a run of that name.
    """
    folder, where = run_folder(runs_dir, name, FinetuneError), training_device(device, FinetuneError)
    if folder.exists():
        raise _is_there(folder)
    recipe = recipe or FinetuneRecipe.of(params())
    parent, material = _open_work(checkpoint, episodes, recipe, progress)
    work = _Work(origin=parent, material=material, recipe=recipe, device=where, progress=progress)
    with make_run(folder, parent.config) as new:
        if folder.exists():  # another process has just made it
            raise _is_there(folder)
        taught = _train_phases(work)
        _leave(new, name, work, taught)
        if folder.exists():  # another command made it meanwhile; what was learned is kept for another name
            raise _is_there(folder)
    shutil.rmtree(taught.folder, ignore_errors=True)  # a process that learns the same may have removed it already
    return folder


def _is_there(folder: Path) -> FinetuneError:
    return FinetuneError(f"{folder}: is there already", remedy="give another --name, or move that run away")


# --- what is learned from ---------------------------------------------------------------------------------------------


def human_samples(episode: Episode) -> tuple[Sample, ...]:
    """Return an episode's samples that a human drove. Their chunks are padded from where that human stopped driving.

    If somebody else drove in the episode too, a frame without a sample, such as one whose picture is damaged, also ends
    a chunk, because nobody knows who drove there.
    """
    drivers = {s.row: s.driver for s in episode.samples}
    if set(drivers.values()) == {HUMAN}:
        return episode.samples
    first, last = min(drivers), max(drivers)
    lasts = np.zeros(last - first + 2, int)  # for how many frames from each one on a human drives
    for i in range(last - first, -1, -1):
        lasts[i] = lasts[i + 1] + 1 if drivers.get(first + i) == HUMAN else 0
    return tuple(
        replace(s, is_pad=s.is_pad | (np.arange(len(s.is_pad)) >= lasts[s.row - first]))
        for s in episode.samples
        if s.driver == HUMAN
    )


@dataclass(frozen=True, eq=False)
class _HeldOut:
    """An episode that judges. kind: OLD or NEW. samples: those that a human drove."""

    name: str
    kind: str
    samples: tuple[Sample, ...]


@dataclass(frozen=True, eq=False)
class _Material:
    """What the policy learns from, and what judges it.

    taught: (kind, a human's frames) of each of the recordings, thinned. The kinds are DEMONSTRATIONS (old), ADDITIONS
    (new demonstrations) and CORRECTIONS. held_out: the episodes that judge. left_out: how many frames are not imitated,
    because a policy or nobody drove.
    """

    recordings: tuple[Recordings, ...]
    taught: tuple[tuple[str, tuple[Sample, ...]], ...]
    held_out: tuple[_HeldOut, ...]
    left_out: int

    def count(self, kind: str) -> int:
        """Count the frames of this kind."""
        return sum(len(samples) for each, samples in self.taught if each == kind)

    def action_range(self) -> dict[str, tuple[float, float]]:
        """Return the smallest and largest value of each action in all recordings."""
        ranges = [r.action_range() for r in self.recordings]
        return {name: (min(r[name][0] for r in ranges), max(r[name][1] for r in ranges)) for name in ranges[0]}


def _open_work(
    checkpoint: Path | str, episodes: Sequence[Path | str | Source], recipe: FinetuneRecipe, progress: Progress
) -> tuple[Checkpoint, _Material]:
    """Read the checkpoint and the recordings, and check that they belong together."""
    if str(checkpoint).endswith((".pt", ".onnx.zip")):
        raise FinetuneError(
            f"{checkpoint}: is an artifact, whose weights are for driving and not for training",
            remedy="give the checkpoint that it was made of: best_model.pth, or LeRobot's pretrained_model folder",
        )
    parent = load_checkpoint(checkpoint)
    _refuse_no_car(parent)
    check_sizes(parent)
    sources = [Source.of(each) for each in episodes]
    if not sources:
        raise FinetuneError("there are no recordings to learn from", remedy="give the old ones, then the new ones")
    places = [str(s.path.resolve()) if isinstance(s.path, Path) else str(s.path) for s in sources]
    if len(set(places)) < len(places):
        raise FinetuneError("the same recordings are given twice", found=", ".join(places), remedy="leave one out")
    p = params()["calibration"]
    read = [load_recordings(source, parent.config.chunk, p["sync_s"], progress) for source in sources]
    policies = [parent.recorded_as(recordings.layout) for recordings in read]
    if any(policy.config != policies[0].config for policy in policies):
        raise FinetuneError(
            "the recordings name, order or time their states and actions differently", found=", ".join(places)
        )
    _refuse_no_car(policies[0])
    _refuse_another_car(read)
    _refuse_another_camera(read)
    _refuse_another_rate(read, policies[0].config.rate_hz)
    return policies[0], _part_episodes(read, recipe)


def _part_episodes(read: Sequence[Recordings], recipe: FinetuneRecipe) -> _Material:
    """Split the old and the new episodes into those to learn from and those that judge."""
    p = params()["calibration"]
    old = [e for e in read[0].episodes if not e.by_policy]
    new = [(r, e) for r in read for e in r.episodes if r is not read[0] or e.by_policy]
    if not new:
        raise FinetuneError(
            f"{read[0].root}: no new episode: in none of them a policy drove",
            remedy="give the new recordings too, after the old ones",
        )
    taught: list[tuple[str, tuple[Sample, ...]]] = []
    held_out = []
    if old:
        parts = split(replace(read[0], episodes=tuple(old)), p["held_out_share"], p["seed"])
        taught.append((DEMONSTRATIONS, _driven_by_humans(parts.calibration, old)))
        for name in dict.fromkeys(s.episode for s in (*parts.choosing, *parts.held_out)):
            samples = tuple(s for s in (*parts.choosing, *parts.held_out) if s.episode == name)
            held_out.append(_HeldOut(name, OLD, _driven_by_humans(samples, old)))
    driven = [(r, e) for r, e in new if any(s.driver == HUMAN for s in e.samples)]
    if not driven:
        raise FinetuneError(
            f"a human drove in none of the {len(new)} new episodes",
            found=f"{sum(len(e.samples) for _, e in new)} frames of a policy or of nobody",
            remedy="a policy cannot learn from its own drives: take over where it drives wrong",
        )
    count = max(round(len(driven) * recipe.held_out_share), 1) if recipe.held_out_share and len(driven) > 1 else 0
    judges = set(np.random.default_rng(recipe.seed).permutation(len(driven))[:count].tolist())
    held_out += [_HeldOut(f"{r.root.name}/{e.id}", NEW, human_samples(e)) for r, e in (driven[i] for i in judges)]
    for recordings in read:
        own = [e for i, (r, e) in enumerate(driven) if r is recordings and i not in judges]
        demonstrated, corrected = [e for e in own if not e.by_policy], [e for e in own if e.by_policy]
        for kind, of_kind in ((ADDITIONS, demonstrated), (CORRECTIONS, corrected)):
            taught.append((kind, tuple(s for e in of_kind for s in human_samples(e))))
    every = [*old, *(e for _, e in new)]
    left_out = sum(s.driver != HUMAN for e in every for s in e.samples)
    return _Material(
        tuple(read),
        tuple((kind, pick_evenly(samples, recipe.samples)) for kind, samples in taught if samples),
        tuple(each for each in held_out if each.samples),
        left_out,
    )


def _driven_by_humans(samples: Sequence[Sample], episodes: Sequence[Episode]) -> tuple[Sample, ...]:
    """Return those of the samples that a human drove, with chunks as `human_samples` pads them."""
    wanted = {(s.episode, s.row) for s in samples}
    names = {s.episode for s in samples}
    return tuple(s for e in episodes if e.id in names for s in human_samples(e) if (s.episode, s.row) in wanted)


def _refuse_no_car(policy: Checkpoint) -> None:
    if found := not_a_cars(policy.config):
        raise FinetuneError(
            f"{policy.path}: only a policy of one camera, steering and throttle can learn from recordings of a car",
            found=found,
            remedy="if it is one, name its numbers so in the dataset's meta/info.json",
        )


def _refuse_another_car(read: Sequence[Recordings]) -> None:
    first = read[0].episodes[0]
    car = first.samples[0].car
    for recordings in read:
        for episode in recordings.episodes:
            if not episode.samples[0].car.drives_like(car):
                raise FinetuneError(
                    f"{episode.path}: was recorded with another car than {first.path}",
                    remedy="a policy drives one car: give recordings of that one alone",
                )


def _refuse_another_camera(read: Sequence[Recordings]) -> None:
    """Compare the first picture of each set of recordings, because all pictures of a set have one shape."""
    shapes = [r.episodes[0].samples[0].frame_bgr().shape[:2] for r in read]
    height, width = shapes[0]
    for recordings, (own_height, own_width) in zip(read, shapes, strict=True):
        if is_squeezed((own_width, own_height), (width, height)):
            raise FinetuneError(
                f"{recordings.root}: its camera has another shape than that of {read[0].root}",
                found=f"{own_width}x{own_height} beside {width}x{height}",
                remedy="a policy looks through one camera: give recordings of that one alone",
            )


def _refuse_another_rate(read: Sequence[Recordings], plans_hz: float) -> None:
    for episode in (episode for recordings in read for episode in recordings.episodes):
        if is_another_rate(found_hz := frame_rate_hz(episode.samples), plans_hz):
            raise FinetuneError(
                f"{episode.path}: the policy plans {plans_hz:g} steps a second",
                found=f"{episode.id} of {found_hz:.1f} frames a second",
                remedy="give recordings of that rate alone: a camera halves its own in the dark",
            )


# --- learning ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class _Work(Work):
    ROLE, VERB = "parent", "finetuned_by"

    material: _Material


def _train_phases(work: _Work) -> Taught:
    """Train both phases. What the policy sees in each of the recordings stays in the cache, for its next training."""
    sources = [lessons_module, phases, training, preprocess, act]
    recipe, parent, ranges = work.recipe, work.origin, judged_ranges(work.material.action_range())
    every = []
    for kind, samples in work.material.taught:
        folder = cache_root() / f"lessons-{key_of(work.sees(samples) | {'kind': kind}, *sources)}"
        lessons = _make_lessons(work, kind, samples, folder)
        every.append((kind, lessons))
        if kind == DEMONSTRATIONS:
            remedy = "give first the recordings that it was trained on"
            lessons.refuse_stranger(parent, ranges, FinetuneError, "the old", remedy)
    whole = {"lessons": [[kind, each.frames.path.parent.name] for kind, each in every], "recipe": asdict(recipe)}
    own = cache_root() / f"finetune-{key_of(whole, sys.modules[__name__], *sources)}"
    room = _Room(work, ranges, every)
    with Resumable(own, work.progress) as saved:
        policy = BatchedPolicy(parent.config, parent.weights).to(work.device)
        policy.thaw()
        room.train(
            saved, "transformer", policy.model, recipe.rate, lambda b: room.loss(policy.plan(b.seen(), b.states()), b)
        )
        slow = recipe.rate / TOGETHER_SLOWER
        room.train(saved, "together", policy, slow, lambda b: room.loss(policy(b.pictures(), b.states()), b))
        losses = dict(saved.losses)
    weights = {name: weight.float() for name, weight in parent.weights.items()} | policy.weights()
    return Taught(weights, losses, own)


def _make_lessons(work: _Work, kind: str, samples: tuple[Sample, ...], folder: Path) -> Lessons:
    """Make or complete the lessons: what the policy sees and plans on these samples before it learns."""
    with Resumable(folder, work.progress) as saved:
        lessons = Lessons.open(folder, samples, work.origin.config, work.origin, work.rng(f"states, {kind}"))
        lessons.ask(saved, work.origin, work.rng(kind), work.device)
    return lessons


class _Room(Room):
    """Draws batches from all lessons, and computes the loss."""

    def __init__(self, work: _Work, ranges: np.ndarray, lessons: Sequence[tuple[str, Lessons]]):
        super().__init__(work, ranges)
        self.lessons = lessons
        counts = [len(each) for _, each in lessons]
        weights = np.concatenate([self._weights(kind, each) for kind, each in lessons])
        self.shares = weights / weights.sum()
        self.places = np.repeat(np.arange(len(lessons)), counts)
        self.rows = np.concatenate([np.arange(count) for count in counts])

    def _weights(self, kind: str, lessons: Lessons) -> np.ndarray:
        """Return how often each sample is drawn, relative to a demonstration's 1, (n,)."""
        recipe = self.work.recipe
        if kind == DEMONSTRATIONS:
            return np.ones(len(lessons))
        planned, driven = lessons.plans[2 * np.arange(len(lessons))], ~lessons.data.is_pad
        off = (np.abs(planned - lessons.data.chunks) * self.units.cpu().numpy()).mean(2)
        off = ((off * driven).sum(1) / driven.sum(1)) ** recipe.focus
        return (recipe.correction_weight if kind == CORRECTIONS else 1.0) * off / max(off.mean(), 1e-9) + 1e-6

    def batch(self, rng: np.random.Generator) -> Batch:
        count = len(self.rows)
        chosen = rng.choice(count, min(self.work.recipe.batch, count), replace=False, p=self.shares)
        views = rng.integers(2, size=len(chosen))
        parts = []
        for place, (kind, lessons) in enumerate(self.lessons):
            own = self.places[chosen] == place
            if own.any():
                parts.append(Part(lessons, self.rows[chosen][own], views[own], kind != DEMONSTRATIONS))
        return Batch(parts, rng, self.work.device)

    def loss(self, plans: Tensor, batch: Batch) -> Tensor:
        """Return the mean absolute error, in units of the recorded range. plans: (B, C, A)."""
        share, driven = batch.share_of_old(self.work.recipe.to_parent), batch.driven()
        to_parent = ((plans - batch.planned()).abs() * self.units * share).sum()
        to_recorded = ((plans - batch.recorded()).abs() * self.units * driven * (1 - share)).sum()
        counted = (share + driven * (1 - share)).expand(*plans.shape[:2], 1).sum()
        return (to_parent + to_recorded) / (counted * len(self.units))


# --- judging and leaving ----------------------------------------------------------------------------------------------


def _judge(work: _Work, weights: dict[str, Tensor]) -> list[Judged]:
    """Judge each held-out episode with the policy as it was before and after."""
    action_range = work.material.action_range()
    policies = [BatchedPolicy(work.origin.config, each).to(work.device) for each in (work.origin.weights, weights)]
    judged = []
    for episode in work.progress(work.material.held_out, desc="judging", total=len(work.material.held_out)):
        samples = pick_evenly(episode.samples, work.recipe.judged_frames)
        driven, recorded = ~np.stack([s.is_pad for s in samples]), np.stack([s.chunk for s in samples])
        errors = [
            np.abs(plans_of(policy, samples).astype(np.float64) - recorded)[driven].mean(0) for policy in policies
        ]
        before, after = (
            {name: pct_of_range(e, ends) for e, (name, ends) in zip(each, action_range.items(), strict=True)}
            for each in errors
        )
        judged.append(Judged(episode.name, episode.kind, len(samples), before, after))
    return judged


def _leave(new: Path, name: str, work: _Work, taught: Taught) -> None:
    """Judge the policy, and write its files and finetune.json into `new`, which becomes the run's folder."""
    parent, material = work.origin, work.material
    judged = _judge(work, taught.weights)
    errors = [e for each in judged if each.kind == OLD for e in each.after.values() if e is not None]
    loss = float(np.mean(errors)) / 100 if errors else float("nan")
    hashes = work.write_policy(new, name, parent.config, taught.weights, loss, material.recordings[-1].root.name)
    write_stage(
        new / "finetune.json",
        "finetune",
        params=work.described(),
        metrics={
            "learned_from": {kind: material.count(kind) for kind in KINDS} | {"not_imitated": material.left_out},
            "held_out": [each.row() for each in judged],
            "verdict": verdict(judged),
            "losses": taught.losses,
            "warnings": not_judged(material.action_range()),
            "files_sha256": hashes,
        },
        inputs={parent.path.name: parent.sha256}
        | {f"{r.root.name}/{name}": digest for r in material.recordings for name, digest in r.hashes().items()},
    )
