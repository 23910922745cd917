"""Kill what writes files at random moments, and fill its disk: `python -m lab kills OUTPUT`.

Nothing may be half-written, finished work stays, and of a recording at most the last second is lost. Each attempt is a
fork of this process, which has imported everything, so that a kill may come at any moment of the work itself.
"""

import contextlib
import mmap
import os
import random
import shutil
import signal
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.cli import main
from rover_lib.onboard.errors import EpisodeError, RoverError
from rover_lib.onboard.recording.episode import About, EpisodeWriter, find_killed, finish_killed
from rover_lib.workshop.recordings.episodes import load_recordings

ROWS, ROW_S = 90, 0.01
DISK_BYTES = (100_000, 3_000_000)


@dataclass(frozen=True)
class Work:
    """What is killed. do: does it, in a folder, and notes its progress. check: says what is wrong afterwards, or ""."""

    name: str
    do: Callable[[Path, Path, mmap.mmap], None]
    check: Callable[[Path, Path, int], str]


def _record(inputs: Path, folder: Path, progress: mmap.mmap) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (36, 64, 3), np.uint8)
    with EpisodeWriter(folder / "episode_1", About("killed"), resolution=None, flags=True) as writer:
        for i in range(ROWS):
            writer.control(100 + i * ROW_S, 10 * i, 1500, 136, 21308, 1016)
            writer.frame(100 + i * ROW_S, picture)
            struct.pack_into("q", progress, 0, i + 1)
            time.sleep(ROW_S)


def _check_recording(inputs: Path, folder: Path, count: int) -> str:
    try:
        for part in find_killed(folder):
            finish_killed(part)
    except EpisodeError as error:
        for part in find_killed(folder):  # as its sentence says
            shutil.rmtree(part)
        return "" if count <= 1 else f"{count} rows were written: {error}"
    if not (folder / "episode_1").exists():
        return "" if not count else f"{count} rows were written, and there is no episode"
    kept = load_recordings(folder, chunk=1).episodes[0].controls
    return "" if kept >= count - 1 else f"{count} rows were written, and {kept} are left"


def _export(inputs: Path, folder: Path, progress: mmap.mmap) -> None:
    main(["export-dataset", str(inputs), str(folder / "dataset")], standalone_mode=False)


def _check_export(inputs: Path, folder: Path, count: int) -> str:
    out = folder / "dataset"
    with contextlib.suppress(RoverError):
        if not out.exists() or len(load_recordings(out, chunk=4).episodes) == len(load_recordings(inputs).episodes):
            return ""
    return f"a dataset that is not whole: {sorted(p.name for p in out.rglob('*'))}"


WORKS = (Work("record", _record, _check_recording), Work("export-dataset", _export, _check_export))


def kill_randomly(work: Work, inputs: Path, times: int, seed: int = 0) -> dict[str, Any]:
    """Kill the work at random moments, each in a folder of its own, check it and then do it to the end.

    Returns the counts, and in `wrong` a sentence for each attempt that lost something.
    """
    rng, wrong = random.Random(seed), []
    begin = time.monotonic()
    with _folder() as folder:
        if code := _attempt(work, inputs, folder, None)[0]:
            raise RoverError(f"{work.name} ends with {code} although nobody killed it")
    whole_s, killed = time.monotonic() - begin, 0
    for i in range(times):
        with _folder() as folder:
            after_s = rng.uniform(0, whole_s)
            code, count = _attempt(work, inputs, folder, after_s)
            killed += code == -signal.SIGKILL
            what = work.check(inputs, folder, count)
            shutil.rmtree(folder / "episode_1", ignore_errors=True)
            shutil.rmtree(folder / "dataset", ignore_errors=True)
            if not what and (again := _attempt(work, inputs, folder, None)[0]):
                what = f"the next one ends with {again}"
            wrong += [f"{i}, killed after {after_s:.2f} s: {what}"] if what else []
    return {"attempts": times, "killed": killed, "wrong": wrong}


def fill_randomly(work: Work, inputs: Path, times: int, seed: int = 0) -> dict[str, Any]:
    """Do the work on small disks, for which root mounts them, and check what is there when they are full."""
    rng, wrong, full = random.Random(seed), [], 0
    for i in range(times):
        with _folder() as folder:
            size = rng.randint(*DISK_BYTES)
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
            try:
                code, count = _attempt(work, inputs, folder, None)
                full += code != 0
                halves = [p for p in folder.glob("[!.]*") if code and p.is_dir()]
                if halves or code not in (0, 1):
                    wrong.append(f"{i}, a disk of {size} bytes: ended with {code}, left {halves}, after {count} rows")
            finally:
                subprocess.run(["umount", "--lazy", folder], check=True)
    return {"attempts": times, "full": full, "wrong": wrong}


def _attempt(work: Work, inputs: Path, folder: Path, kill_after_s: float | None) -> tuple[int, int]:
    """Do the work in a fork; return its exit code, 1 for a sentence and 2 for any other error, and its progress."""
    progress = mmap.mmap(-1, 8)
    if not (child := os.fork()):
        code = 2
        try:
            with open(os.devnull, "w") as nothing:  # noqa: PTH123  # its descriptors are wanted
                os.dup2(nothing.fileno(), 1), os.dup2(nothing.fileno(), 2)
            work.do(inputs, folder, progress)
            code = 0
        except (RoverError, SystemExit):
            code = 1
        finally:
            os._exit(code)
    if kill_after_s is not None:
        time.sleep(kill_after_s)
        os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return code, struct.unpack_from("q", progress)[0]


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="rover-kills-") as folder:
        yield Path(folder)


def make_inputs(folder: Path) -> Path:
    """Record two short episodes to work on."""
    picture = np.random.default_rng(0)
    for name in ("episode_1", "episode_2"):
        with EpisodeWriter(folder / name, About("made"), resolution=(64, 36)) as writer:
            for i in range(12):
                writer.control(100 + i / 30, 33 * i, 1500, 136, 21308, 1016)
                writer.frame(100 + i / 30, picture.integers(0, 255, (36, 64, 3), np.uint8))
    return folder
