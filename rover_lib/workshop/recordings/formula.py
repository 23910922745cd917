"""Find by which formula a recording's actions were computed from its pulses.

Older firmware computed them in another way than this project does: a stopped car, 120 us, is 0.1687 there. The formula
is always a straight line of the duty, the pulse's share of its period: action = (duty % - neutral) / span. So it can be
found from the recorded pairs, and then the pulses, which are right in all recordings, give the actions.
"""

from dataclasses import dataclass

import numpy as np

from rover_lib.onboard.car.pwm import Channel

EXACT = 1e-3  # an action agrees with a formula within this; recorded actions have 4 decimals
FOLLOWS = 0.9  # the share of readings that must agree
LEAST_READINGS = 8  # fewer do not show a formula, and are taken as recorded
LEAST_SPREAD = 1e-3  # actions that vary by less lie on many lines


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
        sign = "-" if self.neutral_pct > 0 else "+"
        duty = f"(duty % {sign} {abs(self.neutral_pct):.3g})" if abs(self.neutral_pct) >= 0.005 else "duty %"
        return f"{duty} / {self.span_pct:.3g}"

    def is_like(self, other: "Formula") -> bool:
        """Whether both may be one, as each was found from the few readings of its recording."""
        return abs(self.neutral_pct - other.neutral_pct) <= 0.15 and abs(self.span_pct / other.span_pct - 1) <= 0.02

    def actions(self, duties_pct: np.ndarray) -> np.ndarray:
        return ((duties_pct - self.neutral_pct) / self.span_pct).clip(self.low, self.high)

    def share(self, actions: np.ndarray, duties_pct: np.ndarray) -> float:
        """The share of recorded actions, (n,), that agree with it at these duties."""
        return float((np.abs(self.actions(duties_pct) - actions) <= EXACT).mean())


# What the user's recorder wrote before October 2025.
OLD = {"steering": Formula(7.0, 2.42, -1.0, 1.0), "throttle": Formula(0.0, 70.0, 0.0, 1.0)}


def formula_of(channel: Channel, actions: np.ndarray, duties_pct: np.ndarray) -> Formula | None:
    """The formula that recorded actions, (n,), follow at their duties: an old one that is known, or any straight line.

    None if they follow none: fewer than FOLLOWS of them are within EXACT of it. Of fewer than LEAST_READINGS, only a
    formula that is known is recognised.
    """
    if not len(actions):
        return None
    known = OLD[channel.name]
    if known.share(actions, duties_pct) >= FOLLOWS:
        return known
    inside = (actions > channel.low) & (actions < channel.high)  # a clipped action does not lie on the line
    x, y = duties_pct[inside], actions[inside]
    if len(y) < LEAST_READINGS or np.ptp(y) < LEAST_SPREAD:
        return None
    # The median slope between pairs is right even if a quarter of the readings are wrong.
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    half = len(x) // 2
    dx, dy = x[half:] - x[: len(x) - half], y[half:] - y[: len(x) - half]
    slopes = dy[dx > 0] / dx[dx > 0]
    if not len(slopes) or not (slope := float(np.median(slopes))):
        return None
    offset = float(np.median(y - slope * x))
    good = np.abs(slope * x + offset - y) <= 10 * EXACT
    if good.sum() >= 2 and np.ptp(x[good]) > 0:
        slope, offset = (float(v) for v in np.polyfit(x[good], y[good], 1))
    found = Formula(-offset / slope, 1 / slope, channel.low, channel.high)
    return found if found.share(actions, duties_pct) >= FOLLOWS else None
