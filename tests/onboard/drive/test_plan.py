"""Chunks used by time: against the arithmetic, and wild sequences of plans."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.onboard.drive.plan import Commanded, Follower, Plan, Settings
from rover_lib.onboard.errors import ParamsError, PolicyError

RATE = 30.0
STEP = 1 / RATE


def ramp(start=0.0, slope=0.01, throttle=0.05, chunk=32):
    return np.stack([start + slope * np.arange(chunk), np.full(chunk, throttle)], 1)


def follower(**settings):
    return Follower(Settings(**{"blend_ticks": 0, "throttle_limit": 1.0, **settings}), RATE)


@pytest.mark.parametrize(("fade_s", "stop_s"), [(60.0, 60.0), (0.5, 60.0), (1.0, 1.0)])
def test_one_picture_drives_for_a_metre_at_most(fade_s, stop_s):
    """With a minute each, a policy of 5 Hz and 256 actions, one picture drove for 51 s."""
    with pytest.raises(ParamsError, match=r"by one picture the car would go [\d.]+ m at 1.1 m/s, and it may 1"):
        Settings(fade_s=fade_s, stop_s=stop_s)
    Settings(fade_s=1 / 1.1, stop_s=1 / 1.1)  # a metre


def test_a_plan_is_used_by_time():
    f = follower()
    f.add(Plan(1, captured_s=10.0, ready_s=10.15, actions=ramp()), 10.15)
    command = f.command(10.15)  # 4.5 steps after the frame that it looked at
    assert command.steering == pytest.approx(0.045)
    assert command.age_s == pytest.approx(0.15)
    f = follower(compensate=False)  # then it begins when it is ready
    f.add(Plan(1, 10.0, 10.15, ramp()), 10.15)
    assert f.command(10.15).steering == pytest.approx(0.0)


def test_nothing_to_drive_by():
    f = follower()
    assert f.command(0.0) is None
    f.add(Plan(1, 0.0, 0.1, ramp()), 0.1)
    assert f.command(0.99) is not None
    assert f.command(1.0) is None
    f = follower()
    f.add(Plan(1, 0.0, 0.0, ramp(chunk=8)), 0.0)  # a short chunk ends earlier
    assert f.command(0.26) is not None and f.command(8 * STEP) is None


def test_the_throttle_fades_with_the_plans_age():
    f = follower()
    f.add(Plan(1, 0.0, 0.1, ramp()), 0.1)
    assert f.command(0.5).throttle == pytest.approx(0.05)
    assert f.command(0.75).throttle == pytest.approx(0.025)
    assert f.command(0.75).fade == pytest.approx(0.5)
    assert f.command(0.9999).throttle == pytest.approx(0.0, abs=1e-4)
    assert f.command(0.75).steering == pytest.approx(0.225)  # steering does not fade


def strange(score, n=1, at_s=0.0):
    return Plan(n, at_s, at_s, ramp(throttle=0.05), strange=score)


@pytest.mark.parametrize(("unfamiliar", "throttle"), [("stop", 0.025), ("warn", 0.05), (False, 0.05)])
def test_an_unfamiliar_place_fades_the_throttle_as_an_old_plan_does(unfamiliar, throttle):
    f = Follower(Settings.of({"blend_ticks": 0, "unfamiliar": unfamiliar}), RATE)  # False: YAML's off
    for i, score in enumerate((0.9, 1.05, 1.04, 1.0, 0.0, 0.0)):  # mean of three: 0.98, 0.997, 1.03 at 0.3 s, ...
        f.add(strange(score, i + 1, i / 10), i / 10)
        if i == 2:
            assert f.strange_s is None and f.command(i / 10).fade == 1.0
    assert f.strange_s == 0.3 and f.strange == pytest.approx(1 / 3)
    assert f.command(0.55).throttle == pytest.approx(throttle)
    assert (f.command(0.81) is None) == (unfamiliar == "stop")  # although it went back: a drive never forgets it


def test_an_older_frames_plan_is_left_aside():
    f = follower()
    f.add(Plan(1, 1.0, 1.1, ramp(0.5)), 1.1)
    f.add(Plan(2, 0.9, 1.2, ramp(-0.5)), 1.2)
    assert f.plan.number == 1


@given(
    st.lists(st.tuples(st.floats(-1, 1), st.floats(0, 1)), min_size=2, max_size=12),
    st.integers(0, 6),
    st.integers(1, 9),
)
def test_no_jump_beyond_what_blending_allows(levels, blend, every):
    """Of constant plans: commands stay among what the plans said, and a settled one is left in equal steps."""
    f = follower(blend_ticks=blend)
    now, before = 0.0, None
    for i, level in enumerate(levels):
        f.add(Plan(i + 1, now, now, np.tile(level, (32, 1))), now)
        low, high = np.min(levels[: i + 1], 0), np.max(levels[: i + 1], 0)
        for tick in range(every):
            command = f.command(now)
            found = np.array([command.steering, command.throttle])
            assert (low - 1e-9 <= found).all()
            assert (found <= high + 1e-9).all()
            if tick == 0 and before is not None and every > blend:
                assert found - before == pytest.approx((np.array(level) - before) / (blend + 1), abs=1e-9)
            before = found
            now += STEP


NO_PLANS = [[np.nan, 0.0]], [[0.0, np.inf]], [[-1.3, 0.0]], [[0.0, -0.3]], np.zeros((4, 3)), np.zeros((0, 2))


@pytest.mark.parametrize("actions", NO_PLANS, ids=range(len(NO_PLANS)))
def test_no_plan_of_what_must_not_drive(actions):
    with pytest.raises(PolicyError):
        Plan(1, 0.0, 0.0, np.array(actions))


def test_a_little_beyond_an_end_is_clipped():
    plan = Plan(1, 0.0, 0.0, np.array([[1.1, -0.02], [-1.2, 1.2]]))
    assert plan.actions.tolist() == [[1.0, 0.0], [-1.0, 1.0]]


def test_the_state_is_what_was_commanded_a_step_before():
    """As in training: a frame's state is the action of the frame before it."""
    commanded = Commanded()
    assert commanded.state(0.0, RATE).tolist() == [0.0, 0.0]
    for i in range(10):  # each frame's command goes out 3 ms after it
        commanded.add(i * STEP + 0.003, i / 10, 0.0)
    for frame in range(1, 10):
        assert commanded.state(frame * STEP, RATE)[0] == pytest.approx((frame - 1) / 10)
    assert commanded.state(0.0, RATE).tolist() == [0.0, 0.0]  # before the first command: neutral


def test_a_command_that_is_no_longer_in_force_is_no_state():
    """The Arduino stops a car 150 ms after its last command: what was commanded before is not what the car does."""
    commanded = Commanded()
    commanded.add(1.0, 0.5, 0.3)
    assert commanded.state(1.0 + STEP + 0.149, RATE).tolist() == pytest.approx([0.5, 0.3])  # a loop of 10 Hz, say
    assert commanded.state(1.0 + STEP + 0.151, RATE).tolist() == [0.0, 0.0]
    assert commanded.state(60.0, RATE).tolist() == [0.0, 0.0]


WRONG = {"stop_s": math.nan}, {"fade_s": True}, {"unfamiliar": "no"}, {"frozen_frames": 0}, {"ensemble": None}


@pytest.mark.parametrize("wrong", WRONG)
def test_settings_that_make_no_sense(wrong):
    with pytest.raises(ParamsError, match=r"params\.yml"):
        Settings.of(wrong)
