"""Actions and pulses: the recorded pulses are the oracle, 4 us (the Arduino's timer step) the tolerance."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US, PwmCalibration
from rover_lib.onboard.errors import CarError
from tests.helpers.recorded import real_episode

PWM = PwmCalibration()


def test_recorded_pulses_come_back_within_a_timer_step():
    controls = json.loads((real_episode() / "episode_data.json").read_text())["control_samples"]
    checked = clipped = 0
    for control in controls:
        for name in ("steering", "throttle"):
            channel = PWM.channel(name)
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
    assert checked > 400 and clipped <= 3


def test_no_pulse_is_no_action():
    for pulse_us, period_us in ((0, 1016), (136, 0), (136, 2032)):  # the last is two periods at once
        assert PWM.throttle.action(pulse_us, period_us) is None
    for pulse_us, period_us in ((1456, 42632), (-4, 21316)):
        assert PWM.steering.action(pulse_us, period_us) is None


@pytest.mark.parametrize("bad", [math.nan, -math.inf, None, "0.1", True, 10**400, np.array(0.1)])
def test_what_is_no_number_never_becomes_a_pulse(bad):
    for refused in (
        lambda: PWM.pulses(bad, 0.0),
        lambda: PWM.pulses(0.0, bad),
        lambda: PWM.actions(bad, 120),
        lambda: PWM.steering.action(1456, math.nan if bad is None else bad),  # None: the nominal period
    ):
        with pytest.raises(CarError):
            refused()


LOPSIDED = {
    "steering": {"period_us": 20000, "left_us": 2000, "neutral_us": 1500, "right_us": 1100},
    "throttle": {"period_us": 14000, "neutral_us": 1500, "forward_us": 1000, "reverse_us": 1900},
}


@given(st.sampled_from((Car(), Car.of(LOPSIDED))), st.floats() | st.floats(-1, 1), st.floats() | st.floats(-1, 1))
def test_a_pulse_comes_back_as_its_action_or_is_refused(car, steering, throttle):
    if not (-1 <= steering <= 1 and car.limits[0, 1] <= throttle <= 1):
        with pytest.raises(CarError):
            car.pwm.pulses(steering, throttle)
        return
    pulses = car.pwm.pulses(np.float64(steering), throttle)
    for name, action in (("steering", steering), ("throttle", throttle)):
        channel, pulse_us = car.pwm.channel(name), getattr(pulses, f"{name}_us")
        assert channel.ends_us[0] <= pulse_us <= channel.ends_us[1]
        # Of a servo only the pulse counts: a receiver's period may be a little longer or shorter.
        back = channel.action(pulse_us, 1.1 * channel.period_us if channel.by_pulse else None)
        side_us = abs(channel.pulse_us(channel.high if action >= 0 else channel.low) - channel.neutral_us)
        # a pulse is a whole microsecond: half of one is all that may be lost
        assert abs(back - action) * side_us <= 0.51
