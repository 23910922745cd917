"""Make the networks of a kit from a policy, in ONNX, and their inputs from its observations."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from torch import Tensor, nn

from rover_hailo.operators import OPERATORS
from rover_lib.onboard.errors import QuantizeError
from rover_lib.workshop.act import ACT, multiply_accumulates, parameters_by_block, transform
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
    """Tokens -> actions, still normalised."""

    def __init__(self, policy: ACT):
        super().__init__()
        self.encoder, self.decoder, self.memory = policy.encoder, policy.decoder, policy.memory
        self.encoder_norm, self.norm, self.head = policy.encoder_norm, policy.norm, policy.head
        self.latent: Tensor
        self.pos: Tensor
        self.q_pos: Tensor
        for name in ("latent", "pos", "q_pos"):
            self.register_buffer(name, getattr(policy, name))

    def forward(self, state: Tensor, *images: Tensor) -> Tensor:
        """state: (1, 1, D); images: (1, h * w, D) each. Returns (1, C, A)."""
        return transform(self, torch.cat([self.latent, state, *images], 1))


class Rest(nn.Module):
    """What runs after the chip in split `backbone`: (state (1, S), features (h, w, D) each) -> actions (1, C, A).

    The state and the actions are raw. The features are as HailoRT gives them: channels last, without a batch.
    """

    def __init__(self, policy: ACT):
        super().__init__()
        self.state_norm, self.state_project = policy.state_norm, policy.state_project
        self.transformer, self.action_unnorm = Transformer(policy), policy.action_unnorm
        self.cameras = len(policy.config.cameras)

    def forward(self, state: Tensor, *features: Tensor) -> Tensor:
        images = [features[i].flatten(0, 1).unsqueeze(0) for i in range(self.cameras)]
        token = self.state_project(self.state_norm(state)).unsqueeze(1)
        return self.action_unnorm(self.transformer(token, *images))


class Whole(nn.Module):
    """(state (1, S, 1, 1), pictures (1, 3, height, width) each) -> (1, C, A), all of them normalised.

    Normalisation happens outside, because the chip has one scale for all numbers of a layer: normalised numbers are of
    similar size, but degrees and shares are not. The state is a picture of one pixel, so that the parser sees nothing
    but pictures.
    """

    def __init__(self, policy: ACT):
        super().__init__()
        self.front, self.transformer = Front(policy), Transformer(policy)
        self.cameras = len(policy.config.cameras)
        self.state_project = nn.Conv2d(policy.state_project.in_features, policy.config.dim, 1)
        self.state_project.weight.data = policy.state_project.weight[:, :, None, None].clone()
        self.state_project.bias = policy.state_project.bias
        self.eval().requires_grad_(False)

    def forward(self, state: Tensor, *pictures: Tensor) -> Tensor:
        token = self.state_project(state).flatten(2).transpose(1, 2)
        images = []
        for i in range(self.cameras):
            features = self.front.image_project(self.front.backbone(pictures[i]))
            images.append(features.flatten(2).transpose(1, 2))
        return self.transformer(token, *images)


@dataclass(frozen=True)
class Network:
    """A graph for the compiler.

    inputs: shapes by name, as the parser sees them. outputs: for each name, the node that computes it. sums: the
    additions that are no biases, which the compiler should name ew_add1, ew_add2 ... in this order. sixteen_bit: those
    of them that a LayerNormalization reads. macs: multiply-accumulates of an inference. parameters: weights and biases.
    """

    name: str
    model: onnx.ModelProto
    inputs: dict[str, list[int]]
    outputs: dict[str, str]
    sums: list[str]
    sixteen_bit: list[str]
    macs: int
    parameters: int

    @property
    def operators(self) -> Counter[str]:
        return Counter(node.op_type for node in self.model.graph.node)


def networks(policy: ACT) -> tuple[Network, Network, onnx.ModelProto]:
    """Make an FP32 policy's networks: `backbone`, `whole`, and what runs after `backbone` on the processor.

    Raises QuantizeError for a policy that sees no state: its networks have no place for one.
    """
    config = policy.config
    if not config.sees_state:
        raise QuantizeError("a policy without a state has no kit for Hailo yet", remedy="use the Pi's processor")
    pictures = {f"frame_{n}": torch.zeros(1, 3, *s) for n, s in zip(config.cameras, config.image_sizes, strict=True)}
    grids = [config.grid(*size) for size in config.image_sizes]
    features = {f"features_{n}": torch.zeros(*g, config.dim) for n, g in zip(config.cameras, grids, strict=True)}
    state = torch.zeros(1, len(config.state_names))
    macs, weights = multiply_accumulates(policy), parameters_by_block(policy)
    of_front = {b for b in macs if b.startswith("backbone") or b == "image_project"}
    front = _network(
        "backbone", Front(policy), pictures, list(features), [{b: n[b] for b in of_front} for n in (macs, weights)]
    )
    whole = _network(
        "whole", Whole(policy), {"state": state[:, :, None, None], **pictures}, ["actions"], [macs, weights]
    )
    return front, whole, _tidy(onnx_model(graph_of(Rest(policy)), {"state": state, **features}, ["chunk"]))


def _network(
    name: str, module: nn.Module, inputs: dict[str, Tensor], outputs: list[str], counts: list[dict[str, int]]
) -> Network:
    model = _tidy(onnx_model(graph_of(module), inputs, outputs))
    if unknown := {node.op_type for node in model.graph.node} - OPERATORS.keys():
        raise QuantizeError(f"{name}: nothing is known of {', '.join(sorted(unknown))} in Hailo's parser")
    biases = {i.name for i in model.graph.initializer if len(i.dims) == 1}
    sums = [node for node in model.graph.node if node.op_type == "Add" and not biases & set(node.input)]
    normalised = {node.input[0] for node in model.graph.node if node.op_type == "LayerNormalization"}
    macs, parameters = (sum(by_block.values()) for by_block in counts)
    return Network(
        name,
        model,
        {key: list(tensor.shape) for key, tensor in inputs.items()},
        {output: node.name for output in outputs for node in model.graph.node if output in node.output},
        [node.name for node in sums],
        [node.name for node in sums if node.output[0] in normalised],
        macs,
        parameters,
    )


def _tidy(model: onnx.ModelProto) -> onnx.ModelProto:
    """Merge two transposes in a row, multiply constants, and remove Identity; the model computes the same as before."""
    graph = model.graph
    constants = {i.name: i for i in graph.initializer}
    made = {node.output[0]: node for node in graph.node}
    readers = Counter(name for node in graph.node for name in node.input)
    for node in list(graph.node):
        before = made.get(node.input[0])
        if node.op_type == "Identity":
            assert before is not None and readers[node.input[0]] == 1
            before.output[0] = node.output[0]
            graph.node.remove(node)
        elif node.op_type == "Transpose" and before is not None and before.op_type == "Transpose":
            assert readers[node.input[0]] == 1
            first, second = (list(helper.get_node_attr_value(n, "perm")) for n in (before, node))
            node.input[0] = before.input[0]
            node.attribute[0].CopyFrom(helper.make_attribute("perm", [first[i] for i in second]))
            graph.node.remove(before)
        elif node.op_type == "Mul" and set(node.input) <= constants.keys():
            x, y = (numpy_helper.to_array(constants[name]) for name in node.input)
            graph.initializer.append(numpy_helper.from_array(x * y, node.output[0]))
            graph.node.remove(node)
    read = {name for node in graph.node for name in node.input}
    for name in constants.keys() - read:
        graph.initializer.remove(constants[name])
    onnx.checker.check_model(model, full_check=True)
    return model


class Splits:
    """The networks of an FP32 policy, and recorded observations in the form that each of them takes.

    front: what runs on the chip in split `backbone`. rest: what runs after it on the processor. whole: split `whole`.
    A state is (1, S) float32 and a frame (height, width, 3) uint8 RGB, both raw, as `act.inputs_of` gives them.
    """

    def __init__(self, policy: ACT):
        self.policy, self.config = policy, policy.config
        self.front, self.whole, self.rest = networks(policy)

    def pictures(self, frames: Sequence[Tensor]) -> dict[str, np.ndarray]:
        """Return the inputs of `front`, (1, 3, height, width) float32: frames, normalised as the model script does."""
        named = zip(self.config.cameras, self.policy.image_input, frames, strict=True)
        return {f"frame_{camera}": pixels(frame).contiguous().numpy() for camera, pixels, frame in named}

    def normalised_state(self, state: Tensor) -> np.ndarray:
        """Normalise a state, (1, 1, S) float32: a picture of one pixel, channels last, for calibration and emulator."""
        return self.policy.state_norm(state).numpy().reshape(1, 1, -1)

    def whole_inputs(self, state: Tensor, frames: Sequence[Tensor]) -> dict[str, np.ndarray]:
        return {"state": self.policy.state_norm(state)[:, :, None, None].numpy(), **self.pictures(frames)}

    def rest_inputs(self, state: Tensor, features: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Return the inputs of `rest`. features: (1, D, h, w) each, as `front` gives them."""
        return {"state": state.numpy(), **self.features(features)}

    def features(self, features: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Turn what `front` gives, (1, D, h, w) each, into what HailoRT gives: (h, w, D) each, by name."""
        named = zip(self.config.cameras, features, strict=True)
        return {f"features_{camera}": f[0].transpose(1, 2, 0) for camera, f in named}

    def actions(self, answer: np.ndarray) -> Tensor:
        """Turn what `whole` gives into actions, by undoing their normalisation."""
        return self.policy.action_unnorm(torch.from_numpy(answer))

    def output_shape(self, network: Network, output: str) -> list[int]:
        """Return an output's shape as HailoRT gives it: channels last, without a batch."""
        if network is self.whole:
            return [1, self.config.chunk, len(self.config.action_names)]
        h, w = self.config.grid(*self.config.image_sizes[list(network.outputs).index(output)])
        return [h, w, self.config.dim]
