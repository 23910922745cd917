"""Count the instructions that an artifact executes in the emulated Pi, in one thread, with rover_lib.onboard alone."""

import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from lab.a76.core import FOR_GUEST, GUEST, Core, emulate_script, fetch_wheels
from lab.a76.symbols import GuestFunctions, by_kernel
from rover_lib.onboard.artifact import engines
from rover_lib.onboard.artifact.manifest import read_manifest
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.progress import Progress
from rover_lib.workshop.wheelhouse import REQUIREMENTS

COUNTED = 10  # how many inferences after loading are counted, each by itself
STEADY = 3  # the number of the first inference whose count is that of all later ones too


@dataclass(frozen=True)
class Guest:
    """A script that runs an artifact in the emulated Pi. It takes guest/predict.py's arguments and leaves its files."""

    script: Path = GUEST / "predict.py"
    arguments: tuple[object, ...] = ()  # further arguments, after those of guest/predict.py
    packages: Path | None = None  # come before the Pi's own on the path


OURS = Guest()


def guest_of(artifact: Path) -> Guest:
    """Return what runs one of our artifacts. One for ONNX Runtime gets the packages of a Pi without torch."""
    if read_manifest(artifact)["engine"] != engines.ONNXRUNTIME:
        return OURS
    wheels = REQUIREMENTS["onnxruntime"]

    def make(folder: Path) -> None:
        fetch_wheels(folder, "--require-hashes", *FOR_GUEST, "--requirement", wheels)

    return Guest(packages=cache_folder("arm-onnxruntime", key_of({"for": FOR_GUEST}, wheels), make))


@dataclass(frozen=True, eq=False)
class Counted:
    """What an artifact executed in the emulated Pi.

    inferences[0] is the first after loading. chunks: (n, C, A) float32.
    """

    load: int  # instructions of load_policy: integrity check, unpacking, parity vectors
    inferences: tuple[int, ...]  # instructions of each
    sdot: int  # SDOT instructions of the steady inference
    work: dict[str, float]  # of the steady inference: simd, cycles, near_lines and far_lines, see Emulation
    kernels: dict[str, tuple[int, int]]  # (instructions, SDOT) of the steady inference by function
    peak_mb: float
    peak_loading_mb: float
    chunks: np.ndarray
    versions: dict[str, Any]

    @property
    def steady(self) -> int:
        """Instructions of the STEADY-th inference."""
        return self.inferences[STEADY - 1]


def write_observations(path: Path, samples: Sequence[Any]) -> Path:
    """Write what a policy shall see, as guest/inferences.predict_all reads it."""
    frames: dict[str, Any] = {}
    for i, sample in enumerate(samples):
        seen = sample.frame_bgr()
        by_name = {f".{camera}": frame for camera, frame in seen.items()} if isinstance(seen, Mapping) else {"": seen}
        frames |= {f"frame_{i:04d}{name}": frame for name, frame in by_name.items()}
    np.savez(path, state=np.stack([s.state for s in samples]).astype(np.float32), **frames)
    return path


def count_artifact(
    core: Core,
    artifact: Path | str,
    samples: Sequence[Any],
    *,
    guest: Guest = OURS,
    counted: int = COUNTED,
    on_line: Callable[[str], None] = lambda line: None,
) -> Counted:
    """Load an artifact in the emulated Pi, predict each sample, and count the first `counted` inferences one by one.

    samples: have frame_bgr() and state; if there are fewer than `counted`, at least STEADY, they are repeated. on_line:
    called with each line that the guest prints. Raises RoverError if it fails.
    """
    with tempfile.TemporaryDirectory(prefix="rover-arm-") as scratch:
        folder = Path(scratch)
        observations = write_observations(folder / "observations.npz", samples)
        given = [Path(artifact).resolve(), observations, folder, counted, *guest.arguments]
        watch = f"memory={STEADY}"
        done = emulate_script(core, guest.script, given, folder, guest.packages, on_line=on_line, watch=watch)
        work = {"simd": done.total(STEADY, "simd"), "cycles": done.cycles(STEADY)}
        work["near_lines"], work["far_lines"] = done.lines(STEADY)
        return Counted(
            load=done.total(0),
            inferences=tuple(done.total(i) for i in range(1, counted + 1)),
            sdot=done.total(STEADY, "sdot"),
            work=work,
            kernels=by_kernel(done.sections[STEADY], GuestFunctions((folder / "maps").read_text())),
            peak_mb=done.peak_mb["predict"],
            peak_loading_mb=done.peak_mb["load"],
            chunks=np.load(folder / "chunks.npy"),
            versions=json.loads((folder / "versions.json").read_text()),
        )


def side_by_side(
    counts: Mapping[str, Callable[..., Counted]], inferences: int, what: str, progress: Progress
) -> dict[str, Counted]:
    """Count in several emulated machines, one for each of this machine's cores at a time.

    counts: functions by name, each called with on_line. inferences, what: all of them, and a label, for the bar.
    """
    bar = iter(progress(range(inferences), desc=what, total=inferences))
    one_at_a_time = Lock()

    def on_line(line: str) -> None:
        if line == "predict":
            with one_at_a_time:
                next(bar, None)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        started = {name: pool.submit(count, on_line=on_line) for name, count in counts.items()}
        try:
            return {name: future.result() for name, future in started.items()}
        finally:
            pool.shutdown(cancel_futures=True)  # if one failed, those that run end, and no more begin
