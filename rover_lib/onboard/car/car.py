"""The car: its servo pulses, the host's throttle limit, its camera and its wheelbase, all read from one file, car.yml.

    with ServoLink("/dev/ttyUSB0", this_car()) as link:
        link.tell(read_car("other.yml"))

Without a car.yml, it is the car of the original recordings. The Arduino is told the same numbers, and refuses any
beyond the limits that its firmware was compiled with (firmware/rover/vehicle.h), which this module repeats.
"""

import math
import os
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.pwm import Channel, PwmCalibration
from rover_lib.onboard.checked import Rule, broken_rule, is_number, one_of, whole
from rover_lib.onboard.errors import CarError, ParamsError

FILE_VARIABLE = "ROVER_CAR"  # environment variable that names another file; inherited by started programs
PLACES = (  # where car.yml may be; the first one that exists is used
    Path(__file__).parents[3] / "car.yml",  # a checkout's
    Path("/etc/rover/car.yml"),  # an installed rover's
)

# What the firmware was compiled to allow, firmware/rover/vehicle.h:
PERIOD_MIN_US, PERIOD_MAX_US = 3000, 25000
FAST_PERIOD_MIN_US, FAST_PERIOD_MAX_US = 1000, 1020  # of a throttle like the user's car's, forward only
PULSE_MIN_US, PULSE_MAX_US = 800, 2200
STEERING_NEUTRAL_MIN_US, THROTTLE_NEUTRAL_MIN_US, NEUTRAL_MAX_US = 1300, 900, 1700
FAST_NEUTRAL_MIN_US, FAST_NEUTRAL_MAX_US, FAST_PULSE_MAX_US = 80, 160, 711
STEERING_THROW_US = 250  # at least, to either side: the gesture before arming moves the stick by 200
THROTTLE_THROW_US = 100  # forward at least
CAP_MAX_US = 118  # from neutral, either way: a fifth of the user's car's throttle

CAP = 0.2
HUMANS = ("receiver", "gamepad")  # on the Arduino's pins, or on this machine
WIDTH_PX = 640  # of the pictures that the balloon world draws


@dataclass(frozen=True)
class Car:
    """One car. Only a car that the Arduino accepts can be made: otherwise CarError says what is wrong.

    cap_us: the farthest that a host may move the throttle's pulse from neutral, either way. field_of_view_deg: of the
    camera, horizontally. positive: the side that positive steering turns to, "left" or "right". human: one of HUMANS.
    """

    name: str = "the recordings' car"
    pwm: PwmCalibration = field(default_factory=PwmCalibration)
    cap_us: int = CAP_MAX_US
    field_of_view_deg: float = 77.3196  # a focal length of 400 pixels of 640
    wheelbase_m: float = 0.26
    positive: str = "right"  # as the pictures of the recordings show
    human: str = "receiver"

    def __post_init__(self) -> None:
        steering = self.pwm.steering
        throttle = self.pwm.throttle
        neutral_us = throttle.neutral_us
        forward_us = throttle.pulse_us(throttle.high)
        periods = (PERIOD_MIN_US, PERIOD_MAX_US)
        pulses = (PULSE_MIN_US, PULSE_MAX_US)
        neutrals = THROTTLE_NEUTRAL_MIN_US, NEUTRAL_MAX_US
        if throttle.period_us < PERIOD_MIN_US:  # a fast one, which goes forward only
            periods = FAST_PERIOD_MIN_US, FAST_PERIOD_MAX_US
            neutrals = (FAST_NEUTRAL_MIN_US, FAST_NEUTRAL_MAX_US)
            pulses = (neutral_us, FAST_PULSE_MAX_US)
        throw_us = min(abs(end - steering.neutral_us) for end in steering.ends_us)
        limits: list[tuple[str, float, float, float]] = [
            ("steering's period_us", steering.period_us, PERIOD_MIN_US, PERIOD_MAX_US),
            ("steering's neutral_us", steering.neutral_us, STEERING_NEUTRAL_MIN_US, NEUTRAL_MAX_US),
            *(("an end of steering", end, PULSE_MIN_US, PULSE_MAX_US) for end in steering.ends_us),
            ("from steering's neutral to its nearer end, us,", throw_us, STEERING_THROW_US, PULSE_MAX_US),
            ("throttle's period_us", throttle.period_us, *periods),
            ("throttle's neutral_us", neutral_us, *neutrals),
            *(("an end of throttle", end, *pulses) for end in throttle.ends_us),
            ("from throttle's neutral to forward, us,", abs(forward_us - neutral_us), THROTTLE_THROW_US, PULSE_MAX_US),
            ("the throttle's cap, us from neutral,", self.cap_us, 1, CAP_MAX_US),
            ("the camera's field_of_view_deg", self.field_of_view_deg, 20, 160),
            ("wheelbase_m", self.wheelbase_m, 0.03, 3),
        ]
        for problem, value, low, high in limits:
            if not low <= value <= high:
                remedy = "measure it with `rover calibrate`, or see docs/build.md"
                raise CarError(f"{problem} must be from {low:g} to {high:g}", found=f"{value:g}", remedy=remedy)

    @property
    def reverses(self) -> bool:
        return self.pwm.throttle.low < 0

    @property
    def left(self) -> int:
        """1 if positive steering turns left, else -1."""
        return 1 if self.positive == "left" else -1

    @property
    def limits(self) -> np.ndarray:
        """(2, 2) float64: the lowest and the highest [steering, throttle]."""
        channels = self.pwm.steering, self.pwm.throttle
        return np.array([[c.low for c in channels], [c.high for c in channels]])

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers sent to the Arduino: each channel's period, least, neutral and longest pulse, and the cap; us."""
        steering_us, *steering, throttle_us, low_us, neutral_us, high_us = self.pulses_us
        return steering_us, *sorted(steering), throttle_us, *sorted((low_us, neutral_us, high_us)), self.cap_us

    @property
    def id(self) -> int:
        """CRC-32 of the numbers, by which host and Arduino know that they mean the same car."""
        return zlib.crc32(struct.pack("<9H", *self.numbers))

    @property
    def cap(self) -> float:
        """The largest forward throttle that the cap allows, an action in [0, 1]."""
        throttle = self.pwm.throttle
        return min(self.cap_us / abs(throttle.pulse_us(throttle.high) - throttle.neutral_us), 1.0)

    @property
    def focal_px(self) -> float:
        """Focal length of its camera in pixels, for a picture 640 pixels wide."""
        return round(WIDTH_PX / 2 / math.tan(math.radians(self.field_of_view_deg) / 2), 2)

    def drives_like(self, other: "Car") -> bool:
        """Whether both are equal but for the name, the cap and the human."""
        return not self.unlike(other)

    def unlike(self, other: "Car") -> str:
        """Say in which way another car drives otherwise with the same actions; "" if it does not."""
        if self.positive != other.positive:
            return f"steering +1 turns {self.name!r} {self.positive} and {other.name!r} {other.positive}"
        mine, theirs = ((c.pulses_us, c.field_of_view_deg, c.wheelbase_m) for c in (self, other))
        return "" if mine == theirs else f"{self.name!r} and {other.name!r} differ in pulses, camera or wheelbase"

    @property
    def pulses_us(self) -> tuple[int, ...]:
        """Of steering and then of throttle: the period, and the pulses of the lowest action, 0 and the highest; us."""
        steering = self.pwm.steering
        throttle = self.pwm.throttle
        return round(steering.period_us), *steering.pulses_us, round(throttle.period_us), *throttle.pulses_us

    def description(self) -> dict[str, Any]:
        """The content of its car.yml, from which Car.of() makes the same car."""
        period_us, *ends_us, throttle_us, back_us, rest_us, forward_us = self.pulses_us
        right_us, neutral_us, left_us = ends_us if self.positive == "left" else ends_us[::-1]
        steering = {"period_us": period_us, "left_us": left_us, "neutral_us": neutral_us, "right_us": right_us}
        throttle = {"period_us": throttle_us, "neutral_us": rest_us, "forward_us": forward_us}
        reverse = {"reverse_us": back_us} if self.reverses else {}
        content = {
            "name": self.name,
            "steering": {**steering, "positive": self.positive},
            "throttle": {**throttle, **reverse, "cap_us": self.cap_us},
            "camera": {"field_of_view_deg": self.field_of_view_deg},
            "wheelbase_m": self.wheelbase_m,
        }
        if self.human != HUMANS[0]:
            content["human"] = self.human
        return content

    @classmethod
    def of(cls, content: object, where: str = "car.yml") -> "Car":
        """The car that the content of a car.yml describes. CarError names what is missing, unknown or impossible."""
        top = _section(content, where, TOP)
        steering, throttle, camera = (
            _section(top.get(name, {}), f"{where}: {name}", keys) for name, keys in SECTIONS.items()
        )
        # In files that do not say it, +1 is what they call left; of the recorded car they did not know it (below).
        positive = steering.get("positive", "left")
        ends_us = steering["right_us"], steering["neutral_us"], steering["left_us"]
        forward_us = abs(throttle["forward_us"] - throttle["neutral_us"])
        settings = {
            "name": top.get("name", "no name"),
            "cap_us": throttle.get("cap_us", min(round(CAP * forward_us), CAP_MAX_US)),
            **{key: top[key] for key in ("wheelbase_m", "human") if key in top},
            **camera,
        }
        pulses_us = throttle.get("reverse_us"), throttle["neutral_us"], throttle["forward_us"]
        try:
            pwm = PwmCalibration(
                steering=_channel("steering", steering["period_us"], ends_us if positive == "left" else ends_us[::-1]),
                throttle=_channel("throttle", throttle["period_us"], pulses_us),
            )
            car = cls(pwm=pwm, positive=positive, **settings)
        except CarError as error:
            raise CarError(f"{where}: {error.what}", found=error.found, remedy=error.remedy) from None
        if car.pulses_us == _DEFAULT_CAR.pulses_us:
            # The checked constants themselves, because whole microseconds are slightly less precise.
            car = cls(positive=steering.get("positive", _DEFAULT_CAR.positive), **settings)
        return car


_US, _NUMBER = whole(1, 65535, " microseconds"), Rule(is_number, "a number")
_MAPPING = Rule(lambda value: isinstance(value, Mapping), "a mapping")
_NAME = Rule(lambda v: isinstance(v, str) and 0 < len(v) <= 60 and v.isprintable(), "1 to 60 characters")
# What each section of a car.yml must have, and what it may have
TOP = (
    {"steering": _MAPPING, "throttle": _MAPPING},
    {"name": _NAME, "camera": _MAPPING, "wheelbase_m": _NUMBER, "human": one_of(HUMANS)},
)
SECTIONS = {
    "steering": (
        {"period_us": _US, "left_us": _US, "neutral_us": _US, "right_us": _US},
        {"positive": one_of(("left", "right"))},
    ),
    "throttle": ({"period_us": _US, "neutral_us": _US, "forward_us": _US}, {"reverse_us": _US, "cap_us": _US}),
    "camera": ({}, {"field_of_view_deg": _NUMBER}),
}


def _section(value: object, where: str, known: tuple[Mapping[str, Rule], Mapping[str, Rule]]) -> Mapping[str, Any]:
    """Return a section whose values keep the rules. known: those of what it must have, and of what it may have."""
    needed, optional = known
    if not isinstance(value, Mapping):
        raise CarError(f"{where} must be a mapping", found=repr(value)[:80])
    if unknown := sorted(map(str, value.keys() - needed.keys() - optional.keys())):
        remedy = f"known are {', '.join(sorted({*needed, *optional}))}"
        raise CarError(f"{where}: unknown {', '.join(unknown)}", remedy=remedy)
    rules = {**needed, **{name: rule for name, rule in optional.items() if name in value}}
    if broken := broken_rule(value, rules):
        raise CarError(f"{where}: {broken[0]} must be {broken[1]}", found=broken[2])
    return value


def _channel(name: str, period_us: int, pulses_us: tuple[int | None, int, int]) -> Channel:
    """A channel from its pulses at the actions -1 (None: there are no actions below 0), 0 and 1."""
    low_us, neutral_us, high_us = pulses_us
    upwards = high_us > neutral_us
    if high_us == neutral_us or (low_us is not None and (low_us == neutral_us or (low_us < neutral_us) != upwards)):
        pulses = f"{low_us}, {neutral_us} and {high_us}"
        problem = f"{name}'s neutral_us must lie between its two ends"
        raise CarError(problem, found=pulses, remedy="measure them with `rover calibrate`")
    neutral_pct = neutral_us / period_us * 100
    high_pct = (high_us - neutral_us) / period_us * 100
    if low_us is None:
        return Channel(name, period_us, neutral_pct, high_pct, 0.0, 1.0, by_pulse=True)
    low_pct = (neutral_us - low_us) / period_us * 100
    return Channel(name, period_us, neutral_pct, high_pct, -1.0, 1.0, low_pct, by_pulse=True)


_DEFAULT_CAR = Car()
DEFAULT = _DEFAULT_CAR.description()
DEFAULT_NUMBERS = _DEFAULT_CAR.numbers  # which the firmware assumes until it is told of others


def read_car(path: Path | str) -> Car:
    """Read a car from a file. Raises CarError if it is missing, not YAML, or not a car that can be driven."""
    from rover_lib.onboard.params import read_params  # imports YAML, which is not needed without a file

    if not Path(path).is_file():
        raise CarError(f"{path}: not found", remedy="`rover calibrate` writes one")
    try:
        return Car.of(read_params(path), str(path))
    except ParamsError as error:
        raise CarError(f"{path}: cannot be read ({error})", remedy="`rover calibrate` writes a new one") from None


def car_file() -> Path | None:
    """The car.yml that is used on this machine, None if there is none."""
    if named := os.environ.get(FILE_VARIABLE):
        return Path(named)
    return next((place for place in PLACES if place.is_file()), None)


def default_place() -> Path:
    """Where a new car.yml belongs on this machine."""
    checkout, installed = PLACES
    return car_file() or (checkout if (checkout.parent / "pyproject.toml").is_file() else installed)


def this_car() -> Car:
    """This machine's car, from its car.yml; without one, the car of the original recordings. Raises as read_car()."""
    path = car_file()
    return read_car(path) if path else _DEFAULT_CAR


def yaml_of(car: Car) -> str:
    """The text of a car.yml that describes it."""
    import yaml

    head = "# The car, as `rover calibrate` found it; docs/build.md says what each is. Pulses in microseconds.\n"
    return head + yaml.safe_dump(car.description(), sort_keys=False)
