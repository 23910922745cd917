"""car.yml: the car that it describes, and the contents that are refused."""

import copy

import numpy as np
import pytest
import yaml

from rover_lib.onboard.car import car as module
from rover_lib.onboard.car.car import Car, this_car, yaml_of
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.errors import CarError

CRAWLER = {
    "name": "crawler",
    "steering": {"period_us": 20000, "left_us": 2000, "neutral_us": 1500, "right_us": 1100},
    "throttle": {"period_us": 20000, "neutral_us": 1500, "forward_us": 2000, "reverse_us": 1000},
    "camera": {"field_of_view_deg": 100},
    "wheelbase_m": 0.31,
}


def changed(where, value):
    """Return CRAWLER with one value changed, or without it if `value` is None."""
    content = copy.deepcopy(CRAWLER)
    *sections, key = where.split(".")
    section = content[sections[0]] if sections else content
    section[key] = value
    if value is None:
        del section[key]
    return content


@pytest.fixture
def no_file(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "PLACES", (tmp_path / "car.yml",))
    monkeypatch.delenv(module.FILE_VARIABLE, raising=False)
    return tmp_path / "car.yml"


def test_without_a_file_it_is_the_recordings_car(no_file):
    car = this_car()
    assert car.pwm == PwmCalibration() and car.numbers == module.DEFAULT_NUMBERS
    assert (car.focal_px, car.wheelbase_m, car.cap, car.reverses) == (400, 0.26, pytest.approx(0.2, abs=1e-3), False)
    np.testing.assert_array_equal(car.limits, [[-1, 0], [1, 1]])


def test_the_default_written_down_is_the_same_to_the_bit_and_a_named_file_counts_first(no_file, monkeypatch, tmp_path):
    for car in (Car(human="gamepad"), Car()):
        no_file.write_text(yaml_of(car))
        assert this_car() == car and car.drives_like(Car()) and car.id == Car().id
    assert this_car().pwm.steering.neutral_pct == 6.83
    other = tmp_path / "other.yml"
    monkeypatch.setenv(module.FILE_VARIABLE, str(other))
    with pytest.raises(CarError, match=r"other\.yml: not found; .*calibrate"):
        this_car()
    other.write_text(yaml.safe_dump(CRAWLER))
    assert this_car().name == "crawler"


def test_each_side_of_neutral_has_its_own_span():
    car = Car.of(CRAWLER)
    assert [car.pwm.steering.pulse_us(a) for a in (-1, -0.5, 0, 0.5, 1)] == [1100, 1300, 1500, 1750, 2000]
    assert car.numbers == (20000, 1100, 1500, 2000, 20000, 1000, 1500, 2000, 100)
    assert car.reverses and car.limits.tolist() == [[-1, -1], [1, 1]]
    assert car.focal_px == pytest.approx(268.5, abs=0.05)
    assert [car.pwm.throttle.moves(us) for us in (1490, 1496, 1500, 1504, 1510)] == [True, False, False, False, True]
    assert [Car().pwm.throttle.moves(us) for us in (0, 104, 120, 124, 125)] == [False] * 4 + [True]


@pytest.mark.parametrize(
    ("where", "value", "sentence"),
    [
        ("steering.left_us", None, "left_us must be a whole number"),
        ("colour", "red", "unknown colour"),
        ("steering.left_us", 1500, "between its two ends"),
        ("steering.neutral_us", 1250, "neutral_us must be from 1300 to 1700"),
        ("steering.right_us", 1300, "must be from 250"),
        ("steering.left_us", 2400, "must be from 800 to 2200"),
        ("steering.period_us", 1900, "steering's period_us must be from 3000"),
        ("throttle.period_us", 2500, "throttle's period_us must be from 1000"),
        ("throttle.reverse_us", 700, "an end of throttle"),
        ("throttle.forward_us", 1550, "must be from 100"),
        ("throttle.cap_us", 119, "from 1 to 118"),
        pytest.param("wheelbase_m", 10**400, "wheelbase_m", id="a number of 401 digits"),
        ("human", "nobody", "human"),
    ],
)
def test_what_is_no_car_is_said_in_a_sentence(where, value, sentence, no_file):
    for text, words in ((yaml.safe_dump(changed(where, value)), sentence), ("- a list", ""), ("a: [", "")):
        no_file.write_text(text)
        with pytest.raises(CarError) as error:
            this_car()
        assert str(error.value).startswith(str(no_file)) and words in str(error.value)


def test_which_side_is_positive_is_said_and_changes_no_pulse():
    """The recorded car's files once called 2012 us left; its pictures show that it is right."""
    ours = Car()
    before = ours.description()
    before["steering"] = {"period_us": 21316, "left_us": 2012, "neutral_us": 1456, "right_us": 900}
    for content in (ours.description(), before):
        assert Car.of(content) == ours and Car.of(content).pwm.pulses(1, 0).steering_us == 2012
    left = Car.of(before | {"steering": before["steering"] | {"positive": "left"}})
    assert (left.positive, left.left, ours.left) == ("left", 1, -1) and not left.drives_like(ours)
