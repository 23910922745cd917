"""Pack an artifact into a folder that LeRobot takes for a pretrained policy.

python -m lerobot_robot_rover runs/mine/policy_static.pt mine
lerobot-record --policy.path=mine ...
"""

import shutil
import tempfile
from pathlib import Path

import click
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_robot_rover.configuration_rover_artifact import N_ACTION_STEPS, RoverArtifactConfig
from lerobot_robot_rover.processor_rover_artifact import make_rover_artifact_pre_post_processors
from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.errors import ParamsError, RoverError


def pack(artifact: Path | str, folder: Path | str, *, n_action_steps: int = N_ACTION_STEPS) -> Path:
    """Write the new folder and return it. It contains the artifact, its config.json and processors that do nothing.

    n_action_steps: see RoverArtifactConfig. Raises ArtifactError for a file that is no artifact, ParamsError for a
    folder that exists. The folder appears complete, or not at all.
    """
    artifact, folder = Path(artifact), Path(folder)
    with Artifact(artifact) as opened:
        opened.prove()
        manifest = opened.manifest
    if folder.exists():
        raise ParamsError(f"{folder}: is there already", remedy="name a new folder")
    visual = {
        f"{OBS_IMAGES}.{c['name']}": PolicyFeature(FeatureType.VISUAL, (3, c["height"], c["width"]))
        for c in manifest["cameras"]
    }
    config = RoverArtifactConfig(
        artifact=artifact.name,
        n_action_steps=n_action_steps,
        input_features={**visual, OBS_STATE: PolicyFeature(FeatureType.STATE, (len(manifest["state_names"]),))},
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (len(manifest["action_names"]),))},
        push_to_hub=False,
    )
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as temporary:
        new = Path(temporary) / folder.name
        new.mkdir()
        shutil.copyfile(artifact, new / artifact.name)
        config.save_pretrained(new)
        for pipeline in make_rover_artifact_pre_post_processors(config):
            pipeline.save_pretrained(new)
        new.rename(folder)
    return folder


@click.command()
@click.argument("artifact", type=click.Path(path_type=Path))
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--n-action-steps",
    type=click.IntRange(min=1),
    default=N_ACTION_STEPS,
    show_default=True,
    help="How many actions of a chunk are used before the next chunk is computed.",
)
def main(artifact: Path, folder: Path, n_action_steps: int) -> None:
    """Pack ARTIFACT into the new FOLDER, for LeRobot's --policy.path."""
    try:
        click.echo(f"packed: {pack(artifact, folder, n_action_steps=n_action_steps)}")
    except (RoverError, OSError) as error:
        raise click.ClickException(str(error)) from None
