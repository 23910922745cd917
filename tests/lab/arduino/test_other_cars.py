"""The firmware as it is flashed, told of two other cars, in simavr: judged by the pulses on its pins.

A 50 Hz servo and speed controller with reverse, and a car with the pulses of the default whose steering is inverted.
"""

import random
import struct
import zlib
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import needs
import pytest
from uno import EEPROM_BYTES, RESET, Uno, pulses, widths

from lab.arduino.emulator import eeprom_of
from rover_lib.onboard.car.car import Car, read_car
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US

CARS = Path(__file__).parents[3] / "lab" / "cars"
pytestmark = [pytest.mark.emulated, needs.simavr]

CRAWLER, INVERTED = (read_car(CARS / f"{name}.yml") for name in ("crawler", "inverted"))
ALL_CARS = [Car(), CRAWLER, INVERTED]
EDGE_US = 0.3
STEP_US = ARDUINO_STEP_US + EDGE_US
ANSWER_MS = 25
TIMEOUT_MS, TAKEOVER_MS = 150, 50  # the cap and a lost signal are the state machine's: tests/firmware/test_cars.py


def told(board, car):
    board.car_id = car.id
    board.command("C", *car.numbers)
    board.run_ms(ANSWER_MS)
    assert board.status.result == "k", board.lines[-3:]


def sticks(board, steering_us, throttle_us):
    board.transmitter(
        steering_us,
        throttle_us,
        steering_period_us=board.car.numbers[0] + 30,  # receiver and Arduino have each a clock of their own
        throttle_period_us=board.car.numbers[4] + 30 * board.car.reverses,
    )


def arm(board):
    board.run_ms(300)
    board.wiggle()
    board.command("A")
    board.run_ms(ANSWER_MS)
    assert (board.status.state, board.status.result) == ("A", "k"), board.lines[-3:]


@pytest.fixture
def armed():
    board = Uno()
    board.car = car = CRAWLER
    board.neutral = SimpleNamespace(steering=car.numbers[2], throttle=car.numbers[6])
    board.run_ms(60)
    told(board, car)
    sticks(board, board.neutral.steering + 4, board.neutral.throttle + 4)
    arm(board)
    yield board
    board.close()


def on_pins(events, steering_us, throttle_us, after_us=0, within_us=ARDUINO_STEP_US / 2 + EDGE_US):
    for pin, wanted in (("steering", steering_us), ("throttle", throttle_us)):
        measured = widths(events, pin, after_us)
        assert measured, f"no {pin} pulses"
        assert all(abs(us - wanted) <= within_us for us in measured), f"{pin}: {sorted(measured)} us, wanted {wanted}"


def is_neutral(board, events, after_us=0):
    on_pins(events, board.neutral.steering, board.neutral.throttle, after_us)


def fastest(board):
    """Full lock, and the cap."""
    return board.car.numbers[3], board.neutral.throttle + board.car.cap_us


def test_the_pins_are_car_ymls_over_the_whole_range(armed):
    car = armed.car
    for share in range(11):
        steering = share / 5 - 1
        throttle = car.cap * (steering if car.reverses else share / 10)
        wanted = car.pwm.pulses(steering, throttle)
        armed.drive(wanted.steering_us, wanted.throttle_us, 330)
        events = armed.drive(wanted.steering_us, wanted.throttle_us, 90)
        on_pins(events, wanted.steering_us, wanted.throttle_us)
        for pin, period_us in (("steering", car.numbers[0]), ("throttle", car.numbers[4])):
            assert all(abs(e.period_us - period_us) <= EDGE_US for e in pulses(events, pin)[1:])
    assert armed.status.state == "A"


def test_a_pulse_is_whole_whenever_it_changes(armed):
    """Commands at any phase: no slow pulse is a round of Timer2 too long or too short, none is missing."""
    rng = random.Random(1)
    low_us, high_us = armed.neutral.throttle, armed.neutral.throttle + 40
    armed.drive(armed.neutral.steering, low_us, 100)
    events = []
    for n in range(120):
        ms = rng.uniform(3, 9)
        events += armed.drive(armed.neutral.steering + 20 * (n % 2), (low_us, high_us)[n // 6 % 2], ms, every_ms=ms)
    for pin, low, high in (
        ("steering", armed.neutral.steering, armed.neutral.steering + 20),
        ("throttle", low_us, high_us),
    ):
        assert min(widths(events, pin)) >= low - 2 - EDGE_US
        assert max(widths(events, pin)) <= high + 2 + EDGE_US
        period_us = armed.car.numbers[0 if pin == "steering" else 4]
        assert all(abs(e.period_us - period_us) <= EDGE_US for e in pulses(events, pin))


@pytest.mark.parametrize("how", ["hang", "power"])
def test_after_a_reset_the_pins_have_its_neutral_and_nobody_arms_it(armed, how):
    """A watchdog's reset in a drive gave the default's neutral, 120 us at 984 Hz, to a speed controller of 50 Hz."""
    armed.drive(*fastest(armed), 297)
    armed.transmitter(0, 0)
    getattr(armed, how)()
    events = armed.run_ms(400)
    reset_us = next(e.at_us for e in events if e.kind == RESET) if how == "hang" else 0
    later = [e for e in armed.events if e.at_us > max(reset_us, max(e.at_us for e in armed.events if e.kind == RESET))]
    is_neutral(armed, later)
    for pin, period_us in (("steering", armed.car.numbers[0]), ("throttle", armed.car.numbers[4])):
        assert all(abs(e.period_us - period_us) <= EDGE_US for e in pulses(later, pin)[1:])
    sticks(armed, armed.neutral.steering, armed.neutral.throttle)
    armed.run_ms(400)
    armed.wiggle()
    armed.command("A")
    armed.run_ms(ANSWER_MS)
    assert (armed.status.state, armed.status.result) == ("M", "c")
    told(armed, armed.car)
    arm(armed)


# ---- the car that it keeps


@pytest.mark.parametrize("car", ALL_CARS, ids=lambda car: car.name)
@pytest.mark.parametrize("signals", [False, True])
def test_from_power_on_the_pins_have_the_neutral_of_the_car_that_was_told(car, signals):
    """Before, they had 120 us at 984 Hz until a host opened the port, whatever the car was."""
    board = Uno(eeprom=b"")
    board.run_ms(60)
    told(board, car)
    board.run_ms(150)
    assert board.eeprom[2:] == eeprom_of(car)[2:]
    start_us = board.now_us
    board.power()
    if signals:
        board.transmitter(car.numbers[2], car.numbers[6] + 100, steering_period_us=car.numbers[0],
                          throttle_period_us=car.numbers[4])  # fmt: skip
    board.run_ms(300)
    for pin, at in (("steering", 0), ("throttle", 4)):
        seen = pulses(board.events, pin, start_us)
        print(f"{pin} after {seen[0].at_us - start_us:.0f} us")
        assert seen[0].at_us - start_us < 1500
        assert all(abs(e.pulse_us - car.numbers[at + 2]) <= ARDUINO_STEP_US / 2 + EDGE_US for e in seen)
        assert all(abs(e.period_us - car.numbers[at]) <= EDGE_US for e in seen[1:])
    assert any(line.endswith(f" p {car.id}") for line in board.lines)
    assert board.status.state == "M"
    board.close()


def spoilt():
    """EEPROMs without a car: erased, of another version, cut short, and with one bit of each byte flipped."""
    good = eeprom_of(CRAWLER)
    yield from (b"", eeprom_of(CRAWLER, version=0), good[: EEPROM_BYTES - 1], eeprom_of(Car())[:10] + good[10:])
    for at in range(2, EEPROM_BYTES):
        yield good[:at] + bytes([good[at] ^ 1 << at % 8]) + good[at + 1 :]
    beyond = (*CRAWLER.numbers[:8], 119)  # the cap
    yield eeprom_of(SimpleNamespace(numbers=beyond, id=zlib.crc32(struct.pack("<9H", *beyond))))


def test_a_board_that_keeps_no_car_sends_nothing_until_it_is_told():
    for eeprom in spoilt():
        board = Uno(eeprom=eeprom)
        board.transmitter(1700, 500)
        events = board.run_ms(90)
        assert not [e for e in events if e.channel >= 0], eeprom.hex()
        assert (board.status.missing, board.status.steering_us, board.status.throttle_us) == ("s", 0, 0)
        board.close()
    for car in ALL_CARS:
        board = Uno(eeprom=b"")
        board.run_ms(random.Random(car.id).uniform(40, 70))
        board.command("A")
        board.run_ms(ANSWER_MS)
        assert board.status.result == "c"
        told(board, car)
        board.run_ms(100)
        board.neutral = SimpleNamespace(steering=car.numbers[2], throttle=car.numbers[6])
        is_neutral(board, board.events)
        board.car = car
        sticks(board, board.neutral.steering + 4, board.neutral.throttle + 4)
        arm(board)
        board.close()


def test_a_power_cut_while_it_writes_leaves_the_old_car_or_none():
    """Cut in each of its writes: before it, after it, and with anything in the cell that was being written."""
    board = Uno(eeprom=eeprom_of(INVERTED))
    board.run_ms(60)
    board.command("C", *CRAWLER.numbers)
    images = [board.eeprom]
    while images[-1][2:] != eeprom_of(CRAWLER)[2:]:
        board.run_ms(0.5)
        if board.eeprom != images[-1]:
            images.append(board.eeprom)
        assert board.now_us < 250_000
    board.run_ms(100)
    assert board.eeprom == images[-1]  # and no more
    board.close()
    rng = random.Random(6)
    between = {
        before[:at] + bytes([byte]) + before[at + 1 :]
        for before, after in pairwise(images)
        for at in range(EEPROM_BYTES)
        if before[at] != after[at]
        for byte in (0xFF, 0, before[at] & after[at], rng.randrange(256))
    }
    found = []
    for eeprom in sorted({*images, *between}):
        board = Uno(eeprom=eeprom)
        pins = {(e.channel, round(e.pulse_us)) for e in board.run_ms(25)}
        found.append(int(board.lines[0].split()[-1]))
        car = next((car for car in (INVERTED, CRAWLER) if car.id == found[-1]), None)
        assert pins == ({(0, car.numbers[2]), (1, car.numbers[6])} if car else set()), eeprom.hex()
        board.close()
    assert len(images) > 12
    assert found.count(zlib.crc32(bytes(18))) > len(images)


def test_told_of_another_car_no_pulse_is_cut():
    """There and back while a human steers, the throttle at rest: each pulse on the way is one neutral or the other."""
    rng = random.Random(4)
    board = Uno()
    board.transmitter(1700, 124)
    board.run_ms(150)
    cars = (CRAWLER, Car(), INVERTED, CRAWLER, INVERTED)
    for before, car in zip((Car(), *cars), cars, strict=False):
        board.transmitter(1700, before.numbers[6])
        board.run_ms(rng.uniform(260, 280))
        start = len(board.events)
        told(board, car)
        board.run_ms(100)
        # The very next throttle pulse may be the human's last; from then on it is one neutral or the other.
        after = [e for e in board.events[start:] if e.kind == 1 and e.channel == 1]
        neutrals = before.numbers[6], car.numbers[6]
        assert all(min(abs(e.pulse_us - us) for us in (*neutrals, 124)) <= STEP_US for e in after[10:])
        assert abs(after[-1].pulse_us - car.numbers[6]) <= STEP_US
        short = 0.9 * min(e.pulse_us for e in after if e.pulse_us > 100)
        assert all(e.pulse_us > short for e in after)
        for e in pulses(board.events[start:], "steering"):
            assert min(abs(e.pulse_us - us) for us in (1700, 1456, 1500)) <= STEP_US
        board.run_ms(80)
        periods = [e.period_us for e in pulses(board.events, "steering")[-2:]]
        assert all(abs(us - car.numbers[0]) <= EDGE_US for us in periods)
    board.close()
