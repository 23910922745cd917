"""Make the networks of a kit from a policy, in ONNX."""

from dataclasses import dataclass

import onnx
import torch
from torch import Tensor, nn

from rover_lib.onboard.errors import ArtifactError
from rover_lib.workshop.act import ACT, transform
from rover_lib.workshop.int8.onnx_graph import graph_of, onnx_model


class Front(nn.Module):
    """Normalised pictures, each (1, 3, height, width) float32 -> projected features, each (1, D, h, w)."""

    def __init__(self, policy: ACT):
        super().__init__()
        self.backbone, self.image_project = policy.backbone, policy.image_project
        self.cameras = len(policy.config.cameras)

    def forward(self, *pictures: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.image_project(self.backbone(pictures[i])) for i in range(self.cameras))


class Rest(nn.Module):
    """What runs after the chip: (state (1, S), features (h, w, D) each) -> actions (1, C, A).

    The state and the actions are raw. The features are as HailoRT gives them: channels last, without a batch.
    """

    def __init__(self, policy: ACT):
        super().__init__()
        self.encoder, self.decoder, self.memory = policy.encoder, policy.decoder, policy.memory
        self.encoder_norm, self.norm, self.head = policy.encoder_norm, policy.norm, policy.head
        self.state_norm, self.state_project = policy.state_norm, policy.state_project
        self.action_unnorm, self.cameras = policy.action_unnorm, len(policy.config.cameras)
        self.latent: Tensor
        for name in ("latent", "pos", "q_pos"):
            self.register_buffer(name, getattr(policy, name))

    def forward(self, state: Tensor, *features: Tensor) -> Tensor:
        images = [features[i].flatten(0, 1).unsqueeze(0) for i in range(self.cameras)]
        token = self.state_project(self.state_norm(state)).unsqueeze(1)
        return self.action_unnorm(transform(self, torch.cat([self.latent, token, *images], 1)))


@dataclass(frozen=True)
class Network:
    """A graph for the compiler. inputs: shapes by name, as the parser sees them. outputs: name and node of each."""

    model: onnx.ModelProto
    inputs: dict[str, list[int]]
    outputs: dict[str, str]


def networks(policy: ACT) -> tuple[Network, onnx.ModelProto]:
    """Make an FP32 policy's networks: what runs on the chip, and what runs after it on the processor.

    Raises ArtifactError for a policy that sees no state: its networks have no place for one.
    """
    config = policy.config
    if not config.sees_state:
        raise ArtifactError("a policy without a state has no kit for Hailo yet", remedy="use the Pi's processor")
    pictures = {f"frame_{n}": torch.zeros(1, 3, *s) for n, s in zip(config.cameras, config.image_sizes, strict=True)}
    grids = [config.grid(*size) for size in config.image_sizes]
    features = {f"features_{n}": torch.zeros(*g, config.dim) for n, g in zip(config.cameras, grids, strict=True)}
    inputs = {"state": torch.zeros(1, len(config.state_names)), **features}
    front = onnx_model(graph_of(Front(policy)), pictures, list(features))
    return _without_ends(front, pictures, list(features)), onnx_model(graph_of(Rest(policy)), inputs, ["chunk"])


def _without_ends(model: onnx.ModelProto, inputs: dict[str, Tensor], outputs: list[str]) -> Network:
    """Remove the Identity before each output: the compiler's end is the node before it."""
    made = {node.output[0]: node for node in model.graph.node}
    ends = {}
    for name in outputs:
        end = made[made[name].input[0]]
        model.graph.node.remove(made[name])
        end.output[0] = name
        ends[name] = end.name
    return Network(model, {name: list(x.shape) for name, x in inputs.items()}, ends)
