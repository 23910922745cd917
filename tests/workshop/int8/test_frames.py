"""Odd frames: seen, named, and no longer able to take INT8's steps from the others."""

import json
import math
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rover_lib.workshop.act import inputs_of
from rover_lib.workshop.int8 import frames, observe
from rover_lib.workshop.int8.choose import Chooser
from rover_lib.workshop.int8.observe import Calibration, calibrate, restore_observed, times_of
from rover_lib.workshop.int8.quantize import quantize
from rover_lib.workshop.int8.scheme import OBSERVERS, Scheme
from rover_lib.workshop.judge.recorded_range import worst
from rover_lib.workshop.progress import silent
from tests.helpers.policies import dazzled_by_white, memory_samples

RANGE = {"steering": (-0.5, 0.5), "throttle": (0.0, 0.5)}
EXTREMES = {
    "backbone.layer4.1.relu": torch.tensor([[0.0, 1.0], [0.0, 0.8], [0.0, 60.0], [0.0, 1.2]]),
    "image_project": torch.tensor([[-1.0, 2.0], [-2.0, 1.0], [-30.0, 3.0], [-4.0, 2.0]]),
}
SEEN = (("a", 5), ("a", 9), ("b", 0), ("b", 7))


def test_the_odd_frame_is_found_and_named():
    assert frames.oddest(EXTREMES).tolist() == pytest.approx([1.0, 1.0, 60.0, 2.0])
    assert frames.usual(EXTREMES, 75).tolist() == [True, True, False, True]
    assert frames.odd_share(EXTREMES) == 0.25
    usual = {place: seen[:2] for place, seen in EXTREMES.items()}
    assert frames.odd_share(usual) == 0 and frames.describe_odd(usual, SEEN[:2]) == {}
    named = {"share_pct": 25.0, "block": "backbone.layer4", "times": pytest.approx(60.0), "episodes": {"b": 1}}
    assert frames.describe_odd(EXTREMES, SEEN) == named | {"rows": [0]}
    samples = [SimpleNamespace(episode=episode, row=row) for episode, row in SEEN]
    assert frames.odd_samples(EXTREMES, SEEN, samples) == (samples[2],)


def test_a_range_reaches_from_usual_frames_to_all():
    for place, wider, expected in (
        ("image_project", 0, (-4, 2)),  # without the frame that is odd
        ("image_project", 1, (-30, 3)),
        ("backbone.layer4.1.relu", 0.5, (0, math.sqrt(1.2 * 60))),
    ):
        assert frames.range_over(EXTREMES[place], frames.usual(EXTREMES, 75), wider) == pytest.approx(expected)


def test_only_the_named_places_reach_to_all_frames(monkeypatch):
    observers = {place: SimpleNamespace() for place in EXTREMES}
    monkeypatch.setattr(observe, "_places", lambda graph: observers)
    scheme = Scheme(observer="frames", usual_pct=75, wider=(("image_project", 1.0),))
    observe.set_ranges(None, scheme, SimpleNamespace(frames=EXTREMES))
    assert observers["image_project"].of_frames == pytest.approx((-30, 3))
    assert observers["backbone.layer4.1.relu"].of_frames == pytest.approx((0, 1.2))


@pytest.mark.parametrize(("costs", "is_widened"), [(1.05, True), (1.15, False)])
def test_usual_frames_pay_at_most_a_tenth_for_odd_ones(costs, is_widened):
    """A fifth took usual frames of a policy from elsewhere out of their limit, with 120 frames that calibrated."""
    chooser = Chooser.__new__(Chooser)
    chooser.calibration, chooser.action_range = SimpleNamespace(frames=EXTREMES), RANGE
    chooser.weights, chooser.is_odd = torch.ones(3), torch.tensor([False, False, True])

    def errors(scheme):
        usual, odd = (costs, 1.0) if scheme.wider else (1.0, 100.0)
        return torch.tensor([[usual], [usual], [odd]]).expand(3, 2)

    scheme, _ = chooser._widen(Scheme(observer="frames", usual_pct=75), errors, silent)
    assert bool(scheme.wider) == is_widened


@pytest.fixture(scope="module")
def dazzled(tiny):
    return dazzled_by_white(tiny)


@pytest.fixture(scope="module")
def jumping():
    """Frames of which every eighth is white."""
    return [replace(s, picture=np.full_like(s.picture, 255)) if s.row % 8 == 3 else s for s in memory_samples(32)]


@pytest.fixture(scope="module")
def jumped(dazzled, jumping):
    return calibrate(dazzled, jumping)


@pytest.mark.slow
def test_calibration_keeps_each_frames_extremes(dazzled, jumping, jumped, tmp_path):
    jumped.save(tmp_path / "calibration.pt")
    again = Calibration.load(tmp_path / "calibration.pt")
    assert again.seen == tuple(("memory", row) for row in range(32))
    named = frames.describe_odd(again.frames, again.seen)
    assert named["rows"] == [3, 11, 19, 27] and named["block"].startswith("backbone.") and named["times"] > frames.ODD
    graph = restore_observed(dazzled, Scheme(), again)
    inputs = [inputs_of(s, dazzled.config) for s in jumping[:4]]
    # the graph's sums may be in another order than while it observed
    assert times_of(graph, again, inputs).tolist() == pytest.approx(frames.oddest(again.frames)[:4].tolist(), rel=1e-3)


@pytest.mark.slow
def test_odd_frames_take_no_steps_from_the_others(dazzled, jumping, jumped):
    """Chosen with the odd frames in their share: better than min-max on usual frames, and on all together."""
    odd = frames.odd_samples(jumped.frames, jumped.seen, jumping)
    chooser = Chooser(dazzled, jumped, memory_samples(6, seed=9), RANGE, odd)
    assert chooser.is_odd.tolist() == 6 * [False] + 4 * [True]
    assert chooser.weights.mean() == pytest.approx(1) and chooser.weights[6:].sum() == pytest.approx(10 / 8)
    scheme, table = chooser.observer(Scheme(), OBSERVERS)
    assert scheme.observer == "frames" and Scheme.of(json.loads(json.dumps(asdict(scheme)))) == scheme
    assert table[list(table)[-1]] == chooser.error(quantize(dazzled, scheme, jumped).module)
    usual, others = (
        chooser.error_by_kind(quantize(dazzled, s, jumped).module)["usual"] for s in (scheme, Scheme(observer="minmax"))
    )
    assert worst(usual) < 0.8 * worst(others)
    assert worst(table[list(table)[-1]]) < 0.8 * worst(table["minmax"])
