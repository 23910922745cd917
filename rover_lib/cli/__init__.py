"""The workstation's command line: the rover's commands, and all that prepares a policy for it."""

import click

from rover_lib.cli import drive, prepare, world
from rover_lib.onboard import cli as onboard
from rover_lib.onboard.cli import VERSION, Rover

ROVERS = onboard.main.commands
# Grouped by what a user does, as `rover --help` lists them. inspect, drive, view and log can do more here than there.
SECTIONS = {
    "Prepare a policy": (
        prepare.run,
        prepare.list_runs,
        prepare.inspect,
        prepare.report,
        prepare.sweep,
        prepare.quantize,
        prepare.compare,
        ROVERS["benchmark"],
        prepare.distill,
        prepare.finetune,
        prepare.export,
        prepare.export_dataset,
    ),
    "Drive": (
        ROVERS["doctor"],
        ROVERS["calibrate"],
        ROVERS["record"],
        drive.drive,
        drive.view,
        drive.log,
        ROVERS["label"],
    ),
    "Set up a rover, and arm it": (prepare.wheelhouse, ROVERS["release"], ROVERS["arm-car"], ROVERS["heartbeat"]),
    "Try it without a car": (world.world,),
}


class Workstation(Rover):
    """Lists its commands in sections."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = formatter.width - 6 - max(map(len, self.commands))
        for title, commands in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(str(c.name), c.get_short_help_str(width)) for c in commands])


@click.group(
    "rover", cls=Workstation, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.option("--debug", is_flag=True, help="Show the traceback of an error, not only its sentence.")
@VERSION
def main(debug: bool) -> None:
    """Put a learned driving policy on a small computer.

    A checkpoint (LeRobot ACT) and recordings go in; an INT8 artifact that a Raspberry Pi can run, an honest comparison
    with the original and a benchmark come out. Start with `make demo`, or with `rover run` on your own files.
    """


for commands in SECTIONS.values():
    for command in commands:
        main.add_command(command)
