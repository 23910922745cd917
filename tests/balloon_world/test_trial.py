import numpy as np
import pytest

from balloon_world.trial import run_trials, wilson_interval
from rover_lib.onboard.errors import TrainingError

AHEAD = 21783  # in this world and the next two the balloon is straight ahead


class Constant:
    """Plans one action for ever."""

    chunk = 32

    def __init__(self, steering, throttle):
        self.action = np.array([steering, throttle], np.float32)
        self.states = []

    def predict_chunk(self, frame_bgr, state):
        assert frame_bgr.shape == (360, 640, 3)
        self.states.append(np.array(state))
        return np.tile(self.action, (self.chunk, 1))


# Newcombe 1998, Statistics in Medicine 17, table I, method 3 (Wilson's score); 40 of 40 and 0 of 40 by its formula.
@pytest.mark.parametrize(
    ("hits", "trials", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662), (0, 20, 0.0000, 0.1611), (1, 29, 0.0061, 0.1718), (40, 40, 0.9124, 1.0000),
    ],
)  # fmt: skip
def test_wilson_interval_equals_published_values(hits, trials, low, high):
    assert wilson_interval(hits, trials) == pytest.approx((low, high), abs=6e-5)


def test_hits_are_counted():
    report = run_trials(Constant(0.0, 0.05), worlds=4, seed=AHEAD - 1)
    assert (report.hits, report.trials, report.wilson) == (3, 4, wilson_interval(3, 4))


def test_the_state_is_the_action_before_and_neutral_at_the_start():
    policy = Constant(0.25, 0.03)
    run_trials(policy, worlds=1, replan_every=4)
    assert policy.states[0].tolist() == [0.0, 0.0]
    assert policy.states[0].dtype == np.float32
    assert all(s == pytest.approx([0.25, 0.03]) for s in policy.states[1:])


@pytest.mark.parametrize("wrong", [{"replan_every": 33}, {"worlds": 0}, {"steering": np.nan}])
def test_what_is_not_a_trial_is_refused(wrong):
    policy = Constant(wrong.pop("steering", 0.0), 0.0)
    with pytest.raises(TrainingError):
        run_trials(policy, **{"worlds": 1, **wrong})
