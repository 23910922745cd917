"""The car: its servo pulses, the host's throttle limit, its camera and its wheelbase, all read from one file, car.yml.

    with ServoLink("/dev/ttyUSB0", this_car()) as link:
        link.send_action(steering=0.2, throttle=0.1)

Without a car.yml, it is the car of the original recordings, with the constants that were checked on them. The Arduino
is told the same numbers, and refuses any beyond the limits that its firmware was compiled with. This module has the
same limits (firmware/rover/vehicle.h), so that a file which the Arduino would refuse is refused when it is read.
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
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import CarError, ParamsError, PwmError

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

    pwm: its two channels. cap_us: the farthest that a host may move the throttle's pulse from neutral, either way.
    field_of_view_deg: of the camera, from the left edge to the right one. wheelbase_m: from axle to axle. positive: the
    side that positive steering turns to, "left" or "right". human: where the human's pulses come from, one of HUMANS.
    """

    name: str = "the recordings' car"
    pwm: PwmCalibration = field(default_factory=PwmCalibration)
    cap_us: int = CAP_MAX_US
    field_of_view_deg: float = 77.3196  # a focal length of 400 pixels of 640
    wheelbase_m: float = 0.26
    positive: str = "right"  # as the pictures of the recordings show
    human: str = "receiver"

    def __post_init__(self):
        steering, throttle = self.pwm.steering, self.pwm.throttle
        low, neutral, high = steering.ends_us[0], steering.neutral_us, steering.ends_us[1]
        _must_be(steering.period_us, PERIOD_MIN_US, PERIOD_MAX_US, "steering's period_us")
        _must_be(neutral, STEERING_NEUTRAL_MIN_US, NEUTRAL_MAX_US, "steering's neutral_us")
        for end_us in (low, high):
            _must_be(end_us, PULSE_MIN_US, PULSE_MAX_US, "an end of steering")
            _must_be(abs(end_us - neutral), STEERING_THROW_US, PULSE_MAX_US, "from steering's neutral to an end, us,")
        low, neutral, high = throttle.ends_us[0], throttle.neutral_us, throttle.ends_us[1]
        forward_us = abs(throttle.pulse_us(throttle.high) - neutral)
        if throttle.period_us < PERIOD_MIN_US:
            _must_be(throttle.period_us, FAST_PERIOD_MIN_US, FAST_PERIOD_MAX_US, "a fast throttle's period_us")
            _must_be(neutral, FAST_NEUTRAL_MIN_US, FAST_NEUTRAL_MAX_US, "a fast throttle's neutral_us")
            _must_be(high, neutral, FAST_PULSE_MAX_US, "a fast throttle's forward_us")
            if low != neutral:
                raise CarError("a throttle with a period below 3000 us must be forward only", found=f"an end of {low}")
        else:
            _must_be(throttle.period_us, PERIOD_MIN_US, PERIOD_MAX_US, "throttle's period_us")
            _must_be(neutral, THROTTLE_NEUTRAL_MIN_US, NEUTRAL_MAX_US, "throttle's neutral_us")
            for end_us in (low, high):
                _must_be(end_us, PULSE_MIN_US, PULSE_MAX_US, "an end of throttle")
        _must_be(forward_us, THROTTLE_THROW_US, PULSE_MAX_US, "from throttle's neutral to forward, us,")
        _must_be(self.cap_us, 1, CAP_MAX_US, "the throttle's cap, us from neutral,")
        _must_be(self.field_of_view_deg, 20, 160, "the camera's field_of_view_deg")
        _must_be(self.wheelbase_m, 0.03, 3, "wheelbase_m")

    @property
    def reverses(self) -> bool:
        """Whether it can drive backwards."""
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
        """The numbers sent to the Arduino, in whole microseconds.

        For each channel the period, the shortest pulse, neutral and the longest pulse; then the cap.
        """
        steering, throttle = (
            (round(c.period_us), c.ends_us[0], c.neutral_us, c.ends_us[1])
            for c in (self.pwm.steering, self.pwm.throttle)
        )
        return (*steering, *throttle, self.cap_us)

    @property
    def id(self) -> int:
        """CRC-32 of the numbers, by which host and Arduino know that they mean the same car."""
        return zlib.crc32(struct.pack("<9H", *self.numbers))

    @property
    def is_default(self) -> bool:
        """Whether it is the car that the firmware assumes until it is told of another."""
        return self.numbers == DEFAULT_NUMBERS

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
        """Whether actions and pictures mean the same on both cars: all is equal but the name, the cap, the human, and
        which side is called left.
        """
        mine, others = ({**c.description(), "name": "", "human": "", "steering": c.steering_us} for c in (self, other))
        for description in (mine, others):
            description["throttle"] = {**description["throttle"], "cap_us": 0}
        return mine == others

    @property
    def steering_us(self) -> tuple[int, ...]:
        """Steering's period, and its pulses at -1, 0 and 1, in microseconds."""
        c = self.pwm.steering
        return round(c.period_us), c.pulse_us(c.low), c.neutral_us, c.pulse_us(c.high)

    def description(self) -> dict[str, Any]:
        """The content of its car.yml, from which Car.of() makes the same car."""
        steering, throttle = self.pwm.steering, self.pwm.throttle
        reverse = {"reverse_us": throttle.pulse_us(throttle.low)} if self.reverses else {}
        return {
            "name": self.name,
            "steering": {
                "period_us": round(steering.period_us),
                "left_us": steering.pulse_us(float(self.left)),
                "neutral_us": steering.neutral_us,
                "right_us": steering.pulse_us(-float(self.left)),
                "positive": self.positive,
            },
            "throttle": {
                "period_us": round(throttle.period_us),
                "neutral_us": throttle.neutral_us,
                "forward_us": throttle.pulse_us(throttle.high),
                **reverse,
                "cap_us": self.cap_us,
            },
            "camera": {"field_of_view_deg": self.field_of_view_deg},
            "wheelbase_m": self.wheelbase_m,
            **({"human": self.human} if self.human != HUMANS[0] else {}),
        }

    @classmethod
    def of(cls, content: object, where: str = "car.yml") -> "Car":
        """The car that the content of a car.yml describes. CarError names what is missing, unknown or impossible."""
        content = _section(content, where, {"steering", "throttle"}, {"name", "camera", "wheelbase_m", "human"})
        steering = _section(
            content["steering"], f"{where}: steering", {"period_us", "left_us", "neutral_us", "right_us"}, {"positive"}
        )
        # In files that do not say it, +1 is what they call left; of the recorded car they did not know it (below).
        positive = steering.get("positive", "left")
        if positive not in ("left", "right"):
            raise CarError(f"{where}: steering: positive must be left or right", found=repr(positive)[:80])
        throttle = _section(
            content["throttle"],
            f"{where}: throttle",
            {"period_us", "neutral_us", "forward_us"},
            {"reverse_us", "cap_us"},
        )
        camera = _section(content.get("camera", {}), f"{where}: camera", set(), {"field_of_view_deg"})
        name = content.get("name", "no name")
        if not isinstance(name, str) or not 0 < len(name) <= 60 or not name.isprintable():
            raise CarError(f"{where}: name must be 1 to 60 characters", found=repr(name)[:80])
        human = content.get("human", HUMANS[0])
        if human not in HUMANS:
            raise CarError(f"{where}: human must be {' or '.join(HUMANS)}", found=repr(human)[:80])
        us = {
            f"{channel}.{key}": _whole(value, f"{where}: {channel}: {key}")
            for channel, section in (("steering", steering), ("throttle", throttle))
            for key, value in section.items()
            if key != "positive"
        }
        ends_us = us["steering.right_us"], us["steering.neutral_us"], us["steering.left_us"]
        forward_us = abs(us["throttle.forward_us"] - us["throttle.neutral_us"])
        cap_us = us.get("throttle.cap_us", min(round(CAP * forward_us), CAP_MAX_US))
        measures = {
            key: _number(section[key], f"{where}: {key}")
            for section, key in ((camera, "field_of_view_deg"), (content, "wheelbase_m"))
            if key in section
        }
        try:
            car = cls(
                name=name,
                pwm=PwmCalibration(
                    steering=_channel(
                        "steering", us["steering.period_us"], ends_us if positive == "left" else ends_us[::-1]
                    ),
                    throttle=_channel(
                        "throttle",
                        us["throttle.period_us"],
                        (us.get("throttle.reverse_us"), us["throttle.neutral_us"], us["throttle.forward_us"]),
                    ),
                ),
                cap_us=cap_us,
                positive=positive,
                human=human,
                **measures,
            )
        except (CarError, PwmError) as error:
            raise CarError(f"{where}: {error.what}", found=error.found, remedy=error.remedy) from None
        if car.steering_us == _DEFAULT_CAR.steering_us and (
            {**car.description()["throttle"], "cap_us": 0} == {**DEFAULT["throttle"], "cap_us": 0}
        ):
            # The checked constants themselves, because whole microseconds are slightly less precise.
            positive = steering.get("positive", _DEFAULT_CAR.positive)
            car = cls(car.name, PwmCalibration(), cap_us, positive=positive, human=human, **measures)
        return car


def _must_be(value: float, low: float, high: float, what: str) -> None:
    if not low <= value <= high:
        raise CarError(
            f"{what} must be from {low:g} to {high:g}",
            found=f"{value:g}",
            remedy="measure it with `rover calibrate`, or see docs/build.md",
        )


def _section(value: object, where: str, needed: set[str], optional: set[str]) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise CarError(f"{where} must be a mapping", found=repr(value)[:80])
    if missing := sorted(needed - set(value)):
        raise CarError(f"{where}: {', '.join(missing)} is missing", remedy="docs/build.md has a whole example")
    if unknown := sorted(map(str, set(value) - needed - optional)):
        raise CarError(
            f"{where}: unknown {', '.join(unknown)}", remedy=f"known are {', '.join(sorted(needed | optional))}"
        )
    return value


def _number(value: Any, what: str) -> float:
    if not is_number(value):
        raise CarError(f"{what} must be a number", found=repr(value)[:80])
    return value


def _whole(value: object, what: str) -> int:
    if not is_whole(value, 0, 65535):
        raise CarError(f"{what} must be whole microseconds", found=repr(value)[:80])
    return value


def _channel(name: str, period_us: int, pulses_us: tuple[int | None, int, int]) -> Channel:
    """A channel from its pulses at the actions -1 (None: there are no actions below 0), 0 and 1."""
    low_us, neutral_us, high_us = pulses_us
    upwards = high_us > neutral_us
    if high_us == neutral_us or (low_us is not None and (low_us == neutral_us or (low_us < neutral_us) != upwards)):
        raise CarError(
            f"{name}'s neutral_us must lie between its two ends",
            found=f"{low_us}, {neutral_us} and {high_us}",
            remedy="measure them with `rover calibrate`",
        )
    longest = max(neutral_us, high_us, low_us or 0)
    if longest >= period_us:
        raise CarError(f"{name}'s period_us must be longer than its pulses", found=f"{period_us} and {longest}")
    return Channel(
        name,
        period_us,
        neutral_us / period_us * 100,
        (high_us - neutral_us) / period_us * 100,
        0.0 if low_us is None else -1.0,
        1.0,
        None if low_us is None else (neutral_us - low_us) / period_us * 100,
        by_pulse=True,
    )


_DEFAULT_CAR = Car()
DEFAULT = _DEFAULT_CAR.description()
DEFAULT_NUMBERS = _DEFAULT_CAR.numbers


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

    return "# The car, as `rover calibrate` found it; docs/build.md says what each is. Pulses in microseconds.\n" + (
        yaml.safe_dump(car.description(), sort_keys=False)
    )
