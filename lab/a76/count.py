"""Count the instructions that an artifact executes in the emulated Pi, in one thread, with rover_lib.onboard alone."""

import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lab.a76.core import FOR_GUEST, Core, Emulation, emulate_artifact, fetch_wheels
from lab.a76.report import alone_of
from lab.a76.symbols import GuestFunctions, by_kernel
from rover_lib.onboard.artifact import engines
from rover_lib.onboard.artifact.manifest import read_manifest
from rover_lib.onboard.care.pi5 import DRIVING, Work, predict_ms
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.progress import Progress
from rover_lib.workshop.wheelhouse import REQUIREMENTS

COUNTED = 10  # how many inferences after loading are counted, each by itself
STEADY = 3  # the number of the first inference whose count is that of all later ones too
SDOT_MACS = 16  # multiply-accumulates of one SDOT; the floor is the count if nothing but SDOT ran


def packages_of(artifact: Path) -> Path | None:
    """Return what comes before the Pi's own packages: for an ONNX Runtime artifact, those of a Pi without torch."""
    if read_manifest(artifact)["engine"] != engines.ONNXRUNTIME:
        return None
    wheels = REQUIREMENTS["onnxruntime"]
    key = key_of({"for": FOR_GUEST}, wheels)
    return cache_folder("arm-onnxruntime", key, lambda folder: fetch_wheels(folder, wheels))


class Counted(NamedTuple):
    """What an artifact did in the emulated Pi. row: its part of arm.json. chunks: (n, C, A) float32."""

    row: dict[str, Any]
    chunks: np.ndarray


def count_artifact(
    core: Core,
    artifact: Path,
    manifest: dict[str, Any],
    samples: Sequence[Any],
    *,
    packages: Path | None = None,
    counted: int = COUNTED,
) -> Counted:
    """Load an artifact in the emulated Pi, predict each sample, and count the first `counted` inferences one by one.

    samples: have frame_bgr() and state; if there are fewer than `counted`, at least STEADY, they are repeated.
    packages: of packages_of(). Raises RoverError if it fails.
    """
    with tempfile.TemporaryDirectory(prefix="rover-arm-") as scratch:
        folder, observations = Path(scratch), Path(scratch) / "observations.npz"  # which guest/predict.py explains
        frames: dict[str, Any] = {f"frame_{i:04d}": sample.frame_bgr() for i, sample in enumerate(samples)}
        np.savez(observations, state=np.stack([s.state for s in samples]).astype(np.float32), **frames)
        given = [artifact.resolve(), observations, folder, counted]
        done = emulate_artifact(core, given, folder, packages, f"memory={STEADY}")
        return Counted(_row(done, folder, counted, manifest), np.load(folder / "chunks.npy"))


def _row(done: Emulation, folder: Path, counted: int, manifest: dict[str, Any]) -> dict[str, Any]:
    """Return an artifact's part of arm.json; _g are 10**9 instructions. The floor is SDOT alone, for every mode."""
    kernels = by_kernel(done.sections[STEADY], GuestFunctions((folder / "maps").read_text()))
    kernels_g = {name: instructions / 1e9 for name, instructions in kernels.items()}
    inferences_g = [done.total(i) / 1e9 for i in range(1, counted + 1)]
    counts: dict[str, float] = {"instructions": done.total(STEADY), "sdot": done.total(STEADY, "sdot")}
    counts |= {"simd": done.total(STEADY, "simd"), "cycles": done.cycles(STEADY)}
    counts["near_lines"], counts["far_lines"] = done.lines(STEADY)
    work = {f"{name}_g": count / 1e9 for name, count in counts.items()} | {"alone": alone_of(kernels_g)}
    floor_g = manifest["gmac"] / SDOT_MACS
    versions = json.loads((folder / "versions.json").read_text())
    return work | {
        "floor_g": floor_g,
        "x_floor": work["instructions_g"] / floor_g,
        "first_g": inferences_g[0],
        "second_g": inferences_g[1],
        "tenth_g": inferences_g[9] if counted >= COUNTED else None,
        "familiar_g": done.total(counted + 1) / 1e9 if "familiar" in manifest else None,
        "load_instructions_g": done.total(0) / 1e9,
        "gmac": manifest["gmac"],
        "image_height": manifest["cameras"][0]["height"],
        "image_width": manifest["cameras"][0]["width"],
        "instructions_by_kernel": kernels_g,
        "peak_memory_mb": done.peak_mb["predict"],
        "peak_memory_loading_mb": done.peak_mb["load"],
        "threads": versions["threads"],
        "versions": versions,
        "computed_pi5_ms": predict_ms(Work.of(work))._asdict() | {"threads": DRIVING},
    }


def side_by_side(counts: Mapping[str, Callable[[], Counted]], progress: Progress) -> dict[str, Counted]:
    """Count in several emulated machines, one for each of this machine's cores at a time."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        started = {name: pool.submit(count) for name, count in counts.items()}
        try:
            watched = progress(started, desc="artifacts, emulated", total=len(started))
            return {name: started[name].result() for name in watched}
        finally:
            pool.shutdown(cancel_futures=True)  # if one failed, those that run end, and no more begin
