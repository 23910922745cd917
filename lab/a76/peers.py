"""Count what other engines execute for the same policy on the same emulated Cortex-A76.

    count_peers("runs/full")      # adds metrics.peers to runs/full/arm.json, which count_run.count_run has written

Each engine quantizes the float policy with its own tools, on the frames that calibrated ours. Its packages are pinned
here and come before ours on Python's path; they are never installed.
"""

import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lab.a76.core import FOR_GUEST, GUEST, fetch_wheels, prepare
from lab.a76.count import Counted, Guest, count_artifact, side_by_side
from lab.a76.count_run import REFERENCE, chunks_here, errors_pct
from lab.debian import install_packages, missing_packages
from rover_lib.onboard.artifact.manifest import car_of, read_manifest
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.policy.load import action_limits
from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.onboard.stage import atomic_path, read_stage, sha256_of, write_stage
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import Sample, choose_calibration
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.session import open_run
from rover_lib.workshop.run_program import run

FOLDER = GUEST / "peers"
SHIM = FOLDER / "executorch.cpp"
COMPILER = "aarch64-linux-gnu-g++"
NEEDS = {COMPILER: "g++-aarch64-linux-gnu"}  # the Debian package of a command
FRAMES = 20  # how many judge a peer; its error only has to show that it computes the same policy


@dataclass(frozen=True)
class Engine:
    """Another engine: its files' suffix, and the packages that it needs before ours; in the emulated Pi only the first.

    FOLDER/make_<name>.py runs its tools. Dependencies such as numpy are not listed, as our own packages have them.
    """

    name: str
    suffix: str
    packages: tuple[str, ...]


ONNX_PACKAGES = ("onnx==1.23.2", "ml-dtypes==0.6.0", "protobuf==7.36.2", "flatbuffers==25.12.19")
ONNXRUNTIME = Engine("onnxruntime", ".onnx", ("onnxruntime==1.31.1", *ONNX_PACKAGES))
# This torch is the newest that runs on the CUDA libraries of our torch 2.8, but for one.
EXECUTORCH_PACKAGES = ("torchao==0.18.0", "torch==2.10.0", "nvidia-nvshmem-cu12==3.4.5; platform_machine == 'x86_64'")
BESIDE = (
    "flatbuffers==25.12.19",
    "ruamel.yaml==0.19.1",
    "tabulate==0.10.0",
    "expecttest==0.3.0",
    "parameterized==0.9.0",
)
EXECUTORCH = Engine("executorch", ".pte", ("executorch==1.5.1", *EXECUTORCH_PACKAGES, *BESIDE))
ENGINES = (ONNXRUNTIME, EXECUTORCH)


def packages_of(engine: Engine, there: bool) -> Path:
    """Return the folder of an engine's packages for this machine or the emulated Pi, from the cache or fetched now.

    For ExecuTorch there, it includes our compiled caller of its C++ runtime.
    """
    wanted, where = (engine.packages[:1], FOR_GUEST) if there else (engine.packages, ("--python", sys.executable))
    made = {"packages": wanted, "for": where if there else [sys.version_info[:2], os.uname().machine]}
    compiled = [SHIM] if there and engine is EXECUTORCH else []

    def make(folder: Path) -> None:
        fetch_wheels(folder, *where, *wanted)
        if compiled:
            _compile(folder)

    return cache_folder(f"peer-{engine.name}", key_of(made, *compiled), make)


def _compile(folder: Path) -> None:
    """Compile policy.so from executorch.cpp, as ExecuTorch's own CMake package would compile and link it."""
    install_packages(missing_packages(NEEDS), "ExecuTorch")
    sdk = folder / "executorch"
    command = [COMPILER, "-std=c++17", "-O2", "-Wall", "-shared", "-fPIC", "-o", folder / "policy.so", SHIM]
    command += ["-DC10_USING_CUSTOM_GENERATED_MACROS", "-DET_EVENT_TRACER_ENABLED", "-isystem", sdk / "include"]
    command += ["-isystem", sdk / "include" / "executorch" / "runtime" / "core" / "portable_type" / "c10"]
    command += ["-L", sdk / "lib", "-Wl,-rpath,$ORIGIN/executorch/lib"]
    # Kernels and backends register themselves when they are loaded; nothing refers to them by name.
    libraries = ("", "_backend_xnnpack", "_kernels_optimized", "_kernels_quantized", "_threadpool")
    command += ["-Wl,--no-as-needed", *(f"-lexecutorch{name}" for name in libraries)]
    run(*command, error=RoverError)


def quantize_with(
    engine: Engine, checkpoint: Checkpoint, samples: Sequence[Sample], folder: Path
) -> tuple[Path, dict[str, str]]:
    """Quantize the policy with an engine's own tools into `folder`; return the file and the tools' versions.

    samples: for calibration. Raises RoverError if they fail.
    """
    folder.mkdir(exist_ok=True)
    artifact = folder / f"{engine.name}{engine.suffix}"
    height, width = checkpoint.config.image_sizes[0]
    with tempfile.TemporaryDirectory(prefix="rover-peer-") as scratch, atomic_path(artifact) as temporary:
        calibration = Path(scratch) / "calibration.npz"
        prepared = np.stack([prepare_frame(s.frame_bgr(), height, width) for s in samples])
        np.savez(calibration, state=np.stack([s.state for s in samples]).astype(np.float32), frames=prepared)
        environment = {**os.environ, "PYTHONPATH": str(packages_of(engine, there=False))}
        maker = FOLDER / f"make_{engine.name}.py"
        command = [sys.executable, maker, checkpoint.path.resolve(), calibration, temporary]
        versions = json.loads(run(*command, error=RoverError, env=environment).splitlines()[-1])
    return artifact, versions


def count_peers(run_dir: Path | str, *, progress: Progress = silent) -> dict[str, Any]:
    """Count the peers of a run's static artifact, add them to its arm.json and return the content of that.

    metrics.peers has rows like those of metrics.artifacts, with `file_mb` and `made_with`, the versions of their tools.
    A peer's chunks come from the emulated Pi, the reference from this machine. What the engines make is kept in
    run_dir/peers. Raises RoverError if arm.json is missing, or if a peer cannot be had or run.
    """
    run_dir = Path(run_dir)
    content, reference = read_stage(run_dir / "arm.json", "arm"), run_dir / f"{REFERENCE}.pt"
    again, manifest = open_run(run_dir), read_manifest(reference)
    samples = pick_evenly(again.parts.held_out, FRAMES)
    core = prepare()
    given = read_stage(run_dir / "calibrate.json", "calibrate")["params"]
    calibrating, _ = choose_calibration(again.parts.calibration, given["samples"], given["seed"])
    made, counts = {}, {}
    for engine in progress(ENGINES, desc="peers' quantization", total=len(ENGINES)):
        size, packages = again.checkpoint.config.image_sizes[0], packages_of(engine, there=True)
        guest = Guest(FOLDER / "guest.py", (engine.name, *size), packages)
        made[engine.name] = quantize_with(engine, again.checkpoint, calibrating, run_dir / "peers")
        counts[engine.name] = partial(count_artifact, core, made[engine.name][0], manifest, samples, guest=guest)
    counted = side_by_side(counts, "peers, emulated", progress)
    here = chunks_here(reference, samples, progress)
    ranges = again.recordings.action_range()
    peers, inputs = {}, dict(content["inputs"])
    for name, (path, versions) in made.items():
        about = {"file_mb": path.stat().st_size / 1e6, "made_with": versions}
        peers[name] = peer_metrics(counted[name], manifest, here, ranges) | about
        inputs[f"peers/{path.name}"] = sha256_of(path)
    metrics = content["metrics"] | {"peers": peers}
    return write_stage(run_dir / "arm.json", "arm", params=content["params"], metrics=metrics, inputs=inputs)


def peer_metrics(
    counted: Counted, manifest: dict[str, Any], reference: np.ndarray, ranges: dict[str, tuple[float, float]]
) -> dict[str, Any]:
    """Return one peer's part of arm.json. manifest, reference: our FP32 artifact's, and its chunks, (n, C, A).

    Raises RoverError if the peer's chunks have another shape or are not finite.
    """
    if counted.chunks.shape != reference.shape or not np.isfinite(counted.chunks).all():
        raise RoverError(f"a peer gave no finite actions of {reference.shape}", found=counted.chunks.shape)
    names = manifest["action_names"]
    low, high = action_limits(names, car_of(manifest))
    errors = errors_pct(reference, np.clip(counted.chunks, low, high), names, ranges)  # as predict_chunk clips
    frames = {"frames": len(reference), "frames_on_the_core": len(counted.chunks)}
    return counted.row | errors | {"reference": REFERENCE} | frames
