"""A policy is called better by a rule that chance does not pass, whatever the drives were."""

from itertools import product

import pytest

from rover_learn.acceptance import chance_of, change_points, verdict


def rows_of(kind, *changes):
    """Episodes that are better or worse by so many points, in steering; throttle never changes."""
    never = {"before_throttle_pct": None, "after_throttle_pct": None}
    return [{"kind": kind, "before_steering_pct": 5.0, "after_steering_pct": 5.0 + c} | never for c in changes]


def test_chance_is_the_share_of_all_signs():
    changes = [-1.0, -2.0, 0.5, -0.25, -3.0]
    every = [abs(sum(s * c for s, c in zip(signs, changes, strict=True))) for signs in product((-1, 1), repeat=5)]
    assert chance_of(changes) == sum(e >= abs(sum(changes)) - 1e-12 for e in every) / 32


@pytest.mark.parametrize(
    ("old", "new", "better"),
    [
        ([0.1, -0.1] * 4, [-1.0] * 8, True),
        ([0.1, -0.1] * 4, [-1.0] * 5, None),  # too few
        ([0.1, -0.1] * 4, [-1.0, 1.0] * 4, None),  # may be chance
        ([0.5] * 8, [-1.0] * 8, False),
        ([0.1, -0.1] * 4, [1.0] * 8, False),
    ],
)
def test_the_rule(old, new, better):
    assert verdict(rows_of("old", *old) + rows_of("new", *new))["better"] is better


def test_an_action_that_never_changes_is_not_judged():
    (row,) = rows_of("new", -1.0)
    assert change_points(row) == -1.0
    assert change_points({"before_throttle_pct": None, "after_throttle_pct": None}) == 0.0
