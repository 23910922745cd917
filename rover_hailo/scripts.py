"""Write the texts for Hailo's compiler: a model script (.alls) for each network and chip, and a script to start it."""

from rover_hailo.chips import Chip
from rover_hailo.networks import Network
from rover_lib.workshop.act import ActConfig, zero_colour


def script_names(network: Network) -> dict[str, str]:
    """Return what the compiler should call the layers that the model script names, keyed by the names of their nodes.

    As in the zoo's script for DETR, layers of one kind are numbered in the graph's order, and a product with weights is
    a convolution. compile.py checks the names before anything is quantized.
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
        # In ONNX the head's bias is a separate Add, so the layer's name belongs to the product before it.
        source = node if node in last else next(n.name for n in weighted if n.output[0] in made[node].input)
        names[source] = last[source]
    return names


def model_script(network: Network, chip: Chip, config: ActConfig, samples: int) -> str:
    """Return the .alls file of a network for a chip. Comments in it give its sources; zoo means hailo_model_zoo."""
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
    """Return the text of compile_<chip>.sh."""
    return f"""#!/bin/sh
# sh compile_{chip.name}.sh [backbone|whole], where Hailo's Dataflow Compiler {chip.compiler}.x is installed
exec python3 "$(dirname "$0")/compile.py" {chip.name} "${{1:-backbone}}"
"""
