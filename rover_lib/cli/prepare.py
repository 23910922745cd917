"""Commands that make artifacts from a checkpoint and inspect them."""

import functools
import json
import re
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rover_lib.onboard.cli import ARTIFACT, AS_JSON, FILE, show
from rover_lib.onboard.columns import align
from rover_lib.onboard.errors import printable
from rover_lib.onboard.kinds import Output, PathTo
from rover_lib.workshop.progress import terminal_bar

if TYPE_CHECKING:
    from rover_lib.workshop.recordings.samples import Source


def size_option(_: click.Context, __: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """Parse WIDTHxHEIGHT; return (height, width)."""
    if value is None:
        return None
    if (sizes := re.fullmatch(r"(\d+)x(\d+)", value)) is None:
        raise click.BadParameter("width and height in pixels are wanted, as in 320x180")
    return int(sizes[2]), int(sizes[1])


CHECKPOINT, EPISODES = PathTo("checkpoint"), PathTo("recordings")
ACTION_NAMES = click.option(
    "--action-names", default="", help="Names of a LeRobotDataset's actions in order, if it has none."
)
CAMERA = click.option(
    "--camera", default="", help="Which cameras of a LeRobotDataset the policy uses, separated by commas."
)


def with_source(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command its `episodes` as a Source: where the recordings are, and what the user says about them."""

    @ACTION_NAMES
    @CAMERA
    @functools.wraps(command)
    def called(*args: Any, episodes: Path, action_names: str, camera: str, **options: Any) -> None:
        from rover_lib.workshop.recordings.samples import Source

        return command(*args, episodes=Source.of(episodes, action_names, camera), **options)

    return called


@click.command(short_help="Turn a checkpoint into artifacts and a verdict.")
@click.argument("checkpoint", type=CHECKPOINT)
@click.argument("episodes", type=EPISODES)
@ACTION_NAMES
@CAMERA
@click.option("--name", default="mine", show_default=True, help="The run's folder: <runs-dir>/<name>/.")
@click.option("--runs-dir", type=FILE, default="runs", show_default=True)
@click.option("--samples", type=click.IntRange(min=1), help="Calibration samples [default: params.yml].")
@click.option("--worlds", type=click.IntRange(min=0), default=0, show_default=True, help="Balloon worlds to drive in.")
@click.option("--iterations", type=click.IntRange(min=1), help="Timed inferences per mode [default: params.yml].")
def run(checkpoint: Path, episodes: Path, **options: Any) -> None:
    """Load, calibrate, quantize, compare and benchmark CHECKPOINT with the recordings in EPISODES.

    EPISODES is a folder of recordings or a LeRobotDataset v3, here and in every other command; give a dataset on the
    Hub as user/name@revision.
    Executes five notebooks and leaves reports, artifacts, figures and the executed notebooks in the run's folder. Ends
    with a verdict, printed and written as report.html and run.json: which artifact to deploy, what failed, and what to
    do about it.
    """
    from rover_lib.workshop.run.run import run as run_notebooks

    chosen = {k: v for k, v in options.items() if v is not None}
    folder = run_notebooks(checkpoint, episodes, progress=terminal_bar(), **chosen)
    _judge(folder)


@click.command(short_help="Execute one notebook of a run again.")
@click.argument("name")
@click.argument("run_dir", type=PathTo("run"))
@click.option("-p", "turned", type=(str, str), multiple=True, metavar="PARAMETER VALUE", help="May be repeated.")
def notebook(name: str, run_dir: Path, turned: tuple[tuple[str, str], ...]) -> None:
    """Execute the notebook NAME, such as 03_quantize, on the run in RUN_DIR, with other parameters.

    Its results replace those in RUN_DIR, so take a copy of a run that you want to keep (`make notebooks-open NAME=demo
    AS=try1`). A value is YAML: 0.5, affine, [static, mixed]. A parameter that the notebook does not have is refused.
    """
    import yaml

    from rover_lib.workshop.run.run import execute

    try:
        given = {key: yaml.safe_load(value) for key, value in turned}
    except yaml.YAMLError as error:
        raise click.BadParameter(f"a value is not YAML: {' '.join(str(error).split())}") from None
    click.echo(f"executed: {execute(name.removesuffix('.ipynb'), run_dir, **given)}")


@click.command(short_help="Judge an existing run again.")
@click.argument("run_dir", type=PathTo("run"))
@AS_JSON
def report(run_dir: Path, as_json: bool) -> None:
    """Judge the existing run in RUN_DIR again, as `rover run` does at its end.

    Use it after `make count` has counted instructions, after `rover world students`, or when params.yml has changed.
    """
    _judge(run_dir, as_json)


def _judge(run_dir: Path, as_json: bool = False) -> None:
    from rover_lib.workshop.run.run_report import PAGE, text, write

    content = write(run_dir)
    if as_json:
        return click.echo(json.dumps(content, indent=2))
    click.echo(f"{text(content['metrics'])}\n\ndone: {run_dir / PAGE}")


@click.command(short_help="Say what a file or folder is, and what is in it.")
@click.argument("episodes", metavar="FILE", type=FILE)
@AS_JSON
@with_source
def inspect(episodes: "Source", as_json: bool) -> None:
    """Say what FILE is and what is in it: everything that this project writes, and what it reads.

    A run, an artifact, a checkpoint (a trainer's or LeRobot's), an episode or a folder of them, a LeRobotDataset, a
    flight log, a calibration, a stage's report.
    """
    from rover_lib.workshop.run.describe import describe

    show(describe(episodes, terminal_bar()), as_json)


@click.command("list", short_help="List the runs with their verdicts.")
@click.argument("runs_dir", type=FILE, default="runs")
@AS_JSON
def list_runs(runs_dir: Path, as_json: bool) -> None:
    """List the runs in RUNS_DIR, one line each, with the verdict that each ended with."""
    from rover_lib.workshop.run.describe import runs

    found = runs(runs_dir)
    if as_json:
        return show(found, True)
    for each in found:
        click.echo(printable(f"{each['name']:<16} {each['verdict']}"))
    if not found:
        click.echo(f"no run in {runs_dir}: make demo, or rover run, makes the first")


@click.command(short_help="Make one artifact from a checkpoint.")
@click.argument("checkpoint", type=CHECKPOINT)
@click.argument("episodes", type=EPISODES)
@click.option("-o", "--output", type=Output("artifact"), required=True, help="The artifact to write.")
@click.option("--mode", type=click.Choice(["fp32", "dynamic", "static"]), default="static", show_default=True)
@click.option(
    "--kind",
    type=click.Choice(["symmetric", "affine"]),
    default="symmetric",
    show_default=True,
    help="How activations become INT8; affine is the usual recipe, and slow on a Pi.",
)
@click.option(
    "--observer", type=click.Choice(["histogram", "minmax", "percentile"]), default="histogram", show_default=True
)
@click.option(
    "--float-block",
    "float_blocks",
    multiple=True,
    help="A block to leave in float, which makes the mode mixed; may be repeated.",
)
@click.option("--samples", type=click.IntRange(min=1), help="Calibration samples [default: params.yml].")
@with_source
def quantize(checkpoint: Path, episodes: "Source", output: Path, mode: str, samples: int | None, **how: Any) -> None:
    """Quantize CHECKPOINT, calibrated on the recordings in EPISODES, to one artifact.

    `rover run` does this for all modes, chooses the observer and the blocks by measurement, and compares.
    """
    from rover_lib.onboard.params import params
    from rover_lib.workshop.run.pipeline import Recipe, make_artifact
    from rover_lib.workshop.run.session import load

    recipe = Recipe.of(params(), samples)
    if mode != "fp32":
        mode = "mixed" if mode == "static" and how["float_blocks"] else mode
        recipe = replace(recipe, scheme=replace(recipe.scheme, mode=mode, **how))
    loaded = load(checkpoint, episodes, terminal_bar())
    digest, warnings = make_artifact(loaded, output, recipe, fp32=mode == "fp32", progress=terminal_bar())
    for warning in warnings:
        click.echo(f"rover: warning: {warning}", err=True)
    click.echo(f"{output}: {mode}, {output.stat().st_size / 1e6:.1f} MB, content {digest[:16]}")


@click.command(short_help="Compare artifacts with FP32, on recorded frames.")
@click.argument("reference", type=ARTIFACT)
@click.argument("artifacts", type=ARTIFACT, nargs=-1, required=True)
@click.option("--episodes", type=EPISODES, required=True, help="Recordings; their held-out part is used.")
@AS_JSON
@with_source
def compare(reference: Path, artifacts: tuple[Path, ...], episodes: "Source", as_json: bool) -> None:
    """Compare ARTIFACTS with REFERENCE (the FP32 artifact) on recorded frames.

    Errors are in percent of the recorded range and in microseconds of servo pulse. Warns if REFERENCE copies its state
    and ignores its camera.
    """
    from rover_lib.onboard.artifact.manifest import distinct_names
    from rover_lib.onboard.policy.confined import run_confined
    from rover_lib.workshop.judge.compare import comparison_rows
    from rover_lib.workshop.judge.compare_files import compare_files

    others = distinct_names(artifacts, drop="policy_")
    report = run_confined(compare_files, reference=reference, others=others, source=vars(episodes))
    for warning in report["warnings"]:
        click.echo(f"rover: warning: {warning}", err=True)
    if as_json:
        return show(report["summaries"], as_json)
    sizes_mb = {name: path.stat().st_size / 1e6 for name, path in others.items()}
    click.echo("\n".join(align(comparison_rows(report["summaries"], sizes_mb, reference.stat().st_size / 1e6))))
    click.echo(f"errors on {report['frames']} held-out frames, of the recorded range, and microseconds of pulse")


@click.command(short_help="Write a run's policies for other engines: ONNX Runtime, Hailo.")
@click.argument("run_dir", type=PathTo("run"))
@click.option("--onnx", is_flag=True, help="policy_fp32.onnx.zip and policy_static.onnx.zip, beside the others.")
@click.option("--card", is_flag=True, help="README.md, a model card to publish the run's artifacts with.")
@click.option("--hailo", "kit", type=FILE, metavar="OUT", help="A kit for Hailo's compiler, in the new folder OUT.")
@click.option(
    "--samples", type=click.IntRange(min=1), default=1024, show_default=True, help="Frames to calibrate the kit with."
)
def export(run_dir: Path, onnx: bool, card: bool, kit: Path | None, samples: int) -> None:
    """Write the policies of the run in RUN_DIR for another engine, or for others to use.

    --onnx: for ONNX Runtime, with the run's own calibration. Such a file can be used like any artifact (benchmark,
    compare, drive, release), and a rover with that engine needs no torch; model.onnx is inside.

    --card: what the verdict and the recordings say of the artifacts, for the Hub; docs/lerobot.md says how to publish.

    --hailo: a kit of networks, calibration set and scripts, calibrated on the run's recordings; see docs/hailo.md.
    """
    if not (onnx or card) and kit is None:
        raise click.UsageError("for what? --onnx, --card, or --hailo OUT")
    if card:
        from rover_lib.workshop.run.run_report import write_card

        click.echo(f"written: {write_card(run_dir)}")
    if onnx:
        from rover_lib.workshop.run.pipeline import export_onnx

        for name, digest in export_onnx(run_dir, terminal_bar()).items():
            path = run_dir / name
            click.echo(f"{path}: {path.stat().st_size / 1e6:.1f} MB, content {digest[:16]}")
    if kit is None:
        return
    (hailo,) = entry_points(group="rover.kits", name="hailo")
    hailo.load()(run_dir, kit, samples)


@click.command(short_help="Collect the packages for a Pi without internet.")
@click.argument("folder", type=FILE, default="wheels")
@click.option("--python", "pythons", multiple=True, help="A Pi's Python [default: 3.11 and 3.13].")
@click.option("--only-rover", is_flag=True, help="Only rover_lib's own wheel: Pis with internet fetch the others.")
@click.option("--engine", type=click.Choice(["torch", "onnxruntime"]), default="torch", show_default=True)
def wheelhouse(folder: Path, pythons: tuple[str, ...], only_rover: bool, engine: str) -> None:
    """Download all packages that a Pi installs into FOLDER, for a rover without internet (154 MB per Python)."""
    from rover_lib.workshop.wheelhouse import PYTHONS, make

    show(vars(make(folder, pythons=pythons or PYTHONS, only_rover=only_rover, engine=engine)), True)
