"""Errors as shares of the recorded range, and actions that were never moved."""

from rover_lib.workshop.judge.recorded_range import constant_actions, follows, pct_of_range, worst

RANGES = {"steering": (-0.5, 0.5), "throttle": (0.06, 0.06)}


def test_an_error_is_a_share_of_what_was_recorded():
    assert pct_of_range(0.01, RANGES["steering"]) == 1.0 and pct_of_range(0.01, RANGES["throttle"]) is None
    assert constant_actions(RANGES) == ["throttle"]
    assert worst({"steering": 0.3, "throttle": None}) == worst([0.1, None, 0.3]) == 0.3
    assert worst({"throttle": None}) is None


def test_a_plan_follows_what_moves_it_by_a_tenth_and_by_1_percent():
    assert follows(1.1, 10.0) and not follows(1.0, 5.0) and not follows(2.0, 20.0) and follows(2.1, 20.0)
