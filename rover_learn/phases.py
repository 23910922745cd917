"""What the trainings share: recipes that are data, the phases, and what a student or a finetuned policy leaves."""

import functools
import shutil
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, asdict, dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from rover_learn.curves import leave_curves
from rover_learn.judges import SMALLEST_RANGE
from rover_learn.lessons import BatchedPolicy, Pool, lit
from rover_learn.student import gmac
from rover_learn.training import STATE, Batch, Machine, Phase, Resumable, threads
from rover_lib.onboard.checked import Rule, broken_rule, number, whole
from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.workshop import act
from rover_lib.workshop.act_config import ActConfig
from rover_lib.workshop.cache import cache_root, key_of
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, write_both
from rover_lib.workshop.judge.recorded_range import Range
from rover_lib.workshop.progress import Progress
from rover_lib.workshop.recordings.samples import Sample
from rover_lib.workshop.run import run_folder
from rover_lib.workshop.run.session import SMALL_GMAC

MOST = {"to_parent": 1.0, "held_out_share": 0.999, "mirrored": 0.5, "blur": 1.0, "shift": 0.2, "softened": 1.0}
MAY_BE_ZERO = ("seed", "transformer_warmup")
LEAST_RATE = 1e-9
LARGE = 10**9
VERSIONS = ("torch", "lerobot", "torchvision", "numpy")


def _rule(each: "Field[Any]") -> Rule:
    """The rule of a recipe's number: by its type, its name and its limits."""
    if each.type is int:
        return whole(0 if each.name.endswith("_steps") or each.name in MAY_BE_ZERO else 1, LARGE)
    return number(LEAST_RATE if each.name.endswith("rate") else 0, MOST.get(each.name, LARGE))


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a policy is trained: a section of params.yml, which explains each number.

    samples: learned from at most. Each of PHASES has its number of steps, `<phase>_steps`.
    """

    PHASES: ClassVar[tuple[str, ...]]

    samples: int
    batch: int

    @classmethod
    def read(cls, where: str, values: Mapping[str, Any]) -> Self:
        """Make a recipe of values. where: in params.yml. Raises TrainingError for a name or a value that cannot be."""
        by_name = {entry.name: entry for entry in fields(cls)}
        needed = {name for name, entry in by_name.items() if entry.default is MISSING}
        if wrong := sorted(set(values) - set(by_name) | needed - set(values)):
            raise TrainingError(f"params.yml: {where}: missing or unknown", found=wrong[0])
        rules = {name: _rule(entry) for name, entry in by_name.items() if name in values and entry.type in (int, float)}
        if broken := broken_rule(values, rules):
            name, words, actual = broken
            raise TrainingError(f"params.yml: {where}: {name} must be {words}", found=actual)
        return cls(**values)

    def of_steps(self, steps: int) -> Self:
        """Return the same recipe with that many steps in all, at least one in each phase that has any.

        Raises TrainingError for less than one step.
        """
        if steps < 1:
            raise TrainingError("training needs at least 1 step", found=steps)
        planned = {f"{name}_steps": getattr(self, f"{name}_steps") for name in self.PHASES}
        total = sum(planned.values())
        counts = {name: max(1, round(steps * count / total)) if count else 0 for name, count in planned.items()}
        return replace(self, **counts)


@dataclass(frozen=True, kw_only=True)
class LessonRecipe(Recipe):
    """A recipe of distilling or finetuning. SECTION: of params.yml.

    rate: learning rate of the first phases. judged_frames: of the held-out episodes, at most. seed: of all that is
    drawn at random.
    """

    SECTION: ClassVar[str]

    rate: float
    judged_frames: int
    seed: int

    @classmethod
    def of(cls, *, steps: int | None = None, **overrides: Any) -> Self:
        """Take the recipe of params.yml, with each override that is not None instead. Raises TrainingError."""
        values = params()[cls.SECTION] | {name: value for name, value in overrides.items() if value is not None}
        recipe = cls.read(cls.SECTION, values)
        return recipe if steps is None else recipe.of_steps(steps)


@dataclass(frozen=True, eq=False)
class Learned:
    """A policy that has learned. losses: by phase. folder: where the phases are saved."""

    weights: dict[str, Tensor]
    losses: dict[str, list[float]]
    folder: Path


@dataclass(frozen=True, eq=False, kw_only=True)
class Work(ABC):
    """What is to be done, and where. origin: what the policy learns from; ROLE and VERB name it in files."""

    ROLE: ClassVar[str]
    VERB: ClassVar[str]

    origin: Checkpoint
    config: ActConfig  # of the policy that is made
    recipe: Any  # of the training's own kind of LessonRecipe
    machine: Machine
    action_range: dict[str, Range]  # the recorded one
    progress: Progress

    @abstractmethod
    def learn(self) -> Learned:
        """Train all phases."""

    @abstractmethod
    def leave(self, new: Path, name: str, learned: Learned) -> None:
        """Judge the policy, and write all files of the run of that name into `new`."""

    def make(self, folder: Path) -> Path:
        """Learn, and leave the run's folder, which appears when it is complete. Returns it."""
        count = 1 if gmac(self.config) < SMALL_GMAC else torch.get_num_threads()
        with self.machine.computing(), build_folder(folder) as new, threads(count):
            learned = self.learn()
            self.leave(new, folder.name, learned)
            free_folder(folder.parent, folder.name)  # another command may have made it meanwhile
        shutil.rmtree(learned.folder, ignore_errors=True)  # who learns the same elsewhere may have removed it already
        return folder

    @functools.cached_property
    def ranges(self) -> np.ndarray:
        """(A,) float32: each action's recorded range, at least SMALLEST_RANGE, in which errors are counted."""
        ends = np.array(list(self.action_range.values()), np.float32)
        return np.maximum(ends[:, 1] - ends[:, 0], SMALLEST_RANGE)

    @functools.cached_property
    def units(self) -> Tensor:
        """(A,) float32: what an error of 1 in each action counts."""
        return torch.from_numpy(1 / self.ranges).to(self.machine.device)

    def rng(self, phase: str) -> np.random.Generator:
        """Return a phase's source of random numbers, the same in every process."""
        return np.random.default_rng([self.recipe.seed, zlib.crc32(phase.encode())])

    def sees(self, samples: Sequence[Sample]) -> dict[str, Any]:
        """Return what the lessons on these samples depend on, as a part of their key in the cache."""
        recorded = ("state", "chunk", "is_pad")
        return {
            "policy": self.origin.identity,
            "pictures": [(s.episode, s.frame_name, s.row, s.frame_path.stat().st_size) for s in samples],
            "recorded": [zlib.crc32(np.stack([getattr(s, name) for s in samples]).tobytes()) for name in recorded],
            "seed": self.recipe.seed,
            "versions": [version(package) for package in VERSIONS],
        }

    def train(
        self,
        saved: Resumable,
        phase: str,
        module: nn.Module,
        rate: float,
        pool: Pool,
        loss: Callable[[Batch], Tensor],
        *shown: str,
    ) -> None:
        """Train a module for the phase's number of steps in the recipe, or continue where that was interrupted."""
        rng = self.rng(phase)
        steps = getattr(self.recipe, f"{phase}_steps")
        count = self.recipe.batch
        draw = functools.partial(pool.batch, count, rng, self.machine.device, *shown)
        saved.train(Phase(phase, steps, rate), module, rng, lambda _: draw(), loss)

    def train_policy(
        self,
        saved: Resumable,
        policy: BatchedPolicy,
        pool: Pool,
        loss: Callable[[Tensor, Batch], Tensor],
        *,
        seen: str,
        slower: float,
    ) -> None:
        """Train the transformer on what its backbone sees, `seen` of the lessons, then all together so much slower."""
        rate = self.recipe.rate

        def of_transformer(batch: Batch) -> Tensor:
            return loss(policy.plan(batch[seen].float(), batch[STATE]), batch)

        def of_all(batch: Batch) -> Tensor:
            return loss(policy(lit(batch), batch[STATE]), batch)

        self.train(saved, "transformer", policy.model, rate, pool, of_transformer, seen)
        self.train(saved, "together", policy, rate / slower, pool, of_all, "frames")

    @property
    def described(self) -> dict[str, Any]:
        """The recipe and the device, as a stage's params."""
        return asdict(self.recipe) | {"device": self.machine.device.type} | ({"amp": True} if self.machine.amp else {})

    def write_policy(self, folder: Path, name: str, learned: Learned, loss: float, recordings: str) -> dict[str, str]:
        """Write best_model.pth, pretrained_model/ and the curves of a run of that name; return the files' sha256."""
        leave_curves(folder / "curves", learned.losses, {}, {})
        settings = {"learning_rate": self.recipe.rate, "batch_size": self.recipe.batch, "seed": self.recipe.seed}
        settings |= {"data_dir": recordings, "output_dir": name, "device": self.machine.device.type}
        origin = {f"{self.ROLE}_sha256": self.origin.sha256, f"{self.ROLE}_format": self.origin.format}
        return write_both(folder, self.config, learned.weights, loss, origin | {self.VERB: self.described}, **settings)


def cache_for(kind: str, made_of: Mapping[str, Any]) -> Path:
    """Return the cache's folder for what these parameters and the present code make."""
    sources = sorted(Path(__file__).parent.glob("*.py"))
    return cache_root() / f"{kind}-{key_of(dict(made_of), *sources, preprocess, act)}"


def free_folder(runs_dir: Path | str, name: str) -> Path:
    """Return a run's folder, which is not there yet. Raises TrainingError if it is, or for a name that cannot be."""
    folder = run_folder(runs_dir, name, TrainingError)
    if folder.exists():
        raise TrainingError(f"{folder}: is there already", remedy="give another --name, or move that run away")
    return folder
