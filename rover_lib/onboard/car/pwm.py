"""Convert actions to servo pulses and back. The constants were checked on the recordings, to 5e-5.

A channel's pulse is a share ("duty") of its period: action = (duty% - neutral) / span, clipped to the channel's range.
Throttle 0 means *stopped*, 120 us; it is not the middle of the throttle's range.
"""

import math
from dataclasses import dataclass, field

from rover_lib.onboard.checked import is_number
from rover_lib.onboard.errors import CarError

ARDUINO_STEP_US = 4  # resolution of micros() on a 16 MHz Arduino: no pulse is known better than this
NEUTRAL = (0.0, 0.0)  # (steering, throttle): straight and stopped


def _finite(value: object, what: str) -> float:
    """Return `value` as a float. Raises CarError for None, strings, booleans, NaN and infinities."""
    if not is_number(value):
        raise CarError(f"{what} must be a finite number", found=f"{type(value).__name__} {value!r}"[:80])
    return float(value)


@dataclass(frozen=True)
class Channel:
    """One servo signal. Of a car.yml's values, Car says which make one (car.py).

    neutral_pct: duty of action 0, in percent. span_pct: duty per unit of action, in percent; negative if the signal is
    inverted. low, high: range of the action, which includes 0. below_pct: the span for actions below 0; None if it is
    span_pct. by_pulse: judge a measured pulse by its microseconds, and not by its share of the measured period.
    """

    name: str
    period_us: float
    neutral_pct: float
    span_pct: float
    low: float
    high: float
    below_pct: float | None = None
    by_pulse: bool = False

    def _span_pct(self, action: float) -> float:
        return self.span_pct if action >= 0 or self.below_pct is None else self.below_pct

    @property
    def us_per_unit(self) -> float:
        """Microseconds of pulse per unit of action; if the two sides differ, those of the wider one."""
        return max(abs(self.span_pct), abs(self._span_pct(-1.0))) / 100 * self.period_us

    @property
    def pulses_us(self) -> tuple[int, int, int]:
        """The pulses of the lowest action, of 0 and of the highest, in microseconds."""
        return self.pulse_us(self.low), self.pulse_us(0.0), self.pulse_us(self.high)

    @property
    def ends_us(self) -> tuple[int, int]:
        """The shortest and the longest pulse in the range of the action, in microseconds."""
        return min(self.pulses_us), max(self.pulses_us)

    @property
    def neutral_us(self) -> int:
        return self.pulse_us(0.0)

    def pulse_us(self, action: float) -> int:
        """Return the pulse for an action, in whole microseconds. Raises CarError for NaN and outside [low, high]."""
        action = _finite(action, self.name)
        if not self.low <= action <= self.high:
            raise CarError(f"{self.name} must be in [{self.low:g}, {self.high:g}]", found=f"{action:g}")
        duty_pct = self.neutral_pct + self._span_pct(action) * action
        return round(duty_pct / 100 * self.period_us)

    def action(self, pulse_us: float, period_us: float | None = None) -> float | None:
        """Return the action that a pulse stands for, clipped to [low, high], or None (not 0) if no pulse was measured.

        period_us: the measured period; None: the nominal one. A pulse was measured if it is shorter than its period,
        and that within 25 % of the nominal one: neither 0 nor two periods taken for one. Raises CarError for a pulse
        that is None, and for strings, NaN and infinities.
        """
        pulse_us = _finite(pulse_us, f"{self.name} pulse")
        period_us = _finite(self.period_us if period_us is None else period_us, f"{self.name} period")
        if not (0 < pulse_us < period_us and 0.75 * self.period_us < period_us < 1.25 * self.period_us):
            return None
        duty_pct = pulse_us / (self.period_us if self.by_pulse else period_us) * 100
        action = (duty_pct - self.neutral_pct) / self.span_pct
        if action < 0:
            action = (duty_pct - self.neutral_pct) / self._span_pct(action)
        return min(max(action, self.low), self.high)

    def moves(self, pulse_us: float) -> bool:
        """Return whether a throttle pulse moves the car: an Arduino measures neutral within ARDUINO_STEP_US."""
        away_us = (pulse_us - self.neutral_us) * math.copysign(1, self.span_pct)
        return away_us > ARDUINO_STEP_US or (self.low < 0 and away_us < -ARDUINO_STEP_US)


@dataclass(frozen=True)
class Pulses:
    """The pulses for the servos, in whole microseconds."""

    steering_us: int
    throttle_us: int


@dataclass(frozen=True)
class PwmCalibration:
    """A car's two channels; by default those of the user's car."""

    # (duty% - 6.83) / 2.37 * (2 / 2.2): one unit of steering is 2.37 * 1.1 percent of a 47 Hz period
    steering: Channel = field(default=Channel("steering", 21316, 6.83, 2.37 * 2.2 / 2, -1.0, 1.0))
    # (duty% - 11.81) / 58.19 of a 985 Hz period
    throttle: Channel = field(default=Channel("throttle", 1016, 11.81, 58.19, 0.0, 1.0))

    def channel(self, action_name: str) -> Channel:
        """Return the channel of "steering" or "throttle". Raises CarError for other names."""
        if action_name not in ("steering", "throttle"):
            raise CarError("an action must be steering or throttle", found=repr(action_name))
        return getattr(self, action_name)

    def pulses(self, steering: float, throttle: float) -> Pulses:
        """Return the pulses for steering in [-1, 1] and throttle in [0, 1] (reverse: -1). Otherwise raises CarError."""
        return Pulses(self.steering.pulse_us(steering), self.throttle.pulse_us(throttle))

    def neutral(self) -> Pulses:
        return self.pulses(*NEUTRAL)

    def actions(self, *measured_us: float) -> tuple[float | None, float | None]:
        """Return the actions that pulses of steering and throttle stand for, as Channel.action() does.

        measured_us: the two pulses, and then their periods, or none.
        """
        steering_us, throttle_us, *periods_us = measured_us
        periods = periods_us or (None, None)
        return self.steering.action(steering_us, periods[0]), self.throttle.action(throttle_us, periods[1])
