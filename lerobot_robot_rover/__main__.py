"""Pack an artifact into a folder that LeRobot takes for a pretrained policy."""

from pathlib import Path

import click

from lerobot_robot_rover.configuration_rover_artifact import RoverArtifactConfig
from lerobot_robot_rover.modeling_rover_artifact import RoverArtifactPolicy
from lerobot_robot_rover.processor_rover_artifact import make_rover_artifact_pre_post_processors
from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import RoverError


def pack(artifact: Path, folder: Path) -> Path:
    """Write the new folder and return it. Raises PolicyError for another file, RoverError for a folder that exists."""
    if folder.exists():
        raise RoverError(f"{folder}: is there already", remedy="name a new folder")
    config = RoverArtifactConfig(artifact=str(artifact), push_to_hub=False)
    policy = RoverArtifactPolicy(config)
    with build_folder(folder) as new:
        policy.save_pretrained(new)
        for pipeline in make_rover_artifact_pre_post_processors(config):
            pipeline.save_pretrained(new)
    return folder


@click.command()
@click.argument("artifact", type=click.Path(path_type=Path))
@click.argument("folder", type=click.Path(path_type=Path))
def main(artifact: Path, folder: Path) -> None:
    """Pack ARTIFACT into the new FOLDER, for LeRobot's --policy.path."""
    try:
        click.echo(f"packed: {pack(artifact, folder)}")
    except (RoverError, OSError) as error:
        raise click.ClickException(str(error)) from None


if __name__ == "__main__":
    main(prog_name="python -m lerobot_robot_rover")
