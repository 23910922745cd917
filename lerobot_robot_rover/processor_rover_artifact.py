"""Steps that LeRobot runs around a policy. Here they only add a batch dimension: an artifact normalises by itself."""

from typing import Any

from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    RenameObservationsProcessorStep,
)
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

from lerobot_robot_rover.configuration_rover_artifact import RoverArtifactConfig


def make_rover_artifact_pre_post_processors(
    config: RoverArtifactConfig, dataset_stats: Any = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return the two pipelines. LeRobot's commands set values in the steps for names and device, so they must exist."""
    device = DeviceProcessorStep(device=config.device or "cpu")
    steps = [RenameObservationsProcessorStep(rename_map={}), AddBatchDimensionProcessorStep(), device]
    before = PolicyProcessorPipeline[dict[str, Any], dict[str, Any]](steps, name=POLICY_PREPROCESSOR_DEFAULT_NAME)
    after = PolicyProcessorPipeline[PolicyAction, PolicyAction](
        steps=[DeviceProcessorStep(device="cpu")],
        name=POLICY_POSTPROCESSOR_DEFAULT_NAME,
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    return before, after
