"""A smaller policy that is taught by a larger one, on recordings alone.

    folder = distill("best_model.pth", "episodes", "fast", StudentShape(180, 320, decoder_layers=2, feedforward=1600))

The student begins with its teacher's weights (see `student`) and learns in phases: its backbone to see what the teacher
sees, its transformer on what that backbone sees, then all together at a tenth of the rate. It learns what the teacher
plans, and a little what was recorded. Channels that it is to do without go after the first phase (see `channels`).

Letters: n samples, B batch, C chunk, A actions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_learn.channels import without_channels
from rover_learn.lessons import PLANNED, VIEWS, BatchedPolicy, Lessons, Pool, lit, plans_of
from rover_learn.phases import Learned, LessonRecipe, Work, cache_for, free_folder
from rover_learn.student import StudentShape, gmac, initial_weights, student_config
from rover_learn.training import ACTION, IS_PAD, Batch, Machine, Resumable
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop.judge.recorded_range import Range, format_pct, not_judged, pct_of_range
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import Sample, pick_evenly, stack_chunks
from rover_lib.workshop.recordings.source import Source
from rover_lib.workshop.run.session import Opened, load

SLOWER = 10  # the last phase's rate is this much smaller


@dataclass(frozen=True, kw_only=True)
class DistillRecipe(LessonRecipe):
    """How a student is taught: params.yml's section `distill`.

    rate: of the first two phases; the third has a tenth. to_teacher, to_recorded: weights of the two losses, mean
    absolute errors in units of the recorded range. unit_frames: choose a feed-forward's units.
    """

    SECTION = "distill"
    PHASES = ("backbone", "transformer", "together")

    backbone_steps: int
    transformer_steps: int
    together_steps: int
    to_teacher: float
    to_recorded: float
    unit_frames: int


def distill(
    checkpoint: Path | str,
    episodes: Path | str | Source,
    name: str,
    shape: StudentShape,
    *,
    runs_dir: Path | str = "runs",
    recipe: DistillRecipe | None = None,
    machine: Machine | None = None,
    progress: Progress = silent,
) -> Path:
    """Teach a student of that shape what the checkpoint plans on these recordings. Returns the run's folder.

    recipe: params.yml's if None. machine: the best there is if None. Ended at any moment and started
    again with the same arguments, it goes on and gives the same student. The folder appears only when it is complete.
    Raises TrainingError for a student, a device or recordings that cannot be, and for a run that is there.
    """
    folder = free_folder(runs_dir, name)
    machine = machine or Machine.of()
    recipe = recipe or DistillRecipe.of()
    opened = load(checkpoint, episodes, progress)
    teacher = opened.checkpoint
    config = student_config(teacher, shape)
    share = None if shape.backbone_channels == 1 else shape.backbone_channels
    if share is None and config == replace(teacher.config, vae_layers=0):
        raise TrainingError("this student would be its teacher", remedy="give it a smaller picture or fewer layers")
    options: dict[str, Any] = {"recipe": recipe, "machine": machine, "progress": progress, "opened": opened}
    options |= {"share": share, "action_range": opened.recordings.action_range()}
    return Distillation(origin=teacher, config=config, **options).make(folder)


@dataclass(frozen=True, eq=False, kw_only=True)
class Distillation(Work):
    """A student's lessons. share: of its backbone's inner channels that stay, None for all."""

    ROLE, VERB = "teacher", "distilled_by"

    opened: Opened
    share: float | None

    def loss(self, plans: Tensor, batch: Batch) -> Tensor:
        """plans: (B, C, A), the student's. Mean absolute errors to the teacher's and to what was recorded, weighted."""
        recipe = self.recipe
        present = ~batch[IS_PAD][..., None]
        units = self.units
        to_teacher = ((plans - batch[PLANNED]).abs() * units).mean()
        to_recorded = ((plans - batch[ACTION]).abs() * units * present).sum() / (present.sum() * len(units))
        return recipe.to_teacher * to_teacher + recipe.to_recorded * to_recorded

    def learn(self) -> Learned:
        """Train all phases. What depends on teacher, picture and samples alone stays cached for the next student."""
        samples = pick_evenly(self.opened.parts.calibration, self.recipe.samples)
        recipe = self.recipe
        first_phase = [recipe.batch, recipe.backbone_steps, recipe.rate]
        sees = self.sees(samples) | {"size": self.config.image_sizes, "recipe": first_phase}
        folder = cache_for("lessons", sees)
        whole = {"student": asdict(self.config), "share": self.share, "units": self.ranges.tolist()}
        own = cache_for("student", sees | whole | {"whole": asdict(recipe)})
        with Resumable(folder, self.machine, self.progress) as saved:
            lessons = Lessons.open(folder, samples, self.config, self.origin, self.rng("states"))
            lessons.ask(saved, self.origin, self.rng("teacher"))
            backbone = self._train_backbone(lessons, saved)
            losses = dict(saved.losses)
        with Resumable(own, self.machine, self.progress) as saved:
            weights = self._start(lessons, backbone)
            policy = self.machine.taking(BatchedPolicy(self.config, weights))
            if self.share is not None:
                lessons = lessons.apart(own)
                lessons.see(saved, policy, self.rng("tokens"))
            policy.thaw()
            self.train_policy(saved, policy, Pool([(lessons, False)]), self.loss, seen="tokens", slower=SLOWER)
        return Learned(policy.weights(), losses | saved.losses, own)

    def _train_backbone(self, lessons: Lessons, saved: Resumable) -> dict[str, Tensor]:
        """Phase one: the backbone, at the student's picture size, to the teacher's feature map.

        Then its tokens, unless it is to lose channels. Returns its weights; at the teacher's own size they are the
        teacher's.
        """
        teacher = self.origin.at_size(*self.config.image_sizes[0])
        policy = self.machine.taking(BatchedPolicy(teacher.config, teacher.weights))
        policy.thaw()

        def off(batch: Batch) -> Tensor:
            maps = batch["maps"].float()
            return (policy.features(lit(batch)) - maps).square().mean() / maps.square().mean()

        if self.config.image_sizes != self.origin.config.image_sizes:
            pool = Pool([(lessons, False)])
            rate = self.recipe.rate
            self.train(saved, "backbone", policy.backbone, rate, pool, off, "frames", "maps")
        if self.share is None:
            lessons.see(saved, policy, self.rng("tokens"))
        return {name: value for name, value in policy.weights().items() if name.startswith("backbone.")}

    def _start(self, lessons: Lessons, backbone: dict[str, Tensor]) -> dict[str, Tensor]:
        """The student before its transformer learns."""
        rows = pick_evenly(range(len(lessons)), self.recipe.unit_frames)
        states = torch.from_numpy(lessons.data.states)
        inputs = ((states[i][None], torch.from_numpy(lessons.frames[np.array([i])][0])) for i in rows)
        seeing = replace(self.origin, weights=self.origin.weights | backbone)
        weights = initial_weights(seeing, self.config, inputs)
        if self.share is not None:
            blocks = self.progress(lessons.blocks, desc="channels", total=len(lessons.blocks))
            images = (torch.from_numpy(lessons.pictures(rows, rows % len(VIEWS))) for rows in blocks)
            weights = without_channels(weights, self.config, self.share, images, self.rng("channels"))
        return weights

    def leave(self, new: Path, name: str, learned: Learned) -> None:
        """Judge the student, and write its files and distill.json."""
        teacher = self.origin
        parts = self.opened.parts
        recordings = self.opened.recordings
        held_out, choosing = (pick_evenly(part, self.recipe.judged_frames) for part in (parts.held_out, parts.choosing))
        of_teacher = "teacher", teacher.config, teacher.weights, None
        teacher_plans = []
        students = []
        for named, config, weights, share in (of_teacher, (name, self.config, learned.weights, self.share)):
            policy = self.machine.taking(BatchedPolicy(config, weights))
            row = {"name": named, **dict(zip(("height", "width"), config.image_sizes[0], strict=True))}
            row |= {"decoder_layers": config.decoder_layers, "feedforward": config.feedforward}
            row |= {"backbone_channels": share, "gmac": gmac(config, weights)}
            teacher_plans.append(plans_of(policy, held_out, self.progress))
            students.append(row | errors_of(teacher_plans[-1], teacher_plans[0], held_out, self.action_range))
        choosing_plans = plans_of(policy, choosing, self.progress)
        chunks, is_pad = stack_chunks(choosing)
        loss = float(np.abs(choosing_plans - chunks)[~is_pad].mean())
        hashes = self.write_policy(new, name, learned, loss, recordings.root.name)
        metrics: dict[str, Any] = {"students": students, "losses": learned.losses, "files_sha256": hashes}
        metrics |= {"judged_frames": len(held_out), "held_out_episodes": parts.episodes["held_out"]}
        metrics |= {"note": "Judged on recordings alone: nobody drove.", "warnings": not_judged(self.action_range)}
        inputs = {teacher.path.name: teacher.sha256} | recordings.hashes()
        write_stage(new / "distill.json", "distill", params=self.described, metrics=metrics, inputs=inputs)


def errors_of(
    plans: np.ndarray, taught: np.ndarray, samples: Sequence[Sample], action_range: Mapping[str, Range]
) -> dict[str, float | None]:
    """teacher_<action>_pct over whole plans and recorded_<action>_pct over the recorded steps. plans: (n, C, A)."""
    to_teacher = np.abs(plans.astype(np.float64) - taught).mean((0, 1))
    chunks, is_pad = stack_chunks(samples)
    to_recorded = np.abs(plans.astype(np.float64) - chunks)[~is_pad].mean(0)
    errors = {}
    for i, (action, recorded) in enumerate(action_range.items()):
        errors[f"teacher_{action}_pct"] = pct_of_range(to_teacher[i], recorded)
        errors[f"recorded_{action}_pct"] = pct_of_range(to_recorded[i], recorded)
    return errors


def shape_of(row: Mapping[str, Any]) -> str:
    """Return a student's shape, or its teacher's, in words. row: of distill.json or students.json."""
    layers = f"{row['decoder_layers']} decoder layer{'s' if row['decoder_layers'] != 1 else ''}"
    share = f", {row['backbone_channels']:.0%} of the channels" if row.get("backbone_channels") else ""
    return f"{row['width']}x{row['height']}, {layers} of {row['feedforward']}{share}"


def summary(content: Mapping[str, Any]) -> str:
    """Return distill.json as people read it."""
    metrics = content["metrics"]
    actions = [key.removeprefix("teacher_").removesuffix("_pct") for key in metrics["students"][0] if "teacher_" in key]
    lines = [f"errors on held-out episodes, % of the recorded range ({' / '.join(actions)})"]
    for row in metrics["students"]:
        policy = f"{row['name']}: {shape_of(row)}, {row['gmac']:.2f} GMAC"
        to_teacher = _errors(row, "teacher", actions)
        to_recorded = _errors(row, "recorded", actions)
        lines.append(f"{policy}: {to_teacher} to the teacher, {to_recorded} to the recordings")
    return "\n".join([*lines, metrics["note"]])


def _errors(row: Mapping[str, Any], to: str, actions: list[str]) -> str:
    return " / ".join(format_pct(row[f"{to}_{action}_pct"]).strip() for action in actions)
