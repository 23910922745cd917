"""Use ONNX Runtime's INT8 as a stand-in for the chip's: how far are a network's answers, and the actions, from FP32?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import onnx
import torch

from rover_hailo.networks import Network, Splits
from rover_lib.workshop.int8.export import Exporter
from rover_lib.workshop.progress import Progress

if TYPE_CHECKING:
    import onnxruntime

FRAMES = 32  # of the calibration set, which calibrate the stand-in


@dataclass(frozen=True)
class Error:
    """The error that INT8 causes.

    network: of the network's answers, as a share of their root mean square. actions: the largest of each action.
    """

    network: float
    actions: dict[str, float]


def stand_in_errors(splits: Splits, folder: Path, judged: Exporter, progress: Progress) -> dict[str, Error]:
    """Return what INT8 does to both networks, by name, against the FP32 policy. folder: with the calibration set."""
    known = _calibration_inputs(splits, folder)
    return {n.name: _error(splits, n, known, judged, progress) for n in (splits.front, splits.whole)}


def _calibration_inputs(splits: Splits, folder: Path) -> list[dict[str, np.ndarray]]:
    """Take FRAMES samples of the calibration set, evenly spaced, as inputs of `whole`."""
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
    """Measure one network's error on the judged observations. known: the inputs that calibrate."""
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
    """Open a model in ONNX Runtime.

    exact: turn fusing off, so that an INT8 graph computes exactly what it says. This processor's INT8 kernels may not;
    those for AVX2 saturate.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    if exact:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def int8(model: onnx.ModelProto, inputs: Sequence[Mapping[str, np.ndarray]]) -> onnx.ModelProto:
    """Quantize a network by ONNX Runtime's static INT8, calibrated on `inputs`, as Hailo's compiler might.

    Convolutions and products of matrices are INT8. Sums stay in float, because on the chip they are part of a
    convolution or have 16 bits.
    """
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static

    class Reader(CalibrationDataReader):
        def __init__(self) -> None:
            self.left = iter(inputs)

        def get_next(self) -> Mapping[str, np.ndarray] | None:
            return next(self.left, None)

    constants = {i.name for i in model.graph.initializer}
    # ONNX Runtime takes a first factor that is constant for a weight, and quantizes it along the wrong axis.
    backwards = [n.name for n in model.graph.node if n.op_type == "MatMul" and n.input[0] in constants]
    with TemporaryDirectory() as folder:
        source, path = Path(folder) / "float.onnx", Path(folder) / "int8.onnx"
        onnx.save(model, source)  # as a file, because quantize_static changes a model that it is given
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
