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
LEAST_UNITS = 5  # so do rounded ones that vary by less than this many of their last digit


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

    def agrees(self, actions: np.ndarray, duties_pct: np.ndarray, half_unit: float = 0.0) -> np.ndarray:
        """Which of recorded actions, (n,), agree with it at these duties."""
        return np.abs(self.actions(duties_pct) - actions) <= EXACT + half_unit


# What the user's recorder wrote before October 2025.
OLD = {"steering": Formula(7.0, 2.42, -1.0, 1.0), "throttle": Formula(0.0, 70.0, 0.0, 1.0)}


def half_unit_of(actions: np.ndarray) -> float:
    """Half of the last digit's unit if recorded actions were rounded so that EXACT is too little, else 0."""
    varies = np.ptp(actions) if len(actions) else -1.0
    for digits, least in ((0, 10), (1, 0), (2, -0.5)):  # few digits may be all that a channel which rests has
        if varies > least and np.allclose(actions, actions.round(digits), rtol=0, atol=1e-9):
            return 0.5 * 10.0**-digits
    return 0.0


def formulas_of(channel: Channel, actions: np.ndarray, duties_pct: np.ndarray, half_unit: float = 0.0) -> list[Formula]:
    """The formulas that recorded actions, (n,), follow at their duties: two in their order if the firmware was changed
    within the recording, none if they follow no line.
    """
    if whole := _formula_of(channel, actions, duties_pct, half_unit):
        return [whole]
    ends = []
    for order in (slice(None), slice(None, None, -1)):
        a, d = actions[order], duties_pct[order]
        parts = (_formula_of(channel, a[: len(a) // n], d[: len(a) // n], half_unit) for n in (2, 3, 4, 6, 8))
        ends.append(next((found for found in parts if found), None))
    if None in ends:
        return []
    first, last = (~end.agrees(actions, duties_pct, half_unit) for end in ends if end)
    wrong = np.append(0, first.cumsum()) + np.append(last[::-1].cumsum()[::-1], 0)  # if it was changed at each reading
    return [end for end in ends if end] if wrong.min() <= (1 - FOLLOWS) * len(actions) else []


def _formula_of(channel: Channel, actions: np.ndarray, duties_pct: np.ndarray, half_unit: float) -> Formula | None:
    """The one formula that recorded actions, (n,), follow: an old one that is known, or any straight line.

    None if they follow none: fewer than FOLLOWS of them agree with it. Of fewer than LEAST_READINGS, only a formula
    that is known is recognised.
    """
    if not len(actions):
        return None
    known = OLD[channel.name]
    if known.agrees(actions, duties_pct, half_unit).mean() >= FOLLOWS:
        return known
    low, high = min(channel.low, actions.min()), max(channel.high, actions.max())
    inside = (actions > low) & (actions < high)  # a clipped action does not lie on the line
    x, y = duties_pct[inside], actions[inside]
    if len(y) < LEAST_READINGS or np.ptp(y) < LEAST_SPREAD + 2 * LEAST_UNITS * half_unit:
        return None
    # The median slope between pairs is right if a quarter of the readings are wrong; rounding turns wide ones less
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    half = len(x) // 2
    dx, dy = x[half:] - x[: len(x) - half], y[half:] - y[: len(x) - half]
    dx, slopes = dx[dx > 0], dy[dx > 0] / dx[dx > 0]
    order = np.argsort(slopes)
    middle = np.searchsorted(dx[order].cumsum(), dx.sum() / 2)
    if not len(slopes) or not (slope := float(slopes[order][middle])):
        return None
    offset = float(np.median(y - slope * x))
    good = np.abs(slope * x + offset - y) <= 10 * EXACT + 2 * half_unit
    values, at = np.unique(y[good], return_inverse=True)
    means = np.bincount(at, x[good]) / np.bincount(at)
    if len(values) >= 2 and np.ptp(means) > 0:  # each value once: a car at rest for long was rounded to one side
        slope, offset = (float(v) for v in np.polyfit(means, values, 1))
    found = Formula(-offset / slope, 1 / slope, low, high) if slope else None
    return found if found and found.agrees(actions, duties_pct, half_unit).mean() >= FOLLOWS else None
