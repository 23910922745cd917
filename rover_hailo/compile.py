"""Compile a network of this kit for one chip, and pack what the rover loads.

    python3 compile.py hailo8 backbone                     # parse, quantize, emulate, compile, pack
    python3 compile.py hailo8 backbone --hef mine.hef      # only pack a HEF that was compiled otherwise

It runs where Hailo's Dataflow Compiler is installed: on x86-64 Linux, version 3.x for Hailo-8 and 8L, 5.x for
Hailo-10H. It is a kit's compile.py, and needs nothing else of the project.

Nobody who wrote this had that compiler. It makes the same calls as Hailo's tutorials and model zoo. If the compiler
names a layer differently from what this kit expects, it stops and says what the name is.
"""

import argparse
import importlib.metadata
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

MOST = 3.0  # if the emulator's error is more than this many times that of ONNX Runtime's INT8, a warning is printed


def main() -> None:
    parser = argparse.ArgumentParser(description="Compile a network of this kit for a chip, and pack it.")
    parser.add_argument("chip", choices=["hailo8", "hailo8l", "hailo10h"])
    parser.add_argument("network", choices=["backbone", "whole"])
    parser.add_argument("--hef", type=Path, help="do not compile: pack this one")
    given = parser.parse_args()
    kit = Path(__file__).resolve().parent
    if given.hef and not given.hef.is_file():
        raise SystemExit(f"{given.hef}: no such file")
    hef = given.hef or compile_network(kit, given.chip, given.network)
    print(f"{pack(kit, given.chip, given.network, hef)}: take it to the rover, and run `rover doctor` there")


def compile_network(kit: Path, chip: str, name: str) -> Path:
    """Compile a network and return the path of its HEF. The archive of each step is kept beside it.

    If something does not fit, the program ends with a sentence that says what.
    """
    network = json.loads((kit / "kit.json").read_text())["networks"][name]
    _check_compiler(network["compilers"][chip])
    from hailo_sdk_client import ClientRunner

    runner = ClientRunner(hw_arch=chip)
    runner.translate_onnx_model(
        str(kit / network["onnx"]),
        name,
        start_node_names=list(network["inputs"]),
        end_node_names=network["end_nodes"],
        net_input_shapes={key: part["shape"] for key, part in network["inputs"].items()},
    )
    runner.save_har(str(kit / f"{name}_{chip}_parsed.har"))
    layers = runner.get_hn_dict()["layers"]
    _check_layers(layers, network)

    runner.load_model_script(str(kit / f"{name}_{chip}.alls"))
    inputs = {key: _layer_of(layers, key) for key in network["inputs"]}
    data = {inputs[key]: np.load(kit / part["calibration"], mmap_mode="r") for key, part in network["inputs"].items()}
    runner.optimize(data if len(data) > 1 else next(iter(data.values())))
    runner.save_har(str(kit / f"{name}_{chip}_quantized.har"))
    _emulate(runner, kit, name, inputs, network["stand_in_error"])

    hef = kit / f"{name}_{chip}.hef"
    hef.write_bytes(runner.compile())
    runner.save_har(str(kit / f"{name}_{chip}_compiled.har"))
    return hef


def pack(kit: Path, chip: str, name: str, hef: Path) -> Path:
    """Pack the artifact for the rover: the HEF, what runs after it on the CPU, the manifest and the parity vectors."""
    content = json.loads((kit / "kit.json").read_text())
    network = content["networks"][name]
    manifest = content["manifest"] | {
        "hailo": network["runs"] | {"chip": chip, "network": name},
        "parity": content["manifest"]["parity"] | {"tolerance": network["tolerance"]},
        "weights_mb": network["weights_mb"],
    }
    path = kit / f"policy_{name}_{chip}.hailo.zip"
    new = path.with_name(f".{path.name}.new")  # so that an earlier artifact stays until this one is complete
    with zipfile.ZipFile(new, "w", zipfile.ZIP_STORED) as z:
        z.writestr("archive/extra/manifest.json", json.dumps(manifest, sort_keys=True, indent=1))
        z.write(kit / "parity.npz", "archive/extra/parity.npz")
        z.write(hef, "archive/network.hef")
        if network["cpu"]:
            z.write(kit / network["cpu"], "archive/model.onnx")
    return new.replace(path)


def _check_compiler(major: str) -> None:
    try:
        found = importlib.metadata.version("hailo_dataflow_compiler")
    except importlib.metadata.PackageNotFoundError:
        raise SystemExit("Hailo's Dataflow Compiler is not installed in this Python; see docs/hailo.md") from None
    if found.split(".")[0] != major:
        raise SystemExit(f"this chip wants the Dataflow Compiler {major}.x, here is {found}; use another environment")


def _layer_of(layers: dict[str, Any], original: str) -> str:
    """Return the compiler's name for the layer that the ONNX file calls `original`."""
    names = [name for name, layer in layers.items() if original in layer.get("original_names", [])]
    names = [n for n in names if layers[n].get("type") == "input_layer"] or names
    if not names:
        raise SystemExit(f"the parser kept no layer of '{original}'; its layers are {', '.join(layers)}")
    return names[0]


def _check_layers(layers: dict[str, Any], network: dict[str, Any]) -> None:
    """Stop unless the compiler names the layers as the model script does.

    With other names, the script would silently change the quantization of the wrong layers.
    """
    wrong = []
    for original, expected in network["script_names"].items():
        found = _layer_of(layers, original)
        if found.split("/")[-1] != expected:
            wrong.append(f"{expected} is to be '{original}', which is {found} here")
    if wrong:
        raise SystemExit(
            "write these names into the .alls file, and into kit.json's script_names:\n" + "\n".join(wrong)
        )


def _emulate(runner: Any, kit: Path, name: str, inputs: dict[str, str], yardstick: float) -> None:
    """Print how far the quantized network is from FP32 on recorded frames, and how far ONNX Runtime's INT8 was."""
    from hailo_sdk_client import InferenceContext

    with np.load(kit / f"expected_{name}.npz") as vectors:
        given = {inputs[key]: vectors[key] for key in inputs}
        expected = [vectors[key] for key in vectors.files if key not in inputs]
    with runner.infer_context(InferenceContext.SDK_QUANTIZED) as context:
        answers = runner.infer(context, given if len(given) > 1 else next(iter(given.values())))
    answers = answers if isinstance(answers, (list, tuple)) else [answers]
    for answer, wanted in zip(answers, expected, strict=True):
        error = float(np.linalg.norm(np.ravel(answer) - np.ravel(wanted)) / np.linalg.norm(wanted))
        print(f"{name}: emulated, its answers differ from FP32 by {error:.1%}; ONNX Runtime's INT8 by {yardstick:.1%}")
        if not error <= MOST * yardstick:
            print(f"{name}: that is more than {MOST:g} times as far; before compiling for an hour, look why")


if __name__ == "__main__":
    main()
