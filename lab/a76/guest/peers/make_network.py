"""Make one of torchvision's networks for ExecuTorch, with random weights, by its XNNPACK quantizer's own recipe.

    make_network.py NAME PRECISION PROGRAM

PRECISION is int8 (static), dynamic or fp32. It runs on the workstation with ExecuTorch's packages and its torchvision
before ours (see lab/a76/network_counts.py). What a network executes does not depend on its weights.
"""

import logging
import sys
import warnings
from pathlib import Path

import torch
import torchvision
from executorch.backends.xnnpack.partition.xnnpack_partitioner import XnnpackPartitioner
from executorch.backends.xnnpack.quantizer.xnnpack_quantizer import XNNPACKQuantizer, get_symmetric_quantization_config
from executorch.exir import EdgeCompileConfig, to_edge_transform_and_lower
from torchao.quantization.pt2e.quantize_pt2e import convert_pt2e, prepare_pt2e

SIZE = 224
OPTIONS = {"googlenet": {"aux_logits": False, "init_weights": False}}


def network(name: str) -> torch.nn.Module:
    if name == "deit_tiny":  # torchvision has its architecture, but not under this name
        return torchvision.models.VisionTransformer(SIZE, 16, 12, 3, 192, 768)
    return torchvision.models.get_model(name, weights=None, **OPTIONS.get(name, {}))


def main(name: str, precision: str, program: str) -> None:
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    torch.manual_seed(0)
    example = (torch.randn(1, 3, SIZE, SIZE),)
    with torch.no_grad():
        graph = torch.export.export(network(name).eval(), example).module()
        if precision != "fp32":
            scheme = get_symmetric_quantization_config(is_per_channel=True, is_dynamic=precision == "dynamic")
            graph = prepare_pt2e(graph, XNNPACKQuantizer().set_global(scheme))
            graph(*example)
            graph = convert_pt2e(graph)
        edge = to_edge_transform_and_lower(
            torch.export.export(graph, example),
            partitioner=[XnnpackPartitioner()],
            compile_config=EdgeCompileConfig(_check_ir_validity=False),
        )
    Path(program).write_bytes(edge.to_executorch().buffer)


if __name__ == "__main__":
    main(*sys.argv[1:])
