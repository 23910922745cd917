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

import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rover_learn import lessons as lessons_module
from rover_learn import phases, training
from rover_learn.acceptance import NEW, OLD, Judged, verdict
from rover_learn.lessons import Batch, BatchedPolicy, Lessons, Pool, judged_ranges, plans_of
from rover_learn.phases import Recipe, Work, free_folder, make_run
from rover_learn.student import not_a_cars
from rover_learn.training import Resumable
from rover_lib.onboard.car.picture import is_squeezed
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.onboard.recording.episode import HUMAN
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop import act
from rover_lib.workshop.cache import cache_root, key_of
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, load_checkpoint
from rover_lib.workshop.judge.recorded_range import not_judged, pct_of_range
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings import samples as recorded
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import Episode, Recordings, Sample, Source, pick_evenly
from rover_lib.workshop.run.session import check_sizes, training_device

SLOWER = 50  # the second phase's rate is this much smaller, so that the backbone does not unlearn to see
DEMONSTRATIONS, ADDITIONS, CORRECTIONS = KINDS = ("demonstrations", "new_demonstrations", "corrections")


@dataclass(frozen=True, kw_only=True)
class FinetuneRecipe(Recipe):
    """How a policy goes on learning: the section `finetune` of params.yml, which explains each number."""

    SECTION, ERROR, PHASES = "finetune", TrainingError, ("transformer", "together")

    transformer_steps: int
    together_steps: int
    correction_weight: float
    focus: float
    to_parent: float
    held_out_share: float


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
    folder appears only when it is complete. Raises TrainingError for a name, a device or recordings that cannot be
    used; CheckpointError, EpisodeError, TrainingError; RoverError while another process makes a run of that name.
    """
    folder, where = free_folder(runs_dir, name, TrainingError), training_device(device, TrainingError)
    recipe = recipe or FinetuneRecipe.of(params())
    parent, material = _open_work(checkpoint, episodes, recipe, progress)
    work = _Work(origin=parent, material=material, recipe=recipe, device=where, progress=progress)
    with make_run(folder, parent.config, TrainingError) as new:
        weights, losses, unfinished = _train_phases(work)
        _leave(new, name, work, weights, losses)
    shutil.rmtree(unfinished, ignore_errors=True)  # a process that learns the same may have removed it already
    return folder


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
        remedy = "give the checkpoint that it was made of: best_model.pth, or LeRobot's pretrained_model folder"
        raise TrainingError(f"{checkpoint}: is an artifact, whose weights cannot be trained", remedy=remedy)
    parent = load_checkpoint(checkpoint)
    _refuse_no_car(parent)
    check_sizes(parent)
    sources = [Source.of(each) for each in episodes]
    if not sources:
        raise TrainingError("there are no recordings to learn from", remedy="give the old ones, then the new ones")
    places = [str(s.path.resolve()) if isinstance(s.path, Path) else str(s.path) for s in sources]
    if len(set(places)) < len(places):
        raise TrainingError("the same recordings are given twice", found=", ".join(places), remedy="leave one out")
    p = params()["calibration"]
    read = [load_recordings(source, parent.config.chunk, p["sync_s"], progress) for source in sources]
    policies = [parent.recorded_as(recordings.layout) for recordings in read]
    if any(policy.config != policies[0].config for policy in policies):
        raise TrainingError("the recordings name, order or time states and actions differently", found=places)
    _refuse_no_car(policies[0])
    _refuse_unlike(read, policies[0].config.rate_hz)
    return policies[0], _part_episodes(read, recipe)


def _part_episodes(read: Sequence[Recordings], recipe: FinetuneRecipe) -> _Material:
    """Split the old and the new episodes into those to learn from and those that judge."""
    p = params()["calibration"]
    old = [e for e in read[0].episodes if not e.by_policy]
    new = [(r, e) for r in read for e in r.episodes if r is not read[0] or e.by_policy]
    if not new:
        remedy = "give the new recordings too, after the old ones"
        raise TrainingError(f"{read[0].root}: no new episode: in none of them a policy drove", remedy=remedy)
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
        remedy = "a policy cannot learn from its own drives: take over where it drives wrong"
        raise TrainingError("no human drove in the new episodes", found=len(new), remedy=remedy)
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
        remedy = "if it is of one camera, steering and throttle, name them so in the dataset's meta/info.json"
        raise TrainingError(f"{policy.path}: is not a car's policy", found=found, remedy=remedy)


def _refuse_unlike(read: Sequence[Recordings], plans_hz: float) -> None:
    """Raise TrainingError for recordings of another car, camera or rate than the first's, or the policy's plans."""
    shapes = [r.episodes[0].samples[0].frame_bgr().shape[1::-1] for r in read]  # all pictures of a set have one
    for recordings, (width, height) in zip(read, shapes, strict=True):
        what = ""
        if is_squeezed((width, height), shapes[0]):
            what, found = "another camera", f"{width}x{height} beside {shapes[0][0]}x{shapes[0][1]}"
        for episode in recordings.episodes:
            rate_hz = recorded.frame_rate_hz(episode.samples)
            if not episode.samples[0].car.drives_like(read[0].episodes[0].samples[0].car):
                what, found = "another car", episode.id
            elif recorded.is_another_rate(rate_hz, plans_hz):
                what, found = "another rate", f"{rate_hz:.1f} frames a second in {episode.id}, {plans_hz:g} in a plan"
        if what:
            remedy = f"give recordings of one car, one camera and {plans_hz:g} Hz; in the dark, a camera is slower"
            raise TrainingError(f"{recordings.root}: was recorded with {what}", found=found, remedy=remedy)


# --- learning ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class _Work(Work):
    ROLE, VERB = "parent", "finetuned_by"

    material: _Material


def _train_phases(work: _Work) -> tuple[dict[str, Tensor], dict[str, list[float]], Path]:
    """Train both phases. Returns weights by LeRobot's names, the losses by phase, and the folder of the saved phases.

    What the policy sees in each of the recordings stays in the cache, for its next training.
    """
    sources = [lessons_module, phases, training, preprocess, act]
    recipe, parent, ranges = work.recipe, work.origin, judged_ranges(work.material.action_range())
    units = torch.from_numpy(1 / ranges).to(work.device)
    every = []
    for kind, samples in work.material.taught:
        folder = cache_root() / f"lessons-{key_of(work.sees(samples) | {'kind': kind}, *sources)}"
        with Resumable(folder, work.progress) as saved:
            lessons = Lessons.open(folder, samples, parent.config, parent, work.rng(f"states, {kind}"))
            lessons.ask(saved, parent, work.rng(kind), work.device)
        every.append((kind, lessons))
        if kind == DEMONSTRATIONS:
            remedy = "give first the recordings that it was trained on"
            lessons.refuse_stranger(parent, ranges, TrainingError, "the old", remedy)
    whole = {"lessons": [[kind, each.frames.path.parent.name] for kind, each in every], "recipe": asdict(recipe)}
    own = cache_root() / f"finetune-{key_of(whole, sys.modules[__name__], *sources)}"
    weights = np.concatenate([_weights(recipe, kind, each, units) for kind, each in every])
    pool = Pool([(each, kind != DEMONSTRATIONS) for kind, each in every], weights)

    def loss(plans: Tensor, batch: Batch) -> Tensor:
        """The mean absolute error, in units of the recorded range. plans: (B, C, A)."""
        share, driven = batch.share_of_old(recipe.to_parent), batch.driven()
        to_parent = ((plans - batch.planned()).abs() * units * share).sum()
        to_recorded = ((plans - batch.recorded()).abs() * units * driven * (1 - share)).sum()
        counted = (share + driven * (1 - share)).expand(*plans.shape[:2], 1).sum()
        return (to_parent + to_recorded) / (counted * len(units))

    with Resumable(own, work.progress) as saved:
        policy = BatchedPolicy(parent.config, parent.weights).to(work.device)
        policy.thaw()
        work.train_policy(saved, policy, pool, loss, seen="maps", slower=SLOWER)
        losses = dict(saved.losses)
    return {name: weight.float() for name, weight in parent.weights.items()} | policy.weights(), losses, own


def _weights(recipe: FinetuneRecipe, kind: str, lessons: Lessons, units: Tensor) -> np.ndarray:
    """Return how often each sample is drawn, relative to a demonstration's 1, (n,)."""
    if kind == DEMONSTRATIONS:
        return np.ones(len(lessons))
    planned, driven = lessons.plans[2 * np.arange(len(lessons))], ~lessons.data.is_pad
    off = (np.abs(planned - lessons.data.chunks) * units.cpu().numpy()).mean(2)
    off = ((off * driven).sum(1) / driven.sum(1)) ** recipe.focus
    return (recipe.correction_weight if kind == CORRECTIONS else 1.0) * off / max(off.mean(), 1e-9) + 1e-6


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


def _leave(new: Path, name: str, work: _Work, weights: dict[str, Tensor], losses: dict[str, list[float]]) -> None:
    """Judge the policy, and write its files and finetune.json into `new`, which becomes the run's folder."""
    parent, material = work.origin, work.material
    judged = _judge(work, weights)
    errors = [e for each in judged if each.kind == OLD for e in each.after.values() if e is not None]
    loss = float(np.mean(errors)) / 100 if errors else float("nan")
    hashes = work.write_policy(new, name, parent.config, weights, loss, material.recordings[-1].root.name)
    write_stage(
        new / "finetune.json",
        "finetune",
        params=work.described(),
        metrics={
            "learned_from": {kind: material.count(kind) for kind in KINDS} | {"not_imitated": material.left_out},
            "held_out": [each.row() for each in judged],
            "verdict": verdict(judged),
            "losses": losses,
            "warnings": not_judged(material.action_range()),
            "files_sha256": hashes,
        },
        inputs={parent.path.name: parent.sha256}
        | {f"{r.root.name}/{name}": digest for r in material.recordings for name, digest in r.hashes().items()},
    )
