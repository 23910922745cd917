"""What distilling and finetuning share: a recipe of checked numbers, the phases, and what they leave.

recipe = DistillRecipe.of(params(), steps=200)
with make_run(folder, config, TrainingError) as new:
    work.train_policy(saved, policy, pool, loss, seen="maps", slower=10)
    hashes = work.write_policy(new, name, config, weights, error, "episodes")
"""

import math
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from rover_learn.lessons import Batch, BatchedPolicy, Pool
from rover_learn.student import gmac
from rover_learn.training import Phase, Resumable, threads
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.act import ActConfig
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.checkpoint.files import write_both
from rover_lib.workshop.progress import Progress
from rover_lib.workshop.recordings.samples import Sample
from rover_lib.workshop.run.run_folder import run_folder
from rover_lib.workshop.run.session import SMALL_GMAC
from rover_lib.workshop.untrusted import quote

# Least and most of a recipe's numbers. Of the others, steps may be 0, whole numbers are at least 1, and rates above 0.
LIMITS = {"seed": (0, math.inf), "to_parent": (0, 1), "held_out_share": (0, 0.999)}
LIMITS |= dict.fromkeys(("focus", "to_teacher", "to_recorded"), (0, math.inf))


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a policy is trained: a section of params.yml, which explains each number.

    samples: learned from at most. rate: learning rate of the first phases. judged_frames: of the held-out episodes, at
    most. seed: of all that is drawn at random. Each of PHASES has its number of steps, `<phase>_steps`.
    """

    SECTION: ClassVar[str]
    ERROR: ClassVar[type[RoverError]]
    PHASES: ClassVar[tuple[str, ...]]

    samples: int
    batch: int
    rate: float
    judged_frames: int
    seed: int

    def __post_init__(self):
        """Raise ERROR for what is no number, or not within its limits."""
        for each in fields(self):
            value, whole = getattr(self, each.name), each.type is int
            least, most = LIMITS.get(each.name, (1 if whole else math.ulp(0.0), math.inf))
            least = 0 if each.name.endswith("_steps") else least
            if not (is_whole if whole else is_number)(value) or not least <= value <= most:
                what = "a whole number" if whole else "a number, written like 1.0e-3,"
                limits = f"from {least:g} to {most:g}" if most < math.inf else f"of at least {least:g}"
                limits = "above 0" if 0 < least < 1 else limits
                where = f"params.yml: {self.SECTION}: {each.name}"
                raise self.ERROR(f"{where} must be {what} {limits}", found=quote(value))

    @classmethod
    def of(
        cls, params: dict[str, Any], *, steps: int | None = None, phases: Collection[str] | None = None, **given: Any
    ) -> Self:
        """Take the recipe of params.yml, with each given value that is not None instead.

        steps: in all, see `of_steps`. Raises ERROR for a name that it does not have or that is missing, and for values
        that cannot be.
        """
        values = params[cls.SECTION] | {name: value for name, value in given.items() if value is not None}
        known = {f.name for f in fields(cls)}
        if wrong := sorted(known ^ set(values)):
            what = "is missing" if wrong[0] in known else "is unknown"
            raise cls.ERROR(
                f"params.yml: {cls.SECTION}: {wrong[0]} {what}", remedy=f"it has {', '.join(sorted(known))}"
            )
        recipe = cls(**values)
        return recipe if steps is None else recipe.of_steps(steps, phases)

    def of_steps(self, steps: int, phases: Collection[str] | None = None) -> Self:
        """Return the same recipe with that many steps in all, at least one in each of these phases, none in others.

        phases: None means all. Raises ERROR for less than one step.
        """
        if steps < 1:
            raise self.ERROR("training needs at least 1 step", found=steps)
        planned = {name: getattr(self, f"{name}_steps") for name in self.PHASES if phases is None or name in phases}
        share = steps / max(sum(planned.values()), 1)
        counts = {name: max(1, round(share * count)) for name, count in planned.items()}
        return replace(self, **{f"{name}_steps": counts.get(name, 0) for name in self.PHASES})


@dataclass(frozen=True, eq=False, kw_only=True)
class Work:
    """What is to be done, and where. origin: what the policy learns from; ROLE and VERB name it in files."""

    ROLE: ClassVar[str]
    VERB: ClassVar[str]

    origin: Checkpoint
    recipe: Any  # of the training's own kind of Recipe
    device: torch.device
    progress: Progress

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
            "at": [self.device.type, self.recipe.seed],
            "versions": [version(package) for package in ("torch", "lerobot", "torchvision", "numpy")],
        }

    def train(
        self, saved: Resumable, phase: str, module: nn.Module, rate: float, pool: Pool, loss: Callable[[Batch], Tensor]
    ) -> None:
        """Train a module for the phase's number of steps in the recipe, or continue where that was interrupted."""
        rng, steps = self.rng(phase), getattr(self.recipe, f"{phase}_steps")
        saved.train(
            Phase(phase, steps, rate), module, rng, lambda _: pool.batch(self.recipe.batch, rng, self.device), loss
        )

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
        model, rate = policy.model, self.recipe.rate
        self.train(saved, "transformer", model, rate, pool, lambda b: loss(policy.plan(b.seen(seen), b.states()), b))
        self.train(saved, "together", policy, rate / slower, pool, lambda b: loss(policy(b.pictures(), b.states()), b))

    def described(self) -> dict[str, Any]:
        """Return the recipe and the device, as a stage's params."""
        return asdict(self.recipe) | {"device": self.device.type}

    def write_policy(
        self, folder: Path, name: str, config: ActConfig, weights: dict[str, Tensor], loss: float, recordings: str
    ) -> dict[str, str]:
        """Write best_model.pth and pretrained_model/ of a run of that name, and return their files' sha256."""
        settings = {
            "learning_rate": self.recipe.rate,
            "batch_size": self.recipe.batch,
            "data_dir": recordings,
            "output_dir": name,
            "device": self.device.type,
            "seed": self.recipe.seed,
        }
        origin = {f"{self.ROLE}_sha256": self.origin.sha256, f"{self.ROLE}_format": self.origin.format}
        return write_both(folder, config, weights, loss, origin | {self.VERB: self.described()}, **settings)


def free_folder(runs_dir: Path | str, name: str, error: type[RoverError]) -> Path:
    """Return a run's folder, which is not there yet. Raises `error` if it is, or for a name that cannot be."""
    folder = run_folder(runs_dir, name, error)
    if folder.exists():
        raise error(f"{folder}: is there already", remedy="give another --name, or move that run away")
    return folder


@contextmanager
def make_run(folder: Path, config: ActConfig, error: type[RoverError]) -> Iterator[Path]:
    """Build a run's folder beside it, with as many threads as a policy of that config gains from."""
    with build_folder(folder) as new, threads(1 if gmac(config) < SMALL_GMAC else torch.get_num_threads()):
        yield new
        free_folder(folder.parent, folder.name, error)  # another command may have made it meanwhile
