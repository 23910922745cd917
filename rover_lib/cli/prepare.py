"""Commands that make artifacts from a checkpoint and inspect them."""

import functools
import re
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rover_lib.onboard.cli import AS_JSON, FILE, FROM_0, FROM_1, notify, show
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.kinds import Output, PathTo, Preset, check_kind, kinds_of
from rover_lib.workshop.progress import terminal_bar

if TYPE_CHECKING:
    from rover_lib.workshop.recordings.source import Source


def size_option(_: click.Context, __: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """Parse WIDTHxHEIGHT; return (height, width)."""
    if value is None:
        return None
    if (sizes := re.fullmatch(r"(\d+)x(\d+)", value)) is None:
        raise click.BadParameter("width and height in pixels are wanted, as in 320x180")
    return int(sizes[2]), int(sizes[1])


SAMPLES: dict[str, Any] = {"cls": Preset, "preset": lambda p, _: p["calibration"]["samples"]}
ITERATIONS: dict[str, Any] = {"cls": Preset, "preset": lambda p, _: p["benchmark"]["iterations"]}


class Resumable(click.Command):
    """A long command that, run again after Ctrl-C, resumes."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            notify("\nrover: stopped; run the same command again to resume")
            ctx.exit(130)


Turned = tuple[tuple[str, str], ...]
CHECKPOINT, EPISODES = PathTo("checkpoint"), PathTo("recordings")
ACTION_NAMES = click.option("--action-names", default="", help="Of a LeRobotDataset's actions, if it has none.")
CAMERA = click.option("--camera", default="", help="A LeRobotDataset's cameras that the policy uses, with commas.")
FACTS = click.option("--facts", default="", help="Of a policy, if its files lack them: rate=20 actions=A,B size=WxH.")
THROTTLE = click.option(
    "--throttle", type=click.Choice(["as-recorded", "negated"]), help="For donkeycar tubs that drive forward by < 0."
)


def with_source(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command its `episodes` as a Source: where the recordings are, and what the user says about them."""

    @ACTION_NAMES
    @CAMERA
    @FACTS
    @THROTTLE
    @functools.wraps(command)
    def called(*args: Any, episodes: Path, **options: Any) -> None:
        from rover_lib.workshop.recordings.source import Source

        texts = {name: options.pop(name) or "" for name in ("action_names", "camera", "facts", "throttle")}
        return command(*args, episodes=Source.of(episodes, **texts), **options)

    return called


@click.command(short_help="Turn a checkpoint into artifacts and a verdict.", cls=Resumable)
@click.argument("checkpoint", type=CHECKPOINT, required=False)
@click.argument("episodes", type=EPISODES, required=False)
@ACTION_NAMES
@CAMERA
@FACTS
@THROTTLE
@click.option(
    "--name", default="mine", show_default=True, help="Of the run's folder in <runs-dir>: letters, digits, _ - ."
)
@click.option("--runs-dir", type=FILE, default="runs", show_default=True)
@click.option("--samples", type=FROM_1, help="Calibration samples [default: params.yml].", **SAMPLES)
@click.option("--worlds", type=FROM_0, help="Balloon worlds to drive in [default: 0].")
@click.option("--iterations", type=FROM_1, help="Timed inferences per mode [default: params.yml].", **ITERATIONS)
@click.option("-p", "turned", type=(str, str), multiple=True, metavar="PARAMETER VALUE", help="May be repeated.")
@click.option("--only", metavar="NOTEBOOK", help="Execute one notebook, such as 04, on the run again.")
def run(checkpoint: Path | None, episodes: Path | None, turned: Turned, only: str | None, **options: Any) -> None:
    """Load, calibrate, quantize, compare and benchmark CHECKPOINT with the recordings in EPISODES.

    EPISODES is a folder of recordings, a LeRobotDataset, a donkeycar tub or a folder of tubs, here and in every other
    command.
    Executes five notebooks in the run's folder. Ends with a verdict, also in run.json: which artifact to deploy,
    what failed, and what to do about it.

    -p turns any of the notebooks' parameters; a value is YAML: 0.5, [minmax], [static, mixed].

    --only 03 --name try1: execute one notebook on that run again, whose results are replaced; `rover report` judges it.
    """
    import yaml

    from rover_lib.workshop.run import run, run_folder

    name, runs_dir = options.pop("name"), options.pop("runs_dir")
    parameters = {key: value for key, value in options.items() if value not in (None, "")}
    try:
        parameters |= {key: yaml.safe_load(value) for key, value in turned}
    except yaml.YAMLError as error:
        raise click.BadParameter(f"a value is not YAML: {' '.join(str(error).split())}") from None
    if only and not (checkpoint or episodes):
        folder = run_folder(runs_dir, name, RoverError)
        return click.echo(f"executed: {run.execute(only, folder, **parameters)}")
    if only or not (checkpoint and episodes):
        raise click.UsageError("give a CHECKPOINT and EPISODES, or --only NOTEBOOK --name RUN")
    parameters = {"worlds": 0} | parameters
    _judge(run.run(checkpoint, episodes, name, runs_dir=runs_dir, progress=terminal_bar(), **parameters))


@click.command(short_help="Judge an existing run again.")
@click.argument("run_dir", type=PathTo("run"))
def report(run_dir: Path) -> None:
    """Judge the run in RUN_DIR again, after `make count` or `rover world students`, or when params.yml has changed."""
    _judge(run_dir)


def _judge(run_dir: Path) -> None:
    from rover_lib.workshop.run.run_report import text, write

    click.echo(f"{text(write(run_dir)['metrics'])}\n\ndone: {run_dir}")


@click.command(short_help="Say what a file or folder is; list the runs.")
@click.argument("episodes", metavar="[FILE]", type=FILE, default="runs")
@AS_JSON
@with_source
def inspect(episodes: "Source", as_json: bool) -> None:
    """Say what FILE is and what is in it: everything that this project writes, and what it reads.

    Of a folder of runs, or without FILE, each run's verdict.
    """
    from rover_lib.workshop.run.describe import describe

    show(describe(episodes, terminal_bar()), as_json)


@click.command(short_help="Write policies for ONNX Runtime, or a run's model card.")
@click.argument("source", metavar="RUN_DIR|CHECKPOINT", type=FILE)
@click.option("--onnx", is_flag=True, help="Of a run policy_fp32.onnx.zip and policy_static.onnx.zip.")
@click.option("--hailo", is_flag=True, help="What Hailo's compiler needs, into RUN_DIR/hailo; see docs/hailo.md.")
@click.option("-o", "--output", type=Output(), help="Of a checkpoint: the graph [default: its name, here, with .onnx].")
@FACTS
@click.option("--card", is_flag=True, help="README.md, a model card to publish the run's artifacts with.")
@click.option("--license", help="For the card, such as apache-2.0 [default: the checkpoint's, if it names one].")
@click.option("--base-model", metavar="USER/NAME", help="For the card: the FP32 policy on the Hub [default: likewise].")
def export(
    source: Path, onnx: bool, hailo: bool, output: Path | None, facts: str, card: bool, **about: str | None
) -> None:
    """Write the policies of a run for another engine, or for others to use; or one checkpoint as a graph in FP32.

    --onnx: artifacts for ONNX Runtime; a rover with that engine needs no torch. Of a CHECKPOINT, which needs neither
    recordings nor a run, the plain graph: docs/api.md has its contract. --card: see docs/lerobot.md.
    """
    if not (onnx or card or hailo):
        raise click.UsageError("for what? --onnx, --hailo or --card")
    is_run = card or hailo or (source / "quantize.json").is_file()
    if not is_run and {"checkpoint", "pretrained"} & {*kinds_of(source)}:
        from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
        from rover_lib.workshop.run.pipeline import export_graph

        graph = export_graph(load_checkpoint(source, said=facts), output or Path(f"{source.resolve().stem}.onnx"))
        return click.echo(f"{graph}: {graph.stat().st_size / 1e6:.1f} MB, FP32")
    check_kind(source, "run")
    if output or facts:
        raise click.UsageError("--output and --facts belong to a checkpoint, not to a run")
    if card:
        from rover_lib.workshop.run.run_report import write_card

        click.echo(f"written: {write_card(source, **about)}")
    if onnx:
        from rover_lib.workshop.run.pipeline import export_onnx

        for name, digest in export_onnx(source, terminal_bar()).items():
            path = source / name
            click.echo(f"{path}: {path.stat().st_size / 1e6:.1f} MB, content {digest[:16]}")
    if hailo:
        (write_kit,) = entry_points(group="rover.graphs", name="hailo")
        show({str(source / "hailo"): write_kit.load()(source, terminal_bar())}, False)


@click.command(short_help="Collect the packages for a Pi without internet.")
@click.argument("folder", type=FILE, default="wheels")
@click.option("--only-rover", is_flag=True, help="Only rover_lib's own wheel: Pis with internet fetch the others.")
@click.option("--engine", type=click.Choice(["torch", "onnxruntime"]), default="torch", show_default=True)
def wheelhouse(folder: Path, only_rover: bool, engine: str) -> None:
    """Download all packages that a Pi installs into FOLDER, for a rover without internet (154 MB per Python)."""
    from rover_lib.workshop.wheelhouse import make

    show(vars(make(folder, only_rover=only_rover, engine=engine)), True)
