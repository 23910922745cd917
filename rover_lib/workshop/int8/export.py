"""Write the artifact: one file with the graph, its manifest and its parity vectors, which is all that a rover needs.

Exporter(checkpoint, samples).export(quantized, "policy_static.pt", calibration)  # or .onnx.zip, for ONNX Runtime
"""

import warnings
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache, partial
from importlib.metadata import entry_points
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from rover_lib.onboard.artifact import manifest as artifact
from rover_lib.onboard.artifact.manifest import ONNX_SUFFIX, ONNXRUNTIME, TORCH
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.picture import is_squeezed
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.familiar import TOLERANCE
from rover_lib.onboard.wheel_version import VERSION
from rover_lib.workshop.act import ACT, example_inputs, inputs_of, multiply_accumulates, predictions
from rover_lib.workshop.act_config import ActConfig
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.int8.familiar import Drives, fit
from rover_lib.workshop.int8.observe import Calibration
from rover_lib.workshop.int8.quantize import QuantizedPolicy, graph_of, int8_layers, with_embedding
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Sample, by_camera, car_of

BATCH = 8
KEPT = 2**28  # bytes of pictures that are prepared once for all modes; larger ones take far longer to plan from
REASONS = {  # why another processor may answer otherwise: of FP32, and of INT8
    False: "another processor sums in another order",
    True: "float parts round differently on another processor, and flipped INT8 roundings grow over layers",
}


class TorchScript:
    """The policy as TorchScript, traced and frozen. A form of a policy predicts, and saves itself as an artifact."""

    engine = TORCH

    def __init__(self, module: nn.Module, config: ActConfig):
        self.versions: dict[str, str] = {}  # empty, because torch's version is in every manifest anyway
        with warnings.catch_warnings(), torch.inference_mode():
            warnings.simplefilter("ignore")
            frozen = torch.jit.freeze(torch.jit.trace(module, example_inputs(config), check_trace=False).eval())
        self.traced = _reread(frozen)

    def run(self, inputs: tuple[Tensor, ...]) -> Sequence[Tensor]:
        """Return the actions, (1, C, A) float32, not clipped; then the embedding, (1, D), if the module gives one."""
        with torch.inference_mode(), torch.jit.optimized_execution(False):
            return _each(self.traced(*inputs))

    def save(self, path: Path | str, manifest: dict[str, Any], vectors: dict[str, np.ndarray]) -> str:
        return artifact.save_artifact(path, self.traced, manifest, vectors)


def _reread(frozen: torch.jit.ScriptModule) -> torch.jit.ScriptModule:
    """Return a frozen module as a file gives it, and empty the one that was given, whose graph torch never frees."""
    file = BytesIO()
    graph = frozen.graph
    torch.jit.save(frozen, file)
    file.seek(0)
    for _ in list(graph.outputs()):
        graph.eraseOutput(0)
    for node in reversed(list(graph.nodes())):
        node.destroy()
    return torch.jit.load(file)


class Onnx:
    """The policy as ONNX, written node by node: see rover_exchange/onnx_graph.py."""

    engine = ONNXRUNTIME

    def __init__(self, module: nn.Module, config: ActConfig):
        # Imported here, because only this form needs these packages.
        import onnx
        import onnxruntime

        from rover_lib.onboard.policy.onnx_engine import session_of

        (onnx_model,) = entry_points(group="rover.graphs", name="onnx")  # what stands beside rover_lib joins it so
        self.versions = {"onnx": onnx.__version__, "onnxruntime": onnxruntime.__version__}
        self.names = ["state", *(f"frame_{name}" for name in config.cameras)]
        inputs = dict(zip(self.names, example_inputs(config), strict=True))
        graph = graph_of(module)
        outputs = ("chunk", "embedding")[: len(_each(graph(*inputs.values())))]
        self.model = onnx_model.load()(graph, inputs, outputs).SerializeToString(deterministic=True)
        self.session = session_of(self.model, torch.get_num_threads())

    def run(self, inputs: tuple[Tensor, ...]) -> Sequence[Tensor]:
        named = {name: x.numpy() for name, x in zip(self.names, inputs, strict=True)}
        return [torch.from_numpy(y) for y in self.session.run(None, named)]

    def note(self, facts: Mapping[str, str]) -> None:
        """Write facts into the graph's own metadata."""
        import onnx

        model = onnx.load_from_string(self.model)
        onnx.helper.set_model_props(model, dict(facts))
        self.model = model.SerializeToString(deterministic=True)

    def save(self, path: Path | str, manifest: dict[str, Any], vectors: dict[str, np.ndarray]) -> str:
        return artifact.save_onnx(path, self.model, manifest, vectors)


def _each(outputs: Tensor | tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return outputs if isinstance(outputs, tuple) else (outputs,)


Form = TorchScript | Onnx


class Exporter:
    """Writes artifacts of one checkpoint.

    samples: recorded observations; some of them, as the section `parity` of params.yml says, become the parity vectors,
    INT8's largest error is taken over all. Raises ArtifactError without samples, and for samples of several cars.
    """

    def __init__(self, checkpoint: Checkpoint, samples: Sequence[Sample]):
        if not samples:
            raise ArtifactError("an artifact needs parity vectors", found="no samples", remedy="give at least one")
        self.checkpoint = checkpoint
        self.parity = params()["parity"]
        self.car = car_of(samples)
        self.recorded = recorded_shapes(samples[0], checkpoint.config)
        self.float_policy = ACT(checkpoint.config, checkpoint.weights)
        self.gmac = sum(multiply_accumulates(self.float_policy).values()) / 1e9
        picture = sum(3 * height * width for height, width in checkpoint.config.image_sizes)
        self.prepared = lru_cache(KEPT // picture)(partial(inputs_of, config=checkpoint.config))
        self.inputs = [inputs_of(s, checkpoint.config) for s in samples]
        self.stored = np.unique(np.linspace(0, len(samples) - 1, self.parity["vectors"]).round().astype(int))
        for i in self.stored:
            state, *frames = self.inputs[i]
            self.inputs[i] = (state, *map(_in_blocks, frames))

    @cached_property
    def float_actions(self) -> Tensor:
        return predictions(self.float_policy, self.inputs)

    def export(
        self,
        policy: ACT | QuantizedPolicy,
        path: Path | str,
        calibration: Calibration | None = None,
        drives: Drives | None = None,
    ) -> tuple[str, dict[str, Any]]:
        """Write the artifact.

        Args:
            policy: in FP32, or quantized.
            path: of the artifact, for ONNX Runtime if it ends in ONNX_SUFFIX.
            calibration: a quantized policy's, for the manifest.
            drives: by which it will tell how unfamiliar a picture is, if they are enough for that.

        Returns:
            Its content hash, and what `familiar.fit` says of the drives, or {}.

        Raises:
            ArtifactError: the engine's form of the policy does not compute what the policy computes, or gives anything
                that is not finite; then nothing is written.
        """
        config = self.checkpoint.config
        module: nn.Module = policy.module if isinstance(policy, QuantizedPolicy) else policy
        tells = drives is not None and not drives.warnings
        source = with_embedding(module) if tells else module
        form: Form = (Onnx if str(path).endswith(ONNX_SUFFIX) else TorchScript)(source, config)
        with torch.inference_mode():  # the eager policy is slow, so it answers only the stored samples
            eager = [_each(source(*self.inputs[i])) for i in self.stored]
        expected = torch.cat([pair[0] for pair in eager])
        outputs = [form.run(x) for x in self.inputs]
        actions = torch.cat([pair[0] for pair in outputs])
        if not torch.isfinite(actions).all():
            raise ArtifactError(f"{path}: the policy gives NaN or Inf on recorded frames; nothing was written")
        # The limit follows from the policy's own error. Taken from the form, it would grow with the form's mistakes.
        limits = self._tolerance(policy, expected, self.stored)
        gaps = (actions[self.stored] - expected).abs().amax((0, 1)).tolist()
        for (name, limit), gap in zip(limits.items(), gaps, strict=True):
            if not gap <= limit:  # written so that NaN fails
                raise ArtifactError(f"{path}: {name} of the written graph differs by {gap:.3g}; nothing was written")
        manifest = self._manifest(policy, calibration, form)
        # The gates judge what INT8 loses. A rover refuses a tolerance so large that another plan would pass.
        tolerance = {}
        for name, limit in self._tolerance(policy, actions, np.arange(len(actions))).items():
            tolerance[name] = min(limit, artifact.largest_tolerance(manifest["mode"], name))
        manifest["parity"] = {"tolerance": tolerance, "reason": REASONS[isinstance(policy, QuantizedPolicy)]}
        states, *frames = zip(*(self.inputs[i] for i in self.stored), strict=True)
        vectors = {"state": np.concatenate(states), "chunk": actions[self.stored].numpy()}
        vectors |= {f"frame_{name}": np.stack(images) for name, images in zip(config.cameras, frames, strict=True)}
        described: dict[str, Any] = {}
        if drives is not None and tells:
            familiar, described = fit(drives, self._embeddings(module, type(form), drives.samples).__getitem__)
            sizes = dict(zip(("directions", "size"), familiar.directions.shape, strict=True))
            manifest["familiar"] = sizes | {"drives": described["drives"]}
            vectors |= familiar.arrays() | {"embedding": np.concatenate([outputs[i][1] for i in self.stored])}
            familiar.check_limits(vectors["embedding"], path)
            expected_embeddings = np.concatenate([pair[1] for pair in eager])
            gap = np.abs(familiar.strange(vectors["embedding"]) - familiar.strange(expected_embeddings)).max()
            if not gap <= TOLERANCE[True]:
                problem = f"{path}: how familiar a picture is differs by {gap:.3g} in the written graph"
                raise ArtifactError(f"{problem}; nothing was written")
        return form.save(path, manifest, vectors), described

    def _embeddings(self, module: nn.Module, form: type[Form], samples: Sequence[Sample]) -> dict[Sample, np.ndarray]:
        """Return each sample's embedding, (D,) float32. A float policy's are computed in batches: rounding differs."""
        encoder = with_embedding(module, alone=True)
        embeddings = list[Tensor]()
        if isinstance(module, ACT):
            together = torch.func.vmap(encoder)
            with torch.inference_mode(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # attention has no rule for batches
                for i in range(0, len(samples), BATCH):
                    inputs = zip(*map(self.prepared, samples[i : i + BATCH]), strict=True)
                    embeddings += together(*map(torch.stack, inputs))[:, 0]
        else:
            run = form(encoder, self.checkpoint.config).run
            embeddings = [run(self.prepared(sample))[0][0] for sample in samples]
        return dict(zip(samples, torch.stack(embeddings).numpy(), strict=True))

    def _manifest(self, policy: ACT | QuantizedPolicy, calibration: Calibration | None, form: Form) -> dict[str, Any]:
        """Return the manifest without its parity."""
        config = self.checkpoint.config
        scheme: Any = getattr(policy, "scheme", None)
        mode = scheme.mode if scheme else "fp32"
        kind = {"fp32": "float", "dynamic": "dynamic"}.get(mode, "symmetric")
        calibrated = calibration and {
            "samples": calibration.samples,
            "observer": None if kind == "dynamic" else scheme.observer,
            "channel_scales": calibration.smooth,
            "float_blocks": list(scheme.float_blocks),
        }
        cameras = []
        for name, (height, width) in zip(config.cameras, config.image_sizes, strict=True):
            cameras.append({"name": name, "height": height, "width": width} | self.recorded[name])
        names_car = not self.car.drives_like(Car()) and bool({*config.action_names} & {*ACTION_NAMES})
        return {
            "schema": artifact.SCHEMA,
            "mode": mode,
            "scheme": kind,
            "engine": form.engine,
            "cameras": cameras,
            "state_names": list(config.state_names),
            "action_names": list(config.action_names),
            "chunk": config.chunk,
            "rate_hz": config.rate_hz,
            "normalisation": "inside the graph: uint8 RGB frames and raw states in, raw actions out",
            "checkpoint": {"sha256": self.checkpoint.sha256, "format": self.checkpoint.format},
            "calibration": calibrated,
            "versions": {"torch": torch.__version__.split("+")[0], "rover_lib": VERSION, **form.versions},
            **({"car": self.car.description()} if names_car else {}),
            "weights_mb": _weights_mb(policy.module if isinstance(policy, QuantizedPolicy) else policy),
            "gmac": self.gmac,
        }

    def _tolerance(self, policy: ACT | QuantizedPolicy, actions: Tensor, rows: np.ndarray) -> dict[str, float]:
        """Return by action how far another computation may be off `actions`, (n, C, A), of the samples `rows`."""
        # Float rounds in proportion: an arm's degrees are a hundred times a car's shares.
        sizes = actions.abs().amax((0, 1)).clamp(min=1).tolist()
        allowed = [self.parity["fp32"] * size for size in sizes]
        if isinstance(policy, QuantizedPolicy):
            errors = (actions - self.float_actions[rows]).abs().amax((0, 1)).tolist()
            allowed = [max(a, self.parity["int8_errors"] * e) for a, e in zip(allowed, errors, strict=True)]
        return dict(zip(self.checkpoint.config.action_names, allowed, strict=True))


def recorded_shapes(sample: Sample, config: ActConfig) -> dict[str, dict[str, Any]]:
    """Return {"recorded": [height, width]} for each camera whose recorded pictures were squeezed for the policy."""
    frames = by_camera(sample.frame_bgr(), config.cameras[0])
    shapes = {}
    for name, (h, w) in zip(config.cameras, config.image_sizes, strict=True):
        height, width = frames[name].shape[:2]
        shapes[name] = {"recorded": [height, width]} if is_squeezed((width, height), (w, h)) else {}
    return shapes


def _in_blocks(frame: Tensor, size: int = 4) -> Tensor:
    """Return the frame in squares of one colour: it tests as much, in a twentieth of the artifact's bytes."""
    height, width, _ = frame.shape
    return frame[::size, ::size].repeat_interleave(size, 0).repeat_interleave(size, 1)[:height, :width].contiguous()


def _weights_mb(module: nn.Module) -> float:
    """Return the size of weights and biases alone, with one byte for an INT8 weight and four for all others."""
    total = sum(p.numel() * 4 for p in module.parameters())
    for m in int8_layers(module).values():
        total += m.weight().numel() + (m.bias().numel() * 4 if m.bias() is not None else 0)
    return total / 1e6
