"""A smaller policy that is taught by a larger one, on recordings alone.

    folder = distill("best_model.pth", "episodes", "fast", StudentShape(180, 320, decoder_layers=2, feedforward=1600))

The student begins with its teacher's weights (see `student`) and learns in phases: its backbone to see what the teacher
sees, its transformer on what that backbone sees, then all together at a tenth of the rate. It learns what the teacher
plans, and a little what was recorded. Channels that it is to do without go after the first phase (see `channels`). With
qat it then learns on, rounded as its export rounds it (see `fake_quant`).
The run's folder gets best_model.pth, pretrained_model/, policy_static.pt and distill.json.

Letters: n samples, B batch, C chunk, A actions.
"""

import math
import shutil
import sys
import zlib
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_learn import channels, refit, training
from rover_learn import lessons as lessons_module
from rover_learn import student as student_module
from rover_learn.channels import without_channels
from rover_learn.fake_quant import RoundedPolicy
from rover_learn.lessons import BatchedPolicy, Lessons, as_driven, in_another_light, judged_ranges, plans_of
from rover_learn.student import StudentShape, gmac, initial_weights, student_config
from rover_learn.training import Resumable, descend, optimiser, threads
from rover_lib.onboard.errors import CheckpointError, DistillError, TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.onboard.stage import atomic_path, write_stage
from rover_lib.workshop import act
from rover_lib.workshop.act import ACT, ActConfig, inputs_of, predictions
from rover_lib.workshop.cache import cache_root, key_of
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, load_checkpoint
from rover_lib.workshop.checkpoint.files import find_written, write_both
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
from rover_lib.workshop.run.session import SMALL_GMAC, Opened, load, training_device
from rover_lib.workshop.swap_folder import build_beside
from rover_lib.workshop.untrusted import numbers

PHASES = ("backbone", "transformer", "together", "qat")
Notes = dict[str, list[dict[str, Any]]]  # of what a student does without, by part
NOBODY_DROVE = "Judged on recordings alone: nobody drove."


@dataclass(frozen=True)
class DistillRecipe:
    """How a student is taught: params.yml's section `distill`.

    samples: asked about at most. rate: of the first two phases; the third has a tenth. to_teacher, to_recorded: weights
    of the two losses, mean absolute errors in units of the recorded range. unit_frames: choose a feed-forward's units.
    judged_frames: of the held-out episodes, at most. seed: of all that is drawn.
    """

    samples: int
    batch: int
    backbone_steps: int
    transformer_steps: int
    together_steps: int
    qat_steps: int
    rate: float
    qat_rate: float
    to_teacher: float
    to_recorded: float
    unit_frames: int
    judged_frames: int
    seed: int

    def __post_init__(self):
        counts = self.samples, self.batch, self.unit_frames, self.judged_frames
        steps = self.backbone_steps, self.transformer_steps, self.together_steps, self.qat_steps
        if min(counts) < 1 or min(*steps, self.seed) < 0:
            raise DistillError("samples, batch and frames must be at least 1, steps and seed at least 0", found=self)
        rates, weights = (self.rate, self.qat_rate), (self.to_teacher, self.to_recorded)
        if not (all(map(math.isfinite, (*rates, *weights))) and min(rates) > 0 and min(weights) >= 0 < max(weights)):
            raise DistillError(
                "rates must be finite and above 0, to_teacher and to_recorded at least 0, and not both 0", found=self
            )

    @classmethod
    def of(
        cls,
        params: dict[str, Any],
        steps: int | None = None,
        samples: int | None = None,
        seed: int | None = None,
        phases: Collection[str] = PHASES,
    ) -> "DistillRecipe":
        """That of params.yml, with what is not None in its place. steps: in all, of these phases alone. Raises
        DistillError.
        """
        recipe = numbers(cls, params["distill"], "params.yml: distill", DistillError)
        if steps is not None:
            recipe = recipe.of_steps(steps, phases)
        given = {"samples": samples, "seed": seed}
        return replace(recipe, **{name: value for name, value in given.items() if value is not None})

    def of_steps(self, steps: int, phases: Collection[str] = PHASES) -> "DistillRecipe":
        """The same with that many steps in all, at least one in each of these phases and none in the others."""
        if steps < 1:
            raise DistillError("a student needs at least 1 step", found=steps)
        planned = {phase: getattr(self, f"{phase}_steps") for phase in PHASES if phase in phases}
        share = steps / max(sum(planned.values()), 1)
        counts = {phase: max(1, round(share * count)) for phase, count in planned.items()}
        return replace(self, **{f"{phase}_steps": counts.get(phase, 0) for phase in PHASES})


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
    work = _Work(opened, config, share, recipe, qat, where, progress)
    if work.is_teacher and not qat:
        remedy = "give it a smaller picture, fewer layers or channels, or train it for INT8 with --qat"
        raise DistillError("this student would be its teacher", remedy=remedy)
    with (
        build_beside(folder, _of_an_earlier_student) as new,
        threads(1 if gmac(config) < SMALL_GMAC else torch.get_num_threads()),
    ):
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


@dataclass(frozen=True, eq=False)
class _Work:
    """What is to be done. config: the student's. share: of its backbone's inner channels that stay, None for all."""

    opened: Opened
    config: ActConfig
    share: float | None
    recipe: DistillRecipe
    qat: bool
    device: torch.device
    progress: Progress

    @property
    def teacher(self) -> Checkpoint:
        return self.opened.checkpoint

    @property
    def is_teacher(self) -> bool:
        """Whether the student has its teacher's shape: then there is only rounding to learn."""
        return self.share is None and self.config == replace(self.teacher.config, vae_layers=0)

    def rng(self, phase: str) -> np.random.Generator:
        """Random numbers of a phase, the same in every process."""
        return np.random.default_rng([self.recipe.seed, zlib.crc32(phase.encode())])

    def ranges(self) -> np.ndarray:
        """(A,) float32: each action's recorded range, in which errors are counted."""
        return judged_ranges(self.opened.recordings.action_range())


# --- teaching ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Taught:
    """A student: weights by LeRobot's names without the leading `model.`, losses by phase. notes: what was left out of
    its "backbone", see `without_channels`, and of each "feed_forward", see `initial_weights`. folder: where its phases
    are saved.
    """

    weights: dict[str, Tensor]
    losses: dict[str, list[float]]
    notes: Notes
    unrounded: dict[str, Tensor] | None  # the weights before quantization-aware training
    folder: Path


def _teach(work: _Work) -> _Taught:
    """All phases. What depends on teacher, picture and samples alone stays in the cache, for its next student."""
    progress = work.progress
    samples = pick_evenly(work.opened.parts.calibration, work.recipe.samples)
    sees = _sees(work, samples)
    sources = [sys.modules[__name__], lessons_module, student_module, channels, refit, training, preprocess, act]
    folder = cache_root() / f"lessons-{key_of(sees, *sources)}"
    own = cache_root() / f"student-{key_of(sees | _learns(work, samples), *sources)}"
    depth = work.teacher.weights["encoder_img_feat_input_proj.weight"].shape[1]
    with Resumable(folder, progress) as saved:
        lessons = Lessons.open(folder, samples, work.config, depth, work.rng("states"))
        room = _Room(work, lessons)
        lessons.ask(saved, work.teacher, work.rng("teacher"), work.device)
        _refuse_strangers(room)
        backbone = _train_backbone(room, saved)
        losses = dict(saved.losses)
    with Resumable(own, progress) as saved:
        weights, notes = _start(room, backbone, own)
        policy = BatchedPolicy(work.config, weights).to(work.device)
        if work.share is not None:
            room = _Room(work, lessons.apart(own))
            room.lessons.see(saved, policy, work.rng("tokens"))
        policy.thaw()
        unrounded = None
        if not work.is_teacher:
            _train_transformer(room, policy, saved)
            _train_together(room, policy, saved)
        if work.qat:
            unrounded = policy.weights()
            _train_rounded(room, policy, saved, own)
        losses |= saved.losses
    return _Taught(policy.weights(), losses, notes, unrounded, own)


def _sees(work: _Work, samples: Sequence[Sample]) -> dict[str, Any]:
    """What lessons and a backbone depend on."""
    recipe = work.recipe
    return {
        "teacher": work.teacher.identity,
        "size": work.config.image_sizes,
        "pictures": [(s.episode, s.frame_path.name, s.frame_path.stat().st_size) for s in samples],
        "rows": [s.row for s in samples],  # a dataset's pictures are many in one file
        "states": zlib.crc32(np.stack([s.state for s in samples]).tobytes()),
        "actions": zlib.crc32(np.stack([s.chunk for s in samples]).tobytes()),
        "recipe": [recipe.batch, recipe.backbone_steps, recipe.rate],
        "at": [work.device.type, recipe.seed],
        "versions": [version(package) for package in ("torch", "lerobot", "torchvision", "numpy")],
    }


def _learns(work: _Work, samples: Sequence[Sample]) -> dict[str, Any]:
    """What a student depends on besides: its losses' units too, and what its ranges are read off if it is rounded."""
    p, choosing = params(), work.opened.parts.choosing
    rounded = [p["calibration"], p["quantization"], [(s.episode, s.row) for s in choosing]]
    return {
        "student": asdict(work.config),
        "share": work.share,
        "whole": asdict(work.recipe),
        "pads": zlib.crc32(np.stack([s.is_pad for s in samples]).tobytes()),
        "units": work.ranges().tolist(),
        "rounded": rounded if work.qat else None,
    }


class _Room:
    """Where a student is taught: batches of lessons, and the loss."""

    def __init__(self, work: _Work, lessons: Lessons):
        self.work, self.lessons = work, lessons
        self.units = torch.from_numpy(1 / work.ranges()).to(work.device)

    def draw(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The next samples, (B,), and their views."""
        count = len(self.lessons)
        rows = rng.choice(count, min(self.work.recipe.batch, count), replace=False)
        return rows, rng.integers(2, size=len(rows))

    def pictures(self, rows: np.ndarray, views: np.ndarray, rng: np.random.Generator) -> Tensor:
        """(B, height, width, 3) uint8 RGB, in another light."""
        return torch.from_numpy(in_another_light(self.lessons.pictures(rows, views), rng)).to(self.work.device)

    def states(self, rows: np.ndarray, views: np.ndarray) -> Tensor:
        return torch.from_numpy(self.lessons.asked[2 * rows + views]).to(self.work.device)

    def loss(self, plans: Tensor, rows: np.ndarray, views: np.ndarray) -> Tensor:
        """plans: (B, C, A), the student's. Mean absolute errors to the teacher's and to what was recorded, weighted."""
        recipe, device = self.work.recipe, self.work.device
        taught = torch.from_numpy(self.lessons.plans[2 * rows + views]).to(device)
        recorded = torch.from_numpy(self.lessons.recorded(rows, views)).to(device)
        driven = torch.from_numpy(~self.lessons.data.is_pad[rows]).to(device)[..., None]
        to_teacher = ((plans - taught).abs() * self.units).mean()
        to_recorded = ((plans - recorded).abs() * self.units * driven).sum() / (driven.sum() * len(self.units))
        return recipe.to_teacher * to_teacher + recipe.to_recorded * to_recorded


def _refuse_strangers(room: _Room) -> None:
    """Raise DistillError if the teacher knows nothing of what was driven: then it is another car's, or camera's."""
    config, ranges = room.work.config, room.work.ranges()
    if found := room.lessons.stranger(ranges, config.action_names):
        raise DistillError(
            f"{room.work.teacher.path}: on these recordings its plans are worse than one action for all frames",
            found=found,
            remedy="give recordings of the car and the camera that it was trained for",
        )


def _train_backbone(room: _Room, saved: Resumable) -> dict[str, Tensor]:
    """Phase one: the backbone, at the student's picture size, to the teacher's feature map. Then its tokens, unless it
    is to lose channels.

    Returns its weights by LeRobot's names. At the teacher's own size it is the teacher's, as it is.
    """
    work, lessons = room.work, room.lessons
    teacher = work.teacher.at_size(*work.config.image_sizes[0])
    policy = BatchedPolicy(teacher.config, teacher.weights).to(work.device)
    policy.thaw()
    backbone = policy.backbone
    steps = work.recipe.backbone_steps if work.config.image_sizes != work.teacher.config.image_sizes else 0
    optimizer, scheduler = optimiser(backbone.parameters(), work.recipe.rate, max(steps, 1))
    rng = work.rng("backbone")
    for _ in saved.steps("backbone", steps, rng, backbone=backbone, optimizer=optimizer, scheduler=scheduler):
        rows, views = room.draw(rng)
        shown = torch.from_numpy(lessons.maps[2 * rows + views]).to(work.device).float()
        error = (policy.features(room.pictures(rows, views, rng)) - shown).square().mean() / shown.square().mean()
        saved.losses["backbone"].append(descend(error, backbone, optimizer, scheduler))
    if not work.is_teacher and work.share is None:
        lessons.see(saved, policy, work.rng("tokens"))
    return {name: value for name, value in policy.weights().items() if name.startswith("backbone.")}


def _start(room: _Room, backbone: dict[str, Tensor], folder: Path) -> tuple[dict[str, Tensor], Notes]:
    """The student before its transformer learns, and what was noted of what it does without. Kept in the folder."""
    path = folder / "start.pt"
    if not path.exists():
        lessons, work = room.lessons, room.work
        rows = pick_evenly(range(len(lessons)), work.recipe.unit_frames)
        states = torch.from_numpy(lessons.data.states)
        inputs = ((states[i][None], torch.from_numpy(lessons.frames[np.array([i])][0])) for i in rows)
        seeing = replace(work.teacher, weights=work.teacher.weights | backbone)
        weights, narrowed = initial_weights(seeing, work.config, inputs)
        thinner: list[dict[str, Any]] = []
        if work.share is not None:
            pictures = work.progress(lessons.each_once(), desc="channels", total=lessons.blocks)
            shown = (torch.from_numpy(block) for block in pictures)
            weights, thinner = without_channels(weights, work.config, work.share, shown, work.rng("channels"))
        with atomic_path(path) as temporary:
            torch.save((weights, {"backbone": thinner, "feed_forward": narrowed}), temporary)
    return _read_phase(path)


def _read_phase(path: Path) -> Any:
    """What a phase left. Raises TrainingError for a damaged file."""
    try:
        return torch.load(path, weights_only=True)
    except Exception as error:  # whatever such a file makes torch say
        remedy = f"remove {path.parent} to teach from the beginning"
        raise TrainingError(f"{path}: cannot go on from it", found=type(error).__name__, remedy=remedy) from error


def _train_transformer(room: _Room, policy: BatchedPolicy, saved: Resumable) -> None:
    """Phase two: all but the backbone, on the tokens that it gave."""
    recipe, lessons = room.work.recipe, room.lessons
    optimizer, scheduler = optimiser(policy.model.parameters(), recipe.rate, max(recipe.transformer_steps, 1))
    rng = room.work.rng("transformer")
    steps, model = recipe.transformer_steps, policy.model
    for _ in saved.steps("transformer", steps, rng, model=model, optimizer=optimizer, scheduler=scheduler):
        rows, views = room.draw(rng)
        tokens = torch.from_numpy(lessons.tokens[2 * rows + views]).to(room.work.device).float()
        loss = room.loss(policy.plan(tokens, room.states(rows, views)), rows, views)
        saved.losses["transformer"].append(descend(loss, policy.model, optimizer, scheduler))


def _train_together(room: _Room, policy: BatchedPolicy, saved: Resumable) -> None:
    """Phase three: all parameters at a tenth of the rate, on pictures in any light."""
    recipe = room.work.recipe
    optimizer, scheduler = optimiser(policy.parameters(), recipe.rate / 10, max(recipe.together_steps, 1))
    rng = room.work.rng("together")
    steps = recipe.together_steps
    for _ in saved.steps("together", steps, rng, policy=policy, optimizer=optimizer, scheduler=scheduler):
        rows, views = room.draw(rng)
        plans = policy(room.pictures(rows, views, rng), room.states(rows, views))
        saved.losses["together"].append(descend(room.loss(plans, rows, views), policy, optimizer, scheduler))


def _train_rounded(room: _Room, policy: BatchedPolicy, saved: Resumable, folder: Path) -> None:
    """Phase four: as INT8 the student learns to plan what it planned before, in float, on the very same pictures.

    Nothing else, so that all that it changes is what rounding costs. Rounded by the ranges that it has before.
    """
    work, recipe = room.work, room.work.recipe
    path, student = folder / "ranges.pt", _checkpoint(work, policy.weights())  # as it was before this phase
    if not path.exists():
        calibration, scheme = _calibrate(work, student)
        with atomic_path(path) as temporary:
            torch.save({"calibration": calibration.__dict__, "scheme": asdict(scheme)}, temporary)
    kept = _read_phase(path)
    rounded = RoundedPolicy(student, Scheme.of(kept["scheme"]), Calibration(**kept["calibration"])).to(work.device)
    exact = BatchedPolicy(work.config, student.weights).to(work.device)
    optimizer, scheduler = optimiser(policy.parameters(), recipe.qat_rate, max(recipe.qat_steps, 1))
    rng, steps = work.rng("qat"), recipe.qat_steps
    for _ in saved.steps("qat", steps, rng, policy=policy, optimizer=optimizer, scheduler=scheduler):
        rows, views = room.draw(rng)
        pictures, states = room.pictures(rows, views, rng), room.states(rows, views)
        with torch.no_grad():
            wanted = exact(pictures, states)
        off = ((rounded(policy.named_weights(), pictures, states) - wanted).abs() * room.units).mean()
        saved.losses["qat"].append(descend(off, policy, optimizer, scheduler))


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


def _quantize(work: _Work, weights: dict[str, Tensor]) -> tuple[QuantizedPolicy, Calibration]:
    """A student in static INT8, and what calibrated it."""
    student = _checkpoint(work, weights)
    calibration, scheme = _calibrate(work, student)
    return quantize(student, scheme, calibration), calibration


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


def _leave(new: Path, name: str, work: _Work, taught: _Taught) -> None:
    """Judge the student, and write its files and distill.json into a folder that will be the run's of that name."""
    teacher, parts, action_range = work.teacher, work.opened.parts, work.opened.recordings.action_range()
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
    rounded, calibration = _quantize(work, taught.weights)
    students[1] |= _int8_errors(work, taught.weights, rounded, held_out, planned)
    unrounded = None
    if taught.unrounded:
        unrounded = _int8_errors(work, taught.unrounded, _quantize(work, taught.unrounded)[0], held_out, planned)
    chosen = _plans(work, work.config, taught.weights, choosing)
    driven = ~np.stack([s.is_pad for s in choosing])
    loss = float(np.abs(chosen - np.stack([s.chunk for s in choosing]))[driven].mean())
    recipe = asdict(work.recipe) | {"device": work.device.type}
    origin = {"teacher_sha256": teacher.sha256, "teacher_format": teacher.format, "distilled_by": recipe}
    settings = {
        "learning_rate": work.recipe.rate,
        "batch_size": work.recipe.batch,
        "data_dir": work.opened.recordings.root.name,
        "output_dir": name,
        "device": work.device.type,
        "seed": work.recipe.seed,
    }
    hashes = write_both(new, work.config, taught.weights, loss, origin, **settings)
    student = load_checkpoint(find_written(new))
    samples, parity = pick_evenly(parts.choosing, quantization.CHOOSING_FRAMES), quantization.Recipe.of(params()).parity
    export(rounded, student, new / "policy_static.pt", samples, calibration, parity)
    write_stage(
        new / "distill.json",
        "distill",
        params=recipe,
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
