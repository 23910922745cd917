"""Errors as shares of the recorded range, and actions that were never moved."""

from rover_lib.workshop.judge.recorded_range import constant_actions, format_pct, not_judged, pct_of_range, worst

RANGES = {"steering": (-0.5, 0.5), "throttle": (0.06, 0.06)}


def test_an_error_is_a_share_of_what_was_recorded():
    assert pct_of_range(0.01, RANGES["steering"]) == 1.0


def test_an_action_that_never_changes_is_not_judged():
    assert pct_of_range(0.01, RANGES["throttle"]) is None
    assert constant_actions(RANGES) == ["throttle"]
    assert [w.partition(",")[0] for w in not_judged(RANGES)] == ["throttle never changes in these recordings"]


def test_what_is_not_judged_is_never_the_worst():
    assert worst({"steering": 0.3, "throttle": None}) == worst([0.1, None, 0.3]) == 0.3
    assert worst({"throttle": None}) is None


def test_what_is_not_judged_is_said_so():
    assert format_pct(0.114) == "  0.11 %" and format_pct(None) == "not judged"
