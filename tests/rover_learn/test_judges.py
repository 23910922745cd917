"""Each action's error stands beside the best guess without eyes, and what was not learned is named. Numbers by hand."""

import numpy as np
import pytest

from rover_learn.act_phases import loss_weights_of
from rover_learn.judges import Judges, not_learned

NAMES = "steering", "throttle"


def chunks(steering, throttle) -> tuple[np.ndarray, np.ndarray]:
    """Plans of two equal steps."""
    actions = np.stack([steering, throttle], 1).astype(np.float32)
    return np.repeat(actions[:, None], 2, axis=1), np.zeros((len(actions), 2), bool)


def judged_by(throttle) -> Judges:
    """Steering from -1 to 1 with mean 0, half of it at each end; the range is 2."""
    learned = chunks([-1, 1, -1, 1], throttle)
    return Judges.of(NAMES, *learned, *learned)


def test_errors_count_in_the_range_beside_the_best_guess():
    judges = judged_by([0.1, 0.3, 0.1, 0.3])
    assert judges.ranges.tolist() == pytest.approx([2, 0.2]) and judges.blind_pct.tolist() == pytest.approx([50, 50])
    errors = judges.errors_pct(judges.chunks + np.array([0.1, 0.05], np.float32))
    assert errors.tolist() == pytest.approx([5, 25])
    assert judges.words(errors) == (
        "steering 5.0 % off (a guess without eyes 50.0 %), throttle 25.0 % off (a guess without eyes 50.0 %)"
    )


def test_what_comes_after_the_end_of_a_recording_is_not_judged():
    judges = judged_by([0.1, 0.3, 0.1, 0.3])
    judges.is_pad[:, 1] = True
    plans = judges.chunks.copy()
    plans[:, 1] += 9
    assert judges.errors_pct(plans).tolist() == [0, 0]


def test_an_action_that_varies_and_is_no_better_than_a_guess_was_not_learned():
    judges = judged_by([0.1, 0.3, 0.1, 0.3])
    assert [f["learned"] for f in judges.summary(np.array([48.0, 10.0])).values()] == [False, True]
    (sentence,) = not_learned(judges.summary(np.array([48.0, 10.0])))
    assert sentence.startswith("steering was not learned: 48.0 % off, a guess without eyes 50.0 %. What helps: ")
    assert "throttle" in not_learned(judges.summary(np.array([1.0, 50.0])))[0]
    assert not not_learned(judges.summary(np.array([1.0, 10.0])))


@pytest.mark.parametrize("throttle", [[0.3, 0.3, 0.3, 0.3], [0.3, 0.31, 0.3, 0.3]])
def test_a_throttle_that_is_held_need_not_be_learned(throttle):
    judges = judged_by(throttle)
    assert judges.varies.tolist() == [True, False] and judges.ranges[1] == pytest.approx(0.02)
    assert not not_learned(judges.summary(np.array([1.0, 60.0])))


def test_how_much_an_error_counts():
    """Ranges of 2 and 0.2; a steering that spreads by half of its range counts 1 there, and a held throttle a tenth."""
    for throttle, weights in (([0.1, 0.3, 0.1, 0.3], [1, 10]), ([0.3, 0.31, 0.3, 0.3], [1, 10])):
        judges = judged_by(throttle)
        assert loss_weights_of(judges, np.array([1, 0.02])).tolist() == pytest.approx(weights)


def test_a_throttle_is_held_by_what_is_learned_from():
    """What chooses the best weights is a small part: a throttle may hardly vary there by chance."""
    varied, still = chunks([-1, 1, -1, 1], [0.1, 0.3, 0.1, 0.3]), chunks([-1, 1, -1, 1], [0.3, 0.31, 0.3, 0.3])
    assert Judges.of(NAMES, *varied, *still).varies.tolist() == [True, True]
    assert Judges.of(NAMES, *still, *varied).varies.tolist() == [True, False]
