"""Whether a policy beats guesses without eyes, by policies of which it is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard.car.car import Car
from rover_lib.workshop.judge.compare import Fidelity
from rover_lib.workshop.judge.guesses import LEAST_EPISODES, against_guesses

CHUNK, RANGE = 8, {"steering": (-1.0, 1.0), "throttle": (0.0, 0.1)}
GUESSES = ["a constant action", "the last action again", "the mean plan"]


def drive(episode, frames=60):
    """One drive's samples: steering follows what is seen, throttle rises from a stand."""
    rng = np.random.default_rng(episode)
    times = np.arange(frames + CHUNK)
    actions = np.stack([0.8 * np.sin(times / 9 + rng.uniform(0, 6)), np.minimum(times / 200, 0.1)], 1)
    pads = np.arange(frames)[:, None] + np.arange(CHUNK) >= frames
    return [
        SimpleNamespace(
            episode=f"episode_{episode}",
            row=i,
            state=np.float32(actions[max(i - 1, 0)]),
            chunk=np.float32(actions[i : i + CHUNK]),
            is_pad=pads[i],
        )
        for i in range(frames)
    ]


def judge(plan, episodes=6, action_range=RANGE):
    """plan: of a sample. Judged on `episodes` drives, and it could learn from four others."""
    samples = [s for e in range(episodes) for s in drive(e)]
    report = Fidelity(
        action_names=("steering", "throttle"),
        action_range=action_range,
        samples=tuple(samples),
        reference=np.stack([plan(s) for s in samples]).astype(np.float32),
        chunks={},
        recorded=np.stack([s.chunk for s in samples]),
        is_pad=np.stack([s.is_pad for s in samples]),
        car=Car(),
    )
    return against_guesses(report, [s for e in range(10, 14) for s in drive(e)])


def noisy(sample):
    return sample.chunk + np.random.default_rng(sample.row).normal(0, (0.1, 0.005), (CHUNK, 2))


@pytest.mark.parametrize(
    ("plan", "unbeaten"),
    [
        (noisy, []),
        (lambda s: np.tile(s.state, (CHUNK, 1)), ["the last action again"]),
        (lambda s: np.zeros((CHUNK, 2)), GUESSES),
        (lambda s: -s.chunk, GUESSES),
        (lambda s: s.chunk * [1, 0], ["the last action again"]),  # it steers well, and its throttle is no better
    ],
    ids=["good", "copies", "always zero", "the other way", "never drives off"],
)
@pytest.mark.parametrize("episodes", [1, LEAST_EPISODES])
def test_only_a_policy_that_sees_beats_the_guesses(plan, unbeaten, episodes):
    judged = judge(plan, episodes)
    assert [g.name for g in judged.guesses] == GUESSES
    assert {g.name for g in judged.guesses if not g.beaten} >= set(unbeaten)
    assert bool(judged.warnings()) == bool(unbeaten)
    assert ("pieces" in judged.drawn) == (episodes == 1) and str(episodes) in judged.drawn
    for guess in judged.guesses:
        assert guess.low <= guess.better <= guess.high
        errors = (np.mean(list(errors.values())) for errors in (guess.errors_pct, judged.errors_pct))
        assert guess.better == pytest.approx(np.subtract(*errors))
    assert judged.summary()["guesses"].keys() == set(GUESSES) and "points" in str(judged.table())


def test_errors_by_hand():
    judged = judge(lambda s: s.chunk + np.float64([0.02, 0.001]))
    assert judged.errors_pct == pytest.approx({"steering": 1, "throttle": 1}, rel=1e-3)
    assert judged.errors_pct.keys() == judged.guesses[0].errors_pct.keys()


def test_what_is_not_judged_counts_for_nothing():
    judged = judge(noisy, action_range=RANGE | {"throttle": (0.1, 0.1)})
    assert judged.errors_pct.keys() == {"steering"}
    assert judge(noisy, action_range={name: (0.0, 0.0) for name in RANGE}) is None
