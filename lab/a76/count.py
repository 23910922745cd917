"""Count the instructions that an artifact executes in the emulated Pi, in one thread, with rover_lib.onboard alone."""

import json
import tempfile
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock
from typing import Any, TypeVar

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
Name = TypeVar("Name", bound=Hashable)


def onnxruntime_there() -> Path:
    """Return a folder with the packages of a Pi without torch, for the emulated Pi, from the cache or fetched now."""
    wheels = REQUIREMENTS["onnxruntime"]

    def make(folder: Path) -> None:
        fetch_wheels(folder, "--require-hashes", *FOR_GUEST, "--requirement", wheels)

    return cache_folder("arm-onnxruntime", key_of({"for": FOR_GUEST}, wheels), make)


def guest_of(artifact: Path) -> Guest:
    """Return what runs one of our artifacts: always the same script, with packages for the manifest's engine."""
    is_onnx = read_manifest(artifact)["engine"] == engines.ONNXRUNTIME
    return Guest(packages=onnxruntime_there()) if is_onnx else OURS


@dataclass(frozen=True, eq=False)
class Counted:
    """What an artifact executed in the emulated Pi.

    inferences[0] is the first after loading. chunks: (n, C, A) float32.
    """

    load: int  # instructions of load_policy: integrity check, unpacking, parity vectors
    inferences: tuple[int, ...]  # instructions of each
    simd: int  # SIMD instructions of the steady inference
    sdot: int  # SDOT instructions of the steady inference
    cycles: float  # of the steady inference, see Emulation, as are
    near_lines: int
    far_lines: int
    kernels: dict[str, tuple[int, int, int]]  # (instructions, SIMD, SDOT) of the steady inference by function
    peak_mb: float
    peak_loading_mb: float
    emulator_mb: float
    chunks: np.ndarray
    versions: dict[str, Any]

    @property
    def steady(self) -> int:
        """Instructions of the STEADY-th inference."""
        return self.inferences[STEADY - 1]


def write_observations(path: Path, samples: Sequence[Any]) -> Path:
    """Write what a policy shall see for the guest: `state` (n, S) float32 and `frame_0000`, ... (h, w, 3) uint8 BGR.

    If there are several cameras, each has its own frames: `frame_0000.<camera>`, ...
    """
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
    on_step: Callable[[], None] = lambda: None,
    stop: Event | None = None,
) -> Counted:
    """Load an artifact in the emulated Pi, predict each sample, and count the first `counted` inferences one by one.

    samples: have frame_bgr() and state. If there are fewer than `counted`, which must be at least STEADY, they are
    repeated from the first. on_step: called after each inference. stop: ends the count when set. Raises RoverError with
    the last lines that the guest printed, if it fails.
    """
    with tempfile.TemporaryDirectory(prefix="rover-arm-") as scratch:
        folder = Path(scratch)
        observations = write_observations(folder / "observations.npz", samples)
        before = ""

        def on_line(line: str) -> None:
            nonlocal before
            if before == "predict":  # a step has ended when the next one begins
                on_step()
            before = line

        given = [Path(artifact).resolve(), observations, folder, counted, *guest.arguments]
        options: dict[str, Any] = {"packages": guest.packages, "on_line": on_line, "stop": stop}
        options["watch"] = f"memory={STEADY}"
        done = emulate_script(core, guest.script, given, folder, **options)
        return Counted(
            load=done.total(0),
            inferences=tuple(done.total(i) for i in range(1, counted + 1)),
            simd=done.total(STEADY, "simd"),
            sdot=done.total(STEADY, "sdot"),
            cycles=done.cycles(STEADY),
            near_lines=done.near_lines(STEADY),
            far_lines=done.far_lines(STEADY),
            kernels=by_kernel(done.sections[STEADY], GuestFunctions((folder / "maps").read_text())),
            peak_mb=done.peak_mb["predict"],
            peak_loading_mb=done.peak_mb["load"],
            emulator_mb=done.emulator_mb,
            chunks=np.load(folder / "chunks.npy"),
            versions=json.loads((folder / "versions.json").read_text()),
        )


def side_by_side(
    counts: Mapping[Name, Callable[..., Counted]], inferences: int, what: str, jobs: int, progress: Progress
) -> dict[Name, Counted]:
    """Count in several emulated machines, `jobs` at a time: a count does not depend on what else is running.

    counts: functions by name, each called with on_step and stop (see `count_artifact`). If one fails, the others end.
    inferences: how many all of them have together, for the progress bar. what: the bar's label.
    """
    bar = iter(progress(range(inferences), desc=what, total=inferences))
    one_at_a_time, stop = Lock(), Event()

    def on_step() -> None:
        with one_at_a_time:
            next(bar, None)

    with ThreadPoolExecutor(min(jobs, len(counts))) as pool:
        started = {name: pool.submit(count, on_step=on_step, stop=stop) for name, count in counts.items()}
        try:
            for future in as_completed(started.values()):
                future.result()
        finally:
            stop.set()  # if one failed, or the user interrupts, the others end
            pool.shutdown(cancel_futures=True)
    next(bar, None)
    return {name: future.result() for name, future in started.items()}
