"""The Arduino's firmware as it is flashed, in simavr, judged by the pulses on its pins: what only the chip shows.

Who may arm, which lines are commands, and what noise does are the state machine's alone: tests/firmware has that.
"""

import random

import pytest

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US
from tests.helpers import needs
from tests.helpers.uno import CUT, EDGE_US, RESET, STEP_US, Uno, arm, line, on_pins, pulses, widths

pytestmark = [pytest.mark.emulated, needs.simavr]
NEUTRAL_US = 1456, 120
WATCHDOG_MS = 60
REST = (1460, 124)  # sticks that were let go, a little off, as transmitters are
RUBBISH = b"<>ADNQ 0123456789*ABCDEF\n\xff"


@pytest.fixture
def board():
    return Uno()


@pytest.fixture
def armed(board):
    board.transmitter(*REST)
    board.run_ms(120)
    arm(board)
    return board


def test_a_line_full_of_rubbish_keeps_no_command_out(armed):
    """With the line full both ways, a turn of the loop takes less than 2 ms, and every byte is taken."""
    rng = random.Random(6)
    armed.drive(1300, 150, 90)
    armed.watch_loop()
    for n in range(60):
        armed.send(bytes(rng.choice(RUBBISH) for _ in range(60)) + b"\n" + line(">Q"))
        armed.command("D", 1300 + n, 150 + n)
        armed.command("D", 1301 + n, 151 + n)
        armed.run_ms(rng.uniform(14, 17))  # 165 bytes take 14: more would wait longer each time, and be late
    assert (armed.status.state, armed.status.lost) == ("A", 0)
    assert armed.now_us / 1000 - 35 <= armed.status.uptime_ms <= armed.now_us / 1000  # no overflow of Timer1 was lost
    print(f"the loop's longest turn takes {armed.longest_ms:.2f} ms")
    assert 0.1 < armed.longest_ms < 2


def test_reset_button_while_driving(armed):
    """Neutral at once; and the lines of before, played to the Arduino again, arm and move nothing."""
    armed.transmitter(0, 0)
    old = [armed.command("A"), *(armed.command("D", 1800, 232) for _ in range(3))]
    armed.drive(1800, 232, 45)
    boot = armed.boot
    armed.reset()
    start_us = armed.now_us
    events = armed.run_ms(150)
    on_pins(events, *NEUTRAL_US, after_us=start_us)
    assert pulses(events, "throttle", start_us)[0].at_us - start_us < 1000
    assert all(e.pulse_us <= 1800 + EDGE_US for e in events if e.kind == CUT)
    assert any(body == f"<H 4 4.2.0 {boot + 1} 0 e {Car().id}" for body in armed.lines)
    for text in old:
        armed.send(text)
    on_pins(armed.run_ms(60), *NEUTRAL_US)
    assert (armed.status.state, armed.status.reason, armed.status.old) == ("M", "r", len(old))


def test_a_hung_loop_is_reset_by_the_watchdog(armed):
    armed.drive(1800, 232, 97)
    armed.hang()
    start_us = armed.now_us
    events = armed.run_ms(300)
    (reset_us,) = (e.at_us for e in events if e.kind == RESET)
    print(f"reset {(reset_us - start_us) / 1000:.1f} ms after the loop hung")
    assert (WATCHDOG_MS - 5) * 1000 <= reset_us - start_us <= (WATCHDOG_MS + 10) * 1000
    # Up to it the timers go on with the last command; from it on the pins are neutral, then the human's.
    on_pins([e for e in events if e.at_us + 2000 < reset_us], 1800, 232)
    assert max(widths(events, "throttle", reset_us)) <= 124 + ARDUINO_STEP_US
    on_pins(events, *REST, after_us=reset_us + 60_000, within_us=STEP_US)
    assert any(body == f"<H 4 4.2.0 {armed.boot} 0 w {Car().id}" for body in armed.lines)


def test_no_other_interrupt_disturbs_the_steering_by_more_than_a_step(board):
    """Throttle edges, lines and overflows at all phases: one that kept INT0 waiting for 6 us was seen in 0.3 %."""
    rng = random.Random(5)
    board.transmitter(*REST)
    board.run_ms(150)
    for _ in range(300):
        steering_us, throttle_us = rng.uniform(1010, 1940), 4 * rng.randrange(30, 170)
        board.transmitter(steering_us, throttle_us)
        for _ in range(6):
            board.send(line(">Q"))
            board.run_ms(rng.uniform(9, 12))
        assert abs(board.status.receiver_throttle_us - throttle_us) <= 1
        assert abs(board.status.receiver_steering_us - steering_us) <= STEP_US + 0.5  # half of one is rounding


def test_a_held_throttle_of_a_gamepad_stops():
    board = Uno(human="gamepad")
    board.run_ms(120)
    for steering_us, throttle_us in [(1456, 120)] * 20 + [(1600, 200)] * 15:
        at_us = board.now_us
        board.send(line(f">S {board.boot} {board.status.uptime_ms} {steering_us} {throttle_us}"))
        board.run_ms(20)
    assert any(abs(us - 200) <= 1 for us in widths(board.events, "throttle"))
    board.run_ms(400)
    last_us = max(e.at_us + e.pulse_us for e in pulses(board.events, "throttle") if e.pulse_us > 124)
    assert last_us - at_us <= 155_000  # after the last line began
