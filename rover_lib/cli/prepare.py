"""Commands that make artifacts of a checkpoint, and look at them."""

import functools
import json
import re
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rover_lib.onboard.cli import AS_JSON, FILE, describe_artifact, show
from rover_lib.workshop.progress import terminal

if TYPE_CHECKING:
    from rover_lib.workshop.samples import Source


def _size(_: click.Context, __: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """WIDTHxHEIGHT as (height, width)."""
    if value is None:
        return None
    if (sizes := re.fullmatch(r"(\d+)x(\d+)", value)) is None:
        raise click.BadParameter("width and height in pixels are wanted, as in 320x180")
    return int(sizes[2]), int(sizes[1])


ACTION_NAMES = click.option(
    "--action-names", default="", help="What a LeRobotDataset's actions are, in their order, if it does not say it."
)
CAMERA = click.option("--camera", default="", help="Which of a LeRobotDataset's cameras is the car's.")


def with_source(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose `episodes` is a Source: where they are, and what a user says of them."""

    @ACTION_NAMES
    @CAMERA
    @functools.wraps(command)
    def called(*args: Any, episodes: Path, action_names: str, camera: str, **options: Any) -> None:
        from rover_lib.workshop.samples import Source

        return command(*args, episodes=Source.of(episodes, action_names, camera), **options)

    return called


@click.command()
@click.argument("checkpoint", type=FILE)
@click.argument("episodes", type=FILE)
@ACTION_NAMES
@CAMERA
@click.option("--name", default="mine", show_default=True, help="The run's folder: <runs-dir>/<name>/.")
@click.option("--runs-dir", type=FILE, default="runs", show_default=True)
@click.option("--samples", type=click.IntRange(min=1), help="Calibration samples [default: params.yml].")
@click.option("--worlds", type=click.IntRange(min=0), default=0, show_default=True, help="Balloon worlds to drive in.")
@click.option("--iterations", type=click.IntRange(min=1), help="Timed inferences per mode [default: params.yml].")
def run(checkpoint: Path, episodes: Path, **options: Any) -> None:
    """Load, calibrate, quantize, compare and benchmark CHECKPOINT with the recordings in EPISODES.

    EPISODES is a folder of recordings or a LeRobotDataset v3, here and in every other command.
    Executes the five notebooks; reports, artifacts, figures and the executed notebooks are left in the run's folder.
    """
    from rover_lib.workshop.run import run as run_notebooks

    chosen = {k: v for k, v in options.items() if v is not None}
    folder = run_notebooks(checkpoint, episodes, progress=terminal(), **chosen)
    click.echo(f"done: {folder}")


@click.command()
@click.argument("episodes", metavar="FILE", type=FILE)
@AS_JSON
@with_source
def inspect(episodes: "Source", as_json: bool) -> None:
    """Say what FILE is: an artifact, a checkpoint, a folder of recordings, or a LeRobotDataset."""
    file = episodes.path
    if file.is_file() and _is_scripted(file):
        return show(describe_artifact(file), as_json)
    from rover_lib.workshop.checkpoint import lerobot_folder, load_checkpoint

    if file.is_dir() and not lerobot_folder(file):
        from rover_lib.workshop.episodes import load_recordings

        return show({"recordings": load_recordings(episodes, progress=terminal()).summary()}, as_json)
    checkpoint = load_checkpoint(file)
    return show({"checkpoint": {"sha256": checkpoint.sha256, **checkpoint.report}}, as_json)


def _is_scripted(file: Path) -> bool:
    """Whether it is a TorchScript archive. A damaged one is not: the checkpoint's loader says what is wrong with it."""
    try:
        with zipfile.ZipFile(file) as z:
            return any("/code/" in name for name in z.namelist())
    except Exception:  # zipfile says in many types that a file is damaged
        return False


@click.command()
@click.argument("checkpoint", type=FILE)
@click.argument("episodes", type=FILE)
@click.option("-o", "--output", type=FILE, required=True, help="The artifact to write.")
@click.option("--mode", type=click.Choice(["fp32", "dynamic", "static"]), default="static", show_default=True)
@click.option("--kind", type=click.Choice(["symmetric", "affine"]), default="symmetric", show_default=True)
@click.option(
    "--observer", type=click.Choice(["histogram", "minmax", "percentile"]), default="histogram", show_default=True
)
@click.option("--float-block", "float_blocks", multiple=True, help="A block to leave in float; makes static mixed.")
@click.option("--samples", type=click.IntRange(min=1), help="Calibration samples [default: params.yml].")
@with_source
def quantize(checkpoint: Path, episodes: "Source", output: Path, mode: str, samples: int | None, **how: Any) -> None:
    """Quantize CHECKPOINT, calibrated on the recordings in EPISODES, to one artifact.

    `rover run` does this for all modes, chooses the observer and the blocks by measurement, and compares.
    """
    from rover_lib.onboard.params import params
    from rover_lib.workshop.pipeline import Recipe, make_artifact
    from rover_lib.workshop.session import load

    recipe = Recipe.of(params(), samples)
    if mode != "fp32":
        mode = "mixed" if mode == "static" and how["float_blocks"] else mode
        recipe = replace(recipe, scheme=replace(recipe.scheme, mode=mode, **how))
    loaded = load(checkpoint, episodes, terminal())
    digest, warnings = make_artifact(loaded, output, recipe, fp32=mode == "fp32", progress=terminal())
    for warning in warnings:
        click.echo(f"rover: warning: {warning}", err=True)
    click.echo(f"{output}: {mode}, {output.stat().st_size / 1e6:.1f} MB, content {digest[:16]}")


@click.command()
@click.argument("reference", type=FILE)
@click.argument("artifacts", type=FILE, nargs=-1, required=True)
@click.option("--episodes", type=FILE, required=True, help="Recordings; their held-out part judges.")
@AS_JSON
@with_source
def compare(reference: Path, artifacts: tuple[Path, ...], episodes: "Source", as_json: bool) -> None:
    """Compare ARTIFACTS with REFERENCE (the FP32 artifact) on recorded frames.

    Errors are shares of the recorded range and microseconds of servo pulse. A REFERENCE that copies its state and does
    not look at its camera is warned of.
    """
    from rover_lib.onboard.artifact import distinct_names
    from rover_lib.onboard.params import params
    from rover_lib.onboard.policy import load_policy
    from rover_lib.workshop import compare as c
    from rover_lib.workshop.episodes import load_recordings, split
    from rover_lib.workshop.looking import look

    p = params()["calibration"]
    fp32 = load_policy(reference)
    recordings = load_recordings(episodes, fp32.chunk, p["sync_s"], terminal())
    held_out = split(recordings, p["held_out_share"], p["seed"]).held_out
    others = {name: load_policy(path) for name, path in distinct_names(artifacts, drop="policy_").items()}
    report = c.fidelity(fp32, others, held_out, recordings.action_range(), terminal())
    for warning in report.warnings() + look(fp32, report, progress=terminal()).warnings():
        click.echo(f"rover: warning: {warning}", err=True)
    show({name: report.summary(name) for name in others}, as_json)


@click.command()
@click.argument("checkpoint", type=FILE)
@click.argument("episodes", type=FILE)
@click.option("--size", callback=_size, metavar="WIDTHxHEIGHT", help="The student's picture [default: its teacher's].")
@click.option("--decoder-layers", type=int, metavar="N", help="Keep only the first N decoder layers [default: all].")
@click.option("--feedforward", type=int, metavar="N", help="Keep the N best units of each feed-forward [default: all].")
@click.option("--name", required=True, help="The run's folder: <runs-dir>/<name>/.")
@click.option("--runs-dir", type=FILE, default="runs", show_default=True)
@click.option("--samples", type=click.IntRange(min=1), help="Frames to learn from [default: params.yml].")
@click.option("--steps", type=click.IntRange(min=1), help="Optimiser steps of all phases [default: params.yml].")
@click.option("--qat", is_flag=True, help="Train it for INT8 at the end. With no other shape: CHECKPOINT itself.")
@click.option("--seed", type=click.IntRange(min=0), help="[default: params.yml]")
@click.option("--device", type=click.Choice(["cpu", "cuda"]), help="[default: cuda where there is one]")
@AS_JSON
@with_source
def distill(
    checkpoint: Path,
    episodes: "Source",
    size: tuple[int, int] | None,
    decoder_layers: int | None,
    feedforward: int | None,
    samples: int | None,
    steps: int | None,
    seed: int | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Teach a smaller policy what CHECKPOINT plans on the recordings in EPISODES.

    Leaves best_model.pth for `rover run`, pretrained_model/ for LeRobot, and distill.json in the run's folder. Ended at
    any moment and started again, it goes on where it was.
    """
    from rover_lib.onboard.params import params
    from rover_lib.onboard.stage import read_stage
    from rover_lib.workshop.distill import Recipe, summary
    from rover_lib.workshop.distill import distill as teach
    from rover_lib.workshop.student import StudentShape

    recipe = Recipe(**params()["distill"])
    recipe = recipe.of_steps(steps) if steps else recipe
    given = {"samples": samples, "seed": seed}
    recipe = replace(recipe, **{name: value for name, value in given.items() if value is not None})
    height, width = size or (None, None)
    shape = StudentShape(height, width, decoder_layers, feedforward)
    folder = teach(checkpoint, episodes, shape=shape, recipe=recipe, progress=terminal(), **options)
    content = read_stage(folder / "distill.json", "distill")
    click.echo(json.dumps(content, indent=2) if as_json else f"{summary(content)}\ndone: {folder}")


@click.command("export-dataset")
@click.argument("episodes", type=FILE)
@click.argument("out", type=FILE)
@click.option("--video", is_flag=True, help="AV1 video, far smaller and not equal to the last bit [default: images].")
@AS_JSON
def export_dataset(episodes: Path, out: Path, video: bool, as_json: bool) -> None:
    """Write our recordings in EPISODES as a LeRobotDataset v3 to the new folder OUT, for lerobot-train.

    What is repaired in them or left out is printed, and kept in OUT/rover_export.json.
    """
    from rover_lib.workshop.export_dataset import REPORT
    from rover_lib.workshop.export_dataset import export_dataset as write

    report = write(episodes, out, video=video, progress=terminal())
    del report["episodes_are"]  # long, and in the file
    show({"exported": report | {"report": str(out / REPORT)}}, as_json)


@click.command()
@click.argument("folder", type=FILE, default="wheels")
@click.option("--python", "pythons", multiple=True, help="A Pi's Python [default: 3.11 and 3.13].")
@click.option("--only-rover", is_flag=True, help="Only rover_lib's own wheel: Pis with internet fetch the others.")
def wheelhouse(folder: Path, pythons: tuple[str, ...], only_rover: bool) -> None:
    """Put all that a Pi installs into FOLDER, for a rover without internet (154 MB for each Python)."""
    from rover_lib.workshop.wheelhouse import PYTHONS, make

    show(vars(make(folder, pythons=pythons or PYTHONS, only_rover=only_rover)), True)
