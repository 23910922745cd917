"""Actions to servo pulses and back, with the constants that were checked on the recordings to 5e-5.

A channel's pulse is a share ("duty") of its period: action = (duty% - neutral) / span, clipped to its range.
Throttle 0 is *stopped*, 120 us, not the middle of the throttle's range. Another car's channels come from its car.yml,
see car.py; they may have another span on either side of neutral, and be inverted.
"""

import math
import numbers
from dataclasses import dataclass, field

from rover_lib.onboard.errors import PwmError

ARDUINO_STEP_US = 4  # resolution of micros() on a 16 MHz Arduino: no pulse is known better than this
NEUTRAL = (0.0, 0.0)  # (steering, throttle): straight and stopped


def is_finite(value: object) -> bool:
    """Whether it is a number, no boolean, that a float can hold; NaN and infinities are not."""
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number of 309 digits
        return False


def _finite(value: object, what: str) -> float:
    """`value` as a float. Raises PwmError for None, strings, booleans, NaN and infinities."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise PwmError(
            f"{what} must be a number", found=f"{type(value).__name__} {value!r}", remedy="send neutral instead"
        )
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if not math.isfinite(found):
        raise PwmError(f"{what} must be finite", found=found, remedy="send neutral and look at what computed it")
    return found


@dataclass(frozen=True)
class Channel:
    """One servo signal. A channel that exists is valid: PwmError says what is not.

    period_us: nominal period. neutral_pct: duty in percent of action 0. span_pct: duty in percent per unit of
    action, below 0 where the signal is inverted. low, high: range of the action, which includes 0.
    below_pct: the span of actions below 0, of the same sign; None: span_pct. by_pulse: a measured pulse is judged by
    its microseconds, as a servo does, and not by its share of the measured period.
    """

    name: str
    period_us: float
    neutral_pct: float
    span_pct: float
    low: float
    high: float
    below_pct: float | None = None
    by_pulse: bool = False

    def __post_init__(self):
        for key in ("period_us", "neutral_pct", "span_pct", "low", "high"):
            _finite(getattr(self, key), f"{self.name} {key}")
        if self.below_pct is not None:
            _finite(self.below_pct, f"{self.name} below_pct")
        below = self._span_pct(-1.0)
        if self.period_us <= 0 or self.span_pct * below <= 0 or not self.low <= 0 <= self.high or self.low == self.high:
            raise PwmError(
                f"{self.name}: period {self.period_us} us, span {self.span_pct} and {below} %, range "
                f"{self.low} to {self.high} is no servo channel",
                remedy="the period must be above 0, and both spans other than 0 and of one sign",
            )
        ends = sorted(self._duty_pct(action) for action in (self.low, self.high))
        if ends[0] <= 0 or ends[1] >= 100:
            raise PwmError(
                f"{self.name}: its ends must be inside a period", found=f"{ends[0]:.2f} % and {ends[1]:.2f} % of it"
            )

    def _span_pct(self, action: float) -> float:
        return self.span_pct if action >= 0 or self.below_pct is None else self.below_pct

    def _duty_pct(self, action: float) -> float:
        return self.neutral_pct + self._span_pct(action) * action

    @property
    def us_per_unit(self) -> float:
        """Microseconds of pulse per unit of action; of the longer side where they differ."""
        return max(abs(self.span_pct), abs(self._span_pct(-1.0))) / 100 * self.period_us

    @property
    def ends_us(self) -> tuple[int, int]:
        """The shortest and the longest pulse of its actions, microseconds."""
        first, second = self.pulse_us(self.low), self.pulse_us(self.high)
        return min(first, second), max(first, second)

    @property
    def neutral_us(self) -> int:
        """Pulse of action 0, microseconds."""
        return self.pulse_us(0.0)

    def pulse_us(self, action: float) -> int:
        """Pulse for an action, whole microseconds. PwmError outside [low, high], NaN included."""
        action = _finite(action, self.name)
        if not self.low <= action <= self.high:
            raise PwmError(
                f"{self.name} must be in [{self.low:g}, {self.high:g}]",
                found=f"{action:g}",
                remedy="clip the plan first",
            )
        return round(self._duty_pct(action) / 100 * self.period_us)

    def measured(self, pulse_us: float, period_us: float) -> bool:
        """Whether the firmware saw a pulse: both above 0, and one period at a time, not none or two."""
        pulse_us, period_us = (
            _finite(pulse_us, f"{self.name} pulse"),
            _finite(period_us, f"{self.name} period"),
        )
        return 0 < pulse_us < period_us and 0.75 * self.period_us < period_us < 1.25 * self.period_us

    def action(self, pulse_us: float, period_us: float | None = None) -> float | None:
        """The action that a pulse stands for, in [low, high]; None where no pulse was measured (not 0).

        period_us: the measured period; nominal when left out. Pulses beyond the ends are clipped, as the
        firmware does (a throttle below 120 us is 0, "stopped"). PwmError for None, strings, NaN and
        infinities.
        """
        period_us = self.period_us if period_us is None else period_us
        if not self.measured(pulse_us, period_us):
            return None
        duty_pct = float(pulse_us) / (self.period_us if self.by_pulse else float(period_us)) * 100
        action = (duty_pct - self.neutral_pct) / self.span_pct
        if action < 0:
            action = (duty_pct - self.neutral_pct) / self._span_pct(action)
        return min(max(action, self.low), self.high)

    def moves(self, pulse_us: float) -> bool:
        """Whether a throttle's pulse moves the car: neutral, as an Arduino may have measured it, does not."""
        away_us = (pulse_us - self.neutral_us) * math.copysign(1, self.span_pct)
        return away_us > ARDUINO_STEP_US or (self.low < 0 and away_us < -ARDUINO_STEP_US)


@dataclass(frozen=True)
class Pulses:
    """What goes to the servos: whole microseconds."""

    steering_us: int
    throttle_us: int


@dataclass(frozen=True)
class Actions:
    """What was read from the transmitter; None for a channel of which no pulse was measured."""

    steering: float | None
    throttle: float | None

    @property
    def measured(self) -> bool:
        """Whether both channels are measurements."""
        return self.steering is not None and self.throttle is not None


@dataclass(frozen=True)
class PwmCalibration:
    """A car's two channels, with those of the user's car as defaults."""

    # (duty% - 6.83) / 2.37 * (2 / 2.2): one unit of steering is 2.37 * 1.1 percent of a 47 Hz period
    steering: Channel = field(default=Channel("steering", 21316, 6.83, 2.37 * 2.2 / 2, -1.0, 1.0))
    # (duty% - 11.81) / 58.19 of a 985 Hz period
    throttle: Channel = field(default=Channel("throttle", 1016, 11.81, 58.19, 0.0, 1.0))

    def channel(self, action_name: str) -> Channel:
        """The channel of "steering" or "throttle". Raises PwmError for other names."""
        if action_name not in ("steering", "throttle"):
            raise PwmError(
                f"no servo channel for action {action_name!r}", remedy="this rover has steering and throttle"
            )
        return getattr(self, action_name)

    def pulses(self, steering: float, throttle: float) -> Pulses:
        """Pulses for steering in [-1, 1] and throttle in [0, 1], from -1 with reverse; PwmError for all else."""
        return Pulses(self.steering.pulse_us(steering), self.throttle.pulse_us(throttle))

    def neutral(self) -> Pulses:
        """Straight and stopped: 1456 us and 120 us on the user's car."""
        return self.pulses(*NEUTRAL)

    def actions_from_pulses(
        self,
        steering_us: float,
        throttle_us: float,
        steering_period_us: float | None = None,
        throttle_period_us: float | None = None,
    ) -> Actions:
        """The actions behind two measured pulses; the nominal periods are taken where none are given.

        A channel without a measured pulse (0, or a period of 0 or of two at once) is None, not 0.
        Raises PwmError for None pulses, strings, NaN and infinities.
        """
        return Actions(
            self.steering.action(steering_us, steering_period_us),
            self.throttle.action(throttle_us, throttle_period_us),
        )

    def us_per_unit(self, action_name: str) -> float:
        """Microseconds of pulse per unit of an action: turns an action's error into what the servo feels."""
        return self.channel(action_name).us_per_unit
