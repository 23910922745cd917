"""What a plan follows; tests/workshop/judge/test_compare.py has shares of the recorded range."""

from rover_lib.workshop.judge.recorded_range import follows


def test_a_plan_follows_what_moves_it_by_a_tenth_and_by_1_percent():
    assert follows(1.1, 10.0) and not follows(1.0, 5.0) and not follows(2.0, 20.0) and follows(2.1, 20.0)
