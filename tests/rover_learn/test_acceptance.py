"""A policy is called better by a rule that chance does not pass, whatever the drives were."""

from itertools import product

import pytest

from rover_learn.acceptance import Judged, chance_of, verdict


def judged(kind, *changes):
    """Episodes that are better or worse by so many points, in steering; throttle never changes."""
    return [Judged(f"e{i}", kind, 30, {"steering": 5.0, "throttle": None}, {"steering": 5.0 + c, "throttle": None})
            for i, c in enumerate(changes)]  # fmt: skip


def test_chance_is_the_share_of_all_signs():
    changes = [-1.0, -2.0, 0.5, -0.25, -3.0]
    every = [abs(sum(s * c for s, c in zip(signs, changes, strict=True))) for signs in product((-1, 1), repeat=5)]
    assert chance_of(changes) == sum(e >= abs(sum(changes)) - 1e-12 for e in every) / 32


@pytest.mark.parametrize(
    ("old", "new", "better", "says"),
    [
        ([0.1, -0.1] * 4, [-1.0] * 8, True, "1.00 points nearer"),
        ([0.1, -0.1] * 4, [-1.0] * 5, None, "only 5 new"),
        ([0.1, -0.1] * 4, [-1.0, 1.0] * 4, None, "may be chance"),
        ([0.5] * 8, [-1.0] * 8, False, "on the old episodes it is 0.50"),
        ([0.1, -0.1] * 4, [1.0] * 8, False, "worse: on the new"),
    ],
)
def test_the_rule(old, new, better, says):
    found = verdict(judged("old", *old) + judged("new", *new))
    assert found["better"] is better and says in found["why"]
    assert found["kinds"]["new"]["better"] == sum(c < 0 for c in new)
    assert "randomisation test" in found["rule"]


def test_an_action_that_never_changes_is_not_judged():
    (episode,) = judged("new", -1.0)
    assert episode.change_points == -1.0
    assert episode.row()["before_throttle_pct"] is None and episode.row()["after_steering_pct"] == 4.0
    assert Judged("e", "old", 1, {"throttle": None}, {"throttle": None}).change_points == 0.0
