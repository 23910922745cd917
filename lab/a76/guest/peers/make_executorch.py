"""Make a policy for ExecuTorch: static INT8 by its XNNPACK quantizer, lowered to XNNPACK.

    make_executorch.py CHECKPOINT CALIBRATION ARTIFACT

Arguments and the printed line are those of make_onnxruntime.py, but ARTIFACT is a .pte. The same parts are INT8.

The recipe is the quantizer's own: symmetric INT8 weights per channel, INT8 activations, ranges by histogram. It is set
for the whole graph, with a filter: if it is set by module type or name, the quantizer silently skips convolutions.
"""

import json
import logging
import sys
import warnings
from importlib.metadata import version
from pathlib import Path
from unittest.mock import patch

import torch
import torch.nn.functional as F
from executorch.backends.xnnpack.partition.xnnpack_partitioner import XnnpackPartitioner
from executorch.backends.xnnpack.quantizer.xnnpack_quantizer import XNNPACKQuantizer, get_symmetric_quantization_config
from executorch.exir import EdgeCompileConfig, to_edge_transform_and_lower
from float_policy import float_policy, observations
from torch import Tensor, nn
from torchao.quantization.pt2e.quantize_pt2e import convert_pt2e, prepare_pt2e

from rover_lib.workshop.act import Residual

INT8 = tuple(f"{c.__module__}.{c.__qualname__}" for c in (nn.Conv2d, nn.Linear, nn.ReLU, nn.MaxPool2d, Residual))
STAYS_FLOAT = ("head", "state_project")
PRODUCTS = (
    "aten.convolution",
    "aten.linear",
    "aten.addmm",
    "aten.mm",
)  # after export


def attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Do F.scaled_dot_product_attention without its ten operators that care for rows in which all is masked."""
    return (q * q.shape[-1] ** -0.5 @ k.transpose(-2, -1)).softmax(-1) @ v


def is_int8(node: torch.fx.Node) -> bool:
    """Return whether the quantizer may quantize a node, by the module that the node comes from."""
    stack = list(node.meta.get("nn_module_stack", {}).values())
    if node.op != "call_function" or not stack:  # weights, and parts of other nodes' patterns
        return True
    name, kind = stack[-1]
    kind = kind if isinstance(kind, str) else f"{kind.__module__}.{kind.__qualname__}"
    return kind in INT8 and not str(name).endswith(STAYS_FLOAT)


def main(checkpoint: str, calibration: str, artifact: str) -> None:
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    model, example = float_policy(checkpoint)
    quantizer = XNNPACKQuantizer().set_global(get_symmetric_quantization_config(is_per_channel=True))
    quantizer.set_filter_function(is_int8)
    with torch.no_grad():
        with patch.object(F, "scaled_dot_product_attention", attention):  # only here, as ExecuTorch's passes use it too
            graph = torch.export.export(model, example).module()
        graph = prepare_pt2e(graph, quantizer)
        for observation in observations(calibration):
            graph(*map(torch.from_numpy, observation))
        graph = convert_pt2e(graph)
        edge = to_edge_transform_and_lower(
            torch.export.export(graph, example),
            partitioner=[XnnpackPartitioner()],
            compile_config=EdgeCompileConfig(_check_ir_validity=False),
        )
    left = [str(n.target) for n in edge.exported_program().graph.nodes if n.op == "call_function"]
    if left := [target for target in left if any(product in target for product in PRODUCTS)]:
        sys.exit(f"error: XNNPACK did not take {len(left)} convolutions and linears: {left[:3]}")
    Path(artifact).write_bytes(edge.to_executorch().buffer)
    versions = {"executorch": version("executorch"), "torchao": version("torchao"), "torch": torch.__version__}
    print(json.dumps(versions))


if __name__ == "__main__":
    main(*sys.argv[1:])
