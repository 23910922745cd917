"""A kit for Hailo's compiler: a policy as networks that its parser should take, with all that compiling them needs.

    write_kit(load("best_model.pth", "episodes"), "kit", samples=1024)

Two splits. `backbone`: pictures to projected features on the chip, the transformer in ONNX Runtime behind it. `whole`:
everything on the chip. Nobody here has Hailo's compiler or a chip: what of this was tried, and on what, is in
docs/hailo.md.
"""

import json
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
import torch
from numpy.lib.format import open_memmap
from onnx import helper, numpy_helper
from torch import Tensor, nn

from rover_lib.onboard.artifact import LARGEST_TOLERANCE, read_manifest, read_parity
from rover_lib.onboard.errors import QuantizeError
from rover_lib.onboard.params import params
from rover_lib.workshop import hailo_compile
from rover_lib.workshop.act import (
    ACT,
    ActConfig,
    Affine,
    inputs_of,
    multiply_accumulates,
    parameters_by_block,
    transform,
    zero_colour,
)
from rover_lib.workshop.compare import thinned
from rover_lib.workshop.episodes import Sample
from rover_lib.workshop.export import Exporter
from rover_lib.workshop.onnx_graph import graph_of, onnx_model
from rover_lib.workshop.pipeline import CHOOSING_FRAMES, Recipe
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.session import Opened

if TYPE_CHECKING:
    import onnxruntime

LEAST_SAMPLES = 1024  # what the zoo's scripts calibrate transformers with (vit_small.alls, deit_base.alls)
STAND_IN_FRAMES = 32  # calibrate ONNX Runtime's INT8
# How many times as far from FP32 as ONNX Runtime's INT8 the chip's answers may be: it rounds elsewhere than that, and
# nobody knows how much; a HEF that computes something else is off by hundreds of times.
STAND_IN_TIMES = 5.0


@dataclass(frozen=True)
class Chip:
    """A chip, and what Hailo's model zoo measured on it at batch 1, in frames a second.

    detr: detr_resnet_v1_18_bn, 61.87 GOP. resnet: resnet_v1_18, 3.64 GOP. Of docs/public_models in hailo_model_zoo
    v5.2.0, where a multiply-accumulate is two operations.
    """

    name: str
    compiler: str  # the major version of its Dataflow Compiler
    detr: float
    resnet: float


CHIPS = {
    c.name: c
    for c in (
        Chip("hailo8", "3", detr=30, resnet=2718),
        Chip("hailo8l", "3", detr=19, resnet=915),
        Chip("hailo10h", "5", detr=40.7, resnet=2709),
    )
}
DETR_GOP, RESNET_GOP = 61.87, 3.64

# What is known of each operator in Hailo's parser, none of it tried here.
OPERATORS = {
    "Conv": "the chip's own; the zoo's ResNets and the backbone of its DETR consist of it",
    "Relu": "part of the convolution before it",
    "MaxPool": "in the zoo's ResNets, with this very kernel",
    "Add": "of a bias: part of the layer; of two tensors, or of one and a constant (const_input): ew_add, as DETR's "
    "positions and residuals are",
    "MatMul": "with weights: a convolution of 1x1; of two tensors: matmul, with a constant query too, as in the zoo's "
    "DETR",
    "Reshape": "features of a picture into tokens, and tokens into heads and back: as timm's ViT has them in the zoo; "
    "in other orders, UnsupportedShuffleLayerError is the parser's most frequent answer",
    "Transpose": "see Reshape; two in a row are one here",
    "Concat": "of tokens, as ViT's class token",
    "Mul": "with a constant: ew_mult, or part of the layer before it; ViT's scaling of queries",
    "Softmax": "over the last axis, decomposed into reduce_max, ew_sub, reduce_sum and ew_mult; 16 bits there ended "
    "the compiler 5.3 for a 10H (a report in Hailo's forum), so it stays at 8",
    "LayerNormalization": "over the last axis since opset 17, decomposed; the zoo's vit_*_ops17 have it",
    "Erf": "of GELU, as in ViT",
    "Div": "of GELU, as in ViT",
}


# --- networks ---------------------------------------------------------------------------------------------------------


class Front(nn.Module):
    """Pictures, each (1, 3, height, width) float32 and normalised -> projected features, each (1, D, h, w)."""

    def __init__(self, policy: ACT):
        super().__init__()
        self.backbone, self.image_project = policy.backbone, policy.image_project
        self.cameras = len(policy.config.cameras)

    def forward(self, *pictures: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.image_project(self.backbone(pictures[i])) for i in range(self.cameras))


class Transformer(nn.Module):
    """Tokens -> actions before their normalisation is undone."""

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
    """What follows the chip in split `backbone`: (state (1, S), features (h, w, D) each) -> actions (1, C, A).

    Raw state in, raw actions out. Features as HailoRT gives them: channels last, without a batch.
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
    """(state (1, S, 1, 1), pictures (1, 3, height, width) each) -> (1, C, A), all normalised outside.

    A chip has one scale for all numbers of a layer: normalised ones are of one size, degrees and shares are not. The
    state is a picture of one pixel here, for the parser to see nothing but pictures.
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

    inputs: shapes by name, as the parser sees them. outputs: by name, the node that gives each. sums: nodes that should
    become ew_add1, ew_add2 ... in the compiler's own order of numbers, without biases. sixteen_bit: those of them that
    a LayerNormalization reads. macs, parameters: of one inference.
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
    """The networks of an FP32 policy: `backbone`, `whole`, and the transformer behind `backbone` for the processor."""
    config = policy.config
    pictures = {f"frame_{n}": torch.zeros(1, 3, *s) for n, s in zip(config.cameras, config.image_sizes, strict=True)}
    grids = [config.grid(*size) for size in config.image_sizes]
    features = {f"features_{n}": torch.zeros(*g, config.dim) for n, g in zip(config.cameras, grids, strict=True)}
    state = torch.zeros(1, len(config.state_names))
    macs, weights = multiply_accumulates(policy), parameters_by_block(policy)
    looks = {b for b in macs if b.startswith("backbone") or b == "image_project"}
    front = _network(
        "backbone", Front(policy), pictures, list(features), [{b: n[b] for b in looks} for n in (macs, weights)]
    )
    whole = _network(
        "whole", Whole(policy), {"state": state[:, :, None, None], **pictures}, ["actions"], [macs, weights]
    )
    return front, whole, _tidied(onnx_model(graph_of(Rest(policy)), {"state": state, **features}, ["chunk"]))


def _network(
    name: str, module: nn.Module, inputs: dict[str, Tensor], outputs: list[str], counts: list[dict[str, int]]
) -> Network:
    model = _tidied(onnx_model(graph_of(module), inputs, outputs))
    if unknown := {node.op_type for node in model.graph.node} - OPERATORS.keys():
        raise QuantizeError(f"{name}: nothing is known of {', '.join(sorted(unknown))} in Hailo's parser")
    biases = {i.name for i in model.graph.initializer if len(i.dims) == 1}
    sums = [node for node in model.graph.node if node.op_type == "Add" and not biases & set(node.input)]
    normalised = {node.input[0] for node in model.graph.node if node.op_type == "LayerNormalization"}
    macs, parameters = (sum(of.values()) for of in counts)
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


def _tidied(model: onnx.ModelProto) -> onnx.ModelProto:
    """The same function with two transposes in a row as one, constants multiplied, and no Identity."""
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


# --- the kit ----------------------------------------------------------------------------------------------------------


def write_kit(
    loaded: Opened, out: Path | str, *, samples: int = LEAST_SAMPLES, progress: Progress = silent
) -> dict[str, Any]:
    """Write the kit of a checkpoint to the new folder `out`; return what KIT.md says, as numbers.

    samples: frames of the calibration set. Raises QuantizeError where `out` exists or too few frames were recorded, and
    leaves nothing half-written.
    """
    out = Path(out)
    if out.exists() or out.is_symlink():
        raise QuantizeError(f"{out}: exists already", remedy="give a folder that does not")
    recipe = Recipe.of(params(), samples)
    chosen, _ = recipe.choose(loaded.parts.calibration)
    if len(chosen) < samples:
        raise QuantizeError(
            f"a calibration set of {samples} frames is wanted, {len(chosen)} are usable for it",
            remedy="record more; or say --samples, and expect more of an error",
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as temporary:
        kit = Kit(loaded, Path(temporary) / out.name, progress)
        report = kit.write(chosen, recipe)
        kit.folder.rename(out)
    return report


class Kit:
    """One kit being written. Use `write_kit`."""

    def __init__(self, loaded: Opened, folder: Path, progress: Progress):
        self.checkpoint, self.parts = loaded.checkpoint, loaded.parts
        self.config: ActConfig = loaded.checkpoint.config
        self.folder, self.progress = folder, progress
        self.policy = ACT(self.config, loaded.checkpoint.weights)
        self.front, self.whole, self.rest = networks(self.policy)
        folder.mkdir()

    def write(self, samples: Sequence[Sample], recipe: Recipe) -> dict[str, Any]:
        """All files of the kit; the content of kit.json. samples: those that calibrate. recipe: of the parity."""
        for name, model in (("backbone", self.front.model), ("whole", self.whole.model), ("transformer", self.rest)):
            onnx.save(model, self.folder / f"{name}.onnx")
        self._calibrate(samples)
        judged = Exporter(self.checkpoint, thinned(self.parts.choosing or samples, CHOOSING_FRAMES), recipe.parity)
        errors = self._stand_in(judged)
        self._vectors(judged)
        for chip in CHIPS.values():
            for network in (self.front, self.whole):
                self._write(f"{network.name}_{chip.name}.alls", model_script(network, chip, self.config, len(samples)))
            self._write(f"compile_{chip.name}.sh", compile_script(chip))
        shutil.copyfile(hailo_compile.__file__, self.folder / "compile.py")
        report = self._report(judged, errors, recipe, len(samples))
        self._write("kit.json", json.dumps(report, indent=1))
        self._write("KIT.md", description(self, report))
        return report

    def _write(self, name: str, text: str) -> None:
        (self.folder / name).write_text(text)

    def _calibrate(self, samples: Sequence[Sample]) -> None:
        """calibration_<input>.npy, channels last: frames, normalised states, and `backbone`'s features of them."""
        count, session = len(samples), _session(self.front.model)
        arrays: dict[str, np.memmap] = {}

        def store(name: str, i: int, value: np.ndarray) -> None:
            if name not in arrays:
                path = self.folder / f"calibration_{name}.npy"
                arrays[name] = open_memmap(path, mode="w+", dtype=value.dtype, shape=(count, *value.shape))
            arrays[name][i] = value

        for i, sample in enumerate(self.progress(samples, desc="calibration set")):
            state, *frames = inputs_of(sample, self.config)
            pictures = self._pictures(frames)
            store("state", i, self.policy.state_norm(state).numpy().reshape(1, 1, -1))
            for camera, frame in zip(self.config.cameras, frames, strict=True):
                store(f"frame_{camera}", i, frame.numpy())
            for camera, features in zip(self.config.cameras, session.run(None, pictures), strict=True):
                store(f"features_{camera}", i, features[0].transpose(1, 2, 0))
        for array in arrays.values():
            array.flush()

    def _pictures(self, frames: Sequence[Tensor]) -> dict[str, np.ndarray]:
        """Frames, (height, width, 3) uint8 RGB, as the chip's input once its model script has normalised them."""
        inputs = self.policy.image_input
        named = zip(self.config.cameras, inputs, frames, strict=True)
        return {f"frame_{camera}": pixels(frame).contiguous().numpy() for camera, pixels, frame in named}

    def _seeing(self, state: Tensor, frames: Sequence[Tensor]) -> dict[str, np.ndarray]:
        """Inputs of `whole`."""
        return {"state": self.policy.state_norm(state)[:, :, None, None].numpy(), **self._pictures(frames)}

    def _actions(self, answer: np.ndarray) -> Tensor:
        """What `whole` gives, as actions."""
        return self.policy.action_unnorm(torch.from_numpy(answer))

    def _stand_in(self, judged: Exporter) -> dict[str, Any]:
        """What INT8 does to both splits, by ONNX Runtime with the calibration set of the kit.

        Of each network: `network`, its answers' error, and `actions`, the largest by action against the FP32 policy.
        """
        frames = STAND_IN_FRAMES
        every = [f"frame_{c}" for c in self.config.cameras]
        stored = {n: np.load(self.folder / f"calibration_{n}.npy", mmap_mode="r") for n in ("state", *every)}
        picked = np.unique(np.linspace(0, len(stored["state"]) - 1, frames).round().astype(int))
        known = []
        for i in picked:
            state = stored["state"][i].reshape(1, -1, 1, 1)
            known.append({"state": state, **self._pictures([torch.from_numpy(np.array(stored[n][i])) for n in every])})
        errors: dict[str, Any] = {}
        rest = _session(self.rest)
        for network in (self.front, self.whole):
            float_session = _session(network.model)
            quantized = _session(int8(network.model, [{k: x[k] for k in network.inputs} for x in known]), exact=True)
            answers, apart, size = [], 0.0, 0.0
            for state, *pictures in self.progress(judged.inputs, desc=f"INT8 stand-in of {network.name}"):
                given = {k: v for k, v in self._seeing(state, pictures).items() if k in network.inputs}
                wanted, got = float_session.run(None, given), quantized.run(None, given)
                apart += sum(float(((g - w) ** 2).sum()) for g, w in zip(got, wanted, strict=True))
                size += sum(float((w**2).sum()) for w in wanted)
                if network is self.whole:
                    answers.append(self._actions(got[0]))
                else:
                    answers.append(torch.from_numpy(rest.run(None, self._behind(state, got))[0]))
            worst = (torch.cat(answers) - judged.float_actions).abs().amax((0, 1))
            errors[network.name] = {
                "network": (apart / size) ** 0.5,
                "actions": dict(zip(self.config.action_names, worst.tolist(), strict=True)),
            }
        return errors

    def _behind(self, state: Tensor, features: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Inputs of the transformer: the features as HailoRT gives them, channels last."""
        named = zip(self.config.cameras, features, strict=True)
        return {"state": state.numpy()} | {f"features_{c}": f[0].transpose(1, 2, 0) for c, f in named}

    def _vectors(self, judged: Exporter) -> None:
        """expected_<network>.npz: the parity vectors' frames, as the compiler's emulator takes them."""
        inputs = [judged.inputs[i] for i in judged.stored]
        frames = {
            f"frame_{camera}": np.stack([x[1 + c].numpy() for x in inputs])
            for c, camera in enumerate(self.config.cameras)
        }
        session = _session(self.front.model)
        seen = [self._behind(s, session.run(None, self._pictures(f))) for s, *f in inputs]
        features = {n: np.stack([x[n] for x in seen]) for n in seen[0] if n != "state"}
        _savez(self.folder / "expected_backbone.npz", frames | features)
        session = _session(self.whole.model)
        actions = np.concatenate([session.run(None, self._seeing(s, f))[0] for s, *f in inputs])
        normalised = np.stack([self.policy.state_norm(s).numpy().reshape(1, 1, -1) for s, *_ in inputs])
        _savez(self.folder / "expected_whole.npz", {"state": normalised, **frames, "actions": actions})

    def _report(self, judged: Exporter, errors: dict[str, Any], recipe: Recipe, samples: int) -> dict[str, Any]:
        """kit.json."""
        config, described = self.config, {}
        for network in (self.front, self.whole):
            tolerance = {
                name: max(recipe.parity.tolerance, min(STAND_IN_TIMES * error, LARGEST_TOLERANCE["int8"]))
                for name, error in errors[network.name]["actions"].items()
            }
            described[network.name] = {
                "onnx": f"{network.name}.onnx",
                "cpu": "transformer.onnx" if network is self.front else None,
                "inputs": {
                    name: {"shape": shape, "calibration": f"calibration_{name}.npy"}
                    for name, shape in network.inputs.items()
                },
                "end_nodes": list(network.outputs.values()),
                "script_names": script_names(network),
                "compilers": {chip.name: chip.compiler for chip in CHIPS.values()},
                "operators": dict(sorted(network.operators.items())),
                "estimate": {chip.name: asdict(estimate(network, chip)) for chip in CHIPS.values()},
                "gmac": network.macs / 1e9,
                "parameters_m": network.parameters / 1e6,
                "stand_in_error": errors[network.name]["network"],
                "stand_in_actions": errors[network.name]["actions"],
                "tolerance": tolerance,
                "weights_mb": (self.whole.parameters + 3 * (self.whole.parameters - network.parameters)) / 1e6,
                "runs": {
                    "outputs": {name: self._shape(network, name) for name in network.outputs},
                    "original_names": network.outputs,
                    "state": _affine(config.state_norm) if network is self.whole else None,
                    "actions": _affine(config.action_unnorm) if network is self.whole else None,
                },
            }
        manifest = self._proven(judged) | {
            "mode": "static",
            "scheme": "affine",
            "engine": "hailo",
            "calibration": {"samples": samples, "observer": "Hailo's compiler"},
            "gmac": judged.gmac,
            "parity": {
                "reason": f"the chip is INT8: {STAND_IN_TIMES:g} times as far from FP32 as ONNX Runtime's INT8",
            },
        }
        return {"schema": 1, "samples": samples, "networks": described, "manifest": manifest}

    def _proven(self, judged: Exporter) -> dict[str, Any]:
        """The manifest of the FP32 artifact, whose parity vectors become the kit's parity.npz."""
        with TemporaryDirectory() as folder:
            path = Path(folder) / "policy_fp32.pt"
            judged.export(self.policy, path)
            _savez(self.folder / "parity.npz", read_parity(path))
            return read_manifest(path)

    def _shape(self, network: Network, output: str) -> list[int]:
        """Of an output as HailoRT gives it: channels last, without a batch."""
        if network is self.whole:
            return [1, self.config.chunk, len(self.config.action_names)]
        h, w = self.config.grid(*self.config.image_sizes[list(network.outputs).index(output)])
        return [h, w, self.config.dim]


def _savez(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    np.savez_compressed(path, allow_pickle=False, **arrays)


def _affine(affine: Affine | None) -> dict[str, Any] | None:
    return asdict(affine) if affine else None


def _session(model: onnx.ModelProto, *, exact: bool = False) -> "onnxruntime.InferenceSession":
    """exact: nothing fused, so that an INT8 graph gives what its numbers say, whatever this processor's kernels do with
    them (those for AVX2 saturate).
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    if exact:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def int8(model: onnx.ModelProto, inputs: Sequence[Mapping[str, np.ndarray]]) -> onnx.ModelProto:
    """ONNX Runtime's static INT8 of a network: a stand-in for what Hailo's compiler makes of it, calibrated on inputs.

    Convolutions and products of matrices are INT8. Sums stay in float: on the chip they are part of a convolution, or
    of 16 bits.
    """
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static

    class Reader(CalibrationDataReader):
        def __init__(self) -> None:
            self.left = iter(inputs)

        def get_next(self) -> Mapping[str, np.ndarray] | None:
            return next(self.left, None)

    constants = {i.name for i in model.graph.initializer}
    # ONNX Runtime takes a constant first factor for a weight, and quantizes it along the wrong axis.
    backwards = [n.name for n in model.graph.node if n.op_type == "MatMul" and n.input[0] in constants]
    with TemporaryDirectory() as folder:
        source, path = Path(folder) / "float.onnx", Path(folder) / "int8.onnx"
        onnx.save(model, source)  # a file, because what is given as a model gets changed
        quantize_static(
            source,
            path,
            Reader(),
            op_types_to_quantize=["Conv", "MatMul"],
            nodes_to_exclude=backwards,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        return onnx.load(path)


# --- what a kit says --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Estimate:
    """Milliseconds on a chip: at the rate of the zoo's DETR, and for a network without attention of its ResNet-18."""

    slow_ms: float
    fast_ms: float
    arithmetic: str


def estimate(network: Network, chip: Chip) -> Estimate:
    """Time of one inference on that chip, computed from the zoo's rates of alike networks; nobody has measured it."""
    gop = 2 * network.macs / 1e9
    slow = DETR_GOP * chip.detr
    words = f"{gop:.1f} GOP / ({DETR_GOP} GOP x {chip.detr:g}/s) = {1000 * gop / slow:.1f} ms"
    if network.sixteen_bit:
        return Estimate(1000 * gop / slow, 1000 * gop / slow, words)
    fast = RESNET_GOP * chip.resnet
    words += f"; at ResNet-18's {RESNET_GOP} GOP x {chip.resnet:g}/s: {1000 * gop / fast:.1f} ms"
    return Estimate(1000 * gop / slow, 1000 * gop / fast, words)


def script_names(network: Network) -> dict[str, str]:
    """What the compiler should call the layers of the nodes that the model script names, by those nodes' names.

    As in the zoo's script for DETR, layers of a kind are numbered in the graph's order, and a product with weights is a
    convolution. compile.py checks it before anything is quantized.
    """
    names = {name: f"input_layer{i}" for i, name in enumerate(network.inputs, 1)}
    names |= {node: f"ew_add{i}" for i, node in enumerate(network.sums, 1) if node in network.sixteen_bit}
    constants = {i.name for i in network.model.graph.initializer}
    weighted = [
        n
        for n in network.model.graph.node
        if n.op_type == "Conv" or (n.op_type == "MatMul" and n.input[1] in constants)
    ]
    last = {n.name: f"conv{i}" for i, n in enumerate(weighted, 1) if n.op_type == "Conv" or n is weighted[-1]}
    made = {n.name: n for n in network.model.graph.node}
    for node in network.outputs.values():
        # the head's bias is an Add of its own in ONNX
        source = node if node in last else next(n.name for n in weighted if n.output[0] in made[node].input)
        names[source] = last[source]
    return names


def model_script(network: Network, chip: Chip, config: ActConfig, samples: int) -> str:
    """The .alls file of a network for a chip. Each line says where it is from; zoo: hailo_model_zoo's scripts."""
    names, scope = script_names(network), network.name
    lines = [f"# {network.name} for {chip.name}, Dataflow Compiler {chip.compiler}.x; compiled by nobody yet"]
    for i, (camera, norm) in enumerate(zip(config.cameras, config.image_norm, strict=True), 1):
        mean = [round(v, 6) for v in zero_colour(norm)]
        std = [round(255 / s, 6) for s in norm.scale]
        layer = f", {scope}/{names[f'frame_{camera}']}" if len(network.inputs) > 1 else ""
        lines.append(f"normalization{i} = normalization({mean}, {std}{layer})")
    lines += [
        f"model_optimization_config(calibration, batch_size=8, calibset_size={samples})",
        "# 0 needs no GPU (zoo: detr_resnet_v1_18_bn, vit_small); with one, try optimization_level=2",
        "model_optimization_flavor(optimization_level=0, compression_level=0)",
        "pre_quantization_optimization(equalization, policy=enabled)  # zoo: detr_resnet_v1_18_bn, vit_small",
    ]
    if network.sixteen_bit:
        adds = ", ".join(f"{scope}/{names[node]}" for node in network.sixteen_bit)
        lines += [
            "# zoo: vit_small, deit_base",
            "pre_quantization_optimization(ew_add_fusing, policy=disabled)",
            "pre_quantization_optimization(matmul_correction, layers={matmul*}, correction_type=zp_comp_block)",
            "model_optimization_config(negative_exponent, layers={*}, rank=0)",
            "# the sums of attention and feed-forward, before each LayerNormalization (zoo: vit_small, deit_base)",
            f"quantization_param([{adds}], precision_mode=a16_w16)",
            "# the state, which is small beside what it stands for (zoo: clip_vit_b_16_text_encoder)",
            f"quantization_param({scope}/{names['state']}, precision_mode=a16_w16)",
        ]
        if chip.compiler == "3":
            lines += ["# zoo: detr_resnet_v1_50 of v2.17", "quantization_param({*layer_norm*}, precision_mode=a16_w16)"]
    ends = ", ".join(f"{scope}/{name}" for name in dict.fromkeys(names.values()) if name.startswith("conv"))
    lines += [
        "# what leaves the chip, and the layer that makes it (zoo: detr_resnet_v1_18_bn)",
        f"quantization_param([{ends}], precision_mode=a16_w16)",
        "quantization_param({output_layer*}, precision_mode=a16_w16)",
    ]
    return "\n".join(lines) + "\n"


def compile_script(chip: Chip) -> str:
    """The text of compile_<chip>.sh."""
    return f"""#!/bin/sh
# sh compile_{chip.name}.sh [backbone|whole], where Hailo's Dataflow Compiler {chip.compiler}.x is installed
exec python3 "$(dirname "$0")/compile.py" {chip.name} "${{1:-backbone}}"
"""


def description(kit: Kit, report: Mapping[str, Any]) -> str:
    """The text of KIT.md."""
    lines = [
        "# A kit for Hailo's compiler",
        "",
        "Made by `rover export --hailo`; the project's docs/hailo.md leads through it. Nobody has compiled it.",
        "",
        "## What both networks are made of",
        "",
        "| operator | backbone | whole | what is known of it in Hailo's parser |",
        "|---|---|---|---|",
    ]
    networks = report["networks"]
    for operator, known in OPERATORS.items():
        counts = [networks[name]["operators"].get(operator, 0) for name in ("backbone", "whole")]
        if any(counts):
            lines.append(f"| {operator} | {counts[0]} | {counts[1]} | {known} |")
    lines += ["", "## What to expect (computed from the zoo's figures, not measured)", ""]
    lines += ["| network | chip | parameters = MB of INT8 weights | time without transfers |", "|---|---|---|---|"]
    for name, network in networks.items():
        for chip, guess in network["estimate"].items():
            lines.append(f"| {name} | {chip} | {network['parameters_m']:.1f} | {guess['arithmetic']} |")
    lines += ["", "## What INT8 does to it (measured with ONNX Runtime as a stand-in)", ""]
    lines += ["| network | its answers' error | largest error of an action | taken for proven on the rover up to |"]
    lines += ["|---|---|---|---|"]
    for name, network in networks.items():
        columns = [
            ", ".join(f"{action} {value:.3g}" for action, value in network[key].items())
            for key in ("stand_in_actions", "tolerance")
        ]
        lines.append(f"| {name} | {network['stand_in_error']:.2%} | {columns[0]} | {columns[1]} |")
    lines += ["", "## Files", "", "| file | what it is |", "|---|---|"]
    lines += [f"| {name} | {what} |" for name, what in files(kit.config).items()]
    return "\n".join(lines) + "\n"


def files(config: ActConfig) -> dict[str, str]:
    """Every file of a kit, and what it is."""
    listed = {
        "KIT.md": "this",
        "kit.json": "the same as numbers, and what compile.py reads",
        "compile.py": "parses, quantizes, emulates, compiles and packs one network for one chip",
        "backbone.onnx": "pictures to projected features, for the chip",
        "transformer.onnx": "what follows backbone, for ONNX Runtime on the rover",
        "whole.onnx": "the whole policy, for the chip",
        "calibration_state.npy": "recorded states, normalised, (n, 1, 1, S) float32",
        "parity.npz": "recorded observations, and what the policy must answer on the rover",
    }
    for camera in config.cameras:
        listed[f"calibration_frame_{camera}.npy"] = "recorded frames, (n, height, width, 3) uint8 RGB"
        listed[f"calibration_features_{camera}.npy"] = "what backbone makes of them, (n, h, w, D) float32"
    for network in ("backbone", "whole"):
        listed[f"expected_{network}.npz"] = f"observations and {network}'s answers in FP32, for the compiler's emulator"
    for chip in CHIPS.values():
        listed[f"compile_{chip.name}.sh"] = f"runs compile.py for {chip.name}: Dataflow Compiler {chip.compiler}.x"
        for network in ("backbone", "whole"):
            listed[f"{network}_{chip.name}.alls"] = f"model script of {network} for {chip.name}"
    return listed
