"""Write KIT.md: what a kit's files are, what its networks consist of, and what to expect of them."""

from collections.abc import Mapping
from typing import Any

from rover_hailo.chips import CHIPS
from rover_hailo.operators import OPERATORS
from rover_lib.workshop.act import ActConfig


def description(config: ActConfig, report: Mapping[str, Any]) -> str:
    """Return the text of KIT.md. report: the content of kit.json."""
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
    lines += [f"| {name} | {what} |" for name, what in files(config).items()]
    return "\n".join(lines) + "\n"


def files(config: ActConfig) -> dict[str, str]:
    """Return every file of a new kit, and what it is."""
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
