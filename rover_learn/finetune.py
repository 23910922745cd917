"""Let a policy go on learning, from what it was trained on and from what a human did where it drove wrong.

    folder = finetune("best_model.pth", ["episodes", "corrected"], "better")

The policy learns what humans did, and nothing else. If a policy drove in an episode too, the human's frames in it are
corrections: they show what to do in places that only that policy reaches, so they are drawn more often. Frames that a
policy or nobody drove are not imitated, and a plan ends where its human let go, as in HG-DAgger and Sirius.

It learns in phases, as a student does (see `distill`): first the transformer on what its backbone sees, then everything
together at a fiftieth of the rate.

A fixed rule decides on held-out episodes whether the policy is *better*: its error fell significantly on the new ones,
and did not rise significantly on the old ones. Whole episodes are compared, because the frames of one drive are alike,
by Fisher's randomisation test: if only chance were at work, each episode's difference could equally well have had the
other sign.

Letters: n samples, B batch, C chunk, A actions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from rover_learn.lessons import OLD as IS_OLD
from rover_learn.lessons import PLANNED, BatchedPolicy, Lessons, Pool, plans_of
from rover_learn.phases import Learned, LessonRecipe, Work, cache_for, free_folder
from rover_learn.student import refuse_no_car
from rover_learn.training import ACTION, IS_PAD, Batch, Machine, Resumable
from rover_lib.onboard.car.picture import is_squeezed
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.recording.episode import HUMAN
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, load_checkpoint
from rover_lib.workshop.judge.recorded_range import Range, format_pct, not_judged, pct_of_range
from rover_lib.workshop.pictures.shown import with_faults
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import (
    Episode,
    Recordings,
    Sample,
    block_of,
    frame_rate_hz,
    is_another_rate,
    pick_evenly,
    stack_chunks,
)
from rover_lib.workshop.recordings.source import Source

SLOWER = 50  # the second phase's rate is this much smaller, so that the backbone does not unlearn to see
DEMONSTRATIONS, ADDITIONS, CORRECTIONS = TAUGHT = ("demonstrations", "new_demonstrations", "corrections")
CHANCE = 0.05
LEAST_EPISODES = 6  # with 5, all changed the same way, the chance is 2 in 32
EXACT = 12  # most episodes for which all 2 ** 12 combinations of signs are tried; else DRAWN at random
DRAWN = 10_000
OLD, NEW = KINDS = ("old", "new")


@dataclass(frozen=True, kw_only=True)
class FinetuneRecipe(LessonRecipe):
    """How a policy goes on learning: the section `finetune` of params.yml, which explains each number."""

    SECTION = "finetune"
    PHASES = ("transformer", "together")

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
    machine: Machine | None = None,
    progress: Progress = silent,
) -> Path:
    """Let a checkpoint go on learning from old and new recordings, and return the run's folder.

    episodes: folders of recordings. The first has the old ones, which the checkpoint was trained on; the others have
    the new ones. An episode in which a policy drove is new in whichever folder it is. recipe: None takes that of
    params.yml. machine: None takes the best that there is. It resumes as `distill` does.
    Raises TrainingError for a name, a device or recordings that cannot be used; CheckpointError, EpisodeError.
    """
    folder = free_folder(runs_dir, name)
    machine = machine or Machine.of()
    recipe = recipe or FinetuneRecipe.of()
    parent, read = _open(checkpoint, [Source.of(path) for path in episodes], progress)
    material = _part_episodes(read, recipe)
    both: dict[str, Range] = {}
    for recordings in read:
        for action, (low, high) in recordings.action_range().items():
            lowest, highest = both.get(action, (low, high))
            both[action] = (min(low, lowest), max(high, highest))
    options: dict[str, Any] = {"recipe": recipe, "machine": machine, "progress": progress, "action_range": both}
    return Finetuning(origin=parent, config=parent.config, material=material, **options).make(folder)


# --- what is learned from ---------------------------------------------------------------------------------------------


def human_samples(episode: Episode) -> tuple[Sample, ...]:
    """Return an episode's samples that a human drove, their chunks padded from where that human stopped driving.

    If somebody else drove too, a frame without a sample, such as a damaged picture, also ends a chunk.
    """
    if all(s.driver == HUMAN for s in episode.samples):
        return episode.samples
    samples: list[Sample] = []
    lasts = 0  # for how many frames from each one on a human drives
    following: int | None = None
    for s in reversed(episode.samples):
        if s.driver == HUMAN:
            lasts = lasts + 1 if following == s.row + 1 else 1
            following = s.row
            samples.append(replace(s, is_pad=s.is_pad | (np.arange(len(s.is_pad)) >= lasts)))
    return tuple(reversed(samples))


@dataclass(frozen=True, eq=False)
class _Material:
    """What the policy learns from, and what judges it.

    taught: (kind, a human's frames) of each of the recordings, thinned. held_out: (episode's name, OLD or NEW, a
    human's frames) of those that judge. left_out: how many frames a policy or nobody drove.
    """

    recordings: tuple[Recordings, ...]
    taught: tuple[tuple[str, tuple[Sample, ...]], ...]
    held_out: tuple[tuple[str, str, tuple[Sample, ...]], ...]
    left_out: int


def _open(
    checkpoint: Path | str, sources: Sequence[Source], progress: Progress
) -> tuple[Checkpoint, tuple[Recordings, ...]]:
    """Read the checkpoint and the recordings, and check that they belong together."""
    parent = load_checkpoint(checkpoint, said=sources[0].facts)
    refuse_no_car(parent)
    places = [str(s.path.resolve()) if isinstance(s.path, Path) else str(s.path) for s in sources]
    if len(set(places)) < len(places):
        raise TrainingError("the same recordings are given twice", found=", ".join(places), remedy="leave one out")
    sync_s = params()["calibration"]["sync_s"]
    loaded = (load_recordings(source, parent.config.chunk, sync_s, progress) for source in sources)
    read = tuple(with_faults(recordings, progress) for recordings in loaded)
    policies = [parent.recorded_as(recordings.layout, recordings.samples) for recordings in read]
    if any(policy.config != policies[0].config for policy in policies):
        raise TrainingError("the recordings name, order or time states and actions differently", found=places)
    refuse_no_car(policies[0])
    _refuse_unlike(read, policies[0].config.rate_hz)
    return policies[0], read


def _part_episodes(read: tuple[Recordings, ...], recipe: FinetuneRecipe) -> _Material:
    """Split the old and the new episodes into those to learn from and those that judge."""
    old = [e for e in read[0].episodes if not e.by_policy]
    new = [(read[0], e) for e in read[0].episodes if e.by_policy]
    for recordings in read[1:]:
        new += [(recordings, e) for e in recordings.episodes]
    corrected = []
    for recordings, episode in new:
        if any(s.driver == HUMAN for s in episode.samples):
            corrected.append((recordings, episode))
    if not corrected:
        remedy = "give the new recordings after the old ones, with drives in which a human took over"
        raise TrainingError("no human drove in a new episode", found=f"{len(new)} new episodes", remedy=remedy)
    taught: list[tuple[str, tuple[Sample, ...]]] = []
    held_out: list[tuple[str, str, tuple[Sample, ...]]] = []
    if old:
        p = params()["calibration"]
        parts = split(replace(read[0], episodes=tuple(old)), p["held_out_share"], p["seed"])
        taught.append((DEMONSTRATIONS, _driven_by_humans(parts.calibration, old)))
        judging = (*parts.choosing, *parts.held_out)
        for name in dict.fromkeys(map(block_of, judging)):
            held_out.append((name, OLD, _driven_by_humans([s for s in judging if block_of(s) == name], old)))
    count = 0
    if recipe.held_out_share and len(corrected) > 1:
        count = max(round(len(corrected) * recipe.held_out_share), 1)
    judges = set(np.random.default_rng(recipe.seed).permutation(len(corrected))[:count].tolist())
    for i in judges:
        recordings, episode = corrected[i]
        held_out.append((f"{recordings.root.name}/{episode.id}", NEW, human_samples(episode)))
    for recordings in read:
        by_kind: dict[str, list[Sample]] = {ADDITIONS: [], CORRECTIONS: []}
        for i, (source, episode) in enumerate(corrected):
            if source is recordings and i not in judges:
                by_kind[CORRECTIONS if episode.by_policy else ADDITIONS] += human_samples(episode)
        taught += [(kind, tuple(samples)) for kind, samples in by_kind.items()]
    left_out = 0
    for episode in (*old, *(e for _, e in new)):
        left_out += sum(s.driver != HUMAN for s in episode.samples)
    return _Material(
        read,
        tuple((kind, pick_evenly(samples, recipe.samples)) for kind, samples in taught if samples),
        tuple(entry for entry in held_out if entry[2]),
        left_out,
    )


def _driven_by_humans(samples: Sequence[Sample], episodes: Sequence[Episode]) -> tuple[Sample, ...]:
    """Return those of the samples that a human drove, with chunks as `human_samples` pads them."""
    keys = {(s.episode, s.row) for s in samples}
    human = chain.from_iterable(map(human_samples, episodes))
    return tuple(s for s in human if (s.episode, s.row) in keys)


def _refuse_unlike(read: Sequence[Recordings], plans_hz: float) -> None:
    """Raise TrainingError for recordings of another car, camera or rate than the first's, or the policy's plans."""
    shapes = [r.episodes[0].samples[0].frame_bgr().shape[1::-1] for r in read]  # all pictures of a set have one
    for recordings, (width, height) in zip(read, shapes, strict=True):
        problem = ""
        if is_squeezed((width, height), shapes[0]):
            problem = "another camera"
            actual = f"{width}x{height} beside {shapes[0][0]}x{shapes[0][1]}"
        for episode in recordings.episodes:
            rate_hz = frame_rate_hz(episode.samples)
            if unlike := episode.samples[0].car.unlike(read[0].episodes[0].samples[0].car):
                problem = "another car"
                actual = f"{episode.id}: {unlike}"
            elif is_another_rate(rate_hz, plans_hz):
                problem = "another rate"
                actual = f"{rate_hz:.1f} frames a second in {episode.id}, {plans_hz:g} in a plan"
        if problem:
            remedy = f"give recordings of one car, one camera and {plans_hz:g} Hz; in the dark, a camera is slower"
            raise TrainingError(f"{recordings.root}: was recorded with {problem}", found=actual, remedy=remedy)


# --- learning ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Finetuning(Work):
    """A policy that goes on learning, and from what."""

    ROLE, VERB = "parent", "finetuned_by"

    material: _Material

    def learn(self) -> Learned:
        """Train both phases. What the policy sees in each of the recordings stays cached for its next training."""
        recipe = self.recipe
        parent = self.origin
        all_lessons = []
        for kind, samples in self.material.taught:
            folder = cache_for("lessons", self.sees(samples) | {"kind": kind})
            with Resumable(folder, self.machine, self.progress) as saved:
                lessons = Lessons.open(folder, samples, parent.config, parent, self.rng(f"states, {kind}"))
                lessons.ask(saved, parent, self.rng(kind))
            all_lessons.append((kind, lessons))
        names = [[kind, own.frames.path.parent.name] for kind, own in all_lessons]
        folder = cache_for("finetune", {"lessons": names, "recipe": asdict(recipe)})
        weights = np.concatenate([_weights(recipe, kind, own, 1 / self.ranges) for kind, own in all_lessons])
        pool = Pool([(own, kind != DEMONSTRATIONS) for kind, own in all_lessons], weights)
        with Resumable(folder, self.machine, self.progress) as saved:
            policy = self.machine.taking(BatchedPolicy(parent.config, parent.weights))
            policy.thaw()
            self.train_policy(saved, policy, pool, self.loss, seen="maps", slower=SLOWER)
        trained = {name: weight.float() for name, weight in parent.weights.items()} | policy.weights()
        return Learned(trained, dict(saved.losses), saved.folder)

    def loss(self, plans: Tensor, batch: Batch) -> Tensor:
        """The mean absolute error, in units of the recorded range. plans: (B, C, A)."""
        units = self.units
        share = self.recipe.to_parent * batch[IS_OLD]
        present = ~batch[IS_PAD][..., None]
        to_parent = ((plans - batch[PLANNED]).abs() * units * share).sum()
        to_recorded = ((plans - batch[ACTION]).abs() * units * present * (1 - share)).sum()
        weights_sum = (share + present * (1 - share)).expand(*plans.shape[:2], 1).sum()
        return (to_parent + to_recorded) / (weights_sum * len(units))

    def judge(self, weights: dict[str, Tensor]) -> list[dict[str, Any]]:
        """Judge each held-out episode with the policy as it was before and after: finetune.json's rows."""
        held_out = self.material.held_out
        rows = []
        policies = {"before": self.origin.weights, "after": weights}
        candidates = {when: self.machine.taking(BatchedPolicy(self.config, state)) for when, state in policies.items()}
        for name, kind, samples_of in self.progress(held_out, desc="judging", total=len(held_out)):
            samples = pick_evenly(samples_of, self.recipe.judged_frames)
            chunks, is_pad = stack_chunks(samples)
            row: dict[str, Any] = {"episode": name, "kind": kind, "frames": len(samples)}
            for when, policy in candidates.items():
                off = np.abs(plans_of(policy, samples).astype(np.float64) - chunks)[~is_pad].mean(0)
                for error, (action, ends) in zip(off, self.action_range.items(), strict=True):
                    row[f"{when}_{action}_pct"] = pct_of_range(error, ends)
            rows.append(row)
        return rows

    def leave(self, new: Path, name: str, learned: Learned) -> None:
        """Judge the policy, and write its files and finetune.json."""
        material = self.material
        rows = self.judge(learned.weights)
        errors = []
        for row in rows:
            if row["kind"] == OLD:
                errors += [row[key] for key in row if key.startswith("after_") and row[key] is not None]
        loss = float(np.mean(errors)) / 100 if errors else float("nan")
        hashes = self.write_policy(new, name, learned, loss, material.recordings[-1].root.name)
        counts = dict.fromkeys(TAUGHT, 0) | {"not_imitated": material.left_out}
        for kind, samples in material.taught:
            counts[kind] += len(samples)
        cautions = chain.from_iterable(r.cautions() for r in material.recordings)
        metrics = {"learned_from": counts, "losses": learned.losses, "files_sha256": hashes}
        metrics |= {"held_out": rows, "verdict": verdict(rows), "warnings": [*not_judged(self.action_range), *cautions]}
        inputs = {self.origin.path.name: self.origin.sha256}
        for r in material.recordings:
            inputs |= {f"{r.root.name}/{file}": digest for file, digest in r.hashes().items()}
        write_stage(new / "finetune.json", "finetune", params=self.described, metrics=metrics, inputs=inputs)


def _weights(recipe: FinetuneRecipe, kind: str, lessons: Lessons, units: np.ndarray) -> np.ndarray:
    """Return how often each sample is drawn, relative to a demonstration's 1, (n,)."""
    if kind == DEMONSTRATIONS:
        return np.ones(len(lessons))
    planned = lessons.plans[2 * np.arange(len(lessons))]
    present = ~lessons.data.is_pad
    off = (np.abs(planned - lessons.data.chunks) * units).mean(2)
    off = ((off * present).sum(1) / present.sum(1)) ** recipe.focus
    return (recipe.correction_weight if kind == CORRECTIONS else 1.0) * off / max(off.mean(), 1e-9) + 1e-6


# --- is it better? ----------------------------------------------------------------------------------------------------


def change_points(row: Mapping[str, Any]) -> float:
    """Return the change of an episode's error (after - before), the mean of the judged actions. Below 0 is better.

    row: before_<action>_pct and after_<action>_pct, mean absolute errors in percent of the action's recorded range;
    None for an action that never changes.
    """
    changes = []
    for key, before in row.items():
        after = row.get(key.replace("before_", "after_", 1))
        if key.startswith("before_") and before is not None and after is not None:
            changes.append(after - before)
    return float(np.mean(changes)) if changes else 0.0


def chance_of(changes: Sequence[float]) -> float:
    """The two-sided p-value: how often changes with random signs have a mean at least as far from 0."""
    differences = np.asarray(changes, float)
    if len(differences) <= EXACT:
        signs = np.array(list(product((-1.0, 1.0), repeat=len(differences))))
    else:
        drawn = np.random.default_rng(0).choice([-1.0, 1.0], (DRAWN, len(differences)))
        signs = np.vstack([np.ones(len(differences)), drawn])
    threshold = abs(differences.sum()) * (1 - 1e-9)  # the last bit of a sum depends on the order of adding
    return float((np.abs(signs @ differences) >= threshold).mean())


def verdict(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return {"better": True, False, or None if it cannot be decided, "why", "kinds": the figures of each kind}.

    rows: of held-out episodes, each with its `kind`, OLD or NEW, and its errors as `change_points` takes them.
    """
    kinds: dict[str, Any] = {}
    for kind in KINDS:
        changes = [change_points(row) for row in rows if row["kind"] == kind]
        kinds[kind] = {
            "episodes": len(changes),
            "change_points": float(np.mean(changes)) if changes else None,
            "chance": chance_of(changes) if changes else None,
        }
    better, why = _judge(kinds)
    return {"better": better, "why": why, "kinds": kinds}


def _judge(kinds: Mapping[str, Any]) -> tuple[bool | None, str]:
    scarce: list[str] = []
    sure_changes: dict[str, float] = {}
    for kind in KINDS:
        figures = kinds[kind]
        if figures["episodes"] < LEAST_EPISODES:
            scarce.append(f"{figures['episodes']} {kind}")
        elif figures["chance"] < CHANCE:
            sure_changes[kind] = figures["change_points"]
    if sure_changes.get(OLD, 0) > 0:
        return False, f"not better: on the old episodes it is {sure_changes[OLD]:.2f} points further from the human"
    if sure_changes.get(NEW, 0) > 0:
        return False, f"worse: on the new episodes it is {sure_changes[NEW]:.2f} points further from the human"
    if scarce:
        return None, f"undecided: {' and '.join(scarce)} held-out episodes, of at least {LEAST_EPISODES} each"
    if NEW not in sure_changes:
        return None, "undecided: on the new episodes the difference may be chance"
    nearer = -sure_changes[NEW]
    return True, f"better: on the new episodes it is {nearer:.2f} points nearer to the human, and no worse on the old"


def summary(content: Mapping[str, Any]) -> str:
    """The content of finetune.json as text for people."""
    metrics = content["metrics"]
    lines = ["frames: " + ", ".join(f"{n} {kind.replace('_', ' ')}" for kind, n in metrics["learned_from"].items())]
    for row in metrics["held_out"]:
        errors = [f"{key.removesuffix('_pct')} {format_pct(row[key]).strip()}" for key in row if key.endswith("_pct")]
        lines.append(f"{row['kind']} {row['episode']}, error: {', '.join(errors)}".replace("_", " "))
    return "\n".join([*lines, metrics["verdict"]["why"], *metrics["warnings"]])
