"""Actions and pulses: the recorded pulses are the oracle, 4 us (the Arduino's timer step) the tolerance."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recorded import real_episode

from rover_lib.onboard.car.pwm import ARDUINO_STEP_US, NEUTRAL, Pulses, PwmCalibration
from rover_lib.onboard.errors import CarError

PWM = PwmCalibration()


@pytest.fixture
def pwm():
    return PWM


def test_zero_throttle_is_a_stopped_car(pwm):
    assert pwm.pulses(steering=0.0, throttle=0.0).throttle_us == 120
    assert NEUTRAL == (0.0, 0.0) and pwm.neutral() == Pulses(steering_us=1456, throttle_us=120)


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
    ("name", "pulse_us", "period_us"),
    [
        ("throttle", 0, 1016),
        ("throttle", 136, 0),
        ("throttle", 136, 2032),  # two periods at once
        ("steering", 1456, 42632),
        ("steering", -4, 21316),
    ],
)
def test_no_pulse_is_no_action(pwm, name, pulse_us, period_us):
    assert pwm.channel(name).action(pulse_us, period_us) is None


@pytest.mark.parametrize("bad", [math.nan, -math.inf, None, "0.1", True, 10**400, np.array(0.1)])
def test_what_is_no_number_never_becomes_a_pulse(pwm, bad):
    with pytest.raises(CarError):
        pwm.pulses(bad, 0.0)
    with pytest.raises(CarError):
        pwm.pulses(0.0, bad)
    with pytest.raises(CarError):
        pwm.actions_from_pulses(bad, 120)
    if bad is not None:  # None means the nominal period
        with pytest.raises(CarError):
            pwm.actions_from_pulses(1456, 120, bad, 1016)


@given(st.floats(), st.floats())
def test_a_pulse_is_within_the_servos_range_or_refused(steering, throttle):
    if -1 <= steering <= 1 and 0 <= throttle <= 1:
        pulses = PWM.pulses(steering, throttle)
        assert 900 <= pulses.steering_us <= 2012 and 120 <= pulses.throttle_us <= 711
        return
    with pytest.raises(CarError):
        PWM.pulses(steering, throttle)


@given(st.floats(-1, 1, width=32), st.floats(0, 1, width=32))
def test_action_to_pulse_and_back(steering, throttle):
    pulses = PWM.pulses(np.float32(steering), np.float32(throttle))
    back = PWM.actions_from_pulses(pulses.steering_us, pulses.throttle_us)
    # a pulse is a whole microsecond: half of one is all that may be lost
    assert abs(back.steering - steering) * PWM.us_per_unit("steering") <= 0.5001
    assert abs(back.throttle - throttle) * PWM.us_per_unit("throttle") <= 0.5001


def test_microseconds_per_unit(pwm):
    assert pwm.us_per_unit("steering") == pytest.approx(555.7, abs=0.1)
    assert pwm.us_per_unit("throttle") == pytest.approx(591.2, abs=0.1)
    with pytest.raises(CarError, match="gripper"):
        pwm.us_per_unit("gripper")


@pytest.mark.parametrize(
    "bad",
    [
        {"period_us": math.nan},
        {"span_pct": 0},
        {"below_pct": -1},  # the other way than above 0
        {"low": 0.5},
        {"neutral_pct": 99},
        {"span_pct": 7},  # its low end would be a negative pulse
        {"high": "1"},
    ],
)
def test_a_calibration_that_exists_is_valid(bad):
    with pytest.raises(CarError):
        replace(PWM.steering, **bad)
