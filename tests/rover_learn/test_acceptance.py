"""A policy is called better by a rule that chance does not pass, whatever the drives were."""

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rover_learn.acceptance import DRAWN, Judged, chance_of, summary, verdict


def judged(kind, *changes):
    """Episodes that are better or worse by so many points, in steering; throttle never changes."""
    return [Judged(f"e{i}", kind, 30, {"steering": 5.0, "throttle": None}, {"steering": 5.0 + c, "throttle": None})
            for i, c in enumerate(changes)]  # fmt: skip


def test_chance_is_the_share_of_all_signs():
    changes = [-1.0, -2.0, 0.5, -0.25, -3.0]
    every = [abs(sum(s * c for s, c in zip(signs, changes, strict=True))) for signs in product((-1, 1), repeat=5)]
    assert chance_of(changes) == sum(e >= abs(sum(changes)) - 1e-12 for e in every) / 32


def test_chance_of_many_is_drawn_and_near_the_normal():
    changes = np.random.default_rng(0).normal(0.4, 1, 40)
    z = abs(changes.sum()) / math.sqrt((changes**2).sum())
    assert chance_of(changes) == pytest.approx(math.erfc(z / math.sqrt(2)), abs=4 / math.sqrt(DRAWN))
    assert chance_of(changes) == chance_of(changes)
    assert 0 < chance_of([-1.0] * 40) <= 1 / DRAWN  # nothing is impossible by chance


@given(st.lists(st.floats(-100, 100), max_size=14), st.floats(0.1, 10))
def test_chance_is_a_share_and_knows_neither_unit_nor_direction(changes, scale):
    found = chance_of(changes)
    assert 0 <= found <= 1
    assert found == pytest.approx(chance_of([-c for c in changes]))
    if all(c == 0 or abs(c) > 1e-3 for c in changes):
        assert found == pytest.approx(chance_of([scale * c for c in changes]), abs=0.05)


@pytest.mark.parametrize(
    ("old", "new", "better", "says"),
    [
        ([0.1, -0.1] * 4, [-1.0] * 8, True, "better: on the new episodes it is 1.00 points nearer"),
        ([0.1, -0.1] * 4, [-1.0] * 5, None, "only 5 new episodes"),
        ([], [-1.0] * 8, None, "only 0 old episodes"),
        ([0.1, -0.1] * 4, [], None, "only 0 new episodes"),
        ([0.1, -0.1] * 4, [-1.0, 1.0] * 4, None, "may be chance"),
        ([0.1, -0.1] * 4, [0.0] * 8, None, "may be chance"),
        ([0.5] * 8, [-1.0] * 8, False, "not better: on the old episodes it is 0.50 points further"),
        ([0.1, -0.1] * 4, [1.0] * 8, False, "worse: on the new episodes"),
        ([-0.5] * 8, [-1.0] * 8, True, "no worse on the old"),
    ],
)
def test_the_rule(old, new, better, says):
    found = verdict(judged("old", *old) + judged("new", *new))
    assert found["better"] is better and says in found["why"]
    assert found["kinds"]["new"]["better"] == sum(c < 0 for c in new)
    assert "randomisation test" in found["rule"]


def test_five_episodes_that_are_all_better_prove_nothing_and_six_do():
    """Why the rule wants six: of five, chance makes 2 in 32 as uneven."""
    assert chance_of([-1.0] * 5) == 2 / 32 > 0.05 > chance_of([-1.0] * 6) == 2 / 64


def test_an_action_that_never_changes_is_not_judged():
    (episode,) = judged("new", -1.0)
    assert episode.change_points == -1.0
    assert episode.row()["before_throttle_pct"] is None and episode.row()["after_steering_pct"] == 4.0
    assert Judged("e", "old", 1, {"throttle": None}, {"throttle": None}).change_points == 0.0


def test_the_summary_names_each_episode():
    rows = judged("old", 0.5) + judged("new", -1.0)
    learned = {"demonstrations": 9, "new_demonstrations": 0, "corrections": 4, "not_imitated": 7}
    metrics = {"learned_from": learned, "held_out": [r.row() for r in rows], "verdict": verdict(rows), "warnings": []}
    text = summary({"metrics": metrics})
    assert "4 of corrections; 7 that no human drove left out" in text
    assert "new e0: 5.00 % to 4.00 %; not judged to not judged" in text and "only 1 old and 1 new episodes" in text
