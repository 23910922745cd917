"""The balloon world's commands."""

import gzip
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import click

from rover_exchange.cli import open_browser
from rover_lib.onboard.cli import ARTIFACT, AS_JSON, FILE, open_view, show, view_options
from rover_lib.onboard.kinds import PathTo
from rover_lib.workshop.progress import terminal_bar

# What this leaves is a student of the demo's policy, packed because an artifact is not:
# rover distill runs/demo/best_model.pth runs/demo/episodes --name tiny --backbone-channels 0.02 --feedforward 64
# --steps 3000 --samples 3000; rover run; rover export --onnx
DEMO = Path(__file__).with_name("demo.onnx.zip.gz")


def executed(notebook: str, run_dir: Path, stage: str, **given: Any) -> dict[str, Any]:
    """Execute a notebook for a run, and return the stage that it has left."""
    from rover_lib.onboard.stage import read_stage
    from rover_lib.workshop.run.run import execute

    execute(notebook, run_dir, **given)
    return read_stage(run_dir / f"{stage}.json", stage)


@click.command(short_help="Watch a learned policy drive, and push its car.")
@view_options
def demo(**options: Any) -> None:
    """Show a policy of 1 MB, part of this package, that drives through the balloon world, in your browser.

    Push its car off its way: with the arrow keys, or by a tap on a side of the picture.
    """
    from balloon_world.show import Simulation
    from rover_lib.onboard.policy.confine import AS_ROOT

    os.environ[AS_ROOT] = "1"  # this artifact is part of the program that root has started
    with tempfile.TemporaryDirectory() as folder:
        artifact = Path(folder, "policy_static.onnx.zip")
        artifact.write_bytes(gzip.decompress(DEMO.read_bytes()))
        open_view(**options, opened=open_browser, shown=Simulation(artifact, title="rover demo"))


@click.group(short_help="The balloon world: record, train, drive.")
def world() -> None:
    """The balloon world: record an expert, train a policy, drive it."""


@world.command(short_help="Record drives of an expert.")
@click.argument("out_dir", type=FILE)
@click.option("--count", type=click.IntRange(min=1), default=80, show_default=True, help="Number of episodes.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
def record(out_dir: Path, count: int, seed: int) -> None:
    """Record COUNT drives of the expert to OUT_DIR, in the format of the real car's recorder."""
    from balloon_world.record import record_episodes

    click.echo(f"recorded: {record_episodes(out_dir, count, seed, terminal_bar())}")


@world.command(short_help="Drive an artifact through unseen worlds; count hits.")
@click.argument("artifact", type=ARTIFACT)
@click.option("--worlds", type=click.IntRange(min=1), default=40, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=10_000, show_default=True, help="Seed of the first world.")
@AS_JSON
def trial(artifact: Path, worlds: int, seed: int, as_json: bool) -> None:
    """Drive ARTIFACT through worlds that it has never seen, and count the balloons it hits."""
    from balloon_world.trial import run_trials
    from rover_lib.onboard.policy.load import load_policy

    report = run_trials(load_policy(artifact), worlds, seed, progress=terminal_bar())
    low, high = report.wilson
    result = {"hits": report.hits, "trials": report.trials, "wilson_low": low, "wilson_high": high}
    show(result, as_json)


@world.command("latency", short_help="Drive a run with late plans; count hits.")
@click.argument("run_dir", type=PathTo("run"))
@click.option("--worlds", type=click.IntRange(min=1), default=40, show_default=True)
@AS_JSON
def world_latency(run_dir: Path, worlds: int, as_json: bool) -> None:
    """Drive by RUN_DIR's static policy with late plans, in the car's loop and virtual time, and count balloons hit.

    Leaves drive.json and the executed notebook 07 in RUN_DIR, and says whether the gate of params.yml holds.
    """
    from balloon_world.latency import table

    content = executed("07_drive", run_dir, "drive", worlds=worlds)
    click.echo(json.dumps(content, indent=2) if as_json else table(content))


@world.command(short_help="Judge distilled policies beside their teacher.")
@click.argument("teacher_run", type=PathTo("run"))
@click.argument("student_runs", type=PathTo("run"), nargs=-1, required=True)
@click.option("--episodes", type=FILE, help="Recordings to judge with [default: those of TEACHER_RUN].")
@click.option(
    "--worlds",
    type=click.IntRange(min=0),
    default=200,
    show_default=True,
    help="Worlds to drive in; 0 for a real car's policy.",
)
@AS_JSON
def students(
    teacher_run: Path, student_runs: tuple[Path, ...], episodes: Path | None, worlds: int, as_json: bool
) -> None:
    """Judge the students that `rover distill` left in STUDENT_RUNS beside the teacher in TEACHER_RUN.

    All policies drive through the same worlds: left alone, and pushed with plans that are as late as was computed for
    the policy. Leaves students.json and the executed notebook 08 in TEACHER_RUN, and says which student may take its
    teacher's place. If it is ended at any moment, the same command continues where it was.
    """
    from balloon_world.students import table

    given = {"students": [str(run.resolve()) for run in student_runs], "worlds": worlds}
    content = executed(
        "08_distill", teacher_run, "students", **given, episodes=str(episodes.resolve()) if episodes else ""
    )
    click.echo(json.dumps(content, indent=2) if as_json else table(content["metrics"]))


@world.command(short_help="Drive, correct, learn: does it drive better?")
@click.argument("run_dir", type=PathTo("run"))
@click.option("--out", type=FILE, help="Folder for recordings and policies [default: <RUN_DIR>-learn].")
@click.option("--rounds", type=click.IntRange(min=1), default=3, show_default=True)
@click.option("--drives", type=click.IntRange(min=1), default=20, show_default=True, help="Drives in each round.")
@click.option(
    "--worlds",
    type=click.IntRange(min=1),
    default=200,
    show_default=True,
    help="Worlds to judge in when pushed; half as many left alone.",
)
@click.option("--steps", type=click.IntRange(min=1), help="Optimiser steps per training [default: params.yml].")
@AS_JSON
def learn(run_dir: Path, out: Path | None, worlds: int, as_json: bool, **options: Any) -> None:
    """Let the policy in RUN_DIR drive while an expert takes over where a human would, and train it further on that.

    For comparison, another copy of the policy is trained on plain demonstrations of the same duration. Leaves
    learn.json and the executed notebook 09 in RUN_DIR. If it is ended at any moment, the same command continues where
    it was; with more --worlds, it drives only in those that are missing.
    """
    from balloon_world.learn import Experiment, run_experiment, table

    run_dir = run_dir.resolve()
    experiment = Experiment(worlds=worlds, other_worlds=max(1, worlds // 2), **options)
    run_experiment(run_dir, out or run_dir.with_name(f"{run_dir.name}-learn"), experiment, terminal_bar())
    content = executed("09_learn", run_dir, "learn")
    click.echo(json.dumps(content, indent=2) if as_json else table(content))
