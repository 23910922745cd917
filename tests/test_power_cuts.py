"""Power cuts at any moment: a recording loses at most its last second, and nothing else is ever half-written.

An ext4 file system lies on a loop device, and its image is copied while it is mounted: the copy holds what had reached
the device. A fork does the work, so that the moments come at any place in it.
"""

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

import numpy as np
import pytest

from rover_learn import training
from rover_lib.cli import main
from rover_lib.onboard.drive.flight_log import FlightLog, Tick, read_log
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording import episode as module
from rover_lib.onboard.recording.episode import About, EpisodeWriter, find_killed, finish_killed
from tests.helpers.needs import Late, real_time, until
from tests.helpers.recorded import record_drives

HZ, LAST_S, SLOW_DISK_S = 30, 1.0, 0.3
NAME = "episode_20260101_120000"
PICTURE = np.random.default_rng(0).integers(0, 255, (36, 64, 3), np.uint8)
TICK = Tick(0.0, 0.25, "A", "a", 0.5, 0.05, 1500, 150, 1500, 149, 1, 150.0, 125.0, 1.0, 1)


@contextmanager
def mounted(image):
    folder = image.with_name(f"{image.name}.mounted")
    folder.mkdir(exist_ok=True)
    done = subprocess.run(["mount", "-o", "loop,noatime", image, folder], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"no loop device can be mounted here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


@pytest.fixture
def disk(tmp_path, request):
    """The folder of a file system: small for a recording, which is copied often, and 2 GB for checkpoints."""
    if os.geteuid() or not (shutil.which("mkfs.ext4") and shutil.which("mount")):
        pytest.skip("needs root and the Debian packages e2fsprogs and mount")
    image = tmp_path / "disk"
    size = "2G" if "work" in request.fixturenames else "100M"
    subprocess.run(["mkfs.ext4", "-q", "-F", image, size], check=True)
    with mounted(image) as folder:
        yield folder


@contextmanager
def after_a_power_cut(disk, child):
    """Yield the folder of the file system as a power cut now would leave it, once it is mounted again.

    Meanwhile the child stands still: else a block of the copy would be older than another.
    """
    image, copy = disk.with_name("disk"), disk.with_name("copy")
    os.killpg(child, signal.SIGSTOP)
    for _ in range(10):  # until nothing else writes meanwhile either
        written_ns = image.stat().st_mtime_ns
        subprocess.run(["cp", "--sparse=always", image, copy], check=True)
        if image.stat().st_mtime_ns == written_ns:
            break
    os.killpg(child, signal.SIGCONT)
    with mounted(copy) as folder:
        yield folder


def start(work, *args):
    """Do the work in a fork, and return its process id."""
    if child := os.fork():
        with suppress(PermissionError):
            os.setpgid(child, child)
        return child
    code = 1
    try:
        os.setpgid(0, 0)
        training.SAVING_SHARE = 1e9  # save after each step
        work(*args)
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        os._exit(code)


# ---- recording


def record(inputs, folder, logged=True):
    """Record in real time until it is killed. Its syncs' durations are appended to a file beside the disk."""
    sync = module.sync_disk

    def timed(path):
        began_s = time.monotonic()
        sync(path)
        with folder.with_name("syncs").open("a") as file:
            file.write(f"{time.monotonic() - began_s}\n")

    module.sync_disk = timed
    limits = {"header": {}, "max_bytes": 10_000_000, "keep": 1}
    with (
        FlightLog(folder / "flight.log", **limits) if logged else nullcontext() as log,
        EpisodeWriter(folder / NAME, About("cut"), resolution=None, flags=True) as writer,
    ):
        began_s = time.time()
        for i in range(10_000):
            time.sleep(max(0.0, began_s + i / HZ - time.time()))
            writer.frame(time.time(), PICTURE)
            writer.control(time.time(), i, 1500, 136, 21308, 1016)
            if log:
                log.tick(TICK._replace(t_s=time.monotonic() - log.start_s, frame=i))


def check_kept(folder, cut_s):
    """What `rover record --finish` makes of a recording has all that was recorded a second before the cut."""
    for part in find_killed(folder):
        finish_killed(part)
    content = json.loads((folder / NAME / "episode_data.json").read_text())
    controls, frames = content["control_samples"], content["frame_samples"]
    assert [row["arduino_timestamp"] for row in controls] == list(range(len(controls)))
    assert [row["frame_id"] for row in frames] == list(range(1, len(frames) + 1))
    oldest_s = min(controls[-1]["system_timestamp"], frames[-1]["timestamp"])
    assert all((folder / NAME / row["image_path"]).stat().st_size > 1000 for row in frames)
    if (folder / "flight.log").exists():
        ticks = read_log(folder / "flight.log").ticks["frame"]
        oldest_s = min(oldest_s, controls[min(int(ticks[-1]), len(controls) - 1)]["system_timestamp"])
    assert cut_s - oldest_s < LAST_S


TEN = pytest.param(10, False, marks=pytest.mark.slow)
THIRTY = [pytest.param(30, logged, marks=pytest.mark.release) for logged in (False, True)]


@pytest.mark.parametrize(("count", "logged"), [TEN, *THIRTY])
@real_time
def test_a_power_cut_costs_a_recording_its_last_second(disk, count, logged):
    durations = disk.with_name("syncs")
    durations.touch()
    child = start(record, None, disk, logged)
    try:
        until(lambda: list(disk.glob(".*.part/frames/frame_000045.jpg")), 60)
        rng = random.Random(0)
        for _ in range(count):
            time.sleep(rng.uniform(0.0, 0.3))
            cut_s = time.time()
            with after_a_power_cut(disk, child) as folder:
                check_kept(folder, cut_s)
    except (AssertionError, EpisodeError, FileNotFoundError):
        if (longest_s := max(map(float, durations.read_text().split()), default=0)) > SLOW_DISK_S:
            raise Late(f"a sync of this disk took {longest_s:.1f} s") from None
        raise
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        shutil.rmtree(disk / f".{NAME}.part", ignore_errors=True)
        durations.unlink()


# ---- all else that is written


def finish(inputs, folder):
    folder.mkdir()
    for i in range(10):
        shutil.copytree(inputs / f".{NAME}.part", folder / f".episode_{i}.part")
    os.sync()
    for part in find_killed(folder):
        finish_killed(part)


def export(inputs, folder):
    main(["export-dataset", str(inputs / "episodes"), str(folder / "out")])


def train(inputs, folder):
    main(["train", str(inputs / "episodes"), str(folder / "out/ck.pth"), "--steps", "8", "--device", "cpu"])


def run(inputs, folder):
    words = ["run", str(inputs / "out/ck.pth"), str(inputs / "episodes"), "--name", "out", "--runs-dir", str(folder)]
    main([*words, "--samples", "8", "--iterations", "2"])


def content_of(folder):
    """The hash of each file that is not hidden, or in a hidden folder, by its path."""
    content = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".") for part in name.parts):
            content[str(name)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return content


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    record_drives(folder / "episodes")
    child = start(train, folder, folder)
    assert os.waitpid(child, 0)[1] == 0
    with pytest.raises(ZeroDivisionError), EpisodeWriter(folder / NAME, About(), resolution=None) as writer:
        for i in range(20):
            writer.frame(i / HZ, PICTURE)
            writer.control(i / HZ, i, 1500, 136, 21308, 1016)
        1 / 0  # noqa: B018 what was recorded stays for --finish
    return folder


@pytest.mark.release
@pytest.mark.parametrize("work", [finish, export, train, run])
def test_what_a_power_cut_leaves_is_whole_or_not_there(inputs, disk, work, monkeypatch):
    """And after it the work can be done again: it is, once, at a moment in the middle."""
    monkeypatch.setenv("ROVER_CACHE", str(disk / "cache"))
    rng, cuts, number, redone = random.Random(0), 0, 0, work is finish
    began_s = time.monotonic()
    assert os.waitpid(start(work, inputs, disk / "whole"), 0)[1] == 0
    whole_s = time.monotonic() - began_s
    while cuts < 30:
        number += 1
        name, found = f"again_{number}", []
        shutil.rmtree(disk / "cache", ignore_errors=True)
        child = start(work, inputs, disk / name)
        while not os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT | os.WNOHANG):
            time.sleep(rng.uniform(0, min(2 * whole_s / 30, 3)))
            cuts += 1
            with after_a_power_cut(disk, child) as copy:
                found.append(content_of(copy / name))
                if work is finish:
                    there = {path.name.removeprefix(".").removesuffix(".part") for path in (copy / name).glob("*e*")}
                    assert not (copy / name).exists() or len(there) in (0, 10)
                elif cuts >= 15 and not found[-1] and not redone:
                    redone = True
                    monkeypatch.setenv("ROVER_CACHE", str(copy / "cache"))
                    assert os.waitpid(start(work, inputs, copy / name), 0)[1] == 0
                    assert content_of(copy / name).keys() == content_of(disk / "whole").keys()
                    monkeypatch.setenv("ROVER_CACHE", str(disk / "cache"))
        assert os.waitpid(child, 0)[1] == 0
        last = content_of(disk / name)
        for content in found:
            assert content.items() <= last.items()
            parts = {Path(file).parts[0] for file in content}
            assert all(content[file] for file in content)
            assert {file for file in last if Path(file).parts[0] in parts} == content.keys()
        shutil.rmtree(disk / name)
