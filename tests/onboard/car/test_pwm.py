"""Actions and pulses: the recorded pulses are the oracle, 4 us (the Arduino's timer step) the tolerance."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recorded import real_episode

from rover_lib.onboard.car.pwm import ARDUINO_STEP_US, NEUTRAL, Channel, Pulses, PwmCalibration
from rover_lib.onboard.errors import PwmError

PWM = PwmCalibration()


@pytest.fixture
def pwm():
    return PwmCalibration()


def test_zero_throttle_is_a_stopped_car(pwm):
    assert pwm.pulses(steering=0.0, throttle=0.0).throttle_us == 120


def test_neutral_is_straight_and_stopped(pwm):
    assert NEUTRAL == (0.0, 0.0)
    assert pwm.neutral() == Pulses(steering_us=1456, throttle_us=120)
    assert (pwm.steering.neutral_us, pwm.throttle.neutral_us) == (1456, 120)


def test_ends(pwm):
    assert pwm.pulses(-1, 0) == Pulses(900, 120)
    assert pwm.pulses(1, 1) == Pulses(2012, 711)


def test_recorded_pulses_come_back_within_a_timer_step(pwm):
    sample_episode = real_episode()
    controls = json.loads((sample_episode / "episode_data.json").read_text())["control_samples"]
    checked = clipped = 0
    for control in controls:
        for name in ("steering", "throttle"):
            channel = pwm.channel(name)
            pulse_us, period_us = control[f"{name}_raw_us"], control[f"{name}_period_us"]
            recorded = control[f"{name}_normalized"]
            action = channel.action(pulse_us, period_us)
            if action is None:
                assert recorded == 0  # the firmware's "no pulse", which is why a 0 proves nothing
                continue
            # raw -> normalised is what the firmware wrote, to its 4 decimals
            assert action == pytest.approx(recorded, abs=5.1e-5)
            if action in (channel.low, channel.high) or action == 0 != pulse_us - channel.neutral_us:
                clipped += 1  # a throttle below "stopped" comes back as stopped
                assert channel.pulse_us(recorded) == channel.pulse_us(action)
                continue
            assert abs(channel.pulse_us(recorded) - pulse_us) <= ARDUINO_STEP_US
            back = channel.action(channel.pulse_us(recorded))
            assert abs(back - recorded) * channel.us_per_unit <= ARDUINO_STEP_US
            checked += 1
    assert checked > 400
    assert clipped <= 3


@pytest.mark.parametrize(
    ("pulse_us", "period_us", "normalised"),
    # readings of a real drive: left and right, and both ends that were seen on the wire
    [
        (1488, 21312, 0.0583), (1500, 21308, 0.0804), (1492, 21308, 0.066), (1488, 21316, 0.0578),
        (1500, 21300, 0.0814),
    ],
)  # fmt: skip
def test_steering_of_real_readings(pwm, pulse_us, period_us, normalised):
    assert pwm.steering.action(pulse_us, period_us) == pytest.approx(normalised, abs=5.1e-5)
    assert abs(pwm.steering.pulse_us(normalised) - pulse_us) <= ARDUINO_STEP_US


def test_throttle_of_real_readings(pwm):
    assert pwm.throttle.action(136, 1016) == pytest.approx(0.0271, abs=5.1e-5)
    assert pwm.throttle.action(136, 1012) == pytest.approx(0.0280, abs=5.1e-5)
    assert pwm.throttle.action(104, 1016) == 0  # below "stopped": measured, and stopped
    assert pwm.throttle.action(948, 1016) == 1


@pytest.mark.parametrize(
    ("name", "pulse_us", "period_us"),
    [
        ("throttle", 0, 0),
        ("throttle", 0, 1016),
        ("throttle", 136, 0),
        ("throttle", 136, 2032),  # two periods at once
        ("throttle", 136, 508),
        ("throttle", 1016, 1016),
        ("steering", 1456, 0),
        ("steering", 1456, 42632),
        ("steering", -4, 21316),
    ],
)
def test_no_pulse_is_no_action(pwm, name, pulse_us, period_us):
    assert pwm.channel(name).action(pulse_us, period_us) is None


def test_actions_say_what_was_measured(pwm):
    both = pwm.actions_from_pulses(1456, 120, 21316, 1016)
    assert both.measured
    assert both.steering == pytest.approx(0, abs=1e-3)
    lost = pwm.actions_from_pulses(1456, 0, 21316, 0)
    assert lost.throttle is None
    assert lost.steering is not None
    assert not lost.measured


BAD = [math.nan, math.inf, -math.inf, None, "0.1", "", b"1", [0.0], True, 1j, 10**400, np.array(0.1)]


@pytest.mark.parametrize("bad", BAD, ids=lambda b: f"{type(b).__name__} {b!r}"[:24])
def test_what_is_no_number_never_becomes_a_pulse(pwm, bad):
    with pytest.raises(PwmError):
        pwm.pulses(bad, 0.0)
    with pytest.raises(PwmError):
        pwm.pulses(0.0, bad)
    with pytest.raises(PwmError):
        pwm.actions_from_pulses(bad, 120)
    if bad is not None:  # None means the nominal period
        with pytest.raises(PwmError):
            pwm.actions_from_pulses(1456, 120, bad, 1016)


@pytest.mark.parametrize(("steering", "throttle"), [(1.001, 0), (-1.001, 0), (0, 1.001), (0, -0.001)])
def test_out_of_range_never_becomes_a_pulse(pwm, steering, throttle):
    with pytest.raises(PwmError, match="must be in"):
        pwm.pulses(steering, throttle)


@given(st.floats(), st.floats())
def test_a_pulse_is_within_the_servos_range_or_refused(steering, throttle):
    try:
        pulses = PWM.pulses(steering, throttle)
    except PwmError:
        assert not (-1 <= steering <= 1 and 0 <= throttle <= 1)
    else:
        assert 900 <= pulses.steering_us <= 2012
        assert 120 <= pulses.throttle_us <= 711
        assert isinstance(pulses.steering_us, int)


@given(st.floats(-1, 1, width=32), st.floats(0, 1, width=32))
def test_action_to_pulse_and_back(steering, throttle):
    pulses = PWM.pulses(np.float32(steering), np.float32(throttle))
    back = PWM.actions_from_pulses(pulses.steering_us, pulses.throttle_us)
    # a pulse is a whole microsecond: half of one is all that may be lost
    assert abs(back.steering - steering) * PWM.us_per_unit("steering") <= 0.5001
    assert abs(back.throttle - throttle) * PWM.us_per_unit("throttle") <= 0.5001


@given(st.integers(900, 2012), st.integers(21300, 21332), st.integers(121, 706), st.integers(1012, 1020))
def test_pulse_to_action_and_back(steering_us, steering_period_us, throttle_us, throttle_period_us):
    actions = PWM.actions_from_pulses(steering_us, throttle_us, steering_period_us, throttle_period_us)
    pulses = PWM.pulses(round(actions.steering, 4), round(actions.throttle, 4))
    assert abs(pulses.steering_us - steering_us) <= ARDUINO_STEP_US
    assert abs(pulses.throttle_us - throttle_us) <= ARDUINO_STEP_US


@given(st.integers(-10, 10**7), st.integers(-10, 10**7))
def test_any_reading_is_an_action_in_range_or_none(pulse_us, period_us):
    for channel in (PWM.steering, PWM.throttle):
        action = channel.action(pulse_us, period_us)
        assert action is None or channel.low <= action <= channel.high


def test_microseconds_per_unit(pwm):
    assert pwm.us_per_unit("steering") == pytest.approx(555.7, abs=0.1)
    assert pwm.us_per_unit("throttle") == pytest.approx(591.2, abs=0.1)
    span_us = pwm.pulses(1, 1).steering_us - pwm.pulses(-1, 1).steering_us
    assert 2 * pwm.us_per_unit("steering") == pytest.approx(span_us, abs=1)
    with pytest.raises(PwmError, match="gripper"):
        pwm.us_per_unit("gripper")


@pytest.mark.parametrize(
    "bad",
    [
        {"period_us": 0},
        {"period_us": math.nan},
        {"span_pct": 0},
        {"below_pct": -1},  # the other way than above 0
        {"low": 0.5},
        {"low": 0, "high": 0},
        {"neutral_pct": 99},
        {"span_pct": 7},  # its low end would be a negative pulse
        {"high": "1"},
    ],
)
def test_a_calibration_that_exists_is_valid(bad):
    good = {
        "name": "steering", "period_us": 21316, "neutral_pct": 6.83, "span_pct": 2.607, "low": -1, "high": 1,
    }  # fmt: skip
    Channel(**good)
    with pytest.raises(PwmError):
        Channel(**{**good, **bad})
