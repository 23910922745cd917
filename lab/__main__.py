"""The laboratory's commands: python -m lab COMMAND, from a checkout."""

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click

from lab.debian import INSTALL
from rover_lib.onboard.cli import FILE, Rover, drive_options, run_drive, show
from rover_lib.onboard.policy.confine import AS_ROOT
from rover_lib.workshop.progress import terminal_bar


@click.group("lab", cls=Rover, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option("--debug", is_flag=True, help="Show the traceback of an error, not only its sentence.")
@click.option("--install", is_flag=True, help="As root, install the Debian packages that a command lacks.")
def main(debug: bool, install: bool) -> None:
    """Prove what the rover project claims, with an emulated Arduino, faults, counted instructions and emulated Pis."""
    if install:
        os.environ[INSTALL] = "1"
    # Some of it needs root, and loads only artifacts that were made here.
    os.environ.setdefault(AS_ROOT, "1")


def _end(ctx: click.Context, wrong: Sequence[object]) -> None:
    """Say what is not as expected, and end the command with exit code 1 if that is anything."""
    for sentence in wrong:
        click.echo(f"rover: {sentence}", err=True)
    ctx.exit(1 if wrong else 0)


@main.command()
@drive_options
@click.pass_context
def drive(ctx: click.Context, **options: Any) -> None:
    """Do what `rover drive --world` does, with the real firmware on an emulated Arduino."""
    from balloon_world.car import VirtualCar
    from lab.arduino.emulator import BOARD, build

    build()  # in this process, where its errors are seen
    ctx.exit(run_drive(car=partial(VirtualCar, board=BOARD), **options))


@main.command()
@click.argument("run_dir", type=FILE)
def arm(run_dir: Path) -> None:
    """Count the instructions that the artifacts of RUN_DIR execute on an emulated Cortex-A76.

    Leaves arm.json and the executed notebook 06 in RUN_DIR, and says which gates of lab/params.yml hold. Needs Debian
    12 with qemu-user, mmdebstrap and gcc, which `python -m lab --install arm` installs.
    """
    from lab.a76.count import count_run
    from lab.a76.report import table
    from rover_lib.onboard.stage import read_stage
    from rover_lib.workshop.run.run import execute

    count_run(run_dir, progress=terminal_bar())
    execute("06_arm", run_dir)
    click.echo(table(read_stage(run_dir / "arm.json", "arm")))


@main.command()
@click.argument("output", type=FILE, required=False)
@click.option("--only", metavar="NAME", multiple=True, help="Only this row; several times for more.")
@click.option("--car", "car_file", type=FILE, help="Drive this car.yml's instead, such as lab/cars/crawler.yml.")
@click.pass_context
def faults(ctx: click.Context, output: Path | None, only: tuple[str, ...], car_file: Path | None) -> None:
    """Break what can break while the car drives, and see whether it stops.

    Most of it in virtual time; twelve faults of the default car in real time, on the pins of an emulated Arduino, which
    takes some minutes. The rows are written to OUTPUT as JSON. The exit code is 1 if anything is not as expected. Needs
    gcc and simavr, see docs/first_hour.md.
    """
    from lab.driving.faults import run_faults
    from rover_lib.onboard.car.car import Car, read_car

    metrics = run_faults(output, only, read_car(car_file) if car_file else Car(), click.echo)
    show(metrics["summary"], False)
    _end(ctx, metrics["wrong"])


@main.command("mutants")
@click.argument("output", type=FILE, required=False)
@click.option("--count", type=click.IntRange(min=0), default=300, show_default=True, help="How many slips.")
@click.option("--first", type=click.IntRange(min=0), default=0, show_default=True, help="Leave out those before it.")
@click.option("--drives", is_flag=True, help="Also the lines of planted.yml, of which random drives notice some.")
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True)
@click.pass_context
def plant_mutants(ctx: click.Context, output: Path | None, count: int, first: int, drives: bool, jobs: int) -> None:
    """Plant slips in drawn lines, each in a copy, and see that a test fails.

    The exit code is 1 if less than 97 % are caught, or a line of planted.yml survives.
    """
    from lab.repository.mutants import draw_slips, read_mutants, try_mutants
    from rover_lib.onboard.stage import write_stage

    params = {"count": count, "first": first, "drives": drives}
    metrics: dict[str, Any] = {}
    share = 1.0
    if count:
        caught, survived = try_mutants(draw_slips(first + count)[first:], jobs, click.echo)
        share = caught / max(caught + len(survived), 1)
        metrics = {"slips": count, "caught_pct": 100 * share, "survived": survived}
    if drives:
        caught, survived = try_mutants(read_mutants(), jobs, click.echo)
        metrics["planted"] = {"caught": caught, "survived": survived}
    if output:
        write_stage(output, "mutants", params=params, metrics=metrics)
    show(metrics, False)
    ctx.exit(1 if share < 0.97 or (drives and survived) else 0)


@main.command("random")
@click.argument("output", type=FILE, required=False)
@click.option("--drives", type=click.IntRange(min=1), default=10_000, show_default=True, help="How many.")
@click.option("--first", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of the first.")
@click.option("--jobs", type=click.IntRange(min=1), help="Drives at a time [default: all cores].")
@click.pass_context
def drive_randomly(ctx: click.Context, output: Path | None, drives: int, first: int, jobs: int | None) -> None:
    """Drive with random faults in virtual time, and check each drive against invariants: what must never happen.

    Prints, and writes to OUTPUT as JSON, for each drive that breaks an invariant, its seed and story. The exit code is
    1 if one does. Needs gcc.
    """
    from lab.driving.random_drives import random_drives
    from rover_lib.onboard.stage import write_stage

    metrics = random_drives(range(first, first + drives), jobs or os.cpu_count() or 1)
    if output:
        write_stage(output, "random", params={"first_seed": first}, metrics=metrics)
    show({name: value for name, value in metrics.items() if name != "broken"}, False)
    _end(ctx, metrics["broken"])


@main.command()
@click.argument("output", type=FILE, default="runs/pi.json")
@click.option("--demo", type=FILE, default="runs/demo", show_default=True, help="A run, whose artifact is deployed.")
@click.pass_context
def pi(ctx: click.Context, output: Path, demo: Path) -> None:
    """Provision an emulated Pi in a container, deploy to it, drive it and roll back, by the playbooks.

    Needs root and Debian 12 or 13. Writes OUTPUT as JSON, and what the playbooks printed beside it.
    """
    from lab.pi.deployment import deploy_and_drive

    _end(ctx, deploy_and_drive(output, demo, click.echo))


if __name__ == "__main__":
    main()
