"""Other cars, in virtual time: what the firmware takes of them, and who drives them."""

import zlib
from pathlib import Path

import pytest

from lab.driving.native import STEERING, THROTTLE, NativeArduino
from rover_lib.onboard.car.car import Car, read_car
from rover_lib.onboard.car.servo_link import State
from tests.helpers import needs

CARS = Path(__file__).parents[2] / "lab" / "cars"
pytestmark = needs.gcc
CRAWLER, INVERTED = (read_car(CARS / f"{name}.yml") for name in ("crawler", "inverted"))
BOAT = Car.of(  # no reverse, and its speed controller stops at 1000 us
    {
        "steering": {"period_us": 20000, "left_us": 1100, "neutral_us": 1480, "right_us": 1900},
        "throttle": {"period_us": 14000, "neutral_us": 1000, "forward_us": 1800, "cap_us": 60},
    }
)


def armed_board(car):
    board = NativeArduino(car=car)
    board.run(400)
    board.wiggle()
    assert board.command("A") == "k"
    return board


@pytest.fixture(params=[INVERTED, BOAT], ids=["inverted", "boat"])
def armed(request):
    return armed_board(request.param)


# ---- being told


def test_a_board_that_keeps_no_car_does_nothing_before_it_is_told():
    board = NativeArduino()
    board.start(None)
    assert set(board.run(500)) == {(0, 0)}
    assert board.hello.car == zlib.crc32(bytes(18))
    assert board.status.missing == "s"
    assert [board.command("A"), board.command("D", 0, 0), board.command("L", 1500)] == ["c", "i", "r"]
    assert not board.may_keep
    assert board.command("C", *CRAWLER.numbers) == "k"
    assert set(board.run(1)) == {(1500, 1500)} and board.may_keep


def test_the_car_is_kept_only_while_it_rests(armed):
    assert not armed.may_keep
    for channel, moved_us, may_keep in ((STEERING, 120, True), (THROTTLE, 60, False)):
        armed.sticks[channel] += moved_us
        armed.run(400)
        assert armed.status.state is State.MANUAL and armed.may_keep is may_keep


def test_no_other_car_while_armed(armed):
    neutral = armed.car.pwm.neutral()
    assert armed.command("C", *Car().numbers) == "i"
    assert armed.status.state is State.AUTONOMOUS and armed.hello.car == armed.car.id
    armed.command("N")
    assert armed.run(1) == [(neutral.steering_us, neutral.throttle_us)]
    assert armed.command("C", *Car().numbers) == "k"
    assert armed.run(1) == [(1456, 120)]


@pytest.mark.parametrize(("numbers", "missing"), [((*INVERTED.numbers[:8], 60), "w"), (CRAWLER.numbers, "s")])
def test_another_car_forgets_the_gesture_and_signals_that_are_not_its(numbers, missing):
    board = NativeArduino()
    board.run(100)
    board.wiggle()
    assert board.status.missing == "-"
    assert board.command("C", *numbers) == "k"
    assert board.status.missing == missing
    board.run(1200)
    assert board.status.missing == missing


def test_after_a_reset_it_must_be_told_again():
    """Its pins may still have that car's neutral; but nobody arms it before they have said which car they mean."""
    board = armed_board(CRAWLER)
    board.start(CRAWLER)
    assert set(board.run(300)) == {(1500, 1500)}
    board.wiggle()
    assert board.command("A", sequence=board.status.sequence + 1) == "c"
    board.sequence = board.status.sequence
    assert board.command("C", *CRAWLER.numbers) == "k"
    board.run(400)
    board.wiggle()
    assert board.command("A") == "k"
