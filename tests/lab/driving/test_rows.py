"""The faults that docs/safety.md names, in virtual time; and two of those on pins."""

import logging
import re
from dataclasses import replace

import needs
import pytest
from click.testing import CliRunner

from lab.__main__ import main
from lab.arduino.emulator import REPOSITORY
from lab.driving.on_pins import INJECT, pin_rows
from lab.driving.pins import CONTINUES, REFUSED, STOPPED
from lab.driving.rows import all_rows, rows_of, run_row
from lab.driving.stories import KEPT
from lab.driving.virtual import LOST, STUCK, World
from lab.driving.virtual_host import VirtualLink
from rover_lib.onboard.car.car import Car, read_car
from rover_lib.onboard.car.servo_link import LinkError, State
from rover_lib.onboard.stage import read_stage

SAFETY = (REPOSITORY / "docs" / "safety.md").read_text()
CARS = REPOSITORY / "lab" / "cars"


@pytest.fixture(autouse=True)
def quiet(caplog):
    caplog.set_level(logging.CRITICAL)  # the link warns of what is broken here on purpose


@needs.gcc
@pytest.mark.parametrize(
    "row",
    [pytest.param(r, id=r.name, marks=() if f"`{r.name}`" in SAFETY else pytest.mark.slow) for r in rows_of(Car())],
)
def test_a_fault_ends_as_it_should(row):
    assert run_row(row)["wrong"] == []


@needs.gcc
@pytest.mark.slow
@pytest.mark.parametrize("name", ["crawler", "inverted", "gamepad"])
def test_they_end_so_on_other_cars(name):
    car = read_car(CARS / f"{name}.yml")
    rows = [run_row(row, car) for row in rows_of(car)]
    assert {row["fault"]: row["wrong"] for row in rows if row["wrong"]} == {}
    assert len(rows) > 35


@needs.gcc
def test_a_fault_that_ends_otherwise_is_wrong():
    for name, expected in (("frames late", STOPPED), ("receiver lost", CONTINUES), ("camera frozen", REFUSED)):
        assert run_row(replace(all_rows()[name], expected=expected))["wrong"]


def test_every_row_is_judged_and_there_are_enough():
    here = rows_of(Car())
    assert len(here) >= 45 and sum(row.expected == STOPPED for row in here) >= 25
    assert [row.name for row in pin_rows()] == [*INJECT] and len(INJECT) == 12


def test_what_proves_safety_exists():
    """Each name in the last column of the page's tables is a row, a kept story, or a test."""
    rows = [line.split("|") for line in SAFETY.splitlines() if line.startswith("| ") and "proven by" not in line]
    code = "".join(path.read_text() for path in (REPOSITORY / "tests").rglob("test_*.py"))
    tests = set(re.findall(r"def (test_\w+)", code))
    for cell in (row[-2] for row in rows):
        names = re.findall(r"`([^`]+)`", cell)
        assert names, f"a hazard that nothing proves: {cell}"
        assert set(names) <= all_rows().keys() | INJECT.keys() | KEPT.keys() | tests


# ---- a gamepad's human, without a drive


class Relay:
    """An open link with a gamepad, whose human holds L1."""

    def __init__(self):
        self.world = World(car=Car(human="gamepad"))
        self.link = VirtualLink(self.world)
        self.link.open()

    def does(self, seconds, steering_us=0, **hand):
        """Let the human hold the steering stick so (from rest)."""
        vars(self.world.hand).update(hand, sticks=[1456 + steering_us, 120])
        self.world.handle()
        self.world.sleep(seconds)

    def wiggles(self):
        for steering_us in (300, -300, 0):
            self.does(0.12, steering_us)
        self.does(1.1)

    def refused(self):
        with pytest.raises(LinkError) as refusal:
            self.link.arm()
        return str(refusal.value)


@needs.gcc
def test_nothing_arms_it_unattended():
    relay = Relay()
    relay.does(0.8, receiver=LOST)
    relay.wiggles()
    assert "hold L1" in relay.refused()
    relay.does(0.6, receiver="live", pad=STUCK)  # held since before
    assert "hold L1" in relay.refused()
    relay.does(0.3, receiver=LOST, pad="")
    relay.does(0.6, receiver="live")  # a press that is seen, and no gesture
    assert "wiggled" in relay.refused()
    relay.wiggles()
    relay.does(0.3, receiver=LOST)  # the gesture is over with it
    relay.does(0.6, receiver="live")
    assert "wiggled" in relay.refused()
    relay.wiggles()
    assert relay.link.arm().state is State.AUTONOMOUS
    relay.link.close()
    relay.world.close()


# ---- the command


@pytest.mark.emulated
@needs.simavr
def test_some_faults_in_the_command(tmp_path):
    """Two on the pins, of which one's line only the next start writes; `python -m lab faults` has all."""
    assert CliRunner().invoke(main, ["faults", "--only", "camera melted"]).exit_code == 1
    names = ["camera frozen", "Arduino loop hung", "SIGKILL"]
    done = CliRunner().invoke(main, ["faults", str(tmp_path / "f.json"), *(f"--only={name}" for name in names)])
    assert done.exit_code == 0, done.output
    rows = {row["fault"]: row for row in read_stage(tmp_path / "f.json", "faults")["metrics"]["faults"]}
    assert set(rows) == set(names) and all(row["recovered"] and row["log_line"] for row in rows.values())
    assert rows["SIGKILL"]["stopped_after_ms"] > 50  # it is the Arduino that stops
