"""python -m lerobot_robot_rover ARTIFACT FOLDER"""

from pathlib import Path

import click

from lerobot_robot_rover.configuration_rover_artifact import N_ACTION_STEPS
from lerobot_robot_rover.pack import pack
from rover_lib.onboard.errors import RoverError


@click.command()
@click.argument("artifact", type=click.Path(path_type=Path))
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--n-action-steps",
    type=click.IntRange(min=1),
    default=N_ACTION_STEPS,
    show_default=True,
    help="Actions of a chunk that are driven by before the next is computed.",
)
def main(artifact: Path, folder: Path, n_action_steps: int) -> None:
    """Put ARTIFACT into the new FOLDER, as LeRobot's --policy.path wants it."""
    try:
        click.echo(f"packed: {pack(artifact, folder, n_action_steps=n_action_steps)}")
    except RoverError as error:
        raise click.ClickException(str(error)) from None


main(prog_name="python -m lerobot_robot_rover")
