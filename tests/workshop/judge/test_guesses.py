"""Whether a policy beats guesses without eyes, by policies of which it is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.workshop.judge.compare import Fidelity
from rover_lib.workshop.judge.guesses import LEAST_EPISODES, against_guesses, least_blind_errors

CHUNK, RANGE = 8, {"steering": (-1.0, 1.0), "throttle": (0.0, 0.1)}
GUESSES = ["a constant action", "the last action again", "the mean plan"]


def drive(episode, frames=60, rise=200):
    """One drive's samples: steering follows what is seen, throttle rises from a stand."""
    rng = np.random.default_rng(episode)
    times = np.arange(frames + CHUNK)
    actions = np.stack([0.8 * np.sin(times / 9 + rng.uniform(0, 6)), np.minimum(times / rise, 0.1)], 1)
    pads = np.arange(frames)[:, None] + np.arange(CHUNK) >= frames
    samples = []
    for i in range(frames):
        did = {"state": np.float32(actions[max(i - 1, 0)]), "chunk": np.float32(actions[i : i + CHUNK])}
        samples.append(SimpleNamespace(episode=f"episode_{episode}", row=i, is_pad=pads[i], **did))
    return samples


def judge(plan, episodes=6, action_range=RANGE, rise=200):
    """plan: of a sample. Judged on `episodes` drives, and it could learn from four others, of this rise in throttle."""
    samples = [s for e in range(episodes) for s in drive(e)]
    report = Fidelity(
        action_names=("steering", "throttle"),
        action_range=action_range,
        samples=tuple(samples),
        reference=np.stack([plan(s) for s in samples]).astype(np.float32),
        chunks={},
        recorded=np.stack([s.chunk for s in samples]),
        is_pad=np.stack([s.is_pad for s in samples]),
    )
    return against_guesses(report, [s for e in range(10, 14) for s in drive(e, rise=rise)])


def noisy(sample):
    return sample.chunk + np.random.default_rng(sample.row).normal(0, (0.1, 0.005), (CHUNK, 2))


@pytest.mark.parametrize(
    ("plan", "unbeaten"),
    [
        (noisy, []),
        (lambda s: np.tile(s.state, (CHUNK, 1)), ["the last action again"]),
        (lambda s: np.zeros((CHUNK, 2)), GUESSES),
        (lambda s: s.chunk * [1, 0], ["the last action again"]),  # it steers well, and its throttle is no better
    ],
)
@pytest.mark.parametrize("episodes", [1, LEAST_EPISODES])
def test_only_a_policy_that_sees_beats_the_guesses(plan, unbeaten, episodes):
    judged = judge(plan, episodes)
    assert list(judged.guesses) == GUESSES
    assert {name for name, g in judged.guesses.items() if not g.beaten} >= set(unbeaten)
    assert bool(judged.warnings()) == bool(unbeaten)
    assert ("pieces" in judged.drawn) == (episodes == 1) and str(episodes) in judged.drawn
    assert judged.summary()["guesses"].keys() == set(GUESSES) and "points" in str(judged.table())


@pytest.mark.parametrize("far", [[0.6, 0], [0, 0.03]])
def test_a_guess_is_beaten_only_in_every_action(far):
    """Perfect in one action and so better in the mean, but in the other one further off than some guesses."""
    guesses = judge(lambda s: s.chunk + np.float64(far)).guesses.values()
    assert [g.low > 0 for g in guesses] == [True, False, True] and not any(g.beaten for g in guesses)


def test_the_guesses_know_only_what_could_be_learned_from():
    """By hand: the mean action, and the mean plan, of four other drives, and the state, which is the last action."""
    judged, seen = judge(lambda s: s.chunk, rise=400), [s for e in range(6) for s in drive(e)]
    learned = [s for e in range(10, 14) for s in drive(e, rise=400)]
    every = np.concatenate([s.chunk[~s.is_pad] for s in learned])
    steps = np.stack([np.mean([s.chunk[i] for s in learned if not s.is_pad[i]], 0) for i in range(CHUNK)])

    def off(plan_of):
        errors = [np.abs(plan_of(s) - s.chunk)[~s.is_pad].mean(0) for s in seen]
        return dict(zip(RANGE, 100 * np.mean(errors, 0) / [2, 0.1], strict=True))

    constants = [off(lambda s, c=c: np.tile(c, (CHUNK, 1))) for c in (every.mean(0), np.median(every, 0))]
    expected = [min(constants, key=lambda e: sum(e.values())), off(lambda s: s.state), off(lambda s: steps)]
    assert [g.errors_pct for g in judged.guesses.values()] == [pytest.approx(e, rel=1e-4) for e in expected]


def test_the_best_blind_guess_of_each_action():
    """By hand: steering is best guessed by its median, throttle, which rises in every plan, by the mean plan."""
    learned = np.array([[[0, 0.1], [0, 0.3]], [[0, 0.1], [0, 0.3]], [[0.9, 0.1], [0.9, 9]]])
    pads = np.array([[False, False], [False, False], [False, True]])
    recorded = np.array([[[0.1, 0.1], [0.3, 0.3]], [[-0.1, 0.15], [9, 9]]])
    errors = least_blind_errors(learned, pads, recorded, np.array([[False, False], [False, True]]))
    assert errors == pytest.approx([(0.2 + 0.1) / 2, (0 + 0.05) / 2])


def test_the_interval_has_95_percent_of_the_draws():
    """Of whole episodes, drawn with replacement: the oracle draws by itself, and many more."""
    guess, rng, gains = judge(noisy).guesses["the last action again"], np.random.default_rng(1), []
    for samples in map(drive, range(6)):
        plans = np.stack([[np.tile(s.state, (CHUNK, 1)), np.float32(noisy(s))] for s in samples])
        errors = np.abs(plans - np.stack([s.chunk for s in samples])[:, None]) / [0.02, 0.001]
        known = ~np.stack([s.is_pad for s in samples])[:, None, :, None]
        by_frame = (errors * known).sum(2) / known.sum(2)
        gains.append((by_frame[:, 0] - by_frame[:, 1]).mean())
    means = np.float64(gains)[rng.integers(0, 6, (100_000, 6))].mean(1)
    low, high = np.percentile(means, [2.5, 97.5])
    assert (guess.low, guess.high) == pytest.approx((low, high), abs=0.05 * (high - low))


def test_what_is_not_judged_counts_for_nothing():
    judged = judge(noisy, action_range=RANGE | {"throttle": (0.1, 0.1)})
    assert judged.errors_pct.keys() == judged.guesses["the mean plan"].errors_pct.keys() == {"steering"}
    assert judge(noisy, action_range={name: (0.0, 0.0) for name in RANGE}) is None
