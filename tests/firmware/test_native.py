"""The firmware's parser and state machine, compiled for this machine: fuzzed, and held against the host's own code."""

import re
import subprocess
from dataclasses import replace

import pytest
from hypothesis import given, reject
from hypothesis import strategies as st

from lab.driving.native import NativeArduino
from rover_lib.onboard.car import car, servo_link
from rover_lib.onboard.errors import RoverError
from tests.helpers import needs, uno

pytestmark = needs.gcc
FOLDER = uno.REPOSITORY / "firmware" / "rover"
SOURCES = FOLDER / "protocol.c", FOLDER / "vehicle.c"
FUZZ = uno.REPOSITORY / "tests" / "firmware" / "fuzz.c"
PULSES = "PERIOD", "MIN", "NEUTRAL", "MAX"
SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.mark.slow
@pytest.mark.parametrize("count", [100_000, pytest.param(10_000_000, marks=pytest.mark.release)])
@pytest.mark.parametrize("human", ["receiver", "gamepad"])
def test_random_and_mutated_lines(count, human):
    """Never an unsafe pulse, no stuck state, no access out of bounds: tests/firmware/fuzz.c says what is unsafe."""
    gamepad = ["-DHUMAN_GAMEPAD"] * (human == "gamepad")
    program = uno.compiled(f"fuzz-{human}", *SANITIZE, *gamepad, FUZZ, *SOURCES)
    done = subprocess.run([program, str(count), "1"], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    numbers = map(int, re.findall(r"\d+", done.stdout))
    lines, commands, driven, *kinds, starts, clock_wraps, sequence_wraps, cars = numbers
    assert lines >= count and commands > 0.4 * count and driven > 0.05 * count and cars > count / 1000
    assert min(kinds) > 0.1 * count and min(starts, clock_wraps, sequence_wraps) > count / 50_000


@pytest.fixture(scope="module")
def board():
    return NativeArduino()


def is_command(board, data):
    """Whether the firmware finds a command in bytes: then more of its status changes than how many lines were bad."""
    before = board.status
    board.send(data + b"\n")
    return replace(board.status, bad_lines=before.bad_lines) != before


GOOD = servo_link.frame(">D 0 1 2 1900 232")


def test_what_is_nearly_a_line_is_no_command(board):
    for body in (
        *("<D 0 1 2 1900 232", ">D  0 1 2 1900 232", ">D 0 1 2 1900 232 ", ">D 0 1 2 1900 232 0", ">D 0 1 2 1900", ">"),
        *(f">D 0 1 2 {n} 232" for n in ("+1900", "01900", "-1900", "0x76C", 1900 + 2**32, "1900" + " " * 60)),
        *(">d 0 1 2 1900 232", ">X 0 1 2 1900 232", ""),
    ):
        assert not is_command(board, servo_link.frame(body))  # with the right checksum
    for bad in (GOOD[:-10] + b"\n", GOOD[:-9] + b"\n", GOOD[:-1] + b"0\n", GOOD[:-2] + b"\n", GOOD[1:]):
        assert not is_command(board, bad)


@given(rubbish=st.binary(max_size=80))
def test_a_line_is_found_behind_any_rubbish(board, rubbish):
    assert is_command(board, rubbish + GOOD)


def test_both_sides_have_the_same_limits():
    """vehicle.h and car.py are two files for two machines; the numbers are one."""
    text = (FOLDER / "vehicle.h").read_text()
    limit = {name: int(value) for name, value in re.findall(r"\b(\w+_US) = (\d+)", text)}
    default = [limit[f"{name}_{what}_US"] for name in ("STEERING", "THROTTLE") for what in PULSES]
    assert (*default, limit["CAP_MAX_US"]) == car.DEFAULT_NUMBERS
    names = ["PERIOD_MIN", "PERIOD_MAX", "FAST_PERIOD_MIN", "FAST_PERIOD_MAX", "FAST_NEUTRAL_MIN", "FAST_NEUTRAL_MAX"]
    names += ["PULSE_MIN", "PULSE_MAX", "STEERING_NEUTRAL_MIN", "THROTTLE_NEUTRAL_MIN", "NEUTRAL_MAX", "STEERING_THROW"]
    for name in [*names, "CAP_MAX"]:
        assert limit[f"{name}_US"] == getattr(car, f"{name}_US"), name
    assert limit["THROTTLE_MAX_US"] == car.FAST_PULSE_MAX_US
    assert int(re.search(r"LATE_MS = (\d+)", text)[1]) == servo_link.LATE_S * 1000


WAY_US = st.integers(250, 700)  # from neutral to an end
SLOW = st.tuples(st.integers(3000, 25000), st.integers(1300, 1700), WAY_US, WAY_US)
FAST = st.tuples(st.integers(1000, 1020), st.integers(80, 160), st.none() | st.integers(20, 60), st.integers(100, 550))


@given(steering=SLOW, throttle=SLOW | FAST, cap_us=st.integers(1, 118), inverted=st.booleans())
def test_both_sides_allow_the_same_cars(board, steering, throttle, cap_us, inverted):
    """What car.py makes a Car of, the firmware takes, by the same name."""
    (period_us, neutral_us, right_us, left_us), sign = steering, -1 if inverted else 1
    ends = {"right_us": neutral_us - sign * right_us, "left_us": neutral_us + sign * left_us}
    content = {"steering": {"period_us": period_us, "neutral_us": neutral_us, **ends}}
    period_us, neutral_us, reverse_us, forward_us = throttle
    content["throttle"] = {"period_us": period_us, "neutral_us": neutral_us, "cap_us": cap_us}
    content["throttle"]["forward_us"] = neutral_us + (sign if reverse_us else 1) * forward_us
    if reverse_us:
        content["throttle"]["reverse_us"] = neutral_us - sign * reverse_us
    try:
        found = car.Car.of(content)
    except RoverError:
        reject()
    numbers = found.numbers
    assert board.command("C", *numbers) == "k"
    assert board.hello.car == found.id
    # And each of its numbers beyond a limit is one that the firmware refuses by itself.
    beyond = [(0, 2999), (0, 25001), (1, 799), (1, numbers[2] - 249), (2, 1299), (3, numbers[2] + 249), (3, 2201)]
    beyond += [(4, 999), (4, 25001), (5, numbers[6] - 1 if numbers[4] < 3000 else 799), (7, 2201), (8, 119), (8, 0)]
    for i, bad in beyond:
        other = list(numbers)
        other[i] = bad
        assert board.command("C", *other) == "r", other
