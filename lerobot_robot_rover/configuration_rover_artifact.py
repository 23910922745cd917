"""The configuration by which LeRobot runs an artifact. LeRobot prescribes this module's name, and its neighbours'."""

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs.policies import PreTrainedConfig
from lerobot.optim.optimizers import OptimizerConfig

from rover_lib.onboard.errors import ParamsError, PolicyError


@PreTrainedConfig.register_subclass("rover_artifact")
@dataclass
class RoverArtifactConfig(PreTrainedConfig):
    """How LeRobot runs an artifact. Raises ParamsError for impossible values.

    artifact: a policy_<mode>.pt or .onnx.zip; a relative path is looked for in the pretrained folder first.
    n_action_steps: how many actions of a chunk are used before the next chunk is computed.
    """

    artifact: str = ""
    n_action_steps: int = 8  # so no action's plan is older than half a second, as in `rover drive`
    device: str | None = field(default="cpu")
    # LeRobot asks for these; an artifact looks at one moment.
    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_action_steps < 1:
            raise ParamsError("a policy needs n_action_steps from 1", found=self.n_action_steps)

    @property
    def file(self) -> Path:
        """The artifact's file. Raises ParamsError if it does not exist."""
        for place in (Path(self.pretrained_path or "") / self.artifact, Path(self.artifact)):
            if place.is_file():
                return place
        remedy = "--policy.artifact=runs/mine/policy_static.pt, or a packed --policy.path"
        raise ParamsError("the artifact is not there", found=repr(self.artifact), remedy=remedy)

    def get_optimizer_preset(self) -> OptimizerConfig:
        raise not_trained()

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        """Do nothing: what counts is the artifact's manifest, which modeling_rover_artifact checks."""


def not_trained() -> PolicyError:
    """Return the error for everything that LeRobot's training asks of a policy."""
    return PolicyError("an artifact is not trained", remedy="train its checkpoint, and `rover run` that")
