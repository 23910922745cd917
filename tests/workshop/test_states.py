"""What a recorded state is, if it is not the last action, on steering that is smooth and throttle that is tapped."""

import numpy as np
import pytest

from rover_lib.workshop.states import explain_state, last_actions

NAMES = ("steering", "throttle")


def actions(frames=120):
    t = np.arange(frames)
    return np.stack([0.4 * np.sin(t / 15), np.where(t // 7 % 2, 0.2, 0.25)], 1).astype(np.float32)


def before(of, rows=1):
    return np.concatenate([np.zeros((rows, 2), np.float32), of[:-rows]])


NOISE = np.random.default_rng(0).normal(0, 0.01, (120, 2))


@pytest.mark.parametrize(
    ("state", "words"),
    [
        (before, ""),
        (lambda a: before(a).round(2), ""),
        (lambda a: before(a) + NOISE * (1, 0.2), ""),
        (np.zeros_like, "steering and throttle: always 0"),
        (lambda a: before(a) * (1, 0) + (0, 0.3), "throttle: always 0.3"),
        (lambda a: a, "steering and throttle: the action of the same row"),
        (lambda a: before(a, 3), "steering and throttle: the action 3 rows before"),
        (lambda a: np.roll(a, -1, 0), "the action 1 row later"),
        (lambda a: before(a) * (30, 100), "steering: 30 times the last action, throttle: 100 times the last action"),
        (lambda a: before(a) * (450, 828) + (1456, 120), "450 times the last action plus 1.46e+03"),
        (lambda a: -a, "-1 times the action of the same row"),
        (
            lambda a: before(a)[:, ::-1],
            "steering: the last action, of throttle, throttle: the last action, of steering",
        ),
        (lambda a: before(a) + NOISE * (1, 0.35), ""),
        (lambda a: NOISE, "follows no action"),
    ],
)
def test_a_state_that_is_not_the_last_action_is_called_what_it_is(state, words):
    found = explain_state(state(actions()), actions(), NAMES)
    assert (words in found) if words else not found


def test_what_never_varies_is_right_where_the_action_does_not_either():
    of = actions() * (1, 0) + (0, 0.2)
    assert explain_state(before(of) * (1, 0) + (0, 0.2), of, NAMES) == ""
    assert explain_state(before(of) * (1, 0), of, NAMES) == "throttle: always 0"
    assert explain_state(of[:5], of[:5], NAMES) == "", "too few to tell"


def test_the_last_action_begins_anew_with_an_episode():
    first = np.array([True, False, True, False])
    assert last_actions(np.arange(8.0).reshape(4, 2), first).tolist() == [[0, 0], [0, 1], [0, 0], [4, 5]]
