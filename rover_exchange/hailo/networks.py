"""Make the networks of a kit from a policy, in ONNX."""

from collections.abc import Sequence
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


class Transformer(nn.Module):
    """The policy's transformer, which two networks have."""

    def __init__(self, policy: ACT):
        super().__init__()
        self.encoder, self.decoder, self.memory = policy.encoder, policy.decoder, policy.memory
        self.encoder_norm, self.norm, self.head = policy.encoder_norm, policy.norm, policy.head
        self.cameras = len(policy.config.cameras)
        self.latent: Tensor
        for name in ("latent", "pos", "q_pos"):
            self.register_buffer(name, getattr(policy, name))

    def plan(self, state: Tensor, images: Sequence[Tensor]) -> Tensor:
        """state: a token (1, 1, D); images: tokens (1, h * w, D) each. Returns (1, C, A), still normalised."""
        return transform(self, torch.cat([self.latent, state, *images], 1))


class Rest(Transformer):
    """What runs after the chip in split `backbone`: (state (1, S), features (h, w, D) each) -> actions (1, C, A).

    The state and the actions are raw. The features are as HailoRT gives them: channels last, without a batch.
    """

    def __init__(self, policy: ACT):
        super().__init__(policy)
        self.state_norm, self.state_project = policy.state_norm, policy.state_project
        self.action_unnorm = policy.action_unnorm

    def forward(self, state: Tensor, *features: Tensor) -> Tensor:
        images = [features[i].flatten(0, 1).unsqueeze(0) for i in range(self.cameras)]
        token = self.state_project(self.state_norm(state)).unsqueeze(1)
        return self.action_unnorm(self.plan(token, images))


class Whole(Transformer):
    """(state (1, S, 1, 1), pictures (1, 3, height, width) each) -> (1, C, A), all of them normalised.

    Normalisation happens outside, because the chip has one scale for all numbers of a layer: normalised numbers are of
    similar size, but degrees and shares are not. The state is a picture of one pixel, so that the parser sees nothing
    but pictures.
    """

    def __init__(self, policy: ACT):
        super().__init__(policy)
        self.backbone, self.image_project = policy.backbone, policy.image_project
        self.state_project = nn.Conv2d(policy.state_project.in_features, policy.config.dim, 1)
        self.state_project.weight.data = policy.state_project.weight[:, :, None, None].clone()
        self.state_project.bias = policy.state_project.bias
        self.eval().requires_grad_(False)

    def forward(self, state: Tensor, *pictures: Tensor) -> Tensor:
        token = self.state_project(state).flatten(2).transpose(1, 2)
        images = []
        for i in range(self.cameras):
            features = self.image_project(self.backbone(pictures[i]))
            images.append(features.flatten(2).transpose(1, 2))
        return self.plan(token, images)


@dataclass(frozen=True)
class Network:
    """A graph for the compiler. inputs: shapes by name, as the parser sees them. outputs: name and node of each."""

    model: onnx.ModelProto
    inputs: dict[str, list[int]]
    outputs: dict[str, str]


def networks(policy: ACT) -> tuple[Network, Network, onnx.ModelProto]:
    """Make an FP32 policy's networks: `backbone`, `whole`, and what runs after `backbone` on the processor.

    Raises ArtifactError for a policy that sees no state: its networks have no place for one.
    """
    config = policy.config
    if not config.sees_state:
        raise ArtifactError("a policy without a state has no kit for Hailo yet", remedy="use the Pi's processor")
    pictures = {f"frame_{n}": torch.zeros(1, 3, *s) for n, s in zip(config.cameras, config.image_sizes, strict=True)}
    grids = [config.grid(*size) for size in config.image_sizes]
    features = {f"features_{n}": torch.zeros(*g, config.dim) for n, g in zip(config.cameras, grids, strict=True)}
    state = torch.zeros(1, len(config.state_names))
    front = _network(Front(policy), pictures, list(features))
    whole = _network(Whole(policy), {"state": state[:, :, None, None], **pictures}, ["actions"])
    return front, whole, onnx_model(graph_of(Rest(policy)), {"state": state, **features}, ["chunk"])


def _network(module: nn.Module, inputs: dict[str, Tensor], outputs: list[str]) -> Network:
    model = onnx_model(graph_of(module), inputs, outputs)
    made = {node.output[0]: node for node in model.graph.node}
    ends = {}
    for name in outputs:  # each is an Identity, which nothing else reads; the compiler's end is the node before it
        end = made[made[name].input[0]]
        model.graph.node.remove(made[name])
        end.output[0] = name
        ends[name] = end.name
    return Network(model, {name: list(x.shape) for name, x in inputs.items()}, ends)
