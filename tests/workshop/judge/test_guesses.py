"""Whether a policy beats guesses without eyes, by policies of which it is known."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.workshop.judge.compare import Fidelity
from rover_lib.workshop.judge.guesses import LEAST_EPISODES, against_guesses, least_blind_errors

CHUNK, RANGE = 8, {"steering": (-1.0, 1.0), "throttle": (0.0, 0.1)}
GUESSES = ["a constant", "the mean plan", "the last action again"]


def drive(episode, frames=60, rise=800):
    """One drive's samples: steering follows what is seen, throttle rises from a stand all the time."""
    rng = np.random.default_rng(episode)
    times = np.arange(frames + CHUNK)
    actions = np.stack([0.8 * np.sin(times / 9 + rng.uniform(0, 6)), np.minimum(times / rise, 0.1)], 1)
    pads = np.arange(frames)[:, None] + np.arange(CHUNK) >= frames
    samples = []
    for i in range(frames):
        did = {"state": np.float32(actions[max(i - 1, 0)]), "chunk": np.float32(actions[i : i + CHUNK])}
        samples.append(SimpleNamespace(episode=f"episode_{episode}", block="", row=i, is_pad=pads[i], **did))
    return samples


def report_of(samples, plans, action_range):
    return Fidelity(
        action_names=("steering", "throttle"),
        action_range=action_range,
        samples=tuple(samples),
        reference=np.float32(plans),
        chunks={},
        recorded=np.stack([s.chunk for s in samples]),
        is_pad=np.stack([s.is_pad for s in samples]),
    )


def judge(plan, episodes=6, action_range=RANGE, rise=800):
    """plan: of a sample. Judged on `episodes` drives, and it could learn from four others, of this rise in throttle."""
    samples = [s for e in range(episodes) for s in drive(e)]
    report = report_of(samples, np.stack([plan(s) for s in samples]), action_range)
    return against_guesses(report, [s for e in range(10, 14) for s in drive(e, rise=rise)])


def noisy(sample):
    return sample.chunk + np.random.default_rng(sample.row).normal(0, (0.1, 0.005), (CHUNK, 2))


def copying(sample):
    return np.tile(sample.state, (CHUNK, 1))


@pytest.mark.parametrize(
    ("plan", "lost"),
    [
        (noisy, {}),
        (lambda s: np.zeros((CHUNK, 2)), {"steering": 2, "throttle": 3}),
        (copying, {"steering": 1, "throttle": 1}),
        (lambda s: s.chunk * [1, 0] + [0, 0.06], {"throttle": 2}),  # blind in throttle alone
        (lambda s: s.chunk * [0, 1], {"steering": 2}),
        (lambda s: s.chunk * [-1, 1], {"steering": 3}),  # mirrored
    ],
)
@pytest.mark.parametrize("episodes", [1, LEAST_EPISODES])
def test_each_action_must_beat_the_guesses(plan, lost, episodes):
    judged = judge(plan, episodes)
    assert {action: list(found.guesses) for action, found in judged.actions.items()} == dict.fromkeys(RANGE, GUESSES)
    missed = {action: len(found.lost()) for action, found in judged.actions.items() if found.lost()}
    assert missed.keys() == lost.keys() and all(missed[action] >= least for action, least in lost.items())
    assert [line.split()[0] for line in judged.warnings()] == list(lost) and judged.notes() == []
    assert ("pieces" in judged.drawn) == (episodes == 1) and str(episodes) in judged.drawn
    assert json.dumps(judged.summary()) and "points" in str(judged.table())


def test_a_policy_no_better_than_a_constant_is_named_with_its_figures():
    """As a racing car's policy that was called ready: 2.60 % off in steering, a constant 2.64 %."""
    (line,) = judge(lambda s: s.chunk * [0.02, 1]).warnings()
    figures = r"2\d\.\d\d % off the driver, a constant 2\d\.\d\d %; better by 0\.\d points \(0\.\d to 0\.\d\) over 6"
    assert re.search(figures, line) and line.startswith("steering is not clearly better than a guess without eyes")


def test_the_last_action_is_no_guess_of_the_next_steps():
    """A car is not told its driver's last action: near it nothing is more exact, but in a plan's later half much is."""
    off = np.where(np.arange(CHUNK) < CHUNK // 2, 0.2, 0.01)[:, None] * [1, 0.05]
    judged = judge(lambda s: s.chunk + off * (1 if s.row % 2 else -1))
    copied = 100 * np.mean([np.abs(copying(s) - s.chunk)[~s.is_pad, 0].mean() for e in range(6) for s in drive(e)]) / 2
    assert 5 < judged.actions["steering"].error_pct < copied + 5 and not judged.warnings()


@pytest.mark.parametrize(
    ("throttle", "says"),
    [
        (lambda t: 0.4 + 0.02 * np.sin(t), "held, not judged"),  # one of a few values around its median
        (lambda t: np.where(t % 50, 0.4, 0.0), "held, not judged"),  # tapped: 2 % zeros
        (lambda t: 0.4 + 0.2 * np.sin(t), "not clearly better"),
        (lambda t: 0.06 * (t % 40 > 20) + 0.03, "not clearly better"),
    ],
)
def test_a_throttle_that_hardly_varies_is_held(throttle, says):
    """The policy steers as the driver did, and holds the throttle: a held one must be that of the recordings."""
    samples = [s for e in range(6) for s in drive(e)]
    for s in samples:
        times = 7 * int(s.episode[-1]) + s.row + np.arange(CHUNK)
        s.chunk = np.column_stack([s.chunk[:, 0], throttle(times)])
    usual = np.median([s.chunk[0, 1] for s in samples])
    ranges = RANGE | {"throttle": (0.0, 0.6)}
    plans = np.stack([np.column_stack([s.chunk[:, 0], np.full(CHUNK, usual)]) for s in samples])
    judged = against_guesses(report_of(samples, plans, ranges), samples)
    (line,) = judged.warnings() + judged.notes()
    assert line.startswith("throttle") and says in line and judged.actions["throttle"].held == ("held" in says)
    if judged.actions["throttle"].held:
        plans[..., 1] = 0
        (line,) = against_guesses(report_of(samples, plans, ranges), samples).warnings()
        assert "throttle hardly varies" in line and "100 % off" in line


@pytest.mark.parametrize(("learned", "held"), [([0.4, 0.42], True), ([0.2, 0.6], False)])
def test_what_is_held_is_decided_by_what_was_learned_from_too(learned, held):
    """So that a training, which holds such a throttle, and the verdict agree, whatever was held out."""
    samples = [s for e in range(6) for s in drive(e)]
    for s in samples:
        s.chunk[:, 1] = 0.4 + 0.2 * np.sin(s.row)
    others = [s for e in range(10, 14) for s in drive(e)]
    for s in others:
        s.chunk[:, 1] = learned[s.row % 2]
    report = report_of(samples, np.stack([s.chunk for s in samples]), RANGE | {"throttle": (0.0, 0.6)})
    assert against_guesses(report, others).actions["throttle"].held == held


@pytest.mark.parametrize("moves", [0.0, 0.001])
def test_where_no_action_varies_nothing_is_shown(moves):
    straight = drive(0)
    for s in straight:
        s.chunk = np.tile(np.float32([0, 0.4]), (CHUNK, 1))
    ranges = {"steering": (0, 0), "throttle": (0.4, 0.4 + moves)}
    report = report_of(straight, np.stack([s.chunk for s in straight]), ranges)
    (line,) = against_guesses(report, straight).warnings()
    assert line == "no action varies enough in these recordings to show whether the policy sees"


def test_blocks_of_long_drives_are_drawn_as_a_whole():
    samples = drive(0, frames=600)
    for s in samples:
        s.block = f"block {s.row // 100}"
    report = report_of(samples, np.stack([noisy(s) for s in samples]), RANGE)
    assert against_guesses(report, samples).drawn == "6 blocks"


def test_the_guesses_know_only_what_could_be_learned_from():
    """By hand: the mean or median, and the mean plan, of four other drives, and the state, which is the last action."""
    judged, seen = judge(lambda s: s.chunk, rise=400), [s for e in range(6) for s in drive(e)]
    learned = [s for e in range(10, 14) for s in drive(e, rise=400)]
    every = np.concatenate([s.chunk[~s.is_pad] for s in learned])
    steps = np.stack([np.mean([s.chunk[i] for s in learned if not s.is_pad[i]], 0) for i in range(CHUNK)])

    def off(plan_of, first=0):
        known = [s for s in seen if not s.is_pad[first]]
        errors = [np.abs(plan_of(s) - s.chunk)[first:][~s.is_pad[first:]].mean(0) for s in known]
        return 100 * np.mean(errors, 0) / [2, 0.1]

    constants = [off(lambda s, c=c: np.tile(c, (CHUNK, 1))) for c in (every.mean(0), np.median(every, 0))]
    expected = np.transpose([np.min(constants, 0), off(lambda s: steps), off(copying, CHUNK // 2)])
    for found, errors in zip(judged.actions.values(), expected, strict=True):
        assert [g.error_pct for g in found.guesses.values()] == pytest.approx(errors, rel=1e-4)


def test_the_best_blind_guess_of_each_action():
    """By hand: steering is best guessed by its median, throttle, which rises in every plan, by the mean plan."""
    learned = np.array([[[0, 0.1], [0, 0.3]], [[0, 0.1], [0, 0.3]], [[0.9, 0.1], [0.9, 9]]])
    pads = np.array([[False, False], [False, False], [False, True]])
    recorded = np.array([[[0.1, 0.1], [0.3, 0.3]], [[-0.1, 0.15], [9, 9]]])
    errors = least_blind_errors(learned, pads, recorded, np.array([[False, False], [False, True]]))
    assert errors == pytest.approx([(0.2 + 0.1) / 2, (0 + 0.05) / 2])


def test_the_interval_has_95_percent_of_the_draws():
    """Of whole episodes, drawn with replacement: the oracle draws by itself, and many more."""
    guess, rng, gains = judge(noisy).actions["steering"].guesses["the mean plan"], np.random.default_rng(1), []
    learned = [s for e in range(10, 14) for s in drive(e)]
    steps = np.stack([np.mean([s.chunk[i] for s in learned if not s.is_pad[i]], 0) for i in range(CHUNK)])
    for samples in map(drive, range(6)):
        plans = np.stack([[steps, np.float32(noisy(s))] for s in samples])
        errors = np.abs(plans - np.stack([s.chunk for s in samples])[:, None])[..., 0] / 0.02
        known = ~np.stack([s.is_pad for s in samples])[:, None]
        by_frame = (errors * known).sum(2) / known.sum(2)
        gains.append((by_frame[:, 0] - by_frame[:, 1]).mean())
    means = np.float64(gains)[rng.integers(0, 6, (100_000, 6))].mean(1)
    low, high = np.percentile(means, [2.5, 97.5])
    assert (guess.low, guess.high) == pytest.approx((low, high), abs=0.05 * (high - low))


def test_what_never_changes_is_not_judged():
    assert judge(noisy, action_range=RANGE | {"throttle": (0.1, 0.1)}).actions.keys() == {"steering"}
