"""The balloon world in a view: a slow machine slows its time and changes nothing else; a page's requests."""

import time

import numpy as np
import pytest

from balloon_world import show
from balloon_world.show import Simulation
from rover_lib.onboard.car.car import this_car


class Straight:
    """A policy that drives straight on, and takes its time."""

    rate_hz, car = 30.0, this_car()

    def __init__(self, path, seconds=0.0, threads=None):
        self.seconds = seconds

    def predict_unclipped(self, frame_bgr, state):
        time.sleep(self.seconds)
        return np.tile(np.float32([0.0, 0.4]), (32, 1))


@pytest.fixture
def simulation(tmp_path, monkeypatch):
    """Of a run with two modes. The clock's time passes as fast as a test wants it."""
    for name in ("policy_static.pt", "policy_fp32.pt"):
        (tmp_path / name).touch()
    monkeypatch.setattr(show, "load_policy", Straight)
    monkeypatch.setattr(show, "HOLD_S", 0.0)
    monkeypatch.setattr(show, "PICTURE_S", 0.0)
    return Simulation(tmp_path / "policy_static.pt")


def drive(simulation, worlds=1, each=lambda head: None):
    seen = []

    def post(head, picture):
        seen.append(head)
        assert picture.startswith(b"\xff\xd8")
        each(head)

    simulation.run(post, worlds)
    return seen


@pytest.mark.slow
def test_a_slow_machine_slows_time_and_changes_nothing_else(simulation, monkeypatch):
    fast = drive(simulation)
    slow_one = Simulation(simulation._paths["INT8"])
    slow_one._policies["INT8"].seconds = 0.15  # for a plan, which the simulation needs ten times a second
    slow = drive(slow_one)
    assert fast[-1]["world"]["path"] == slow[-1]["world"]["path"] and len(fast[-1]["world"]["path"]) > 10
    assert simulation._results == slow_one._results and sum(r[1] for r in simulation._results.values()) == 1


@pytest.mark.slow
def test_what_a_page_asks_for(simulation):
    asked = iter([("driving", "stop"), ("ended", "drive FP32"), ("driving", "rm -rf"), ("driving", "next")])
    waiting = [next(asked)]
    said = []

    def each(head):
        said.append((head["phase"], head["text"], head["world"]["drives"]))
        if waiting and head["phase"] == waiting[0][0]:
            simulation.ask(waiting.pop()[1])
            waiting.extend([step] if (step := next(asked, None)) else [])

    drive(simulation, 3, each)  # stopped; the same world by FP32, skipped; the next one
    assert ("ended", "stopped here; nobody drives", "INT8") in said and said[-1][2] == "FP32"
    assert [results[1] for results in simulation._results.values()] == [0, 1]  # what was stopped counts for nobody
    assert simulation._seed == 10_002
