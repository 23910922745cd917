"""Make a policy for ONNX Runtime: export it in float, then quantize it to static INT8 with ONNX Runtime's own tools.

    make_onnxruntime.py CHECKPOINT CALIBRATION ARTIFACT

CALIBRATION: see float_policy.observations. Writes ARTIFACT, an .onnx with the inputs `state` and `frame`, and prints
the versions of the tools as a line of JSON.

The recipe is what ONNX Runtime's documentation advises for ARM: QDQ, symmetric INT8 weights per channel, signed
activations, ranges by minimum and maximum. Attention's products and the transformer's residual stream stay float; so do
the head and the state's projection: with these two in INT8, the demo policy's throttle was four times as far off.
"""

import json
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from float_policy import float_policy, observations
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

LAYERS = ("Conv", "Gemm", "MatMul")
INT8 = (*LAYERS, "Add", "Relu", "MaxPool")
OPSET = 17


class Recorded(CalibrationDataReader):
    def __init__(self, calibration: str):
        self.rest = observations(calibration)

    def get_next(self) -> dict[str, np.ndarray] | None:
        observation = next(self.rest, None)
        return dict(zip(("state", "frame"), observation, strict=True)) if observation else None


def stays_float(graph: onnx.GraphProto) -> list[str]:
    """Return the nodes that quantize_static shall leave in float, chosen by what they compute."""
    constants = {i.name for i in graph.initializer}
    users = Counter(name for node in graph.node for name in node.input)
    used_by = {name: node.op_type for node in graph.node for name in node.input}  # right for values with one user
    found = []
    for node in graph.node:
        # A product has no constant as its second input; a constant query would be its first.
        product = node.op_type in LAYERS and node.input[1] not in constants
        residual = node.op_type == "Add" and not (users[node.output[0]] == 1 and used_by[node.output[0]] == "Relu")
        if product or residual or "/head/" in node.name or "/state_project/" in node.name:
            found.append(node.name)
    return found


def main(checkpoint: str, calibration: str, artifact: str) -> None:
    warnings.simplefilter("ignore")  # the trace warns that shapes become constants, which is intended
    model, example = float_policy(checkpoint)
    with tempfile.TemporaryDirectory() as scratch:
        exported, prepared = Path(scratch) / "float.onnx", Path(scratch) / "prepared.onnx"
        names = {"input_names": ["state", "frame"], "output_names": ["chunk"]}
        torch.onnx.export(model, example, str(exported), opset_version=OPSET, dynamo=False, **names)
        quant_pre_process(exported, prepared, skip_symbolic_shape=True)
        types = {"quant_format": QuantFormat.QDQ, "activation_type": QuantType.QInt8, "weight_type": QuantType.QInt8}
        layers = {"op_types_to_quantize": list(INT8), "nodes_to_exclude": stays_float(onnx.load(prepared).graph)}
        quantize_static(prepared, artifact, Recorded(calibration), per_channel=True, **types, **layers)
    versions = {"onnxruntime": onnxruntime.__version__, "onnx": onnx.__version__, "torch": torch.__version__}
    print(json.dumps(versions))


if __name__ == "__main__":
    main(*sys.argv[1:])
