"""The formulas by which firmware has computed actions from pulses: this car's, and an older one.

The pulses are right in all recordings, so they give the actions. The duty is the pulse's share of its period.
"""

from dataclasses import dataclass

import numpy as np

from rover_lib.onboard.car.pwm import Channel

EXACT = 1e-3  # an action agrees with a formula within this; recorded actions have 4 decimals
FOLLOWS = 0.9  # the share of readings that must agree
LEAST_READINGS = 8  # fewer do not show a formula, and are taken as recorded


@dataclass(frozen=True)
class Formula:
    """action = (duty % - neutral_pct) / span_pct, clipped to [low, high]."""

    neutral_pct: float
    span_pct: float
    low: float
    high: float

    @classmethod
    def of(cls, channel: Channel) -> "Formula":
        return cls(channel.neutral_pct, channel.span_pct, channel.low, channel.high)

    def __str__(self) -> str:
        duty = f"(duty % - {self.neutral_pct:.3g})" if self.neutral_pct else "duty %"
        return f"{duty} / {self.span_pct:.3g}"

    def actions(self, duties_pct: np.ndarray) -> np.ndarray:
        return ((duties_pct - self.neutral_pct) / self.span_pct).clip(self.low, self.high)

    def is_followed(self, actions: np.ndarray, duties_pct: np.ndarray) -> bool:
        """Whether recorded actions, (n,), are those of this formula at their duties, all but a few."""
        agrees = np.abs(self.actions(duties_pct) - actions) <= EXACT
        return len(actions) > 0 and agrees.mean() >= FOLLOWS


# What the user's recorder wrote before October 2025.
OLD = {"steering": Formula(7.0, 2.42, -1.0, 1.0), "throttle": Formula(0.0, 70.0, 0.0, 1.0)}
