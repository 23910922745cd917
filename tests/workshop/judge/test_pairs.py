"""Two policies in the same worlds, against what the interval and the test are defined by."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.workshop.judge.pairs import Z, compare_pairs, loss_interval, sign_test


@pytest.mark.parametrize(("one", "other"), [(12, 2), (2, 12), (4, 0), (1, 1)])
def test_the_interval_ends_where_the_score_is_that_of_95_percent(one, other, worlds=50):
    """The likeliest shares for a given loss are looked for on a grid."""
    for loss, score in zip(loss_interval(one, other, worlds), (Z, -Z), strict=True):
        only_other = np.linspace(max(0, -loss), (1 - loss) / 2, 1_000_001)[1:-1]
        only_one = only_other + loss
        both = 1 - only_one - only_other
        likely = one * np.log(only_one) + other * np.log(only_other) + (worlds - one - other) * np.log(both)
        rare = (only_one + only_other)[likely.argmax()]
        assert (one - other - worlds * loss) / math.sqrt(worlds * (rare - loss**2)) == pytest.approx(score, rel=1e-3)


@given(st.integers(0, 12), st.integers(0, 12))
def test_the_p_is_of_coins_that_fall_as_unevenly(one, other):
    n = one + other
    uneven = sum(math.comb(n, k) for k in range(n + 1) if abs(2 * k - n) >= abs(one - other))
    assert sign_test(one, other) == pytest.approx(uneven / 2**n)


def test_worlds_that_both_hit_say_how_much_could_have_been_seen():
    found = compare_pairs([True] * 40, [True] * 40)
    assert (found["only_first"], found["only_second"], found["p"], found["least_loss"]) == (0, 0, 1.0, 4)
    assert -found["loss_low"] == pytest.approx(found["loss_high"], abs=1e-6) and 3 < found["loss_high"] < 4
    lost = compare_pairs([True] * 40, [False] * 6 + [True] * 34)
    assert lost["only_first"] == 6 and lost["p"] < 0.05 and lost["loss_low"] > 0
