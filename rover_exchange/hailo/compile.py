"""Compile this kit's network for one chip, and pack what the rover loads.

    python3 compile.py hailo8       # parse, quantize, compile, pack

It needs Hailo's Dataflow Compiler, 3.x for Hailo-8 and 8L, 5.x for Hailo-10H, and nothing else of the project. Nobody
who wrote this had that compiler. It makes the same calls as Hailo's tutorials and model zoo.
"""

import argparse
import json
import zipfile
from pathlib import Path

import numpy as np

CHIPS = ("hailo8", "hailo8l", "hailo10h")
NAME = "backbone"  # of the network


def main() -> None:
    parser = argparse.ArgumentParser(description="Compile this kit's network for a chip, and pack it.")
    parser.add_argument("chip", choices=CHIPS)
    chip, kit = parser.parse_args().chip, Path(__file__).resolve().parent
    print(f"{pack(kit, chip, compile_network(kit, chip))}: take it to the rover, and run `rover doctor` there")


def compile_network(kit: Path, chip: str) -> Path:
    """Compile the network and return the path of its HEF."""
    from hailo_sdk_client import ClientRunner

    network = json.loads((kit / "kit.json").read_text())
    runner = ClientRunner(hw_arch=chip)
    runner.translate_onnx_model(
        str(kit / f"{NAME}.onnx"),
        NAME,
        start_node_names=[network["input"]],
        end_node_names=[network["end"]],
        net_input_shapes={network["input"]: network["shape"]},
    )
    runner.load_model_script(str(kit / f"{NAME}.alls"))
    runner.optimize(np.load(kit / f"calibration_{network['input']}.npy", mmap_mode="r"))
    runner.save_har(str(kit / f"{NAME}_{chip}.har"))
    hef = kit / f"{NAME}_{chip}.hef"
    hef.write_bytes(runner.compile())
    return hef


def pack(kit: Path, chip: str, hef: Path) -> Path:
    """Pack the artifact for the rover: the HEF, what runs after it on the CPU, the manifest and the parity vectors."""
    manifest = json.loads((kit / "kit.json").read_text())["manifest"]
    manifest["hailo"]["chip"] = chip
    path = kit / f"policy_{NAME}_{chip}.hailo.zip"
    new = path.with_name(f".{path.name}.new")  # so that an earlier artifact stays until this one is complete
    with zipfile.ZipFile(new, "w", zipfile.ZIP_STORED) as z:
        z.writestr("archive/extra/manifest.json", json.dumps(manifest, sort_keys=True, indent=1))
        z.write(kit / "parity.npz", "archive/extra/parity.npz")
        z.write(hef, "archive/network.hef")
        z.write(kit / "transformer.onnx", "archive/model.onnx")
    return new.replace(path)


if __name__ == "__main__":
    main()
