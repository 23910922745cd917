"""The balloon world in a view: a slow machine slows its time and changes nothing else.

What its page asks for, test_view_in_a_browser.py clicks.
"""

import time

import numpy as np
import pytest

from balloon_world import show
from rover_lib.onboard.car.car import this_car


class Straight:
    """A policy that drives straight on, and takes its time."""

    rate_hz, car = 30.0, this_car()

    def __init__(self, path, threads):
        self.seconds = 0.0

    def predict_unclipped(self, frame_bgr, state):
        time.sleep(self.seconds)
        return np.tile(np.float32([0.0, 0.4]), (32, 1))


@pytest.mark.slow
def test_a_slow_machine_slows_time_and_changes_nothing_else(tmp_path, monkeypatch):
    (artifact := tmp_path / "policy_static.pt").touch()
    monkeypatch.setattr(show, "load_policy", Straight)
    monkeypatch.setattr(show, "HOLD_S", 0.0)
    monkeypatch.setattr(show, "PICTURE_S", 0.0)
    paths, results = [], []
    for seconds in (0.0, 0.15):  # for a plan, which the simulation needs ten times a second
        seen, simulation = [], show.Simulation(artifact)
        simulation._policies["INT8"].seconds = seconds
        simulation.run(lambda head, picture, seen=seen: seen.append((head, picture)), 1)
        assert all(picture.startswith(b"\xff\xd8") for _, picture in seen)
        paths.append(seen[-1][0]["world"]["path"])
        results.append(simulation._results["easy"])
    assert paths[0] == paths[1] and len(paths[0]) > 10
    assert results[0] == results[1] and results[0]["INT8"][1] == 1
    simulation.ask("level hard")  # a choice on the page
    simulation.run(lambda head, picture: seen.append((head, picture)), 1)
    world = seen[-1][0]["world"]
    assert (world["level"], world["results"]["INT8"][1]) == ("hard", 1)
    assert simulation._results["easy"] == results[1]
