"""What every training in phases on lessons shares: its recipe, its place in the cache, and what it leaves.

class DistillRecipe(Recipe): ...
recipe = DistillRecipe.of(params(), steps=200)
with make_run(folder, config) as new:
    room.train(saved, "transformer", policy.model, recipe.rate, loss)
    hashes = work.write_policy(new, name, config, weights, error, "episodes")
"""

import math
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self, get_type_hints

import numpy as np
import torch
from torch import Tensor, nn

from rover_learn.lessons import Batch
from rover_learn.student import gmac
from rover_learn.training import Resumable, threads
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.act import ActConfig
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.checkpoint.files import write_both
from rover_lib.workshop.progress import Progress
from rover_lib.workshop.recordings.samples import Sample
from rover_lib.workshop.run.session import SMALL_GMAC
from rover_lib.workshop.swap_folder import build_beside
from rover_lib.workshop.untrusted import quote


class Within(NamedTuple):
    """What a number of a recipe may be, in words and in figures."""

    words: str
    least: float
    most: float = math.inf


TINY = math.ulp(0.0)  # the smallest number above 0
Count = Annotated[int, Within("at least 1", 1)]
FromZero = Annotated[int, Within("at least 0", 0)]
Weight = Annotated[float, Within("at least 0", 0)]
Positive = Annotated[float, Within("above 0", TINY)]
Share = Annotated[float, Within("from 0 to 1", 0, 1)]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a policy is trained: a section of params.yml.

    samples: learned from at most. rate: learning rate of the first phases. judged_frames: of the held-out episodes, at
    most. seed: of all that is drawn at random. Each of PHASES has its number of steps, `<phase>_steps`.
    """

    SECTION: ClassVar[str]
    ERROR: ClassVar[type[RoverError]]
    PHASES: ClassVar[tuple[str, ...]]

    samples: Count
    batch: Count
    rate: Positive
    judged_frames: Count
    seed: FromZero

    def __post_init__(self):
        """Raise ERROR for what is no number, or not within its limits."""
        hints = get_type_hints(type(self), include_extras=True)
        for name, value in vars(self).items():
            of_type, limits = hints[name].__origin__, hints[name].__metadata__[0]
            whole = of_type is int
            what, like = ("a whole number", "10") if whole else ("a finite number", "1.0e-3; 1e-3 is text in YAML")
            if not (is_whole if whole else is_number)(value):
                remedy = f"write it like {like}"
                raise self.ERROR(f"{self._where()}: {name} must be {what}", found=quote(value), remedy=remedy)
            if not limits.least <= value <= limits.most:
                raise self.ERROR(f"{self._where()}: {name} must be {limits.words}", found=quote(value))

    @classmethod
    def _where(cls) -> str:
        return f"params.yml: {cls.SECTION}"

    @classmethod
    def of(
        cls, params: dict[str, Any], *, steps: int | None = None, phases: Collection[str] | None = None, **given: Any
    ) -> Self:
        """Take the recipe of params.yml, with each given value that is not None instead.

        steps: in all, see `of_steps`. Raises ERROR for a name that it does not have or that is missing, and for values
        that cannot be.
        """
        values = params[cls.SECTION] | {name: value for name, value in given.items() if value is not None}
        known = [f.name for f in fields(cls)]
        if unknown := sorted(set(values) - set(known)):
            raise cls.ERROR(f"{cls._where()}: there is no {unknown[0]!r}", remedy=f"known are {', '.join(known)}")
        if missing := sorted(set(known) - set(values)):
            raise cls.ERROR(f"{cls._where()}: {missing[0]} is missing")
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

    def described(self) -> dict[str, Any]:
        """Return the recipe and the device, as a stage's params."""
        return asdict(self.recipe) | {"device": self.device.type}

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
        policy = self.origin
        origin = {f"{self.ROLE}_sha256": policy.sha256, f"{self.ROLE}_format": policy.format}
        return write_both(folder, config, weights, loss, origin | {self.VERB: self.described()}, **settings)


class Room:
    """Where a policy learns from lessons, batch by batch. ranges: each action's, (A,); errors are divided by them."""

    def __init__(self, work: Work, ranges: np.ndarray):
        self.work, self.units = work, torch.from_numpy(1 / ranges).to(work.device)

    def batch(self, rng: np.random.Generator) -> Batch:
        """Draw the next samples, each with one of its views."""
        raise NotImplementedError

    def train(
        self, saved: Resumable, phase: str, module: nn.Module, rate: float, loss: Callable[[Batch], Tensor]
    ) -> None:
        """Train a module for the phase's number of steps in the recipe, or go on where that was interrupted."""
        rng, steps = self.work.rng(phase), getattr(self.work.recipe, f"{phase}_steps")
        saved.train(phase, steps, rate, module, rng, lambda: loss(self.batch(rng)))


@dataclass(frozen=True, eq=False)
class Taught:
    """A policy that has learned.

    weights: by LeRobot's names without the leading `model.`. losses: by phase. folder: where the phases are saved.
    notes: what it was made to do without, by part. unrounded: the weights before quantization-aware training, if any.
    """

    weights: dict[str, Tensor]
    losses: dict[str, list[float]]
    folder: Path
    notes: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    unrounded: dict[str, Tensor] | None = None


@contextmanager
def make_run(
    folder: Path, config: ActConfig, replaced: Callable[[Path], Iterable[Path]] = lambda _: ()
) -> Iterator[Path]:
    """Build a run's folder beside it, as `build_beside`, with as many threads as a policy of that config gains from."""
    with build_beside(folder, replaced) as new, threads(1 if gmac(config) < SMALL_GMAC else torch.get_num_threads()):
        yield new
