"""The study of stuck cars can fail: a car at a wall is stopped in it, a free one is not."""

import pytest

from research.stuck import study


@pytest.mark.research
def test_the_car_at_a_wall_is_stopped_and_the_free_one_hits(demo_run):
    found = study(demo_run / "policy_static.pt", None, walls=1, good=1)
    assert (found["walls_stopped_in_time"], found["good_stopped"], found["good_hits"]) == (1, 0, 1)
