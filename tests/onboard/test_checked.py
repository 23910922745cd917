"""What counts as a number, for every file, cable and caller."""

import math

import pytest

from rover_lib.onboard.checked import is_number, is_whole


@pytest.mark.parametrize(
    ("value", "number", "whole"),
    [
        (0, True, True),
        (-3, True, True),
        (0.5, True, False),
        (2.0, True, False),
        (True, False, False),
        (math.nan, False, False),
        (math.inf, False, False),
        (10**309, False, True),  # no float can hold it
        ("1", False, False),
        (None, False, False),
        ([1], False, False),
    ],
)
def test_what_is_a_number_and_what_a_whole_one(value, number, whole):
    assert (is_number(value), is_whole(value)) == (number, whole)


@pytest.mark.parametrize("check", [is_number, is_whole])
def test_limits_belong_to_what_may_be(check):
    assert [check(value, 1, 3) for value in (0, 1, 3, 4)] == [False, True, True, False]
