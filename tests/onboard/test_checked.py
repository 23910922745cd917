"""What counts as a number, for every file, cable and caller."""

import math

from rover_lib.onboard.checked import is_number, is_whole


def test_what_is_a_number_and_what_a_whole_one():
    for value in (0, -3):
        assert is_number(value) and is_whole(value)
    for value in (0.5, 2.0):
        assert is_number(value) and not is_whole(value)
    for value in (True, math.nan, math.inf, "1", None, [1]):
        assert not is_number(value) and not is_whole(value)
    assert not is_number(10**309) and is_whole(10**309)  # no float can hold it


def test_limits_belong_to_what_may_be():
    assert [is_number(value, 1, 3) for value in (0, 1, 3, 4)] == [False, True, True, False]
    assert [is_whole(value, 1, 3) for value in (0, 1, 3, 4)] == [False, True, True, False]
