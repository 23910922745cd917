"""The commands that teach policies. `rover` has them by entry points of pyproject.toml."""

import functools
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rover_lib.cli.prepare import CHECKPOINT, EPISODES, FACTS, THROTTLE, Resumable, size_option, with_source
from rover_lib.onboard.cli import FILE
from rover_lib.onboard.kinds import Number, Output, Preset
from rover_lib.workshop.progress import terminal_bar

if TYPE_CHECKING:
    from rover_lib.workshop.recordings.source import Source


def _by_recipe(value_of: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """What makes an option show a recipe's value; of `rover train`, that of each size."""

    def preset(p: dict[str, Any], command: str) -> object:
        recipe = p[command]
        if "small" in recipe:
            return ", ".join(f"{value_of(recipe[size])} ({size})" for size in ("small", "full"))
        return value_of(recipe)

    return {"cls": Preset, "preset": preset}


STEPS = _by_recipe(lambda recipe: sum(count for name, count in recipe.items() if name.endswith("_steps")))
BATCH = _by_recipe(lambda recipe: recipe["batch"])
MINUTES = _by_recipe(lambda recipe: recipe["minutes"])


def of_a_training(command: Callable[..., None]) -> Callable[..., None]:
    """Add what every training can be told: how long it lasts, and what it computes on, which it gets as a Machine."""

    @functools.wraps(command)
    def called(*args: Any, device: str | None, workers: int | None, amp: bool, **options: Any) -> None:
        from rover_learn.training import Machine

        return command(*args, machine=Machine.of(device, workers, amp), **options)

    for option in (
        click.option("--amp/--no-amp", default=False, show_default=True, help="Mixed precision, in bfloat16."),
        click.option("--workers", type=click.IntRange(min=0), help="Threads that read ahead [default: all for a GPU]."),
        click.option("--device", metavar="cpu|cuda|cuda:N", help="[default: cuda where there is one]"),
        click.option("--batch", type=click.IntRange(min=1), help="Samples in a step [default: params.yml].", **BATCH),
        click.option("--steps", type=click.IntRange(min=1), help="Steps of all phases [default: params.yml].", **STEPS),
    ):
        called = option(called)
    return called


def of_a_recipe(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of a training that leaves a run's folder."""
    for option in (
        of_a_training,
        click.option("--runs-dir", type=FILE, default="runs", show_default=True),
        click.option("--name", required=True, help="Of the run's folder in <runs-dir>: letters, digits, _ - ."),
    ):
        command = option(command)
    return command


def show_stage(folder: Path, stage: str, summary: Callable[[Any], str]) -> None:
    """Print the summary of a run's stage, and where the run is."""
    from rover_lib.onboard.stage import read_stage

    click.echo(f"{summary(read_stage(folder / f'{stage}.json', stage))}\ndone: {folder}")


@click.command(short_help="Teach a smaller policy.", cls=Resumable)
@click.argument("checkpoint", type=CHECKPOINT)
@click.argument("episodes", type=EPISODES)
@click.option(
    "--size", callback=size_option, metavar="WIDTHxHEIGHT", help="The student's picture [default: its teacher's]."
)
@click.option("--decoder-layers", type=int, metavar="N", help="Keep only the first N decoder layers.")
@click.option("--feedforward", type=int, metavar="N", help="Keep the N most important units of each feed-forward.")
@click.option(
    "--backbone-channels", type=float, metavar="SHARE", help="Of the channels inside its blocks, such as 0.5."
)
@of_a_recipe
@with_source
def distill(checkpoint: Path, episodes: "Source", size: tuple[int, int] | None, **options: Any) -> None:
    """Teach a smaller policy what CHECKPOINT plans on the recordings in EPISODES.

    Leaves best_model.pth for `rover run`, pretrained_model/ for LeRobot and distill.json in the run's folder. Run it
    again to resume.
    """
    from rover_learn import distill
    from rover_learn.distill import DistillRecipe, summary
    from rover_learn.student import StudentShape

    parts = {name: options.pop(name) for name in ("decoder_layers", "feedforward", "backbone_channels")}
    recipe = DistillRecipe.of(steps=options.pop("steps"), batch=options.pop("batch"))
    options |= {"shape": StudentShape(*(size or (None, None)), **parts), "recipe": recipe}
    folder = distill.distill(checkpoint, episodes, progress=terminal_bar(), **options)
    show_stage(folder, "distill", summary)


@click.command(short_help="Train a policy further, from takeovers.", cls=Resumable)
@click.argument("checkpoint", type=CHECKPOINT)
@click.argument("episodes", type=EPISODES, nargs=-1, required=True)
@FACTS
@THROTTLE
@of_a_recipe
def finetune(checkpoint: Path, episodes: tuple[Path, ...], facts: str, throttle: str | None, **options: Any) -> None:
    """Train CHECKPOINT further on what humans drove in EPISODES: first the old recordings, then the new ones.

    A human's frames in a drive of the policy are corrections, and count more; the policy's own frames are not
    imitated. Leaves best_model.pth for `rover run`, pretrained_model/ for LeRobot and finetune.json in the run's
    folder, and says on which held-out episodes it came closer to the human. Run it again to resume.
    """
    from rover_learn import finetune
    from rover_learn.finetune import FinetuneRecipe, summary
    from rover_lib.workshop.recordings.source import Source

    recipe = FinetuneRecipe.of(steps=options.pop("steps"), batch=options.pop("batch"))
    sources = [Source.of(path, facts=facts, throttle=throttle or "") for path in episodes]
    folder = finetune.finetune(checkpoint, sources, recipe=recipe, progress=terminal_bar(), **options)
    show_stage(folder, "finetune", summary)


@click.command(short_help="Train a policy, LeRobot's ACT, on recordings.", cls=Resumable)
@click.argument("episodes", type=EPISODES)
@click.argument("output", type=Output("checkpoint"))
@click.option(
    "--size",
    type=click.Choice(["small", "full"]),
    default="small",
    show_default=True,
    help="full is the size of the real car's policy.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option(
    "--minutes", type=Number(min=0.1), help="Budget: of the processor, or of a GPU [default: params.yml].", **MINUTES
)
@click.option(
    "--backbone",
    default="imagenet",
    show_default=True,
    metavar="FILE|imagenet|none",
    help="torchvision's ResNet18 weights to begin with; imagenet: from the internet, if it is there.",
)
@of_a_training
@with_source
def train(episodes: "Source", output: Path, backbone: str, **options: Any) -> None:
    """Train LeRobot's ACT on the recordings in EPISODES and write the checkpoint OUTPUT, as a trainer's .pth.

    It goes on while its error on recordings that it does not learn from falls, within a budget of minutes, and shows
    that error of each action beside a guess that needs no eyes. `full`, the policy of the real car, is trained at a
    quarter of its pixels and then carried to 640x360. The rate of its plans is that of the recordings, whose held-out
    part is left for `rover run`. Beside OUTPUT are its curves, and pretrained_model/ for LeRobot. Run it again to
    resume; for that it keeps up to 5 GB in the cache, $ROVER_CACHE or ~/.cache/rover.
    """
    from rover_learn import train
    from rover_learn.act_phases import Overrides
    from rover_learn.curves import read_actions
    from rover_learn.judges import not_learned
    from rover_learn.train import curves_of
    from rover_lib.workshop.installed import typed

    options |= {"backbone": None if backbone == "none" else backbone}
    options["overrides"] = Overrides(*(options.pop(name) for name in ("steps", "batch", "minutes")))
    click.echo(f"trained: {train.train(episodes, output, progress=terminal_bar(), say=click.echo, **options)}")
    actions = read_actions(curves_of(output))
    if lacking := not_learned(actions):
        return click.echo("\n".join(lacking))
    command = typed(f"rover run {shlex.quote(str(output))} {episodes.typed()} --name mine")
    click.echo(f"next: {command}")
