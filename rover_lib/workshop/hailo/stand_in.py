"""ONNX Runtime's INT8 as a stand-in for the chip's: how far it takes a network, and the actions behind, from FP32."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import onnx
import torch

from rover_lib.workshop.export import Exporter
from rover_lib.workshop.hailo.networks import Network, Splits
from rover_lib.workshop.progress import Progress

if TYPE_CHECKING:
    import onnxruntime

FRAMES = 32  # calibrate it


@dataclass(frozen=True)
class Error:
    """network: of a network's answers, relative, by root mean square. actions: the largest, by action."""

    network: float
    actions: dict[str, float]


def stand_in_errors(splits: Splits, folder: Path, judged: Exporter, progress: Progress) -> dict[str, Error]:
    """What INT8 does to both networks, by name, against the FP32 policy. folder: of the kit's calibration set."""
    known = _calibration_inputs(splits, folder)
    return {n.name: _error(splits, n, known, judged, progress) for n in (splits.front, splits.whole)}


def _calibration_inputs(splits: Splits, folder: Path) -> list[dict[str, np.ndarray]]:
    """FRAMES of the calibration set, evenly chosen, as `whole` takes them."""
    every = [f"frame_{c}" for c in splits.config.cameras]
    stored = {n: np.load(folder / f"calibration_{n}.npy", mmap_mode="r") for n in ("state", *every)}
    inputs = []
    for i in np.unique(np.linspace(0, len(stored["state"]) - 1, FRAMES).round().astype(int)):
        frames = [torch.from_numpy(np.array(stored[n][i])) for n in every]
        inputs.append({"state": stored["state"][i].reshape(1, -1, 1, 1), **splits.pictures(frames)})
    return inputs


def _error(
    splits: Splits, network: Network, known: Sequence[Mapping[str, np.ndarray]], judged: Exporter, progress: Progress
) -> Error:
    """known: inputs that calibrate."""
    float_session = session_of(network.model)
    quantized = session_of(int8(network.model, [{k: x[k] for k in network.inputs} for x in known]), exact=True)
    rest = session_of(splits.rest)
    answers, apart, size = [], 0.0, 0.0
    for state, *frames in progress(judged.inputs, desc=f"INT8 stand-in of {network.name}"):
        given = {k: v for k, v in splits.whole_inputs(state, frames).items() if k in network.inputs}
        wanted, got = float_session.run(None, given), quantized.run(None, given)
        apart += sum(float(((g - w) ** 2).sum()) for g, w in zip(got, wanted, strict=True))
        size += sum(float((w**2).sum()) for w in wanted)
        if network is splits.whole:
            answers.append(splits.actions(got[0]))
        else:
            answers.append(torch.from_numpy(rest.run(None, splits.rest_inputs(state, got))[0]))
    worst = (torch.cat(answers) - judged.float_actions).abs().amax((0, 1))
    return Error((apart / size) ** 0.5, dict(zip(splits.config.action_names, worst.tolist(), strict=True)))


def session_of(model: onnx.ModelProto, *, exact: bool = False) -> "onnxruntime.InferenceSession":
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
