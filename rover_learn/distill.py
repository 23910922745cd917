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
from dataclasses import asdict, dataclass, replace
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
from rover_learn.lessons import Batch, BatchedPolicy, Lessons, Part, as_driven, judged_ranges, plans_of
from rover_learn.phases import Count, FromZero, Positive, Recipe, Room, Taught, Weight, Work, make_run
from rover_learn.student import StudentShape, gmac, initial_weights, student_config
from rover_learn.training import Resumable
from rover_lib.onboard.errors import CheckpointError, DistillError, TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop import act
from rover_lib.workshop.act import ACT, ActConfig, inputs_of, predictions
from rover_lib.workshop.cache import cache_root, key_of
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, load_checkpoint
from rover_lib.workshop.checkpoint.files import find_written, save_torch
from rover_lib.workshop.checkpoint.lerobot import read_origin
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
from rover_lib.workshop.run.run import files_of_a_run
from rover_lib.workshop.run.run_folder import run_folder
from rover_lib.workshop.run.session import Opened, load, training_device

Notes = dict[str, list[dict[str, Any]]]  # of what a student does without, by part
NOBODY_DROVE = "Judged on recordings alone: nobody drove."


@dataclass(frozen=True, kw_only=True)
class DistillRecipe(Recipe):
    """How a student is taught: params.yml's section `distill`.

    rate: of the first two phases; the third has a tenth. to_teacher, to_recorded: weights of the two losses, mean
    absolute errors in units of the recorded range. unit_frames: choose a feed-forward's units.
    """

    SECTION, ERROR, PHASES = "distill", DistillError, ("backbone", "transformer", "together", "qat")

    backbone_steps: FromZero
    transformer_steps: FromZero
    together_steps: FromZero
    qat_steps: FromZero
    qat_rate: Positive
    to_teacher: Weight
    to_recorded: Weight
    unit_frames: Count

    def __post_init__(self):
        super().__post_init__()
        if not self.to_teacher + self.to_recorded > 0:
            raise DistillError(
                "to_teacher and to_recorded must not both be 0", remedy="a student learns from one of them"
            )


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
    Ended at any moment and started again with the same arguments, it goes on and gives the same student. An earlier
    student in the run's folder stays until the new one is whole; then it goes, with all that a run has left of it.
    Raises DistillError for a student, a device or recordings that cannot be, and for a run of a policy that is no
    student; CheckpointError, EpisodeError, TrainingError; RoverError while another process makes a run of that name.
    """
    folder, where = run_folder(runs_dir, name, DistillError), training_device(device, DistillError)
    recipe = recipe or DistillRecipe.of(params())
    opened = load(checkpoint, episodes, progress)
    teacher = opened.checkpoint
    config = student_config(teacher, shape)
    share = None if shape.backbone_channels == 1 else shape.backbone_channels
    work = _Work(
        origin=teacher,
        opened=opened,
        config=config,
        share=share,
        recipe=recipe,
        qat=qat,
        device=where,
        progress=progress,
    )
    if work.is_teacher and not qat:
        remedy = "give it a smaller picture, fewer layers or channels, or train it for INT8 with --qat"
        raise DistillError("this student would be its teacher", remedy=remedy)
    with make_run(folder, config, _of_an_earlier_student) as new:
        _refuse_another_policy(folder, teacher)
        taught = _teach(work)
        _leave(new, name, work, taught)
    shutil.rmtree(taught.folder, ignore_errors=True)  # who learns the same under another name may have removed it
    return folder


def _refuse_another_policy(folder: Path, teacher: Checkpoint) -> None:
    """Raise DistillError if the run's folder holds a policy that somebody trained, and that a student would replace."""
    remedy = "give another --name"
    if teacher.path.resolve().is_relative_to(folder):
        raise DistillError(f"{folder}: holds the teacher, which its student would replace", remedy=remedy)
    policies = [path for path in (folder / "best_model.pth", folder / "pretrained_model") if path.exists()]
    for path in policies:
        if not _is_student(path):
            raise DistillError(f"{path}: is no student, and one would replace it", remedy=remedy)
    if not policies and (folder / "quantize.json").exists():
        raise DistillError(f"{folder}: holds the run of another policy, which a student would replace", remedy=remedy)


def _of_an_earlier_student(folder: Path) -> list[Path]:
    """What goes even if it has no successor: its report would be read as the new one's, and so would its checkpoint."""
    return [*files_of_a_run(folder), folder / "best_model.pth"]


def _is_student(path: Path) -> bool:
    """Whether `distill` has left that checkpoint."""
    try:
        origin = load_checkpoint(path).report["trainer_config"]["origin"] if path.is_file() else read_origin(path)
        return "teacher_sha256" in origin
    except (CheckpointError, KeyError, TypeError):
        return False


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


# --- teaching ---------------------------------------------------------------------------------------------------------


def _teach(work: _Work) -> Taught:
    """All phases. What depends on teacher, picture and samples alone stays in the cache, for its next student."""
    progress = work.progress
    samples = pick_evenly(work.opened.parts.calibration, work.recipe.samples)
    recipe = work.recipe
    sees = work.sees(samples) | {
        "size": work.config.image_sizes,
        "recipe": [recipe.batch, recipe.backbone_steps, recipe.rate],
    }
    sources = [sys.modules[__name__], phases, lessons_module, student_module, channels, refit]
    sources += [training, preprocess, act]
    folder = cache_root() / f"lessons-{key_of(sees, *sources)}"
    own = cache_root() / f"student-{key_of(sees | _learns(work), *sources)}"
    with Resumable(folder, progress) as saved:
        lessons = Lessons.open(folder, samples, work.config, work.origin, work.rng("states"))
        room = _Room(work, lessons)
        lessons.ask(saved, work.origin, work.rng("teacher"), work.device)
        remedy = "give recordings of the car and the camera that it was trained for"
        lessons.refuse_stranger(work.origin, work.ranges(), DistillError, "these", remedy)
        backbone = _train_backbone(work, room, saved)
        losses = dict(saved.losses)
    with Resumable(own, progress) as saved:
        weights, notes = _start(work, lessons, backbone, own)
        policy = BatchedPolicy(work.config, weights).to(work.device)
        if work.share is not None:
            room = _Room(work, lessons.apart(own))
            room.lessons.see(saved, policy, work.rng("tokens"))
        policy.thaw()
        unrounded = None
        if not work.is_teacher:
            model = policy.model
            room.train(
                saved,
                "transformer",
                model,
                recipe.rate,
                lambda b: room.loss(policy.plan(b.seen("tokens"), b.states()), b),
            )
            slow = recipe.rate / 10
            room.train(saved, "together", policy, slow, lambda b: room.loss(policy(b.pictures(), b.states()), b))
        if work.qat:
            unrounded = policy.weights()
            _train_rounded(work, room, policy, saved, own)
        losses |= saved.losses
    return Taught(policy.weights(), losses, own, notes, unrounded)


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


class _Room(Room):
    """Where a student is taught: batches of lessons, and the loss."""

    def __init__(self, work: _Work, lessons: Lessons):
        super().__init__(work, work.ranges())
        self.lessons = lessons

    def batch(self, rng: np.random.Generator) -> Batch:
        count = len(self.lessons)
        rows = rng.choice(count, min(self.work.recipe.batch, count), replace=False)
        return Batch([Part(self.lessons, rows, rng.integers(2, size=len(rows)))], rng, self.work.device)

    def loss(self, plans: Tensor, batch: Batch) -> Tensor:
        """plans: (B, C, A), the student's. Mean absolute errors to the teacher's and to what was recorded, weighted."""
        recipe, driven = self.work.recipe, batch.driven()
        to_teacher = ((plans - batch.planned()).abs() * self.units).mean()
        to_recorded = ((plans - batch.recorded()).abs() * self.units * driven).sum() / (driven.sum() * len(self.units))
        return recipe.to_teacher * to_teacher + recipe.to_recorded * to_recorded


def _train_backbone(work: _Work, room: _Room, saved: Resumable) -> dict[str, Tensor]:
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
        room.train(saved, "backbone", policy.backbone, work.recipe.rate, off)
    if not work.is_teacher and work.share is None:
        room.lessons.see(saved, policy, work.rng("tokens"))
    return {name: value for name, value in policy.weights().items() if name.startswith("backbone.")}


def _start(work: _Work, lessons: Lessons, backbone: dict[str, Tensor], folder: Path) -> tuple[dict[str, Tensor], Notes]:
    """The student before its transformer learns, and what was noted of what it does without. Kept in the folder."""
    path = folder / "start.pt"
    if not path.exists():
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
        save_torch(path, (weights, {"backbone": thinner, "feed_forward": narrowed}))
    return _read_phase(path)


def _read_phase(path: Path) -> Any:
    """What a phase left. Raises TrainingError for a damaged file."""
    try:
        return torch.load(path, weights_only=True)
    except Exception as error:  # whatever such a file makes torch say
        remedy = f"remove {path.parent} to teach from the beginning"
        raise TrainingError(f"{path}: cannot go on from it", found=type(error).__name__, remedy=remedy) from error


def _train_rounded(work: _Work, room: _Room, policy: BatchedPolicy, saved: Resumable, folder: Path) -> None:
    """Phase four: as INT8 the student learns to plan what it planned before, in float, on the very same pictures.

    Nothing else, so that all that it changes is what rounding costs. Rounded by the ranges that it has before.
    """
    path, student = folder / "ranges.pt", _checkpoint(work, policy.weights())  # as it was before this phase
    if not path.exists():
        calibration, scheme = _calibrate(work, student)
        save_torch(path, {"calibration": calibration.__dict__, "scheme": asdict(scheme)})
    rounded = RoundedPolicy(student, *_ranges_before(folder)).to(work.device)
    exact = BatchedPolicy(work.config, student.weights).to(work.device)

    def off(batch: Batch) -> Tensor:
        pictures, states = batch.pictures(), batch.states()
        with torch.no_grad():
            wanted = exact(pictures, states)
        return ((rounded(policy.named_weights(), pictures, states) - wanted).abs() * room.units).mean()

    room.train(saved, "qat", policy, work.recipe.qat_rate, off)


def _ranges_before(folder: Path) -> tuple[Scheme, Calibration]:
    """How the student was rounded before phase four."""
    kept = _read_phase(folder / "ranges.pt")
    return Scheme.of(kept["scheme"]), Calibration(**kept["calibration"])


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


def _plans(work: _Work, config: ActConfig, weights: dict[str, Tensor], samples: Sequence[Sample]) -> np.ndarray:
    """(n, C, A) float32 of what a policy would drive."""
    return plans_of(BatchedPolicy(config, weights).to(work.device), samples, work.progress)


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
    """Of static INT8, on the samples: int8_<action>_pct to its own FP32, int8_teacher_<action>_pct to the teacher.

    weights: the student's. rounded: the same in INT8. taught: (n, C, A), what the teacher would drive; the student's
    plans are clipped like them to be compared.
    """
    inputs = [inputs_of(s, work.config) for s in samples]
    exact, int8 = (predictions(policy, inputs) for policy in (ACT(work.config, weights), rounded.module))
    driven = torch.from_numpy(as_driven(int8.numpy(), work.config.action_names, samples))
    errors: dict[str, float | None] = {}
    for i, (action, recorded) in enumerate(work.opened.recordings.action_range().items()):
        for name, own, other in (("int8", int8, exact), ("int8_teacher", driven, torch.from_numpy(taught))):
            off = (own[..., i] - other[..., i]).abs().mean().item()
            errors[f"{name}_{action}_pct"] = pct_of_range(off, recorded)
    return errors


def _row(
    name: str, config: ActConfig, weights: dict[str, Tensor], share: float | None = None, qat: bool = False
) -> dict[str, Any]:
    """A policy's shape, as a row of the frontier begins. share: of the backbone's inner channels, None: all."""
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
    actions = [key.removeprefix("teacher_").removesuffix("_pct") for key in metrics["students"][0] if "teacher_" in key]
    lines = [f"errors on held-out episodes, % of the recorded range ({', '.join(actions)})"]
    for row in metrics["students"]:
        shape = f"{row['width']}x{row['height']}, {row['decoder_layers']} decoder layer(s) of {row['feedforward']}"
        if share := row.get("backbone_channels"):
            shape += f", {share:.0%} of the backbone's channels"
        pairs = []
        for to in ("teacher", "recorded"):
            errors = [format_pct(row[f"{to}_{action}_pct"]).strip() for action in actions]
            pairs.append(f"to the {'teacher' if to == 'teacher' else 'recordings'} {', '.join(errors)}")
        lines.append(f"{row['name']}: {shape}, {row['gmac']:.2f} GMAC; {'; '.join(pairs)}")
    for title, errors in (("before quantization-aware training", metrics["before_qat"]), ("", metrics["students"][1])):
        if errors:
            own, teachers = (
                ", ".join(format_pct(errors[f"{name}_{action}_pct"]).strip() for action in actions)
                for name in ("int8", "int8_teacher")
            )
            lines.append(f"in INT8{f', {title}' if title else ''}: to its own FP32 {own}; to the teacher {teachers}")
    for row in metrics["gates"]:
        if row["passed"] is False:
            remedy = "train with --qat"
            if odd := metrics.get("odd"):  # training with INT8's rounding does not mend those
                remedy = f"{odd['share_pct']:.0f} % of the frames are odd, and `rover run` names them"
            elif metrics["before_qat"]:
                remedy = "--qat was not enough, and `rover run` says where it comes from"
            lines.append(f"INT8 loses {row['found']:.1f} % of the recorded range, more than {row['limit']} %: {remedy}")
    return "\n".join([*lines, metrics["note"]])


# --- what is left in the run's folder ---------------------------------------------------------------------------------


def _leave(new: Path, name: str, work: _Work, taught: Taught) -> None:
    """Judge the student, and write its files and distill.json into a folder that will be the run's of that name."""
    teacher, parts, action_range = work.origin, work.opened.parts, work.opened.recordings.action_range()
    held_out = pick_evenly(parts.held_out, work.recipe.judged_frames)
    choosing = pick_evenly(parts.choosing, work.recipe.judged_frames)
    planned = _plans(work, teacher.config, teacher.weights, held_out)
    own = _plans(work, work.config, taught.weights, held_out)
    students = [
        row | errors_of(plans, planned, held_out, action_range)
        for row, plans in (
            (_row("teacher", teacher.config, teacher.weights), planned),
            (_row(name, work.config, taught.weights, work.share, work.qat), own),
        )
    ]
    exact = _checkpoint(work, taught.weights)
    calibration, scheme = _calibrate(work, exact)
    rounded = quantize(exact, scheme, calibration)
    students[1] |= _int8_errors(work, taught.weights, rounded, held_out, planned)
    unrounded = None
    if taught.unrounded:
        before = quantize(_checkpoint(work, taught.unrounded), *_ranges_before(taught.folder))
        unrounded = _int8_errors(work, taught.unrounded, before, held_out, planned)
    chosen = _plans(work, work.config, taught.weights, choosing)
    driven = ~np.stack([s.is_pad for s in choosing])
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
