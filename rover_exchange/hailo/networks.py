"""Make the networks of a kit from a policy, in ONNX."""

from dataclasses import dataclass

import onnx
import torch
from torch import Tensor, nn

from rover_lib.onboard.errors import ArtifactError
from rover_lib.workshop.act import ACT, transform
from rover_lib.workshop.int8.graph import graph_of
from rover_lib.workshop.int8.onnx_graph import onnx_model


class Front(nn.Module):
    """A normalised picture, (1, 3, height, width) float32 -> projected features, (1, D, h, w)."""

    def __init__(self, policy: ACT):
        super().__init__()
        self.backbone, self.image_project = policy.backbone, policy.image_project

    def forward(self, picture: Tensor) -> Tensor:
        return self.image_project(self.backbone(picture))


class Rest(nn.Module):
    """What runs after the chip: (state (1, S), features (h, w, D)) -> actions (1, C, A).

    The state and the actions are raw. The features are as HailoRT gives them: channels last, without a batch.
    """

    def __init__(self, policy: ACT):
        super().__init__()
        self.encoder, self.decoder, self.memory = policy.encoder, policy.decoder, policy.memory
        self.encoder_norm, self.norm, self.head = policy.encoder_norm, policy.norm, policy.head
        self.state_norm, self.state_project = policy.state_norm, policy.state_project
        self.action_unnorm = policy.action_unnorm
        self.latent: Tensor
        for name in ("latent", "pos", "q_pos"):
            self.register_buffer(name, getattr(policy, name))

    def forward(self, state: Tensor, features: Tensor) -> Tensor:
        image = features.flatten(0, 1).unsqueeze(0)
        token = self.state_project(self.state_norm(state)).unsqueeze(1)
        return self.action_unnorm(transform(self, torch.cat([self.latent, token, image], 1)))


@dataclass(frozen=True)
class Network:
    """A graph for the compiler. picture, features: names of input and output. shape: the input's. end: last node."""

    model: onnx.ModelProto
    picture: str
    features: str
    shape: list[int]
    end: str


def networks(policy: ACT) -> tuple[Network, onnx.ModelProto]:
    """Make an FP32 policy's networks: what runs on the chip, and what runs after it on the processor.

    Raises ArtifactError for a policy that sees no state, or not exactly one camera's pictures.
    """
    config = policy.config
    if not config.sees_state or len(config.cameras) != 1:
        remedy = "use the Pi's processor"
        raise ArtifactError("a kit for Hailo needs a state and one camera", found=config.cameras, remedy=remedy)
    (camera,), (size,) = config.cameras, config.image_sizes
    picture, features = f"frame_{camera}", f"features_{camera}"
    front = onnx_model(graph_of(Front(policy)), {picture: torch.zeros(1, 3, *size)}, [features])
    inputs = {"state": torch.zeros(1, len(config.state_names)), features: torch.zeros(*config.grid(*size), config.dim)}
    end = _without_identity(front, features)
    return Network(front, picture, features, [1, 3, *size], end), onnx_model(graph_of(Rest(policy)), inputs, ["chunk"])


def _without_identity(model: onnx.ModelProto, output: str) -> str:
    """Remove the Identity before the output, and return the node before it, which is the compiler's end."""
    made = {node.output[0]: node for node in model.graph.node}
    end = made[made[output].input[0]]
    model.graph.node.remove(made[output])
    end.output[0] = output
    return end.name
