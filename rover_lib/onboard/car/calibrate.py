"""Measure another car's transmitter through the Arduino's receiver pins, for `rover calibrate`, which writes car.yml.

The human's pulses go through to the servo and the speed controller, and while several kinds of car are tried, these get
the neutral of each. So the wheels must be off the ground and the motor unplugged.
"""

import statistics
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rover_lib.onboard.car.car import DEFAULT, FAST_PULSE_MAX_US, PERIOD_MIN_US, Car
from rover_lib.onboard.errors import CarError

if TYPE_CHECKING:
    from rover_lib.onboard.car.servo_link import ServoLink

LOOK_S = 0.5  # time for both signals to appear with one kind of car; two or even eight pulses of 25 ms take less
MEASURE_S = 1.0
STEP_S = 0.02  # between two statuses of the Arduino
STEADY_US = 24  # a stick held still stays within this; resting sticks in the recordings stay within 16
RETURNS_US = 40  # if the throttle moves back less than this, the car has no reverse
NAMES = ("steering", "throttle")


def _slow(steering_us: int, throttle_us: int) -> Car:
    """Return a car with about these periods, used only to receive pulses."""
    steering = {"period_us": steering_us, "right_us": 1000, "neutral_us": 1500, "left_us": 2000}
    throttle = {"period_us": throttle_us, "neutral_us": 1500, "forward_us": 2000, "cap_us": 1}
    return Car.of({"steering": steering, "throttle": throttle})


# The Arduino accepts periods within a quarter of the car's. Together these cover 3 to 25 ms; the likely come first.
PERIODS_US = (20000, 12500, 7900, 5000, 3200)
KINDS = (Car(), *(_slow(us, us) for us in PERIODS_US), *(_slow(a, b) for a in PERIODS_US for b in PERIODS_US if a != b))


def measure(
    link: "ServoLink",
    ask: Callable[[str], object],
    *,
    notify: Callable[[str], None] = lambda text: None,
    sleep: Callable[[float], None] = time.sleep,
    positive: str = "right",
    **more: Any,
) -> Car:
    """Lead a human through the ends and centres of steering and throttle; return the measured car.

    ask: tells the human what to do, and returns when it is done. notify: is told what was measured. positive: the side
    that positive steering turns to, by default as on the recorded car, however the servo is mounted. more: `name`,
    `camera` and `wheelbase_m` of car.yml. Raises CarError if the values do not make a car; LinkError like the link.
    """
    Car.of({**DEFAULT, **more}, "what was given")  # so that mistakes in it are reported before the human does anything
    ask("Take the wheels off the ground and unplug the motor. Switch the transmitter on, and let go of it.")
    _find(link, sleep)
    steering_us, throttle_us, *periods_us = _hold(link, "at rest", sleep)
    notify(f"at rest: {steering_us} and {throttle_us} us, with periods of {periods_us[0]} and {periods_us[1]} us")
    ends = {}
    for position, stick in (
        ("left", "Steer fully to the left"),
        ("right", "Steer fully to the right"),
        ("forward", "Let go of it, and give throttle fully forward (stick or trigger)"),
        ("back", "Give throttle fully back (leave it at rest if this car has no reverse)"),
    ):
        ask(f"{stick}, and hold it there.")
        ends[position] = _hold(link, f"with the stick {position}", sleep)[position in ("forward", "back")]
        notify(f"{position}: {ends[position]} us")
    ask("Let go of steering and throttle.")
    fast = periods_us[1] < PERIOD_MIN_US
    if fast:
        ends["forward"] = min(ends["forward"], FAST_PULSE_MAX_US)  # which the firmware takes for full throttle
    steering = {
        "period_us": periods_us[0],
        "left_us": ends["left"],
        "neutral_us": steering_us,
        "right_us": ends["right"],
        "positive": positive,
    }
    throttle = {"period_us": periods_us[1], "neutral_us": throttle_us, "forward_us": ends["forward"]}
    if abs(ends["back"] - throttle_us) > RETURNS_US and not fast:
        throttle["reverse_us"] = ends["back"]
    try:
        return Car.of({**more, "steering": steering, "throttle": throttle}, "the measured car")
    except CarError as error:
        remedy = "let go of a stick for its rest, hold it at its end, and set dual rate and end points to 100 %"
        raise CarError(error.what, found=error.found, remedy=remedy) from None


def _find(link: "ServoLink", sleep: Callable[[float], None]) -> None:
    """Tell the Arduino of one kind of car after the other until it receives both signals. Raises CarError."""
    names: set[str] = set()
    for kind in KINDS:
        link.tell(kind)
        for _ in range(round(LOOK_S / STEP_S)):
            sleep(STEP_S)
            status = link.latest()
            pulses = status.receiver[:2] if status else (None, None)
            names |= {name for name, us in zip(NAMES, pulses, strict=True) if us is not None}
            if None not in pulses:
                return
    silent = " and ".join(name for name in NAMES if name not in names)
    remedy = "is the transmitter on, and are the receiver's channels on D2 and D8 (firmware/README.md)?"
    raise CarError(f"no pulse of {silent or 'both channels at a time'} came from the receiver", remedy=remedy)


def _hold(link: "ServoLink", where: str, sleep: Callable[[float], None]) -> list[int]:
    """Measure both channels for MEASURE_S. Return the medians of both pulses and both periods, in microseconds.

    Raises CarError if a signal is lost or a stick moves.
    """
    rows = []
    for _ in range(round(MEASURE_S / STEP_S)):
        sleep(STEP_S)
        status = link.latest()
        assert status, "it was received a moment ago"
        for name, pulse_us in zip(NAMES, status.receiver[:2], strict=True):
            if pulse_us is None:
                problem = f"no pulse of {name} {where} that a servo would take, 800 to 2200 us"
                raise CarError(problem, remedy="set the transmitter's end points to 100 %, and keep it on")
        rows.append([us or 0 for us in status.receiver])
    columns = list(zip(*rows, strict=True))
    for name, column in zip(NAMES, columns, strict=False):
        if max(column) - min(column) > STEADY_US:
            span = f"{min(column)} to {max(column)} us"
            raise CarError(f"{name} moved while it was measured {where}", found=span, remedy="hold the stick still")
    return [round(statistics.median(column)) for column in columns]
