"""The faults that docs/safety.md names, in virtual time; and two of those on pins."""

import logging
import re
from dataclasses import fields

import pytest
from click.testing import CliRunner

from lab.__main__ import main
from lab.arduino.emulator import REPOSITORY
from lab.driving.on_pins import INJECT
from lab.driving.rows import all_rows, run_row
from lab.driving.stories import KEPT
from rover_lib.onboard.car.car import read_car
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.stage import read_stage
from tests.helpers import needs

SAFETY = (REPOSITORY / "docs" / "safety.md").read_text()
CARS = REPOSITORY / "lab" / "cars"


@pytest.fixture(autouse=True)
def quiet(caplog):
    caplog.set_level(logging.CRITICAL)  # the link warns of what is broken here on purpose


@needs.gcc
@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, id=name, marks=() if f"`{name}`" in SAFETY else pytest.mark.slow)
        for name, row in all_rows().items()
    ],
)
def test_a_fault_ends_as_it_should(row):
    assert run_row(row)["wrong"] == []


@needs.gcc
@pytest.mark.slow
@pytest.mark.parametrize("name", ["crawler", "inverted"])
def test_they_end_so_on_other_cars(name):
    car = read_car(CARS / f"{name}.yml")
    rows = [run_row(row, car) for row in all_rows().values()]
    assert {row["fault"]: row["wrong"] for row in rows if row["wrong"]} == {}


def test_what_proves_safety_exists():
    """Each name in the last column of the page's tables is a row, a kept story, or a test."""
    rows = [line.split("|") for line in SAFETY.splitlines() if line.startswith("| ") and "proven by" not in line]
    code = "".join(path.read_text() for path in (REPOSITORY / "tests").rglob("test_*.py"))
    tests = set(re.findall(r"def (test_\w+)", code))
    for cell in (row[-2] for row in rows):
        names = re.findall(r"`([^`]+)`", cell)
        assert names, f"a hazard that nothing proves: {cell}"
        assert set(names) <= all_rows().keys() | INJECT.keys() | KEPT.keys() | tests
    assert set(re.findall(r"`drive\.(\w+)`", SAFETY)) <= {field.name for field in fields(Settings)}


@pytest.mark.emulated
@needs.simavr
def test_some_faults_in_the_command(tmp_path):
    """Two on the pins; `python -m lab faults` has all."""
    assert CliRunner().invoke(main, ["faults", "--only", "camera melted"]).exit_code == 1
    names = ["camera frozen", "Arduino loop hung", "SIGKILL"]
    done = CliRunner().invoke(main, ["faults", str(tmp_path / "f.json"), *(f"--only={name}" for name in names)])
    assert done.exit_code == 0, done.output
    rows = {row["fault"]: row for row in read_stage(tmp_path / "f.json", "faults")["metrics"]["faults"]}
    assert set(rows) == set(names) and all(row["recovered"] and row["log_line"] for row in rows.values())
    assert rows["SIGKILL"]["stopped_after_ms"] > 50  # it is the Arduino that stops
