"""Instructions that an artifact executes in the emulated Pi, in one thread and by rover_lib.onboard alone."""

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
from rover_lib.onboard import engines
from rover_lib.onboard.artifact import read_manifest
from rover_lib.workshop.cache import cached_folder, key_of
from rover_lib.workshop.progress import Progress
from rover_lib.workshop.wheelhouse import REQUIREMENTS

COUNTED = 10  # inferences after loading, each for itself
STEADY = 3  # the first whose count is what all later ones cost


@dataclass(frozen=True)
class Guest:
    """A script that runs an artifact in the emulated Pi: it is told, and leaves, what guest/predict.py is and does."""

    script: Path = GUEST / "predict.py"
    arguments: tuple[object, ...] = ()  # after those
    packages: Path | None = None  # laid before the Pi's own


OURS = Guest()
Name = TypeVar("Name", bound=Hashable)


def onnxruntime_there() -> Path:
    """The folder of what a Pi without torch installs, for the emulated one: from the cache or fetched now."""
    wheels = REQUIREMENTS["onnxruntime"]

    def make(folder: Path) -> None:
        fetch_wheels(folder, "--require-hashes", *FOR_GUEST, "--requirement", wheels)

    return cached_folder("arm-onnxruntime", key_of({"for": FOR_GUEST}, wheels), make)


def guest_of(artifact: Path) -> Guest:
    """What runs an artifact of ours: the same script, with the engine that its manifest names."""
    is_onnx = read_manifest(artifact)["engine"] == engines.ONNXRUNTIME
    return Guest(packages=onnxruntime_there()) if is_onnx else OURS


@dataclass(frozen=True, eq=False)
class Counted:
    """An artifact in the emulated Pi. inferences[0] is the first after loading; chunks (n, C, A) float32."""

    load: int  # instructions of load_policy: integrity, unpacking, parity vectors
    inferences: tuple[int, ...]
    simd: int  # of the steady inference, as is sdot
    sdot: int
    kernels: dict[str, tuple[int, int, int]]  # its (instructions, SIMD, SDOT) by function
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
    """What a policy shall see, where the guest can read it: `state` (n, S) float32, `frame_0000`... (h, w, 3) BGR.

    Of several cameras `frame_0000.<camera>`, ... each.
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

    samples: with frame_bgr() and state; the first ones come again if there are fewer than `counted`, which is at
    least STEADY. on_step: told after each inference. stop: ends it when set. Raises CountError with the guest's last
    words, if it fails there.
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
        done = emulate_script(core, guest.script, given, folder, **options)
        return Counted(
            load=done.total(0),
            inferences=tuple(done.total(i) for i in range(1, counted + 1)),
            simd=done.total(STEADY, "simd"),
            sdot=done.total(STEADY, "sdot"),
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
    """Count in several emulated machines, `jobs` at a time: a count does not depend on who else is running.

    counts: by name, each called with on_step and stop (see `count_artifact`); the others end when one fails.
    inferences: of all of them together, for the bar; what: their name there.
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
            stop.set()  # when one failed, or the user does not want to wait
            pool.shutdown(cancel_futures=True)
    next(bar, None)
    return {name: future.result() for name, future in started.items()}
