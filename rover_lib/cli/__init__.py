"""The workstation's command line: the rover's commands, and all that prepares a policy for it.

Other packages of the same install add commands by the entry points `rover.<section>` of pyproject.toml.
"""

import os
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, cast

import click
from click.core import ParameterSource

from rover_lib.cli import prepare, programs
from rover_lib.onboard import cli as onboard
from rover_lib.onboard.car.car import FILE_VARIABLE
from rover_lib.onboard.cli import FROM_0, VERSION, Rover
from rover_lib.onboard.kinds import Number
from rover_lib.onboard.params import FOR_THIS_RUN
from rover_lib.workshop.installed import IN_WHEEL


@click.command(help=onboard.drive.help, short_help="Drive a car, or in the balloon world, with an artifact.")
@onboard.drive_options
@click.option("--world", "in_world", is_flag=True, help="Drive in the balloon world instead of a car, in real time.")
@click.option("--latency-ms", type=Number(min=0), default=0, help="With --world: minimum time of a plan.")
@click.option("--seed", type=FROM_0, default=10_000, show_default=True, help="With --world: seed of the first world.")
@click.pass_context
def drive(ctx: click.Context, in_world: bool, latency_ms: float, seed: int, **options: Any) -> None:
    for name in ("camera", "port", "dry_run") if in_world else ("latency_ms", "seed"):
        if ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            owner = "a car, not --world" if in_world else "--world"
            raise click.UsageError(f"--{name.replace('_', '-')} belongs to {owner}")
    car = None
    if in_world:
        (simulated,) = entry_points(group="rover.cars", name="world")
        car = partial(simulated.load(), seed=seed)
    ctx.exit(onboard.run_drive(car=car, latency_ms=latency_ms, **options))


ROVERS = onboard.main.commands
# What most people need, by what they do; below it all others. inspect, drive, view and log can do more here than there.
SECTIONS: dict[str, list[click.Command]] = {
    "Prepare a policy": [
        prepare.run,
        prepare.inspect,
        prepare.report,
        programs.notebooks,
        ROVERS["benchmark"],
        prepare.export,
    ],
    "Drive": [ROVERS["doctor"], ROVERS["calibrate"], ROVERS["record"], drive],
    "Look": [],
    "Teach": [],
    "Recordings": [],
    "A rover's models, and arming it": [programs.playbook, ROVERS["release"], ROVERS["arm-car"]],
}
for title in ("Teach", "Look", "Recordings"):
    SECTIONS[title] += [entry.load() for entry in entry_points(group=f"rover.{title.lower()}")]


class Workstation(Rover):
    """Lists its commands in sections."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = formatter.width - 6 - max(map(len, self.commands))
        for title, commands in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(str(c.name), c.get_short_help_str(width)) for c in commands])


@click.group("rover", cls=Workstation, context_settings=onboard.main.context_settings)
@click.option("--debug", is_flag=True, help="Show the traceback of an error, not only its sentence.")
@VERSION
def main(debug: bool) -> None:
    """Put a learned driving policy on a small computer.

    A checkpoint (LeRobot ACT) and recordings go in; an INT8 artifact that a Raspberry Pi can run, an honest comparison
    with the original and a benchmark come out. Start with `rover demo`, or with `rover run` on your own files.
    """
    if IN_WHEEL:  # in a checkout these files stand at its top
        for variable, name in ((FOR_THIS_RUN, "params.yml"), (FILE_VARIABLE, "car.yml")):
            if Path(name).is_file():
                os.environ.setdefault(variable, str(Path(name).resolve()))


cast(click.Group, ROVERS["release"]).add_command(prepare.wheelhouse)
for command in (command for commands in SECTIONS.values() for command in commands):
    main.add_command(command)
