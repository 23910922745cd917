"""Kill what writes files at random moments, fill its disk, and do it twice at once: `python -m lab kills OUTPUT`.

Nothing may be half-written, finished work stays, and of a recording at most the last second is lost. Each attempt is a
fork of this process, which has imported everything, so that a kill may come at any moment of the work itself.
"""

import contextlib
import functools
import hashlib
import json
import math
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

import cv2
import numpy as np
import torch
from pyarrow import parquet

from rover_learn import distill, finetune, train, training
from rover_lib.cli import main
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.errors import EpisodeError, RoverError
from rover_lib.onboard.recording.episode import HUMAN, POLICY, About, EpisodeWriter, find_killed, finish_killed
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.recordings.episodes import load_recordings

ROWS, ROW_S = 90, 0.01
TINY = "--size 64x36 --feedforward 64 --steps 6 --samples 12"


@dataclass(frozen=True)
class Work:
    """What is killed. do: does it, in a folder, and notes its progress. left: what it has made there, None if nothing.

    Raises RoverError or ValueError for what is half-written. lost: says what is missing after so much progress, or "".
    """

    name: str
    do: Callable[[Path, Path, mmap.mmap], None]
    left: Callable[[Path], Any]
    lost: Callable[[Path, int], str] = lambda *_: ""


def _record(inputs: Path, folder: Path, progress: mmap.mmap) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (36, 64, 3), np.uint8)
    with EpisodeWriter(folder / "episode_1", About("killed"), resolution=None, flags=True) as writer:
        for i in range(ROWS):
            writer.control(100 + i * ROW_S, 10 * i, 1500, 136, 21308, 1016)
            writer.frame(100 + i * ROW_S, picture)
            struct.pack_into("q", progress, 0, i + 1)
            time.sleep(ROW_S)


def _lost_rows(folder: Path, count: int) -> str:
    """Finish what was killed, say which rows it lacks, and remove it, as the next recording has the same name."""
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
    shutil.rmtree(folder / "episode_1")
    return "" if kept >= count - 1 else f"{count} rows were written, and {kept} are left"


def _command(name: str, words: str, out: str) -> Work:
    """A command of rover, with {inputs} and {folder} in its words, that makes `out` in the folder."""

    def do(inputs: Path, folder: Path, progress: mmap.mmap) -> None:
        arguments = words.format(inputs=inputs, folder=folder).split()
        if code := main([name, *arguments], standalone_mode=False):  # click returns it
            raise SystemExit(code)

    return Work(name, do, lambda folder: _made(folder / out))


def _made(out: Path) -> dict[str, str] | None:
    """Each file of what was made, with what must be the same however often it was killed; None if nothing is there."""
    if not out.exists():
        return None
    return {
        str(p.relative_to(out)): _content(p) for p in (sorted(out.rglob("*")) if out.is_dir() else [out]) if p.is_file()
    }


def _content(path: Path) -> str:
    if path.suffix == ".pth":
        weights = load_checkpoint(path).weights
        return hashlib.sha256(b"".join(weights[k].numpy().tobytes() for k in sorted(weights))).hexdigest()
    if path.name.startswith("policy_") and path.suffix == ".pt":
        return content_hash(path)
    if path.suffix in (".json", ".ipynb"):
        json.loads(path.read_text())
    elif path.suffix == ".parquet":
        return str(parquet.read_table(path).num_rows)
    return "" if path.stat().st_size else "empty"


WORKS = (
    Work("record", _record, lambda folder: None, _lost_rows),
    _command("export-dataset", "{inputs}/episodes {folder}/dataset", "dataset"),
    _command("import", "{inputs}/tub {folder}/dataset", "dataset"),
    _command("train", "{inputs}/episodes {folder}/ck.pth --steps 8 --device cpu", "ck.pth"),
    _command(
        "distill", "{inputs}/ck.pth {inputs}/episodes --name mine --runs-dir {folder} --device cpu " + TINY, "mine"
    ),
    _command(
        "finetune",
        "{inputs}/ck.pth {inputs}/episodes {inputs}/takeovers --name mine --runs-dir {folder} --device cpu"
        " --steps 6 --samples 12",
        "mine",
    ),
    _command(
        "run", "{inputs}/ck.pth {inputs}/episodes --name mine --runs-dir {folder} --samples 8 --iterations 2", "mine"
    ),
)


def kill_randomly(work: Work, inputs: Path, times: int, seed: int = 0) -> dict[str, Any]:
    """Kill the work `times` times at random moments, again and again in one folder until it ends, then in a new one.

    Returns the counts, and in `wrong` a sentence for each attempt that lost something or ended in another way.
    """
    rng, killed, finished = random.Random(seed), 0, 0
    wrong: list[str] = []
    whole, whole_s, _ = _whole(work, inputs)
    while killed < times and len(wrong) < 5:
        with _folder() as folder:
            code = -signal.SIGKILL
            while code == -signal.SIGKILL:
                after_s = rng.uniform(0, whole_s) if killed < times else None
                code, count = _attempt(work, inputs, folder, after_s)
                killed += code == -signal.SIGKILL
                finished += code == 0
                if what := _wrong(work, folder, whole, code, count):
                    wrong.append(f"{killed}, killed after {after_s} s: {what}")
                    break
    return {"killed": killed, "finished": finished, "wrong": wrong}


def _whole(work: Work, inputs: Path) -> tuple[Any, float, int]:
    """What the work leaves if nobody disturbs it, in which time, and the bytes that it needs."""
    with _folder() as folder:
        begin = time.monotonic()
        if code := _attempt(work, inputs, folder, None)[0]:
            raise RoverError(f"{work.name} ends with {code} although nobody disturbed it")
        whole_s = time.monotonic() - begin
        return work.left(folder), whole_s, sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())


def _wrong(work: Work, folder: Path, whole: Any, code: int, count: int) -> str:
    """Say what an attempt left that is not right, or ""."""
    if code not in (0, 1, -signal.SIGKILL):
        return f"it ended with {code}"
    try:
        left = work.left(folder)
    except (RoverError, ValueError, OSError) as error:
        return f"half-written: {error}"
    if left != whole and (left is not None or code == 0):
        return f"not whole: {sorted(set(left or {}).symmetric_difference(whole)) or 'its content is another'}"
    return work.lost(folder, count)


def fill_randomly(work: Work, inputs: Path, times: int, seed: int = 0) -> dict[str, Any]:
    """Do the work on small disks, for which root mounts them, and check what is there when they are full."""
    rng, wrong, full = random.Random(seed), [], 0
    whole, _, needed = _whole(work, inputs)
    for i in range(times):
        with _folder() as folder:
            size = rng.randint(needed // 20, needed)
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
            try:
                code, _ = _attempt(work, inputs, folder, None)
                full += code != 0
                what = _wrong(work, folder, whole, code, 0)
                wrong += [f"{i}, a disk of {size} bytes: {what}"] if what else []
            finally:
                subprocess.run(["umount", "--lazy", folder], check=True)
    return {"attempts": times, "full": full, "wrong": wrong}


def do_twice(work: Work, inputs: Path, times: int, seed: int = 0) -> dict[str, Any]:
    """Do the work twice at once in one folder: one ends well, the other too or in a sentence."""
    rng, wrong, refused = random.Random(seed), [], 0
    whole, whole_s, _ = _whole(work, inputs)
    for i in range(times):
        with _folder() as folder:
            first, _ = _start(work, inputs, folder)
            time.sleep(rng.uniform(0, whole_s / 2))
            codes = sorted((_attempt(work, inputs, folder, None)[0], _end(first)))
            refused += codes == [0, 1]
            what = f"they ended with {codes}" if codes not in ([0, 0], [0, 1]) else _wrong(work, folder, whole, 0, 0)
            wrong += [f"{i}: {what}"] if what else []
    return {"attempts": times, "refused": refused, "wrong": wrong}


def _start(work: Work, inputs: Path, folder: Path) -> tuple[int, mmap.mmap]:
    """Do the work in a fork, with its cache in the folder. It exits with 1 for a sentence, 2 for any other error."""
    progress = mmap.mmap(-1, 8)
    if not (child := os.fork()):
        code = 2
        try:
            with open(os.devnull, "w") as nothing:  # noqa: PTH123  # its descriptors are wanted
                os.dup2(nothing.fileno(), 1), os.dup2(nothing.fileno(), 2)
            os.environ |= {"ROVER_CACHE": str(folder / ".cache"), "ROVER_AS_ROOT": "1"}
            torch.set_num_threads(1)
            training.SAVING_SHARE = 1e9
            for module in (distill, finetune, train):
                vars(module)["Resumable"] = functools.partial(training.Resumable, every_s=0.0)
            work.do(inputs, folder, progress)
            code = 0
        except RoverError:
            code = 1
        except SystemExit as end:
            code = int(end.code or 0)
        except BaseException as error:
            code = int(getattr(error, "exit_code", 2))  # click's
        finally:
            os._exit(code)
    return child, progress


def _end(child: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _attempt(work: Work, inputs: Path, folder: Path, kill_after_s: float | None) -> tuple[int, int]:
    """Do the work in a fork; return its exit code and its progress."""
    child, progress = _start(work, inputs, folder)
    if kill_after_s is not None:
        end, look = time.monotonic() + kill_after_s, os.WEXITED | os.WNOWAIT | os.WNOHANG
        while time.monotonic() < end and not os.waitid(os.P_PID, child, look):  # it may end long before
            time.sleep(0.005)
        os.kill(child, signal.SIGKILL)
    return _end(child), struct.unpack_from("q", progress)[0]


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="rover-kills-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def make_inputs(folder: Path) -> Path:
    """Make what the commands work on: small episodes, takeovers, a tub, and a policy of a few steps."""
    for kind, drivers in (("episodes", [HUMAN] * 40), ("takeovers", [POLICY] * 8 + [HUMAN] * 32)):
        for drive in range(4):
            _drive(folder / kind / f"episode_{drive}", drivers, drive + 10 * (kind == "takeovers"))
    _tub(folder / "tub")
    maker = _command("train", "{inputs}/episodes {folder}/ck.pth --steps 8 --device cpu", "ck.pth")
    if code := _attempt(maker, folder, folder, None)[0]:
        raise RoverError(f"the policy's training ends with {code}")
    shutil.rmtree(folder / ".cache")
    return folder


def _picture(seed: int, size: tuple[int, int] = (64, 36)) -> np.ndarray:
    return cv2.resize(np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8), size)


def _drive(folder: Path, drivers: list[str], seed: int) -> None:
    with EpisodeWriter(folder, About("made"), resolution=(64, 36)) as writer:
        for i, driver in enumerate(drivers):
            pulses = PwmCalibration().pulses(0.5 * math.sin(4 * i / 30 + seed), 0.05 + 0.04 * math.cos(i / 10 + seed))
            writer.frame(100 + i / 30, _picture(1000 * seed + i))
            writer.control(100.004 + i / 30, 33 * i, pulses.steering_us, pulses.throttle_us, 21316, 1016, driver=driver)


def _tub(folder: Path, count: int = 60) -> None:
    (folder / "images").mkdir(parents=True)
    rows = []
    for i in range(count):
        name = f"{i}_cam_image_array_.jpg"
        cv2.imwrite(str(folder / "images" / name), _picture(i, (160, 120)))
        angle, throttle = 0.8 * math.sin(i / 5), 0.3 * math.cos(i / 7)
        row = {"_index": i, "_session_id": "a", "_timestamp_ms": 1_629_500_000_000 + 50 * i, "cam/image_array": name}
        rows.append(row | {"user/angle": angle, "user/mode": "user", "user/throttle": throttle})
    (folder / "a.catalog").write_text("".join(json.dumps(row) + "\n" for row in rows))
    head: list[Any] = [["cam/image_array", "user/angle", "user/throttle", "user/mode"]]
    head += [["image_array", "float", "float", "str"], {}, {"created_at": 1.0}]
    head += [{"paths": ["a.catalog"], "current_index": count, "max_len": count, "deleted_indexes": []}]
    (folder / "manifest.json").write_text("".join(json.dumps(line) + "\n" for line in head))
