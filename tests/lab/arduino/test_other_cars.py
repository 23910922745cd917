"""The firmware as it is flashed, told of other cars, in simavr: pulses of 50 Hz, and the car that the EEPROM keeps."""

import random
import struct
import zlib
from itertools import pairwise
from types import SimpleNamespace

import pytest

from lab.arduino.emulator import eeprom_of
from rover_lib.onboard.car.car import Car, read_car
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US
from tests.helpers import needs
from tests.helpers.uno import ANSWER_MS, EDGE_US, EEPROM_BYTES, REPOSITORY, STEP_US, Uno, arm, on_pins, pulses, widths

pytestmark = [pytest.mark.emulated, needs.simavr]
CRAWLER, INVERTED = (read_car(REPOSITORY / "lab" / "cars" / f"{name}.yml") for name in ("crawler", "inverted"))
HALF_STEP_US = ARDUINO_STEP_US / 2 + EDGE_US


def told(board, car):
    board.car_id = car.id
    board.command("C", *car.numbers)
    board.run_ms(ANSWER_MS)
    assert board.status.result == "k", board.lines[-3:]


def has_periods(events, car):
    for pin, period_us in (("steering", car.numbers[0]), ("throttle", car.numbers[4])):
        assert all(abs(e.period_us - period_us) <= EDGE_US for e in pulses(events, pin)[1:])


@pytest.fixture
def crawler():
    """Armed."""
    board = Uno()
    board.run_ms(60)
    told(board, CRAWLER)
    # Near neutral; receiver and Arduino have each a clock of their own.
    board.transmitter(1504, 1504, (CRAWLER.numbers[0] + 30, CRAWLER.numbers[4] + 30))
    board.run_ms(300)
    arm(board)
    return board


def test_the_pins_are_car_ymls_over_the_whole_range(crawler):
    for share in range(6):
        action = share / 2.5 - 1
        wanted = CRAWLER.pwm.pulses(action, CRAWLER.cap * action)
        crawler.drive(wanted.steering_us, wanted.throttle_us, 330)
        events = crawler.drive(wanted.steering_us, wanted.throttle_us, 90)
        on_pins(events, wanted.steering_us, wanted.throttle_us, within_us=HALF_STEP_US)
        has_periods(events, CRAWLER)
    assert crawler.status.state == "A"


def test_a_pulse_is_whole_whenever_it_changes(crawler):
    """Commands at any phase: no slow pulse is a round of Timer2 too long or too short, none is missing."""
    rng = random.Random(1)
    crawler.drive(1500, 1500, 100)
    events = []
    for n in range(120):
        ms = rng.uniform(3, 9)
        events += crawler.drive(1500 + 20 * (n % 2), 1500 + 40 * (n // 6 % 2), ms, every_ms=ms)
    for pin, most_us in (("steering", 1520), ("throttle", 1540)):
        assert min(widths(events, pin)) >= 1500 - 2 - EDGE_US
        assert max(widths(events, pin)) <= most_us + 2 + EDGE_US
    has_periods(events, CRAWLER)


def test_told_of_another_car_no_pulse_is_cut():
    """There and back while a human steers, the throttle at rest: each pulse on the way is one neutral or the other."""
    rng = random.Random(4)
    board = Uno()
    board.transmitter(1700, 124)
    board.run_ms(150)
    for before, car in pairwise((Car(), CRAWLER, Car(), INVERTED, CRAWLER)):
        board.transmitter(1700, before.numbers[6])
        board.run_ms(rng.uniform(260, 280))
        start = len(board.events)
        told(board, car)
        board.run_ms(100)
        # The very next throttle pulses may be the human's last.
        after = pulses(board.events[start:], "throttle")[10:]
        may_be = before.numbers[6], car.numbers[6], 124
        assert all(min(abs(e.pulse_us - us) for us in may_be) <= STEP_US for e in after)
        assert abs(after[-1].pulse_us - car.numbers[6]) <= STEP_US
        assert all(us > 1400 for us in widths(board.events[start:], "steering"))
        assert board.now_us / 1000 - 35 <= board.status.uptime_ms <= board.now_us / 1000  # the clock's timer changed


# ---- the car that it keeps


@pytest.mark.parametrize("car", [Car(), INVERTED], ids=lambda car: car.name)
def test_from_power_on_the_pins_have_the_neutral_of_the_car_that_was_told(car):
    """Before, they had 120 us at 984 Hz until a host opened the port, whatever the car was."""
    board = Uno(eeprom=b"")
    board.run_ms(60)
    told(board, car)
    board.run_ms(150)
    assert board.eeprom[2:] == eeprom_of(car)[2:]
    start_us = board.now_us
    board.power()
    board.run_ms(300)
    events = [e for e in board.events if e.at_us >= start_us]
    assert all(pulses(events, pin)[0].at_us - start_us < 1500 for pin in ("steering", "throttle"))
    on_pins(events, car.numbers[2], car.numbers[6], within_us=HALF_STEP_US)
    has_periods(events, car)
    assert any(line.endswith(f" p {car.id}") for line in board.lines)


def test_a_board_that_keeps_no_car_sends_nothing_until_it_is_told():
    good = eeprom_of(CRAWLER)
    flipped = [good[:at] + bytes([good[at] ^ 1 << at % 8]) + good[at + 1 :] for at in range(2, EEPROM_BYTES, 3)]
    beyond = (*CRAWLER.numbers[:8], 119)  # the cap
    beyond_all = eeprom_of(SimpleNamespace(numbers=beyond, id=zlib.crc32(struct.pack("<9H", *beyond))))
    for eeprom in (b"", eeprom_of(CRAWLER, version=0), good[: EEPROM_BYTES - 1], beyond_all, *flipped):
        board = Uno(eeprom=eeprom)
        board.transmitter(1700, 500)
        assert not [e for e in board.run_ms(90) if e.channel >= 0], eeprom.hex()
        assert (board.status.missing, board.status.steering_us, board.status.throttle_us) == ("s", 0, 0)


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
    between = {
        before[:at] + bytes([byte]) + before[at + 1 :]
        for before, after in pairwise(images)
        for at in range(EEPROM_BYTES)
        if before[at] != after[at]
        for byte in (0xFF, 0, before[at] & after[at])
    }
    for eeprom in sorted({*images, *between}):
        board = Uno(eeprom=eeprom)
        pins = {(e.channel, round(e.pulse_us)) for e in board.run_ms(25)}
        found = int(board.lines[0].split()[-1])
        car = next((car for car in (INVERTED, CRAWLER) if car.id == found), None)
        assert pins == ({(0, car.numbers[2]), (1, car.numbers[6])} if car else set()), eeprom.hex()
    assert len(images) > 12
