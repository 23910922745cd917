"""A smaller policy that is taught by a larger one, on recordings alone.

    folder = distill("best_model.pth", "episodes", "fast", StudentShape(180, 320, decoder_layers=2, feedforward=1600))

The student begins with its teacher's weights (see `student`) and learns in phases: its backbone to see what the teacher
sees, its transformer on what that backbone sees, then all together at a tenth of the rate. It learns what the teacher
plans, and a little what was recorded. Channels that it is to do without go after the first phase (see `channels`). With
qat it then learns on, rounded as its export rounds it (see `fake_quant`).
The run's folder gets best_model.pth, pretrained_model/, policy_static.pt and distill.json.

Letters: n samples, B batch, C chunk, A actions.
"""

import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_learn import channels, phases, refit, training
from rover_learn import lessons as lessons_module
from rover_learn import student as student_module
from rover_learn.channels import without_channels
from rover_learn.fake_quant import RoundedPolicy
from rover_learn.lessons import Batch, BatchedPolicy, Lessons, Pool, as_driven, judged_ranges, plans_of
from rover_learn.phases import Recipe, Work, free_folder, make_run
from rover_learn.student import StudentShape, gmac, initial_weights, student_config
from rover_learn.training import Resumable
from rover_lib.onboard.columns import align
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop import act
from rover_lib.workshop.act import ACT, ActConfig, inputs_of, predictions
from rover_lib.workshop.cache import cache_root, key_of
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, load_checkpoint
from rover_lib.workshop.checkpoint.files import find_written
from rover_lib.workshop.int8.export import export
from rover_lib.workshop.int8.frames import describe_odd
from rover_lib.workshop.int8.observe import Calibration, calibrate
from rover_lib.workshop.int8.quantize import QuantizedPolicy, quantize
from rover_lib.workshop.int8.scheme import Scheme
from rover_lib.workshop.judge.compare import gate
from rover_lib.workshop.judge.recorded_range import Range, format_pct, not_judged, pct_of_range, worst
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import Sample
from rover_lib.workshop.recordings.samples import Source, pick_evenly
from rover_lib.workshop.run import pipeline as quantization
from rover_lib.workshop.run.session import Opened, load, training_device

NOBODY_DROVE = "Judged on recordings alone: nobody drove."
SLOWER = 10  # the last phase's rate is this much smaller


@dataclass(frozen=True, kw_only=True)
class DistillRecipe(Recipe):
    """How a student is taught: params.yml's section `distill`.

    rate: of the first two phases; the third has a tenth. to_teacher, to_recorded: weights of the two losses, mean
    absolute errors in units of the recorded range. unit_frames: choose a feed-forward's units.
    """

    SECTION, ERROR, PHASES = "distill", TrainingError, ("backbone", "transformer", "together", "qat")

    backbone_steps: int
    transformer_steps: int
    together_steps: int
    qat_steps: int
    qat_rate: float
    to_teacher: float
    to_recorded: float
    unit_frames: int

    def __post_init__(self):
        super().__post_init__()
        if not self.to_teacher + self.to_recorded > 0:
            raise TrainingError("to_teacher and to_recorded are both 0", remedy="a student learns from one of them")


def phases_of(shape: StudentShape, qat: bool) -> list[str]:
    """The phases in which a student of that shape learns: one of its teacher's own shape only rounding."""
    phases = ["backbone"] if (shape.height, shape.width) != (None, None) else []
    if shape != StudentShape():
        phases += ["transformer", "together"]
    return [*phases, "qat"] if qat else phases


def distill(
    checkpoint: Path | str,
    episodes: Path | str | Source,
    name: str,
    shape: StudentShape,
    *,
    runs_dir: Path | str = "runs",
    recipe: DistillRecipe | None = None,
    qat: bool = False,
    device: str | None = None,
    progress: Progress = silent,
) -> Path:
    """Teach a student of that shape what the checkpoint plans on these recordings. Returns the run's folder.

    recipe: params.yml's if None. qat: quantization-aware training at the end; then the student may have its
    teacher's own shape, and that is all that is done. device: 'cpu', 'cuda' or None for the best there is.
    Ended at any moment and started again with the same arguments, it goes on and gives the same student. The folder
    appears only when it is complete. Raises TrainingError for a student, a device or recordings that cannot be, and for
    a run that is there; CheckpointError, EpisodeError, TrainingError; RoverError while another process makes it.
    """
    folder, where = free_folder(runs_dir, name, TrainingError), training_device(device, TrainingError)
    recipe = recipe or DistillRecipe.of(params())
    opened = load(checkpoint, episodes, progress)
    config = student_config(opened.checkpoint, shape)
    share = None if shape.backbone_channels == 1 else shape.backbone_channels
    given: dict[str, Any] = {"opened": opened, "config": config, "share": share, "qat": qat}
    work = _Work(origin=opened.checkpoint, recipe=recipe, device=where, progress=progress, **given)
    if work.is_teacher and not qat:
        remedy = "give it a smaller picture, fewer layers or channels, or train it for INT8 with --qat"
        raise TrainingError("this student would be its teacher", remedy=remedy)
    with make_run(folder, config, TrainingError) as new:
        taught = _teach(work)
        _leave(new, name, work, taught)
    shutil.rmtree(taught.folder, ignore_errors=True)  # who learns the same under another name may have removed it
    return folder


@dataclass(frozen=True, eq=False, kw_only=True)
class _Work(Work):
    """What is to be done. config: the student's. share: of its backbone's inner channels that stay, None for all."""

    ROLE, VERB = "teacher", "distilled_by"

    opened: Opened
    config: ActConfig
    share: float | None
    qat: bool

    @property
    def is_teacher(self) -> bool:
        """Whether the student has its teacher's shape: then there is only rounding to learn."""
        return self.share is None and self.config == replace(self.origin.config, vae_layers=0)

    def ranges(self) -> np.ndarray:
        """(A,) float32: each action's recorded range, in which errors are counted."""
        return judged_ranges(self.opened.recordings.action_range())

    def units(self) -> Tensor:
        return torch.from_numpy(1 / self.ranges()).to(self.device)

    def loss(self, plans: Tensor, batch: Batch) -> Tensor:
        """plans: (B, C, A), the student's. Mean absolute errors to the teacher's and to what was recorded, weighted."""
        recipe, driven, units = self.recipe, batch.driven(), self.units()
        to_teacher = ((plans - batch.planned()).abs() * units).mean()
        to_recorded = ((plans - batch.recorded()).abs() * units * driven).sum() / (driven.sum() * len(units))
        return recipe.to_teacher * to_teacher + recipe.to_recorded * to_recorded


@dataclass(frozen=True, eq=False)
class _Taught:
    """A student that has learned.

    weights: by LeRobot's names without the leading `model.`. losses: by phase. folder: where the phases are saved.
    notes: what it was made to do without, by part. unrounded: its weights before it learned to be INT8, and how they
    are rounded; None without.
    """

    weights: dict[str, Tensor]
    losses: dict[str, list[float]]
    folder: Path
    notes: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    unrounded: tuple[dict[str, Tensor], Scheme, Calibration] | None = None


# --- teaching ---------------------------------------------------------------------------------------------------------


def _teach(work: _Work) -> _Taught:
    """All phases. What depends on teacher, picture and samples alone stays in the cache, for its next student."""
    samples, recipe = pick_evenly(work.opened.parts.calibration, work.recipe.samples), work.recipe
    sees = work.sees(samples) | {
        "size": work.config.image_sizes,
        "recipe": [recipe.batch, recipe.backbone_steps, recipe.rate],
    }
    sources = [sys.modules[__name__], phases, lessons_module, student_module, channels, refit]
    sources += [training, preprocess, act]
    folder = cache_root() / f"lessons-{key_of(sees, *sources)}"
    own = cache_root() / f"student-{key_of(sees | _learns(work), *sources)}"
    with Resumable(folder, work.progress) as saved:
        lessons = Lessons.open(folder, samples, work.config, work.origin, work.rng("states"))
        lessons.ask(saved, work.origin, work.rng("teacher"), work.device)
        remedy = "give recordings of the car and the camera that it was trained for"
        lessons.refuse_stranger(work.origin, work.ranges(), TrainingError, "these", remedy)
        backbone = _train_backbone(work, lessons, saved)
        losses = dict(saved.losses)
    with Resumable(own, work.progress) as saved:
        weights, notes = _start(work, lessons, backbone)
        policy = BatchedPolicy(work.config, weights).to(work.device)
        if work.share is not None:
            lessons = lessons.apart(own)
            lessons.see(saved, policy, work.rng("tokens"))
        policy.thaw()
        unrounded, pool = None, Pool([(lessons, False)])
        if not work.is_teacher:
            work.train_policy(saved, policy, pool, work.loss, seen="tokens", slower=SLOWER)
        if work.qat:
            unrounded = _train_rounded(work, pool, policy, saved)
        losses |= saved.losses
    return _Taught(policy.weights(), losses, own, notes, unrounded)


def _learns(work: _Work) -> dict[str, Any]:
    """What a student depends on besides: its losses' units too, and what its ranges are read off if it is rounded."""
    p, choosing = params(), work.opened.parts.choosing
    rounded = [p["calibration"], p["quantization"], [(s.episode, s.row) for s in choosing]]
    return {
        "student": asdict(work.config),
        "share": work.share,
        "whole": asdict(work.recipe),
        "units": work.ranges().tolist(),
        "rounded": rounded if work.qat else None,
    }


def _train_backbone(work: _Work, lessons: Lessons, saved: Resumable) -> dict[str, Tensor]:
    """Phase one: the backbone, at the student's picture size, to the teacher's feature map. Then its tokens, unless it
    is to lose channels.

    Returns its weights by LeRobot's names. At the teacher's own size it is the teacher's, as it is.
    """
    teacher = work.origin.at_size(*work.config.image_sizes[0])
    policy = BatchedPolicy(teacher.config, teacher.weights).to(work.device)
    policy.thaw()

    def off(batch: Batch) -> Tensor:
        shown = batch.seen()
        return (policy.features(batch.pictures()) - shown).square().mean() / shown.square().mean()

    if work.config.image_sizes != work.origin.config.image_sizes:
        work.train(saved, "backbone", policy.backbone, work.recipe.rate, Pool([(lessons, False)]), off)
    if not work.is_teacher and work.share is None:
        lessons.see(saved, policy, work.rng("tokens"))
    return {name: value for name, value in policy.weights().items() if name.startswith("backbone.")}


def _start(
    work: _Work, lessons: Lessons, backbone: dict[str, Tensor]
) -> tuple[dict[str, Tensor], dict[str, list[dict[str, Any]]]]:
    """The student before its transformer learns, and what was noted of what it does without, by part."""
    rows = pick_evenly(range(len(lessons)), work.recipe.unit_frames)
    states = torch.from_numpy(lessons.data.states)
    inputs = ((states[i][None], torch.from_numpy(lessons.frames[np.array([i])][0])) for i in rows)
    seeing = replace(work.origin, weights=work.origin.weights | backbone)
    weights, narrowed = initial_weights(seeing, work.config, inputs)
    thinner: list[dict[str, Any]] = []
    if work.share is not None:
        pictures = work.progress(lessons.each_once(), desc="channels", total=lessons.blocks)
        shown = (torch.from_numpy(block) for block in pictures)
        weights, thinner = without_channels(weights, work.config, work.share, shown, work.rng("channels"))
    return weights, {"backbone": thinner, "feed_forward": narrowed}


def _train_rounded(
    work: _Work, pool: Pool, policy: BatchedPolicy, saved: Resumable
) -> tuple[dict[str, Tensor], Scheme, Calibration]:
    """Phase four: as INT8 the student learns to plan what it planned before, in float, on the very same pictures.

    Nothing else, so that all that it changes is what rounding costs. Rounded by the ranges that it has before. Returns
    its weights before, and how they are rounded.
    """
    student, units = _checkpoint(work, policy.weights()), work.units()
    calibration, scheme = _calibrate(work, student)
    rounded = RoundedPolicy(student, scheme, calibration).to(work.device)
    exact = BatchedPolicy(work.config, student.weights).to(work.device)

    def off(batch: Batch) -> Tensor:
        pictures, states = batch.pictures(), batch.states()
        with torch.no_grad():
            wanted = exact(pictures, states)
        return ((rounded(policy.named_weights(), pictures, states) - wanted).abs() * units).mean()

    work.train(saved, "qat", policy, work.recipe.qat_rate, pool, off)
    return student.weights, scheme, calibration


def _checkpoint(work: _Work, weights: dict[str, Tensor]) -> Checkpoint:
    """The student as quantization wants it, before it is a file."""
    return Checkpoint(Path("student"), "trainer", work.config, weights, "not written yet", {})


def _calibrate(work: _Work, student: Checkpoint) -> tuple[Calibration, Scheme]:
    """Calibration, and static INT8 with the observer that loses least: as a run of the student would have them."""
    how = quantization.Recipe.of(params())
    samples, _ = how.choose(work.opened.parts.calibration)
    calibration = calibrate(student, samples, smooth=how.scheme.smooth, progress=work.progress)
    chooser = quantization.prepare_chooser(student, work.opened, calibration)
    return calibration, chooser.observer(how.scheme, how.observers, work.progress)[0]


# --- judging ----------------------------------------------------------------------------------------------------------


def errors_of(
    plans: np.ndarray, taught: np.ndarray, samples: Sequence[Sample], action_range: dict[str, Range]
) -> dict[str, float | None]:
    """teacher_<action>_pct over whole plans and recorded_<action>_pct over the recorded steps. plans: (n, C, A)."""
    to_teacher = np.abs(plans.astype(np.float64) - taught).mean((0, 1))
    driven = ~np.stack([s.is_pad for s in samples])
    to_recorded = np.abs(plans.astype(np.float64) - np.stack([s.chunk for s in samples]))[driven].mean(0)
    errors = {}
    for i, (action, recorded) in enumerate(action_range.items()):
        errors[f"teacher_{action}_pct"] = pct_of_range(to_teacher[i], recorded)
        errors[f"recorded_{action}_pct"] = pct_of_range(to_recorded[i], recorded)
    return errors


def _int8_errors(
    work: _Work, weights: dict[str, Tensor], rounded: QuantizedPolicy, samples: Sequence[Sample], taught: np.ndarray
) -> dict[str, float | None]:
    """Of a student in static INT8: int8_<action>_pct to its own FP32, int8_teacher_<action>_pct to the teacher.

    weights: the student's. rounded: the same in INT8. taught: (n, C, A), what the teacher would drive; the student's
    plans are clipped like them to be compared.
    """
    inputs = [inputs_of(s, work.config) for s in samples]
    own, int8 = (predictions(policy, inputs) for policy in (ACT(work.config, weights), rounded.module))
    driven = torch.from_numpy(as_driven(int8.numpy(), work.config.action_names, samples))
    errors: dict[str, float | None] = {}
    for i, (action, recorded) in enumerate(work.opened.recordings.action_range().items()):
        for name, plans, other in (("int8", int8, own), ("int8_teacher", driven, torch.from_numpy(taught))):
            off = (plans[..., i] - other[..., i]).abs().mean().item()
            errors[f"{name}_{action}_pct"] = pct_of_range(off, recorded)
    return errors


def _shape(
    name: str, config: ActConfig, weights: dict[str, Tensor], share: float | None = None, qat: bool = False
) -> dict[str, Any]:
    """How a policy's row of students.json begins. share: of the backbone's inner channels, None: all."""
    ((height, width),) = config.image_sizes
    return {
        "name": name,
        "height": height,
        "width": width,
        "decoder_layers": config.decoder_layers,
        "feedforward": config.feedforward,
        "backbone_channels": share,
        "qat": qat,
        "gmac": gmac(config, weights),
    }


def summary(content: dict[str, Any]) -> str:
    """distill.json as people read it."""
    metrics = content["metrics"]
    student = metrics["students"][1]
    actions = [key.removeprefix("teacher_").removesuffix("_pct") for key in student if key.startswith("teacher_")]

    def errors(row: dict[str, Any], to: str) -> str:
        return " / ".join(format_pct(row[f"{to}_{action}_pct"]).strip() for action in actions)

    lines = [["", "picture", "decoder", "GMAC", "to the teacher", "to the recordings"]]
    for row in metrics["students"]:
        share = f", {row['backbone_channels']:.0%} of channels" if row["backbone_channels"] else ""
        decoder = f"{row['decoder_layers']} x {row['feedforward']}{share}"
        size = f"{row['width']}x{row['height']}"
        lines.append(
            [row["name"], size, decoder, f"{row['gmac']:.2f}", errors(row, "teacher"), errors(row, "recorded")]
        )
    said = [f"errors on held-out episodes, % of the recorded range ({' / '.join(actions)})", *align(lines)]
    for title, row in (("before quantization-aware training", metrics["before_qat"]), ("in INT8", student)):
        if row:
            said.append(f"{title}: to its own FP32 {errors(row, 'int8')}; to the teacher {errors(row, 'int8_teacher')}")
    for row in metrics["gates"]:
        if row["passed"] is False:
            why = "`rover run` says where it comes from" if metrics["before_qat"] else "train with --qat"
            why = "`rover run` names its odd frames" if metrics["odd"] else why
            said.append(f"INT8 loses {row['found']:.1f} % of the recorded range, more than {row['limit']} %: {why}")
    return "\n".join([*said, metrics["note"]])


# --- what is left in the run's folder ---------------------------------------------------------------------------------


def _leave(new: Path, name: str, work: _Work, taught: _Taught) -> None:
    """Judge the student, and write its files and distill.json into a folder that will be the run's of that name."""
    teacher, parts, action_range = work.origin, work.opened.parts, work.opened.recordings.action_range()
    held_out, choosing = (pick_evenly(each, work.recipe.judged_frames) for each in (parts.held_out, parts.choosing))
    teachers, own = (
        BatchedPolicy(config, weights).to(work.device)
        for config, weights in ((teacher.config, teacher.weights), (work.config, taught.weights))
    )
    planned = plans_of(teachers, held_out, work.progress)
    students = [
        row | errors_of(plans, planned, held_out, action_range)
        for row, plans in (
            (_shape("teacher", teacher.config, teacher.weights), planned),
            (
                _shape(name, work.config, taught.weights, work.share, work.qat),
                plans_of(own, held_out, work.progress),
            ),
        )
    ]
    exact = _checkpoint(work, taught.weights)
    calibration, scheme = _calibrate(work, exact)
    rounded = quantize(exact, scheme, calibration)
    students[1] |= _int8_errors(work, taught.weights, rounded, held_out, planned)
    unrounded = None
    if taught.unrounded:
        weights, before_scheme, before_calibration = taught.unrounded
        before = quantize(_checkpoint(work, weights), before_scheme, before_calibration)
        unrounded = _int8_errors(work, weights, before, held_out, planned)
    chosen, driven = plans_of(own, choosing, work.progress), ~np.stack([s.is_pad for s in choosing])
    loss = float(np.abs(chosen - np.stack([s.chunk for s in choosing]))[driven].mean())
    hashes = work.write_policy(new, name, work.config, taught.weights, loss, work.opened.recordings.root.name)
    student = load_checkpoint(find_written(new))
    samples, parity = pick_evenly(parts.choosing, quantization.CHOOSING_FRAMES), quantization.Recipe.of(params()).parity
    export(rounded, student, new / "policy_static.pt", samples, calibration, parity)
    write_stage(
        new / "distill.json",
        "distill",
        params=work.described(),
        metrics={
            "students": students,
            "losses": taught.losses,
            **taught.notes,
            "before_qat": unrounded,
            "odd": describe_odd(calibration.frames, calibration.seen),
            "gates": [_quantization_gate(students[1])],
            "judged_frames": len(held_out),
            "held_out_episodes": parts.episodes["held_out"],
            "warnings": not_judged(action_range),
            "note": NOBODY_DROVE,
            "files_sha256": hashes,
        },
        inputs={teacher.path.name: teacher.sha256} | work.opened.recordings.hashes(),
    )


def _quantization_gate(student: dict[str, Any]) -> dict[str, Any]:
    """The original's rule: a policy that loses more by INT8 wants quantization-aware training."""
    loss = worst(v for k, v in student.items() if k.startswith("int8_") and not k.startswith("int8_teacher_"))
    limit = params()["gates"]["original"]["accuracy_loss_pct"]
    return gate("INT8 accuracy_loss_pct, or else --qat", loss, "<=", limit)
