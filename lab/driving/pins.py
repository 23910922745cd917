"""Judge what the servo pins do after a fault: stop, follow the human, go on as commanded, or never drive.

All times are of the monotonic clock that simavr's pins and the bench share.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

from balloon_world.simulated_arduino import REST_US, PinEvent
from lab import PARAMS
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US
from rover_lib.onboard.params import params

STOPPED, HUMAN, CONTINUES, REFUSED = "stopped", "human", "continues", "refused"
EDGE_US = 0.5  # an edge in simavr is known to 0.25 us
STEP_US = ARDUINO_STEP_US + EDGE_US  # the error of a pulse that the Arduino measured and sends on
COMMAND_US = {"steering": 1.0, "throttle": 2.5}  # the error of a commanded pulse: half a tick of its timer, and an edge
STILL_VALID_S = 0.2  # the Arduino holds a command for 150 ms, and a steering pulse may begin 21 ms later
BEFORE_S = 0.2  # how long the car must have been driving before a fault
LAST_S = 0.2  # how long at the end there must be pulses
DEFAULT = Car()
GATES = PARAMS["faults"]


class Command(NamedTuple):
    """A drive command of the host, and when the Arduino had it."""

    at_s: float
    steering_us: int
    throttle_us: int


@dataclass(frozen=True)
class Observation:
    """What a fault is judged by: the pins' events in order, and the drive's commands, from before at_s to end_s.

    at_s: when the fault happened. end_s: until when the car was watched.
    """

    events: Sequence[PinEvent]
    commands: Sequence[Command]
    at_s: float
    end_s: float

    def pulses(self, pin: str, from_s: float | None = None) -> list[PinEvent]:
        """Return a pin's pulses that ended after from_s [default: the fault], until the end."""
        from_s = self.at_s if from_s is None else from_s
        kinds = "pulse", "cut"
        return [e for e in self.events if e.pin == pin and e.kind in kinds and from_s < e.end_s <= self.end_s]

    def was_driving(self, throttle_max_us: float) -> bool:
        """Whether each throttle pulse right before the fault moved the car."""
        before = [e for e in self.pulses("throttle", self.at_s - BEFORE_S) if e.end_s <= self.at_s]
        return bool(before) and min(e.pulse_us for e in before) > throttle_max_us

    def stalled_ms(self) -> float:
        """Return how long this machine had no time for the Arduino, or 1e9 and more if events of its pins were lost."""
        spoilt = [e for e in self.events if e.kind in ("stall", "lost") and self.at_s - BEFORE_S < e.monotonic_s]
        return sum(e.pulse_us / 1e3 if e.kind == "stall" else 1e9 for e in spoilt)

    def longest_pause_s(self) -> float:
        """Return the longest time between two commands of the drive, from the fault on."""
        times = [self.at_s, *(c.at_s for c in self.commands if c.at_s > self.at_s), self.end_s]
        return max(b - a for a, b in pairwise(times))


Figures = dict[str, Any]  # of a row


def judge(
    expected: str,
    seen: Observation,
    car: Car = DEFAULT,
    *,
    human_us: tuple[float, float] = REST_US,
    until_limit: bool = False,
) -> tuple[Figures, list[str]]:
    """Compare what the pins did from the fault on with what was expected, by GATES.

    human_us: the human's pulses. until_limit: whether a car that `continues` is stopped by a limit in the end. Returns
    the row's figures, and a sentence for everything that is not as expected.
    """
    throttle, steering, most_us = seen.pulses("throttle"), seen.pulses("steering"), most_throttle_us(car)
    least_us = car.numbers[6] - ARDUINO_STEP_US if car.reverses else 0
    moving = [e.end_s for e in throttle if not least_us <= e.pulse_us <= most_us]
    late = [e.pulse_us for e in throttle if e.end_s > seen.at_s + GATES["stopped_ms"] / 1e3]
    figures: Figures = {
        "stopped_after_ms": round((max(moving) - seen.at_s) * 1e3, 1) if moving else 0.0,
        "max_throttle_us_after": round(max(late), 1) if late else None,
        "steering_us_after": round(steering[-1].pulse_us, 1) if steering else None,
    }
    wrong = []
    if expected != REFUSED and not seen.was_driving(most_us):
        wrong.append(f"the car was not driving in the {BEFORE_S * 1e3:g} ms before the fault")
    for pin, period_us in periods_of(car).items():
        count, nominal = len(seen.pulses(pin, seen.end_s - LAST_S)), LAST_S * 1e6 / period_us
        if count < nominal - 2:
            wrong.append(f"{count} {pin} pulses in the last {LAST_S * 1e3:g} ms, {nominal:.0f} are its rate")
    if expected == STOPPED:
        wrong += _not_stopped(seen, figures, most_us, (car.numbers[2], human_us[0]))
    elif expected == REFUSED:
        figures["stopped_after_ms"] = None
        if moving:
            wrong.append(f"throttle at {max(e.pulse_us for e in throttle):g} us, and the car was not to be armed")
    elif expected == HUMAN:
        wrong += _not_human(seen, figures, human_us)
    else:
        if until_limit:
            wrong += _not_limited(seen, figures, most_us)
        wrong += _not_continued(seen, figures, until_limit, car)
    return figures, wrong


def most_throttle_us(car: Car = DEFAULT) -> float:
    """Return the largest throttle pulse that moves no car: neutral, and a step of the Arduino's."""
    return car.numbers[6] + ARDUINO_STEP_US


def periods_of(car: Car) -> dict[str, int]:
    """Return the periods of the pins' pulses, in microseconds."""
    return {"steering": car.numbers[0], "throttle": car.numbers[4]}


def row_of(
    fault: Any,
    judged: tuple[Figures, list[str]],
    code: int | None,
    line: str | None,
    recovered: bool,
    method: str,
    **more: Any,
) -> dict[str, Any]:
    """Return a row of metrics.faults. judged: by judge(). code: of the drive. method: how it was done.

    line: tells of the fault, None if none does. A fault without a message needs no line.
    """
    figures, wrong = judged
    if code != fault.wanted_code:
        wrong.append(f"rover drive ended with {code}, expected {fault.wanted_code}")
    if not fault.message:
        line = "nothing tells of it"
    if line is None:
        wrong.append(f"no line tells of it (wanted: {fault.message})")
    if not recovered:
        wrong.append("the car was not driven again")
    row = {"fault": fault.name, "kind": fault.kind, "expected": fault.expected, **figures}
    row |= {"recovered": recovered, "log_line": line, "exit_code": code, "injected": method}
    row |= {"attempts": 1, "stalled_ms": 0.0, "wrong": wrong} | more
    return row | {"found": fault.expected if not wrong else "not as expected"}


def _not_stopped(seen: Observation, figures: Figures, most_us: float, resting_us: tuple[float, float]) -> Iterator[str]:
    limit_ms = GATES["stopped_ms"]
    if figures["stopped_after_ms"] > limit_ms:
        yield f"throttle off {figures['stopped_after_ms']:g} ms after the fault, {limit_ms:g} are allowed"
    if (figures["max_throttle_us_after"] or 0) > most_us:
        yield f"throttle at {figures['max_throttle_us_after']:g} us after it had to be off"
    # A reset leaves the Arduino in manual. Then the steering is that of the resting stick, as measured.
    since_s = seen.at_s + limit_ms / 1e3 + 0.022
    widths = [e.pulse_us for e in seen.pulses("steering", since_s)]
    if off := [us for us in widths if min(abs(us - rest_us) for rest_us in resting_us) > STEP_US]:
        yield f"steering at {off[-1]:g} us, neutral is {resting_us[0]:g}"


def _not_human(seen: Observation, figures: Figures, human_us: tuple[float, float]) -> Iterator[str]:
    took_ms = 0.0
    for pin, wanted_us in zip(("steering", "throttle"), human_us, strict=True):
        pulses = seen.pulses(pin)
        ours = [i for i, e in enumerate(pulses) if abs(e.pulse_us - wanted_us) > STEP_US]
        first = ours[-1] + 1 if ours else 0
        if first >= len(pulses):
            figures["takeover_ms"] = None
            yield f"{pin} was never the human's"
            return
        took_ms = max(took_ms, (pulses[first].end_s - seen.at_s) * 1e3)
    figures |= {"stopped_after_ms": None, "takeover_ms": round(took_ms, 1)}
    if took_ms > GATES["takeover_ms"]:
        yield f"the human's pulses after {took_ms:.1f} ms, {GATES['takeover_ms']:g} are allowed"


def _not_continued(seen: Observation, figures: Figures, until_limit: bool, car: Car) -> Iterator[str]:
    stopped_s = seen.at_s + figures["stopped_after_ms"] / 1e3 + 1e-4 if until_limit else seen.end_s
    if not until_limit:
        figures["stopped_after_ms"] = None
    for index, (pin, period_us) in enumerate(periods_of(car).items(), 1):
        for e in (e for e in seen.pulses(pin) if e.end_s <= stopped_s):
            recent = [c[index] for c in seen.commands if e.monotonic_s - STILL_VALID_S < c.at_s <= e.monotonic_s]
            if e.kind == "cut" or abs(e.period_us - period_us) > EDGE_US:
                yield f"a {pin} pulse out of time: {e.period_us:g} us after the one before, {period_us} is its period"
                return
            # The firmware moves a pin slowly, so a pulse may lie between those of two recent commands.
            if not recent or not min(recent) - COMMAND_US[pin] <= e.pulse_us <= max(recent) + COMMAND_US[pin]:
                yield f"{pin} at {e.pulse_us:g} us {(e.monotonic_s - seen.at_s) * 1e3:.0f} ms after the fault, which "\
                      f"was not commanded ({sorted(set(recent))})"  # fmt: skip
                return
    if not until_limit and min((e.pulse_us for e in seen.pulses("throttle")), default=0) <= most_throttle_us(car):
        yield "the throttle went off"


def _not_limited(seen: Observation, figures: Figures, most_us: float) -> Iterator[str]:
    """The throttle must fade from a plan's age of fade_s (params.yml) on, and be off at stop_s.

    When the fault comes, the plan already has some age, so both may happen earlier after the fault.
    """
    limits, throttle = params()["drive"], seen.pulses("throttle")
    fading = [e.end_s for e in throttle if e.pulse_us < throttle[0].pulse_us - 2 * ARDUINO_STEP_US]
    figures["fades_after_ms"] = round((fading[0] - seen.at_s) * 1e3, 1) if fading else None
    most_ms = limits["stop_s"] * 1e3 + GATES["stopped_ms"]
    if not fading or abs(fading[0] - seen.at_s - limits["fade_s"]) > 0.15:
        yield f"the throttle fades after {figures['fades_after_ms']} ms, the limit is {limits['fade_s']:g} s"
    if not figures["fades_after_ms"] or not figures["fades_after_ms"] < figures["stopped_after_ms"] <= most_ms:
        yield f"throttle off after {figures['stopped_after_ms']:g} ms, {most_ms:g} are allowed"
    if throttle and throttle[-1].pulse_us > most_us:
        yield "the car was never stopped"
