"""Ten kills each of record, train and run, at random moments: nothing is half-written, and finished work stays.

Each attempt is a fork of this process, which has imported everything: a kill may come at any moment of the work.
"""

import hashlib
import json
import math
import mmap
import os
import random
import shutil
import signal
import struct
import time

import cv2
import numpy as np
import pytest

from rover_learn import training
from rover_lib.cli import main
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording.episode import About, EpisodeWriter, find_killed, finish_killed
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.recordings.episodes import load_recordings

pytestmark = [pytest.mark.slow, pytest.mark.release]  # a run of five notebooks is killed ten times
KILLS, ROWS, ROW_S = 10, 90, 0.01


def record(inputs, folder, progress):
    """Record, and keep in `progress` how many rows are written."""
    picture = np.random.default_rng(0).integers(0, 255, (36, 64, 3), np.uint8)
    with EpisodeWriter(folder / "episode_1", About("killed"), resolution=None, flags=True) as writer:
        for i in range(ROWS):
            writer.control(100 + i * ROW_S, 10 * i, 1500, 136, 21308, 1016)
            writer.frame(100 + i * ROW_S, picture)
            struct.pack_into("q", progress, 0, i + 1)
            time.sleep(ROW_S)


def train(inputs, folder, progress):
    main(["train", str(inputs / "episodes"), str(folder / "ck.pth"), "--steps", "8", "--device", "cpu"])


def run(inputs, folder, progress):
    words = ["run", str(inputs / "ck.pth"), str(inputs / "episodes"), "--name", "mine", "--runs-dir", str(folder)]
    main([*words, "--samples", "8", "--iterations", "2"])


def attempt(work, inputs, folder, after_s):
    """Do the work in a fork, and kill that after so many seconds. Return its exit code and its progress."""
    progress = mmap.mmap(-1, 8)
    if not (child := os.fork()):
        code = 2
        try:
            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 1), os.dup2(quiet, 2)
            os.environ["ROVER_CACHE"] = str(folder / ".cache")
            training.SAVING_SHARE = 1e9  # save after each step
            work(inputs, folder, progress)
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        finally:
            os._exit(code)
    if after_s is not None:
        end, look = time.monotonic() + after_s, os.WEXITED | os.WNOWAIT | os.WNOHANG
        while time.monotonic() < end and not os.waitid(os.P_PID, child, look):
            time.sleep(0.005)
        os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), struct.unpack_from("q", progress)[0]


def content_of(path):
    """What must be the same however often the work was killed. Raises for what is half-written."""
    if path.suffix == ".pth":
        weights = load_checkpoint(path).weights
        return hashlib.sha256(b"".join(weights[k].numpy().tobytes() for k in sorted(weights))).hexdigest()
    if path.name.startswith("policy_") and path.suffix == ".pt":
        return content_hash(path)
    if path.suffix in (".json", ".ipynb"):
        json.loads(path.read_text())
    return "" if path.stat().st_size else "empty"


def made_in(out):
    files = sorted(out.rglob("*")) if out.is_dir() else [out] if out.exists() else []
    return {str(path.relative_to(out)): content_of(path) for path in files if path.is_file()}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Small episodes, and a policy of a few steps."""
    folder = tmp_path_factory.mktemp("inputs")
    for drive in range(4):
        with EpisodeWriter(folder / "episodes" / f"episode_{drive}", About("made"), resolution=(64, 36)) as writer:
            for i in range(40):
                pulses = PwmCalibration().pulses(0.5 * math.sin(4 * i / 30 + drive), 0.05 + 0.04 * math.cos(i / 10))
                noise = np.random.default_rng(1000 * drive + i).integers(0, 255, (6, 8, 3), np.uint8)
                writer.frame(100 + i / 30, cv2.resize(noise, (64, 36)))
                times = 100.004 + i / 30, 33 * i
                writer.control(*times, pulses.steering_us, pulses.throttle_us, 21316, 1016)
    assert attempt(train, folder, folder, None)[0] == 0
    return folder


@pytest.mark.parametrize(("work", "out"), [(train, "ck.pth"), (run, "mine")])
def test_what_was_killed_is_whole_in_the_end(inputs, tmp_path, work, out):
    rng, killed = random.Random(0), 0
    began_s = time.monotonic()
    assert attempt(work, inputs, tmp_path / "whole", None)[0] == 0
    whole, whole_s = made_in(tmp_path / "whole" / out), time.monotonic() - began_s
    while killed < KILLS:
        folder, code = tmp_path / f"killed_{killed}", -signal.SIGKILL
        while code == -signal.SIGKILL:
            code, _ = attempt(work, inputs, folder, rng.uniform(0, whole_s) if killed < KILLS else None)
            killed += code == -signal.SIGKILL
            assert code in (0, -signal.SIGKILL)
            assert code == -signal.SIGKILL or made_in(folder / out) == whole
            assert made_in(folder / out) in ({}, whole)


def test_a_killed_recording_keeps_all_but_its_last_row(inputs, tmp_path):
    rng = random.Random(0)
    for i in range(KILLS):
        folder = tmp_path / str(i)
        folder.mkdir()
        _, count = attempt(record, inputs, folder, rng.uniform(0.1, ROWS * ROW_S))
        try:
            for part in find_killed(folder):
                finish_killed(part)
        except EpisodeError:
            assert count <= 1
            continue
        kept = load_recordings(folder, chunk=1).episodes[0].controls if (folder / "episode_1").exists() else 0
        assert kept >= count - 1
        shutil.rmtree(folder)
