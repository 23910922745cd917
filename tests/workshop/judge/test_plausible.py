"""Statistics of other recordings are said, for a policy whose own plans were recorded."""

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest

from rover_lib.workshop.act import ACT, Affine, inputs_of, predictions
from rover_lib.workshop.judge.plausible import fits
from tests.helpers.policies import MemorySample, memory_samples

NAMES = ("steering", "throttle")


@dataclass(frozen=True, eq=False, kw_only=True)
class Driven(MemorySample):
    chunk: np.ndarray
    is_pad: np.ndarray
    time_s: float


@pytest.fixture(scope="module")
def driven(tiny):
    """What the tiny policy itself plans, as if somebody had driven so, a little less steadily."""
    samples, rng = memory_samples(14), np.random.default_rng(0)
    plans = predictions(ACT(tiny.config, tiny.weights), [inputs_of(s, tiny.config) for s in samples]).numpy()
    noisy = plans + rng.normal(0, 0.1, plans.shape) * plans.std((0, 1))
    none = np.zeros(plans.shape[1], bool)
    recorded = [{"chunk": chunk, "is_pad": none, "time_s": i / 30} for i, chunk in enumerate(noisy)]
    return [Driven(s.state, s.picture, i, "episode_1", **recorded[i]) for i, s in enumerate(samples)]


def ranges(driven):
    values = np.concatenate([s.chunk for s in driven])
    return {n: (float(values[:, i].min()), float(values[:, i].max())) for i, n in enumerate(NAMES)}


def of(tiny, driven, **changes):
    return fits(replace(tiny, config=replace(tiny.config, **changes)), driven, ranges(driven))


def test_its_own_recordings_fit(tiny, driven):
    fit = of(tiny, driven)
    assert fit.warnings() == [] and fit.frames == 12
    assert list(fit.actions) == list(NAMES) and 0.9 < fit.actions["steering"]["spread"] < 1.1
    assert "steering" in str(fit.table()) and fit.summary()["warnings"] == []


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"action_unnorm": Affine((1.0, 30.0), (0.0, 0.0))}, "throttle: .* far outside of what was recorded"),
        ({"action_unnorm": Affine((1.0, 1.0), (9.0, 0.0))}, "steering: 100 % of its predictions are far outside"),
        ({"action_unnorm": Affine((1.0, 0.01), (0.0, 0.0))}, "throttle: "),
        ({"state_norm": Affine((1.0, 200.0), (0.0, 0.0))}, "state throttle: "),
    ],
)
def test_statistics_of_other_recordings_are_said(tiny, driven, changes, says):
    assert [w for w in of(tiny, driven, **changes).warnings() if re.match(says, w)]


@pytest.mark.parametrize(("planned", "fit"), [(0.4, True), (0.41, True), (0.0, False)])
def test_a_held_throttle_may_be_planned_as_a_constant(tiny, driven, planned, fit):
    """Within a range as narrow as a hair, a hundredth beside it is not far outside."""
    throttle = 0.4 + 0.0005 * np.sin(np.arange(len(driven)))
    held = []
    for s, t in zip(driven, throttle, strict=True):
        held.append(replace(s, chunk=np.column_stack([s.chunk[:, 0], np.full(len(s.chunk), t)])))
    constant = Affine((1.0, 1e-6), (0.0, planned))
    assert (of(tiny, held, action_unnorm=constant).warnings() == []) == fit


def test_recordings_of_another_rate_are_said(tiny, driven):
    """The trainer's file does not say how fast it plans, which is 30 steps a second. Of 15, it drives twice as fast."""
    half = len(driven) // 2
    for hz, warned in ((28.0, False), (15.0, True)):
        other = [replace(s, episode="episode_2", time_s=s.row / hz) for s in driven[half:]]
        found = [w for w in of(tiny, driven[:half] + other).warnings() if "steps a second" in w]
        assert len(found) == warned and all(f"episode_2 has {hz:.1f} frames" in w for w in found)
    assert of(tiny, driven[::3]).other_rates_hz == {}  # a frame that is missing makes no other rate


def test_what_was_trained_here_is_not_asked_what_it_was_trained_with(tiny, driven):
    """`rover train`'s own file, which had learned nothing: with its statistics nothing can be wrong."""
    ours = replace(tiny, report=tiny.report | {"written_here": True})
    (warning,) = of(ours, driven, action_unnorm=Affine((1.0, 0.01), (0.0, 0.0))).warnings()
    assert "has learned too little" in warning and "?" not in warning
