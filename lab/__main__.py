"""The laboratory's commands: python -m lab COMMAND, from a checkout."""

import json
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click

from rover_lib.onboard.cli import ARTIFACT, FILE, Rover, drive_options, run_drive, show
from rover_lib.onboard.kinds import Number
from rover_lib.onboard.policy.confine import AS_ROOT
from rover_lib.workshop.progress import terminal_bar


@click.group("lab", cls=Rover, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option("--debug", is_flag=True, help="Show the traceback of an error, not only its sentence.")
def main(debug: bool) -> None:
    """Prove what the rover project claims, with an emulated Arduino, faults, counted instructions and emulated Pis."""
    # Some of it needs root, and loads only artifacts that were made here.
    os.environ.setdefault(AS_ROOT, "1")


def _end(ctx: click.Context, wrong: Sequence[object]) -> None:
    """Say what is not as expected, and end the command with exit code 1 if that is anything."""
    for sentence in wrong:
        click.echo(f"rover: {sentence}", err=True)
    ctx.exit(1 if wrong else 0)


@main.command()
@drive_options
@click.option("--latency-ms", type=Number(min=0), default=0, help="Time that a plan takes, at least.")
@click.option("--seed", type=click.IntRange(min=0), default=10_000, show_default=True, help="Of the first world.")
@click.pass_context
def drive(ctx: click.Context, latency_ms: float, seed: int, **options: Any) -> None:
    """Do what `rover drive --world` does, with the real firmware on an emulated Arduino."""
    from balloon_world.car import VirtualCar
    from lab.arduino.emulator import BOARD, build

    build()  # in this process, where its errors are seen
    ctx.exit(run_drive(car=partial(VirtualCar, seed=seed, board=BOARD), latency_ms=latency_ms, **options))


@main.command()
@click.argument("artifact", type=ARTIFACT, required=False)
@click.pass_context
def doctor(ctx: click.Context, artifact: Path | None) -> None:
    """Do `rover doctor` and its ritual with the transmitter, with the real firmware on an emulated Arduino.

    The camera is the balloon world's, and a script holds the transmitter. Exit code 1 if anything fails.
    """
    from lab.arduino.rehearsal import rehearse

    failed = False
    for check in rehearse(artifact, lambda what: click.echo(f"  asked: {what}")):
        click.echo(str(check))
        failed |= check.verdict == "fail"
    ctx.exit(1 if failed else 0)


@main.command()
@click.argument("run_dir", type=FILE)
@click.option(
    "--frames", type=click.IntRange(min=3), default=50, show_default=True, help="Held-out frames to judge with."
)
@click.option("--jobs", type=click.IntRange(min=1), help="Artifacts at a time [default: all cores].")
@click.option("--peers", is_flag=True, help="Count ONNX Runtime, ExecuTorch and others beside them.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def arm(run_dir: Path, frames: int, jobs: int | None, peers: bool, as_json: bool) -> None:
    """Count the instructions that the artifacts of RUN_DIR execute on an emulated Cortex-A76.

    The result is a count, never a time. Leaves arm.json and the executed notebook 06 in RUN_DIR, and says which gates
    of lab/params.yml hold. Needs Debian 12 with qemu-user and gcc, which it installs if you are root.
    """
    from lab.a76.count_run import count_run
    from lab.a76.report import table
    from rover_lib.onboard.stage import read_stage
    from rover_lib.workshop.run.run import execute

    count_run(run_dir, frames=frames, jobs=jobs, progress=terminal_bar())
    if peers:
        from lab.a76.peers import count_peers

        count_peers(run_dir, jobs=jobs, progress=terminal_bar())
    execute("06_arm", run_dir)
    content = read_stage(run_dir / "arm.json", "arm")
    click.echo(json.dumps(content, indent=2) if as_json else table(content))


@main.command()
@click.argument("run_dir", type=FILE)
@click.option("--samples", type=click.IntRange(min=1), default=64, show_default=True, help="Calibration samples.")
@click.option("--steps", type=click.IntRange(min=1), default=24, show_default=True, help="Training steps.")
@click.option("--learned", is_flag=True, help="Train it whole instead, as `rover train --size full` does.")
def full(run_dir: Path, steps: int, learned: bool, **options: Any) -> None:
    """Make a policy of the real car's size in RUN_DIR, and artifacts of it at several image sizes, for `arm`.

    Its format, size and ranges are real, but it is trained for a few steps only and cannot drive. With --learned it
    can: its training takes an hour or more on two cores, goes on where it was ended, and is done only once, as the
    checkpoint stays in the cache.
    """
    from lab.a76.full import LEARNED_NOTE, NOTE, full_run

    made = full_run(run_dir, steps=None if learned else steps, progress=terminal_bar(), **options)
    click.echo(f"made: {made} ({LEARNED_NOTE if learned else NOTE})")


@main.command()
@click.argument("output", type=FILE, required=False)
@click.option("--only", metavar="NAME", multiple=True, help="Only this row, or 'fuzz'; several times for more.")
@click.option("--kind", "kinds", metavar="KIND", multiple=True, help="Rows of this kind; several times for more.")
@click.option("--car", "car_file", type=FILE, help="Drive this car.yml's instead, such as lab/cars/crawler.yml.")
@click.pass_context
def faults(
    ctx: click.Context, output: Path | None, only: tuple[str, ...], kinds: tuple[str, ...], car_file: Path | None
) -> None:
    """Break what can break while the car drives, and see whether it stops.

    Most of it in virtual time, with the real firmware compiled for this machine; of the default car twelve faults in
    real time too, on the pins of an emulated Arduino, which takes some minutes. The rows are written to OUTPUT as JSON,
    if it is given. The exit code is 1 if anything is not as expected. Needs Debian's packages for the Arduino's
    firmware and simavr, see docs/first_hour.md.
    """
    from lab.driving.faults import run_faults
    from rover_lib.onboard.car.car import read_car

    outcome = run_faults(only, kinds=kinds, car=read_car(car_file) if car_file else None, echo=click.echo)
    if output:
        outcome.write(output)
    show(outcome.summary, False)
    _end(ctx, outcome.wrong)


@main.command("mutants")
@click.argument("output", type=FILE, required=False)
@click.option("--only", multiple=True, metavar="NAME", help="Only this mutant; several times for more.")
@click.option("--drives", is_flag=True, help="Random drives, too, must notice those that an invariant is about.")
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True)
@click.pass_context
def plant_mutants(ctx: click.Context, output: Path | None, only: tuple[str, ...], drives: bool, jobs: int) -> None:
    """Break single lines of the safety path, each in a copy, and see that a named test fails.

    The exit code is 1 if one survives.
    """
    from lab.repository.mutants import read_mutants, try_mutants
    from rover_lib.onboard.stage import write_stage

    outcomes = try_mutants([m for m in read_mutants() if not only or m.name in only], jobs, drives)
    for outcome in outcomes:
        click.echo(str(outcome))
    survived = [outcome.mutant.name for outcome in outcomes if outcome.survived]
    noticed = sum(outcome.noticed is True for outcome in outcomes)
    metrics = {"mutants": len(outcomes), "survived": survived, "noticed_by_random_drives": noticed}
    if output:
        write_stage(output, "mutants", params={"drives": drives}, metrics=metrics)
    show(metrics, False)
    ctx.exit(1 if survived else 0)


@main.command("random")
@click.argument("output", type=FILE, required=False)
@click.option("--drives", type=click.IntRange(min=1), default=10_000, show_default=True, help="How many.")
@click.option("--first", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the first.")
@click.option("--jobs", type=click.IntRange(min=1), help="Drives at a time [default: all cores].")
@click.pass_context
def random_drives(ctx: click.Context, output: Path | None, drives: int, first: int, jobs: int | None) -> None:
    """Drive with random faults in virtual time, and check each drive against invariants: what must never happen.

    All drives take some minutes. Prints how many states they visited and, for each drive that breaks an invariant, its
    seed and a short story that breaks the same one. This is written to OUTPUT as JSON, if it is given. The exit code is
    1 if a drive breaks an invariant. Needs gcc.
    """
    from lab.driving import random_drives as lab_random

    tally, failures = lab_random.random_drives(range(first, first + drives), jobs or os.cpu_count() or 1)
    if output:
        lab_random.write_random_drives(output, first, tally, failures)
    show(tally.summary, False)
    _end(ctx, failures)


@main.command()
@click.argument("output", type=FILE, default="runs/pi.json")
@click.option("--demo", type=FILE, default="runs/demo", show_default=True, help="A run, whose artifact is deployed.")
@click.pass_context
def pi(ctx: click.Context, output: Path, demo: Path) -> None:
    """Provision an emulated Pi in a container, deploy to it, drive it and roll back, by the playbooks.

    The container has real systemd and sshd, aarch64 programs, and the real firmware on an emulated Arduino. Needs root
    and Debian 12 or 13. Writes OUTPUT as JSON, and what the playbooks printed beside it. The exit code is 1 if anything
    is not as expected.
    """
    from lab.pi.deployment import deploy_and_drive

    _end(ctx, deploy_and_drive(output, demo, click.echo).wrong)


if __name__ == "__main__":
    main()
