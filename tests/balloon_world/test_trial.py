import numpy as np
import pytest

from balloon_world.trial import run_trials, wilson_interval
from balloon_world.world import World
from rover_lib.onboard.errors import TrainingError


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


class SeesRed:
    """Steers to the middle of what is red in the picture, however it is told."""

    chunk = 32

    def predict_chunk(self, frame_bgr, state):
        blue, green, red = frame_bgr[::2, ::2].astype(int).transpose(2, 0, 1)
        columns = np.nonzero((red > 70) & (red > 2.2 * np.maximum(blue, green)))[1]
        column = columns.mean() if len(columns) else 160
        return np.tile(np.float32([np.clip((column - 160) / 200, -0.65, 0.65), 0.05]), (self.chunk, 1))


# Newcombe 1998, Statistics in Medicine 17, table I, method 3 (Wilson's score); 40 of 40 and 0 of 40 by its formula.
@pytest.mark.parametrize(
    ("hits", "trials", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662), (0, 20, 0.0000, 0.1611), (1, 29, 0.0061, 0.1718), (40, 40, 0.9124, 1.0000),
    ],
)  # fmt: skip
def test_wilson_interval_equals_published_values(hits, trials, low, high):
    assert wilson_interval(hits, trials) == pytest.approx((low, high), abs=6e-5)


@pytest.mark.slow
def test_a_blind_policy_misses_and_one_that_sees_hits():
    blind = run_trials(Constant(0.0, 0.05), worlds=10)
    seeing = run_trials(SeesRed(), worlds=10, replan_every=2)
    assert blind.hits <= 3
    assert seeing.hits >= 7
    assert seeing.wilson == wilson_interval(seeing.hits, 10)


def test_a_report_tells_of_every_world():
    report = run_trials(Constant(0.2, 0.05), worlds=3, seed=500)
    assert report.trials == len(report.per_world) == 3 and report.hits == sum(w.hit for w in report.per_world)
    for seed, result in enumerate(report.per_world, 500):
        track, balloon = result.trajectory, World(seed).balloon
        assert len(track.x_m) == len(track.y_m) == len(track.steering) == len(track.throttle)
        assert len(track.x_m) == round(result.duration_s * 30) + 1
        assert track.balloon_xy_m == (balloon.x_m, balloon.y_m)


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
