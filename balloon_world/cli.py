"""The balloon world's commands."""

import gzip
import os
import tempfile
from pathlib import Path
from typing import Any

import click

from balloon_world.level import EASY, LEVELS, level_named
from rover_exchange.cli import open_browser
from rover_lib.cli.prepare import Resumable
from rover_lib.onboard.cli import FILE, open_view, view_options
from rover_lib.onboard.kinds import PathTo
from rover_lib.workshop.progress import terminal_bar

# What this leaves is a student of the demo's policy, packed because an artifact is not:
# rover distill runs/demo/best_model.pth runs/demo/episodes --name tiny --backbone-channels 0.02 --feedforward 64
# --steps 3000, with 3000 samples in params.yml; rover run; rover export --onnx
DEMO = Path(__file__).with_name("demo.onnx.zip.gz")

level_option = click.option(
    "--level", type=click.Choice(list(LEVELS)), default=EASY.name, show_default=True, help="How hard the worlds are."
)


def execute_stage(notebook: str, run_dir: Path, stage: str, **parameters: Any) -> dict[str, Any]:
    """Execute a notebook for a run, and return the stage that it has left."""
    from rover_lib.onboard.stage import read_stage
    from rover_lib.workshop.run.run import execute

    execute(notebook, run_dir, **parameters)
    return read_stage(run_dir / f"{stage}.json", stage)


@click.command(short_help="Watch a learned policy drive, and push its car.")
@view_options
@level_option
def demo(level: str, **options: Any) -> None:
    """Show a policy of 1 MB, part of this package, that drives through the balloon world, in your browser.

    Push its car off its way: with the arrow keys, or by a tap on a side of the picture.
    """
    from balloon_world.show import Simulation
    from rover_lib.onboard.policy.confine import AS_ROOT

    os.environ[AS_ROOT] = "1"  # this artifact is part of the program that root has started
    with tempfile.TemporaryDirectory() as folder:
        artifact = Path(folder, "policy_static.onnx.zip")
        artifact.write_bytes(gzip.decompress(DEMO.read_bytes()))
        open_view(**options, opened=open_browser, shown=Simulation(artifact, "rover demo", level))


@click.group(short_help="The balloon world: record, judge students, learn.")
def world() -> None:
    """The balloon world: record an expert, judge distilled policies, learn from takeovers."""


@world.command(short_help="Record drives of an expert.")
@click.argument("out_dir", type=FILE)
@click.option("--count", type=click.IntRange(min=1), default=80, show_default=True, help="Number of episodes.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@level_option
def record(out_dir: Path, count: int, seed: int, level: str) -> None:
    """Record COUNT drives of the expert to OUT_DIR, in the format of the real car's recorder."""
    from balloon_world.record import record_episodes

    click.echo(f"recorded: {record_episodes(out_dir, count, seed, terminal_bar(), level_named(level))}")


@world.command(short_help="Judge distilled policies beside their teacher.", cls=Resumable)
@click.argument("teacher_run", type=PathTo("run"))
@click.argument("student_runs", type=PathTo("run"), nargs=-1, required=True)
@click.option(
    "--worlds",
    type=click.IntRange(min=0),
    default=200,
    show_default=True,
    help="Worlds to drive in; 0 for a real car's policy.",
)
@level_option
def students(teacher_run: Path, student_runs: tuple[Path, ...], worlds: int, level: str) -> None:
    """Judge the students that `rover distill` left in STUDENT_RUNS beside the teacher in TEACHER_RUN.

    All policies drive through the same worlds: left alone, and pushed with plans that are as late as was computed for
    the policy. Leaves students.json and the executed notebook 08 in TEACHER_RUN, and says which student may take its
    teacher's place. If it is ended at any moment, the same command continues where it was.
    """
    from balloon_world.students import table

    parameters = {"students": [str(run.resolve()) for run in student_runs], "worlds": worlds, "level": level}
    click.echo(table(execute_stage("08_distill", teacher_run, "students", **parameters)["metrics"]))


@world.command(short_help="Drive, correct, learn: does it drive better?", cls=Resumable)
@click.argument("run_dir", type=PathTo("run"))
@click.option("--rounds", type=click.IntRange(min=1), default=3, show_default=True)
@click.option("--drives", type=click.IntRange(min=1), default=20, show_default=True, help="Drives in each round.")
@click.option(
    "--worlds",
    type=click.IntRange(min=1),
    default=200,
    show_default=True,
    help="Worlds to judge in when pushed; half as many left alone.",
)
@level_option
def learn(run_dir: Path, worlds: int, **options: Any) -> None:
    """Let the policy in RUN_DIR drive while an expert takes over where a human would, and train it further on that.

    For comparison, another copy of the policy is trained on plain demonstrations of the same duration. Leaves
    learn.json and the executed notebook 09 in RUN_DIR, recordings and policies in <RUN_DIR>-learn. If it is ended at
    any moment, the same command continues where it was; with more --worlds, it drives only in those that are missing.
    """
    from balloon_world.learn import Experiment, run_experiment, table

    run_dir = run_dir.resolve()
    experiment = Experiment(worlds=worlds, other_worlds=max(1, worlds // 2), **options)
    run_experiment(run_dir, run_dir.with_name(f"{run_dir.name}-learn"), experiment, terminal_bar())
    click.echo(table(execute_stage("09_learn", run_dir, "learn")))
