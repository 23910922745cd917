"""The rule that recommends a student: against counts by hand, and every way in which coins can fall."""

from itertools import product

import pytest

from balloon_world.frontier import (
    NOBODY_DROVE,
    gates_of,
    pair_worlds,
    points_above,
    recommendation,
    sentences,
    sign_test,
    table,
)
from rover_lib.onboard.params import params

LIMITS = params()["students"]
SEEDS = list(range(10_000, 10_200))


def row(name, lost=0, pushed_lost=0, above=0.0, work=1.0, **changed):
    """A policy that misses `lost` of 200 worlds when left alone, and `pushed_lost` of them when it is pushed."""
    values = {"name": name, "height": 180, "width": 320, "decoder_layers": 2, "feedforward": 1600, "qat": False}
    values |= {"gmac": 10 * work, "instructions_g": work, "simd_g": work, "size_mb": 30.0}
    values |= {"computed_ms": [40 * work, 60 * work], "pushed_latency_ms": 60 * work}
    for action in ("steering", "throttle"):
        values |= {f"teacher_{action}_pct": 0.1 + above, f"recorded_{action}_pct": 5 + above}
    for key, missed in (("", SEEDS[:lost]), ("pushed_", SEEDS[:pushed_lost])):
        values |= {f"{key}hits": 200 - len(missed), f"{key}trials": 200, f"{key}missed": missed}
    return values | changed


TEACHER = row("teacher", pushed_lost=20)
NOT_DRIVEN = {f"{key}{what}": None for key in ("", "pushed_") for what in ("hits", "trials", "missed")}


def metrics(*students, teacher=TEACHER):
    rows = [teacher, *students]
    return {
        "students": rows,
        "recommendation": recommendation(rows, LIMITS),
        "limits": LIMITS,
        "notes": ["a note"],
        "warnings": [],
    }


def test_the_limits_are_four_of_200_worlds_none_pushed_and_three_tenths_of_a_point():
    assert LIMITS == {"worlds_lost_pct": 2, "pushed_worlds_lost_pct": 0, "recorded_points": 0.3}


@pytest.mark.parametrize(
    ("student", "passed"),
    [
        (row("s", lost=4, pushed_lost=20, above=0.29), [True, True, True]),
        (row("s", lost=5, pushed_lost=0), [False, True, True]),
        (row("s", pushed_lost=21), [True, False, True]),
        (row("s", above=0.31), [True, True, False]),
        (row("s", recorded_steering_pct=4.0, recorded_throttle_pct=5.31), [True, True, False]),
        (row("s", pushed_hits=None, pushed_trials=None, pushed_missed=None), [True, None, True]),
    ],
)
def test_each_limit_is_held(student, passed):
    assert [g["passed"] for g in gates_of(student, TEACHER, LIMITS)] == passed
    assert recommendation([TEACHER, student], LIMITS)["name"] == ("s" if all(passed) else "teacher")


def test_of_40_worlds_not_one_may_be_lost():
    """The same share: 4 of 200 are 0.8 of 40."""
    forty = {"trials": 40, "pushed_trials": 40, "pushed_hits": 40}
    teacher = row("teacher", hits=40, **forty)
    assert recommendation([teacher, row("s", hits=40, **forty)], LIMITS)["name"] == "s"
    assert recommendation([teacher, row("s", hits=39, **forty)], LIMITS)["name"] == "teacher"


def test_the_fastest_of_those_that_keep_to_it():
    slow, fast, wrong = row("slow", work=0.5), row("fast", work=0.3), row("wrong", work=0.1, lost=9)
    verdict = recommendation([TEACHER, slow, fast, wrong], LIMITS)
    assert (verdict["name"], verdict["fastest_by"], len(verdict["gates"])) == ("fast", "instructions_g", 9)
    uncounted = row("slow", work=0.5, instructions_g=None, gmac=1.0)
    assert recommendation([TEACHER, uncounted, fast, wrong], LIMITS)["name"] == "slow"  # then by multiply-accumulates


def test_where_nobody_drove_errors_decide_and_it_is_said():
    teacher, student = row("teacher", **NOT_DRIVEN), row("s", **NOT_DRIVEN)
    found = metrics(student, teacher=teacher)
    assert found["recommendation"]["name"] == "s"
    assert [g["gate"] for g in found["recommendation"]["gates"]] == ["s error to the recordings, points above"]
    text = "\n".join(sentences(found))
    assert NOBODY_DROVE in text and "worlds" not in text
    assert metrics(row("s", above=1, **NOT_DRIVEN), teacher=teacher)["recommendation"]["name"] == "teacher"


def test_an_action_that_never_changes_does_not_judge():
    student, teacher = (row(n, recorded_throttle_pct=None, teacher_throttle_pct=None) for n in ("s", "teacher"))
    assert points_above(student, teacher) == 0
    assert "5.00 / not judged" in str(table(metrics(student, teacher=teacher)))


@pytest.mark.parametrize(("one", "other"), [(0, 0), (0, 1), (1, 0), (3, 3), (0, 6), (2, 9), (10, 1)])
def test_the_sign_test_is_of_coins_that_fall_as_unevenly(one, other):
    n = one + other
    uneven = [sum(coins) for coins in product((0, 1), repeat=n) if abs(2 * sum(coins) - n) >= abs(one - other)]
    assert sign_test(one, other) == pytest.approx(len(uneven) / 2**n, abs=1e-12)


def test_pairs_are_of_the_same_worlds():
    student = row("s", missed=SEEDS[3:8])
    teacher = row("teacher", missed=SEEDS[:4])
    found = pair_worlds(student, teacher, "")
    assert (found["only_student"], found["only_teacher"]) == (3, 4)
    assert pair_worlds(row("s", **NOT_DRIVEN), teacher, "") is None


def test_the_recommendation_is_said_in_words():
    text = "\n".join(sentences(metrics(row("fast", lost=2, pushed_lost=8, work=0.2), row("bad", lost=30, work=0.1))))
    assert "loses at most 2 % of the worlds when left alone and 0 % when pushed" in text
    assert "Recommended: fast (320x180, 2 decoder layers of 1600), which has the fewest instructions of those" in text
    assert (
        "fast, pushed: 192 of 200 worlds, its teacher 180 of 200; 12 only the student hit, 0 only the teacher: " in text
    )
    assert "chance alone seldom does that (sign test, p = 0.00049)." in text
    assert "Not kept: bad worlds lost, left alone, %: 15.00, at most 2." in text
    text = "\n".join(sentences(metrics(row("bad", lost=30))))
    assert "stay with the teacher" in text and "bad, pushed: 200 of 200" in text


def test_the_table_says_what_was_not_counted():
    text = str(table(metrics(row("fast", instructions_g=None, computed_ms=None, qat=True))))
    assert "fast: 320x180, 2 decoder layers of 1600, QAT" in text and "not counted" in text
    assert "180 of 200 at 60 ms" in text and "0.10 / 0.10" in text and text.endswith("a note")
