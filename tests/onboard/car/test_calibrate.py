"""`rover calibrate`: what a human does with the sticks, seen through the firmware's own state machine, becomes a
car.yml, or a sentence that says why not.
"""

from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from lab.driving.native import NativeArduino
from rover_lib.onboard import cli
from rover_lib.onboard.car import calibrate as module
from rover_lib.onboard.car import car as car_module
from rover_lib.onboard.car import servo_link
from rover_lib.onboard.car.calibrate import measure
from rover_lib.onboard.car.car import Car, read_car, yaml_of
from rover_lib.onboard.car.pwm import Pulses
from rover_lib.onboard.errors import CarError
from tests.helpers import needs

pytestmark = needs.gcc
CRAWLER = {"rest": (1504, 1496), "left": 1996, "right": 1012, "forward": 1990, "back": 1004}
OURS = {"rest": (1456, 120), "left": 1948, "right": 1008, "forward": 640, "back": 120}


class Desk:
    """A transmitter on a desk, a human who does what he is asked, and the Arduino that receives it."""

    def __init__(self, sticks, periods_us=(20000, 20000)):
        self.board, self.sticks, self.asked = NativeArduino(), dict(sticks), []
        self.board.periods_us = periods_us
        self.board.sticks = list(self.sticks["rest"])

    def ask(self, text):
        self.asked.append(text)
        sticks = list(self.sticks["rest"])
        for said in ("to the left", "to the right", "fully forward", "fully back"):
            if said in text:
                where = said.split()[-1]
                sticks[where in ("forward", "back")] = self.sticks[where]
        self.board.sticks = sticks
        self.board.run(1500)

    def tell(self, car):
        if (answer := self.board.command("C", *car.numbers)) != "k":
            raise servo_link.LinkError(f"refused: {answer}")

    def latest(self):
        return self.board.status

    def sleep(self, seconds):
        self.board.run(round(seconds * 1000))

    def measure(self, **more):
        return measure(self, self.ask, sleep=self.sleep, **more)


def test_an_inverted_transmitter():
    """Positive steering is right, however the servo is mounted, or what an earlier car.yml said."""
    for left, right in ((1012, 1996), (1996, 1012)):
        desk = Desk(CRAWLER | {"left": left, "right": right, "forward": 1004, "back": 1990})
        for given, found in (({}, "right"), ({"positive": "left"}, "left")):
            car = desk.measure(**given)
            ends = car.pwm.pulses(car.left, 1), car.pwm.pulses(-car.left, -1)
            assert car.positive == found and ends == (Pulses(left, 1004), Pulses(right, 1990))


@pytest.mark.parametrize("periods_us", [(3100, 3300), (20000, 9000), (21316, 1016)])
def test_other_periods(periods_us):
    fast = periods_us[1] < 3000
    car = Desk(OURS | {"forward": 948} if fast else CRAWLER, periods_us).measure()
    assert (car.numbers[0], car.numbers[4]) == periods_us and (not fast or car.numbers[7] == 711)


@pytest.mark.parametrize(
    ("sticks", "sentence"),
    [
        (CRAWLER | {"rest": (1500, 0)}, "no pulse of throttle"),
        (CRAWLER | {"left": 1504}, "steering's neutral_us must lie between its two ends.*hold it at its end"),
        (CRAWLER | {"forward": 1570}, "from throttle's neutral to forward, us, must be from 100"),
        (CRAWLER | {"left": 2400}, "no pulse of steering"),
    ],
)
def test_what_is_no_car_says_what_was_seen(sticks, sentence):
    with pytest.raises(CarError, match=sentence):
        Desk(sticks).measure()


@pytest.fixture
def run(monkeypatch, tmp_path):
    """run(desk, *options) runs `rover calibrate` and returns its result and the path of car.yml."""
    path = tmp_path / "etc" / "car.yml"
    monkeypatch.setattr(car_module, "PLACES", (tmp_path / "checkout" / "car.yml", path))
    monkeypatch.delenv(car_module.FILE_VARIABLE, raising=False)

    def run(desk, *options):
        monkeypatch.setattr(module, "measure", partial(measure, sleep=desk.sleep))

        link = SimpleNamespace(tell=desk.tell, latest=lambda: (desk.sleep(0.02), desk.latest())[1])
        monkeypatch.setattr(servo_link, "ServoLink", lambda port, car: nullcontext(link))
        monkeypatch.setattr(cli.click, "prompt", lambda text, *args, **more: desk.ask(text))
        return CliRunner().invoke(cli.main, ["calibrate", *options]), path

    return run


def test_the_command_writes_what_it_measured_and_replaces_nothing_without_force(run):
    desk = Desk(CRAWLER, (20010, 19980))
    result, path = run(desk, "--name", "crawler", "--field-of-view-deg", "100", "--wheelbase-m", "0.3")
    assert result.exit_code == 0, result.output
    car = read_car(path)
    assert (car.name, car.field_of_view_deg, car.wheelbase_m, car.reverses) == ("crawler", 100, 0.3, True)
    assert car.numbers == (20010, 1012, 1504, 1996, 19980, 1004, 1496, 1990, 99)
    assert "unplug the motor" in desk.asked[0] and len(desk.asked) == 6
    assert desk.board.hello.car == car.id  # and not one of the cars that were tried before
    path.write_text(yaml_of(Car()))
    for options, word in (((), "--force replaces it"), (("--wheelbase-m", "30", "--force"), "--wheelbase-m")):
        result, _ = run(desk := Desk(CRAWLER), *options)
        assert result.exit_code and word in result.output and not desk.asked
    assert read_car(path) == Car()
    assert run(Desk(CRAWLER), "--force")[0].exit_code == 0 and read_car(path) != Car()
