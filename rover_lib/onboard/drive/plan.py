"""Follow an action chunk by time: do what the policy meant for now, although its frame is already 100 ms old.

    follower = Follower(settings, rate_hz=30)
    follower.add(Plan(1, captured_s, ready_s, actions), now_s)
    command = follower.command(now_s)          # at each tick

Nothing here uses a clock or a device: times are arguments, in seconds of one monotonic clock.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from rover_lib.onboard.checked import broken_rule, number, of_type, one_of, whole
from rover_lib.onboard.errors import ParamsError, PolicyError

STEERING, THROTTLE = 0, 1
LIMITS = np.array([[-1.0, 0.0], [1.0, 1.0]])  # lowest and highest [steering, throttle]
IN_FORCE_S = 0.15  # how long a command holds: after that, the Arduino stops a car that gets no other
BLIND_M = 1.0  # how far the car may go by one picture, at RECORDED_MPS
RECORDED_MPS = 1.1  # throttle 0.09, the most of the recordings, of 12 m/s
SMOOTHED = 3  # plans: one odd picture is not an odd place
STOP, WARN, OFF = "stop", "warn", "off"  # what an unfamiliar place does
OVERSHOOT = 0.25  # a learned action may be this far beyond an end, as a transmitter's may: it is clipped
RULES = {
    "fade_s": number(1e-3, 3600),
    "stop_s": number(1e-3, 3600),
    "blend_ticks": whole(0, 1000),
    "compensate": of_type(bool),
    "throttle_limit": number(0, 1),
    "frozen_frames": whole(2, 1000),
    "black_frames": whole(2, 1000),
    "black_level": number(-255, 255),
    "flat_level": number(-255, 255),
    "unfamiliar": one_of((STOP, WARN, OFF)),
    "stuck_s": number(0, 3600),
    "undervoltage_s": number(0, 3600),
}


@dataclass(frozen=True)
class Settings:
    """How plans become commands: the section `drive` of params.yml, which explains each. Raises ParamsError."""

    fade_s: float = 0.5
    stop_s: float = 1.0
    blend_ticks: int = 3
    compensate: bool = True
    throttle_limit: float = 0.2
    frozen_frames: int = 3
    black_frames: int = 3
    black_level: float = 8.0
    flat_level: float = 2.0
    unfamiliar: str = STOP
    stuck_s: float = 1.5
    undervoltage_s: float = 3.0

    def __post_init__(self) -> None:
        remedy = "look at the section 'drive' of params.yml"
        if broken := broken_rule(vars(self), RULES):
            name, rule, actual = broken
            raise ParamsError(f"drive: {name} must be {rule}", found=actual, remedy=remedy)
        if self.fade_s > self.stop_s:
            raise ParamsError("drive: fade_s must not be above stop_s", found=self.fade_s, remedy=remedy)
        if (blind_m := self.blind_s * RECORDED_MPS) > BLIND_M:
            problem = f"by one picture the car would go {blind_m:.1f} m at {RECORDED_MPS:g} m/s, and it may {BLIND_M:g}"
            raise ParamsError(f"drive: {problem}", found=(self.fade_s, self.stop_s), remedy=remedy)

    @property
    def blind_s(self) -> float:
        """For how long one picture drives the car, in seconds of a throttle that does not fade."""
        return (self.fade_s + self.stop_s) / 2

    @classmethod
    def of(cls, section: Mapping[str, Any], **overrides: Any) -> "Settings":
        """Make settings of a mapping such as params.yml's; overrides that are not None win. Raises ParamsError."""
        names = {f.name for f in fields(cls)}
        if unknown := sorted(set(section) - names):
            raise ParamsError(f"drive: unknown {unknown}, known are {sorted(names)}", remedy="look at params.yml")
        values = {**section, **{k: v for k, v in overrides.items() if v is not None}}
        if values.get("unfamiliar") is False:  # YAML's `off`
            values["unfamiliar"] = OFF
        return cls(**values)


@dataclass(frozen=True, eq=False)
class Plan:
    """The action chunk of one inference. actions[i] is meant for captured_s + i / rate.

    number: 1, 2, ... captured_s: when the policy's frame was captured. ready_s: when the plan arrived. actions:
    (chunk, 2) float [steering, throttle], clipped to limits: (2, 2), the lowest and the highest action. strange: how
    unfamiliar the frame is to the policy, as a share of the artifact's threshold; None if it has none. Raises
    PolicyError for actions of another shape, not finite, or beyond an end by more than OVERSHOOT: this is the last
    boundary before the servos.
    """

    number: int
    captured_s: float
    ready_s: float
    actions: np.ndarray
    limits: np.ndarray = field(default_factory=lambda: LIMITS)
    strange: float | None = None

    def __post_init__(self) -> None:
        actions = np.asarray(self.actions, float)
        if actions.ndim != 2 or actions.shape[1] != 2 or len(actions) == 0:
            raise PolicyError("a plan must be (chunk, 2) actions", found=actions.shape)
        if not np.isfinite(actions).all():
            raise PolicyError(f"plan {self.number} is not finite", remedy="stop the car and quantize again")
        if (actions < self.limits[0] - OVERSHOOT).any() or (actions > self.limits[1] + OVERSHOOT).any():
            ends = actions.min(0).round(3).tolist(), actions.max(0).round(3).tolist()
            raise PolicyError(f"plan {self.number} has actions outside the range of a servo", found=ends)
        object.__setattr__(self, "actions", np.clip(actions, *self.limits))

    @property
    def latency_s(self) -> float:
        """Seconds from the capture of the frame to the arrival of the plan."""
        return self.ready_s - self.captured_s

    def at(self, step: float) -> np.ndarray:
        """Return the (2,) [steering, throttle] meant for `step` steps after the first, interpolated; it ends held."""
        step = min(max(step, 0.0), len(self.actions) - 1.0)
        i = min(int(step), max(0, len(self.actions) - 2))
        share = step - i
        if share == 0:
            return self.actions[i]
        return (1 - share) * self.actions[i] + share * self.actions[i + 1]


@dataclass(frozen=True)
class Command:
    """What to do at a tick: steering in [-1, 1], throttle in [0, 1], or from -1 on a car with reverse.

    fade: by how much the plan's age, or an unfamiliar place, multiplied the throttle, in [0, 1]. cut: the throttle that
    throttle_limit took.
    """

    steering: float
    throttle: float
    plan: Plan
    age_s: float  # since the frame of the plan in use
    fade: float
    cut: float = 0.0


class Smoother:
    """The mean of the newest SMOOTHED scores, Plan.strange, of one drive's plans."""

    def __init__(self) -> None:
        self._newest: deque[float] = deque(maxlen=SMOOTHED)

    def add(self, score: float) -> float:
        """Take a plan's score; return the mean that has it."""
        self._newest.append(score)
        return sum(self._newest) / len(self._newest)


def is_unfamiliar(strange: float) -> bool:
    """Whether a score says that the policy has seen nothing like it; NaN does, too."""
    return not strange < 1


class Follower:
    """Turns plans into commands. rate_hz: steps of a plan per second. For one thread at a time.

    strange: the smoothed Plan.strange; None without one. strange_s: when it first reached 1; a drive never forgets it.
    """

    def __init__(self, settings: Settings, rate_hz: float):
        self.settings = settings
        self.rate_hz = rate_hz
        self.plan: Plan | None = None  # the newest; None before the first
        self._offset = np.zeros(2)  # old command minus new plan, when the newest plan took over
        self._blended = 0  # ticks since then
        self.strange: float | None = None
        self.strange_s: float | None = None
        self._smoother = Smoother()

    def add(self, plan: Plan, now_s: float) -> None:
        """Let a fresh plan take over at this tick. It is ignored unless its frame is newer than the last plan's."""
        before = self.plan
        if before and plan.captured_s <= before.captured_s:
            return
        if before and self.settings.blend_ticks:
            old = self._wanted(before, now_s) * [1.0, self._fade(now_s - before.captured_s)]
            self._offset = old - self._meant(plan, now_s)
            self._blended = 0
        self.plan = plan
        if plan.strange is not None:
            self.strange = self._smoother.add(plan.strange)
            if is_unfamiliar(self.strange) and self.strange_s is None:
                self.strange_s = now_s

    def stop_s(self) -> float:
        """Return the age in seconds at which the newest plan stops the car: the settings', or the chunk's end."""
        if not self.plan:
            return 0.0
        return min(self.settings.stop_s, len(self.plan.actions) / self.rate_hz)

    def command(self, now_s: float) -> Command | None:
        """Return what the newest plan meant for now; None without a plan, or if it is too old to drive by.

        None, too, once the throttle has faded because the place is unfamiliar.
        """
        plan = self.plan
        if plan is None or not (age_s := now_s - plan.captured_s) < self.stop_s():
            return None
        fade = self._fade(age_s)
        if self.strange_s is not None and self.settings.unfamiliar == STOP:
            fade_s = self.settings.stop_s - self.settings.fade_s
            if (passed_s := now_s - self.strange_s) >= fade_s:
                return None
            fade *= 1 - passed_s / fade_s
        steering, throttle = np.clip(self._wanted(plan, now_s) * [1.0, fade], *plan.limits)
        self._blended += 1
        limit = self.settings.throttle_limit  # forwards and backwards
        throttle_sent = max(min(float(throttle), limit), -limit)
        return Command(float(steering), throttle_sent, plan, age_s, fade, abs(float(throttle) - throttle_sent))

    def _fade(self, age_s: float) -> float:
        stop_s = self.stop_s()
        fade_s = min(self.settings.fade_s, stop_s)
        if age_s <= fade_s:
            return 1.0
        if stop_s <= fade_s:
            return 0.0
        return max(0.0, (stop_s - age_s) / (stop_s - fade_s))

    def _wanted(self, plan: Plan, now_s: float) -> np.ndarray:
        weight = 1 - (self._blended + 1) / (self.settings.blend_ticks + 1)
        return self._meant(plan, now_s) + self._offset * max(0.0, weight)

    def _meant(self, plan: Plan, now_s: float) -> np.ndarray:
        began_s = plan.captured_s if self.settings.compensate else plan.ready_s
        return plan.at((now_s - began_s) * self.rate_hz)


class Commanded:
    """The latest commands, for the policy's state. One thread may add commands while others ask for the state."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, float, float]] = deque(maxlen=300)  # three seconds at 100 Hz

    def add(self, at_s: float, steering: float, throttle: float) -> None:
        self._sent.append((at_s, steering, throttle))

    def state(self, captured_s: float, rate_hz: float) -> np.ndarray:
        """Return the policy's state for a frame captured at that time, (2,) float32 [steering, throttle].

        In training, a frame's state is the action of the frame before it (episodes.py). So it is the command nearest to
        one step before the capture; neutral if that was sent more than a step later, or is no longer in force.
        """
        before_s = captured_s - 1 / rate_hz
        nearest = min(tuple(self._sent), key=lambda c: abs(c[0] - before_s), default=None)
        if nearest is None or not -1 / rate_hz <= before_s - nearest[0] <= IN_FORCE_S:
            return np.zeros(2, np.float32)
        return np.array(nearest[1:], np.float32)
