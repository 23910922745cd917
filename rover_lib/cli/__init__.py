"""The workstation's command line: the rover's commands, and all that prepares a policy for it."""

import click

import rover_lib
from rover_lib.cli import drive, prepare, world
from rover_lib.onboard import cli as onboard
from rover_lib.onboard.cli import Rover


@click.group("rover", cls=Rover, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option("--debug", is_flag=True, help="Show the traceback of an error, not only its sentence.")
@click.version_option(rover_lib.__version__)
def main(debug: bool) -> None:
    """Put a learned driving policy on a small computer.

    A checkpoint (LeRobot ACT) and recordings go in; an INT8 artifact that a Raspberry Pi can run, an honest comparison
    with the original and a benchmark come out. Start with `make demo`, or with `rover run` on your own files.
    """


for command in onboard.main.commands.values():
    main.add_command(command)
for command in (*prepare.COMMANDS, *drive.COMMANDS, world.world):  # those of the same name know more than the rover's
    main.add_command(command)
