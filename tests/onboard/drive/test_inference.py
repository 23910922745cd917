"""Plans beside the loop, and the policy in its own process: what it computes, and all the ways in which it can fail."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard import load_policy
from rover_lib.onboard.car.camera import CameraError, Frame
from rover_lib.onboard.drive.inference import Planner, PolicyProcess
from rover_lib.onboard.drive.plan import Commanded
from rover_lib.onboard.errors import PolicyError
from tests.helpers.needs import until

pytestmark = pytest.mark.slow  # each starts processes that import torch

FRAME = np.random.default_rng(0).integers(0, 256, (36, 64, 3), np.uint8)
CHUNK = np.tile(np.array([0.1, 0.05], np.float32), (8, 1))


class Frames:
    """A camera that gives a frame whenever it is asked."""

    def __init__(self, fails_after=None):
        self.number, self.fails_after = 0, fails_after

    def wait(self, after, timeout_s):
        time.sleep(0.002)
        self.number += 1
        if self.fails_after and self.number > self.fails_after:
            raise CameraError("camera: unplugged")
        return Frame(FRAME, time.monotonic(), self.number, 0, 100.0, 40.0)


def policy_of(predict):
    return SimpleNamespace(predict=predict, rate_hz=30.0, strange=None)


def until_raises(planner, kind, match, seconds=3):
    end = time.monotonic() + seconds
    with pytest.raises(kind, match=match):
        while time.monotonic() < end:
            planner.newest()
            time.sleep(0.002)


def test_plans_follow_the_frames():
    states = []

    def predict(frame, state):
        states.append(state.tolist())
        return CHUNK

    commanded = Commanded()
    with Planner(Frames(), policy_of(predict), commanded) as planner:
        first = planner.wait(2.0)
        commanded.add(time.monotonic() - 1 / 30, 0.25, 0.5)
        time.sleep(0.05)
        later = planner.newest()
    assert later.number > first.number
    assert later.captured_s > first.captured_s
    assert 0 <= later.latency_s < 0.1
    assert later.actions == pytest.approx(CHUNK)
    assert states[0] == [0.0, 0.0]
    assert [0.25, 0.5] in states


def test_what_must_not_drive_is_raised():
    wild = lambda *_: np.full((8, 2), 3.0, np.float32)  # noqa: E731
    for predict, match in ((wild, "outside the range"), (lambda *_: 1 / 0, "ZeroDivisionError")):
        with Planner(Frames(), policy_of(predict), Commanded()) as planner:
            until_raises(planner, PolicyError, match)
    with Planner(Frames(fails_after=3), policy_of(lambda frame, state: CHUNK), Commanded()) as planner:
        until_raises(planner, CameraError, "unplugged")


def test_a_plan_to_begin_by_is_fresh(monkeypatch):
    """It rests after each plan, unless the car is to drive; then an old plan is not enough."""
    monkeypatch.setattr("rover_lib.onboard.drive.inference.FRESH_S", 0.2)
    answers = iter([CHUNK, CHUNK])

    def predict(frame, state):
        if (answer := next(answers, None)) is None:
            time.sleep(0.5)
            raise PolicyError("too late")
        return answer

    with Planner(Frames(), policy_of(predict), Commanded(), rest_s=10.0) as planner:
        old = planner.wait(2.0)
        planner.renew(5.0)
        assert planner.newest() is old
        with planner.without_rest():
            planner.renew(0.0)
            assert planner.newest().number == 2
            with pytest.raises(PolicyError, match="no fresh plan"):
                planner.renew(0.0)
            until_raises(planner, PolicyError, "too late")


@pytest.fixture(scope="module")
def process(artifacts):
    with PolicyProcess(artifacts["static"], threads=1) as process:
        yield process


def test_the_process_computes_what_the_policy_does(process, artifacts):
    policy = load_policy(artifacts["static"])
    state = np.array([0.1, 0.02], np.float32)
    assert process.predict(FRAME, state).tolist() == policy.predict_unclipped(FRAME, state).tolist()
    assert (process.rate_hz, process.chunk, process.manifest["mode"]) == (policy.rate_hz, policy.chunk, "static")


def test_an_answer_of_another_size_is_no_plan(process, monkeypatch):
    monkeypatch.setattr(process, "_answer", lambda timeout_s: bytes(8 * 33))
    with pytest.raises(PolicyError, match="size of a plan"):
        process.predict(FRAME, np.zeros(2))
    monkeypatch.undo()
    process._answer(None)  # of the request that was made


def test_a_bad_state_is_a_sentence_and_the_process_goes_on(process):
    with pytest.raises(PolicyError, match="state is not finite"):
        process.predict(FRAME, np.array([np.nan, 0.0]))
    assert process.predict(FRAME, np.zeros(2)).shape == (process.chunk, 2)


def test_a_process_that_is_killed(artifacts):
    with PolicyProcess(artifacts["static"], threads=1) as process:
        os.kill(process._process.pid, signal.SIGINT)  # a terminal's Ctrl-C is not for it
        assert process.predict(FRAME, np.zeros(2)).shape == (process.chunk, 2)
        os.kill(process._process.pid, signal.SIGKILL)
        with pytest.raises(PolicyError, match="SIGKILL"):
            for _ in range(100):
                process.predict(FRAME, np.zeros(2))


def test_a_process_that_hangs_is_ended(artifacts):
    with PolicyProcess(artifacts["static"], threads=1) as process:
        os.kill(process._process.pid, signal.SIGSTOP)
        start = time.monotonic()
    assert time.monotonic() - start < 3
    assert process._process.exitcode is not None


def test_it_ends_with_its_parent(artifacts):
    code = (
        "import os, sys; from rover_lib.onboard.drive.inference import PolicyProcess; "
        f"p = PolicyProcess({str(artifacts['static'])!r}).__enter__(); print(p._process.pid, flush=True); "
        "os.kill(os.getpid(), 9)"
    )
    pid = int(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout)
    until(lambda: not Path(f"/proc/{pid}").exists(), 5)
