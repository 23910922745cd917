"""The Arduino's firmware, compiled as it is flashed, in simavr: judged by the pulses on its pins, in microseconds."""

import json
import random

import needs
import pytest
from recorded import real_episode
from uno import CUT, LINE_IN, RESET, Uno, line, pulses, widths

from rover_lib.onboard.car import car
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US, PwmCalibration

pytestmark = [pytest.mark.emulated, needs.simavr]

# Who may arm, which lines are commands, and what noise does are the state machine's alone: tests/firmware has that.
NEUTRAL = {"steering": 1456, "throttle": 120}
STEERING_PERIOD_US, THROTTLE_PERIOD_US = 21316, 1016
TIMEOUT_MS, SIGNAL_MS, WATCHDOG_MS, TAKEOVER_MS, STOP_MS = 150, 100, 60, 50, 200
EDGE_US = 0.3  # an instruction of simavr takes up to four cycles of 0.0625 us
STEP_US = ARDUINO_STEP_US + EDGE_US
ANSWER_MS = 25  # a command takes up to 4 ms on the wire, a status 7, and may wait for one that is under way
REST = (1460, 124)  # sticks that were let go, a little off, as transmitters are


@pytest.fixture
def board():
    board = Uno()
    yield board
    board.close()


@pytest.fixture
def manual(board):
    """Running, with a transmitter whose sticks rest."""
    board.transmitter(*REST)
    board.run_ms(120)
    assert board.status.state == "M"
    return board


@pytest.fixture
def armed(manual):
    arm(manual)
    return manual


def arm(board):
    board.wiggle()
    board.command("A")
    board.run_ms(ANSWER_MS)
    assert (board.status.state, board.status.reason, board.status.result) == ("A", "a", "k"), board.lines[-3:]


def on_pins(events, steering_us, throttle_us, after_us=0, within_us=EDGE_US):
    """Whether there are pulses of both pins, and all are these."""
    for pin, wanted in (("steering", steering_us), ("throttle", throttle_us)):
        measured = widths(events, pin, after_us)
        assert measured, f"no {pin} pulses"
        assert all(abs(us - wanted) <= within_us for us in measured), f"{pin}: {sorted(measured)} us, wanted {wanted}"


def is_neutral(events, after_us=0):
    on_pins(events, *NEUTRAL.values(), after_us=after_us)


# ---- what the pins do


def test_neutral_before_anything_else(board):
    events = board.run_ms(200)
    assert pulses(events, "throttle")[0].at_us < 1000
    assert pulses(events, "steering")[0].at_us < 1000
    is_neutral(events)
    for pin, period_us in (("steering", STEERING_PERIOD_US), ("throttle", THROTTLE_PERIOD_US)):
        periods = [e.period_us for e in pulses(events, pin)][1:]
        assert periods
        assert all(abs(p - period_us) <= EDGE_US for p in periods)
    assert board.lines[0] == f"<H 4 4.1.1 {board.boot} 0 p {car.this_car().id}"
    status = board.status
    assert (status.state, status.reason, status.result) == ("M", "r", "-")
    assert status.receiver_steering_us == status.receiver_throttle_us == "-"


def test_recorded_pulses_come_out_as_they_went_in(board):
    """What a transmitter sent, through the receiver's pins, and as actions through the host, within a timer step."""
    pwm = PwmCalibration()
    controls = json.loads((real_episode() / "episode_data.json").read_text())["control_samples"][60:260:8]
    board.transmitter(*REST)
    board.run_ms(100)
    for control in controls:
        steering_us, throttle_us = control["steering_raw_us"], control["throttle_raw_us"]
        if pwm.actions_from_pulses(steering_us, throttle_us).measured and throttle_us >= 40:
            board.transmitter(steering_us, throttle_us)
            board.run_ms(50)
            on_pins(board.run_ms(25), steering_us, throttle_us, within_us=STEP_US)
            assert abs(board.status.receiver_steering_us - steering_us) <= ARDUINO_STEP_US
    board.transmitter(*REST)
    board.run_ms(60)
    arm(board)
    checked = 0
    for control in controls:
        actions = pwm.actions_from_pulses(
            *(control[f"{name}_{what}_us"] for what in ("raw", "period") for name in ("steering", "throttle"))
        )
        if actions.measured and actions.throttle > 0:
            sent = pwm.pulses(actions.steering, actions.throttle)
            board.drive(sent.steering_us, sent.throttle_us, 60)
            events = board.drive(sent.steering_us, sent.throttle_us, 25)
            on_pins(events, control["steering_raw_us"], control["throttle_raw_us"], within_us=2 * ARDUINO_STEP_US)
            on_pins(events, sent.steering_us, sent.throttle_us, within_us=STEP_US)
            checked += 1
    assert checked >= 5


# ---- who drives


def test_no_command_for_150_ms_stops_and_stays(armed):
    rng = random.Random(1)
    latest = 0
    for _ in range(8):
        armed.drive(1800, 232, 60 + rng.uniform(0, 25), every_ms=20)
        armed.command("D", 1800, 232)
        events = armed.run_ms(350)
        command_us = max(e.at_us for e in events if e.kind == LINE_IN)
        last_us = max(e.at_us + e.pulse_us for e in pulses(events, "throttle") if e.pulse_us > 124)
        latest = max(latest, last_us - command_us)
        assert TIMEOUT_MS * 1000 - 2000 <= last_us - command_us <= (TIMEOUT_MS + 3) * 1000
        is_neutral(events, after_us=command_us + (TIMEOUT_MS + 24) * 1000)
        assert (armed.status.state, armed.status.reason) == ("S", "t")
        # Commands that come after all change nothing.
        is_neutral(armed.drive(1800, 232, 100))
        assert armed.status.result == "i"
        arm(armed)
    print(f"throttle off at most {latest / 1000:.1f} ms after the last command")


@pytest.mark.parametrize(("pin", "sticks"), [("steering", (1560, 124)), ("throttle", (1460, 240))])
def test_the_human_takes_over_within_50_ms(armed, pin, sticks):
    rng = random.Random(2)
    latest = 0
    for _ in range(8):
        armed.drive(1800, 232, 60 + rng.uniform(0, 25), every_ms=20)
        start_us = armed.now_us
        armed.transmitter(*sticks)
        events = armed.drive(1800, 232, 90, every_ms=20)
        human_us = (sticks[0], sticks[1] if pin == "steering" else 120)  # his throttle passes once it was at rest
        on_pins(events, *human_us, after_us=start_us + TAKEOVER_MS * 1000, within_us=STEP_US)
        for name, us in zip(("steering", "throttle"), human_us, strict=True):
            first = next(e for e in pulses(events, name) if abs(e.pulse_us - us) <= ARDUINO_STEP_US)
            latest = max(latest, first.at_us + first.pulse_us - start_us)
        assert (armed.status.state, armed.status.reason, armed.status.result) == ("M", "h", "i")
        armed.transmitter(*REST)
        armed.run_ms(50)
        # Letting go hands nothing back.
        on_pins(armed.drive(1800, 232, 60), *REST, within_us=STEP_US)
        arm(armed)
    assert latest <= TAKEOVER_MS * 1000
    print(f"{pin}: at most {latest / 1000:.1f} ms")


# ---- lines: which of them are commands, tests/firmware has natively; here is what the wire does to them


def test_the_clock_is_true(manual):
    """It is counted from Timer1's overflows: none may be lost, with all interrupts busy."""
    manual.transmitter(None, 200, throttle_period_us=1016.4)  # its edges wander across the overflows
    for _ in range(150):
        manual.command("D", 1300, 200)
        manual.run_ms(20)
    assert manual.now_us / 1000 - 35 <= manual.status.uptime_ms <= manual.now_us / 1000


def test_a_line_full_of_rubbish_does_not_keep_commands_out(armed):
    """Another program writes to the port as fast as it can: every byte is taken, the loop never falls behind."""
    rng = random.Random(4)
    armed.drive(1300, 200, 90)
    events = []
    for _ in range(30):
        armed.send(bytes(rng.choice(b"<>ADNQ 0123456789*ABCDEF\n\xff") for _ in range(280)) + b"\n")
        armed.command("D", 1300, 200)
        events += armed.run_ms(32)
    on_pins(events, 1300, 200)
    assert (armed.status.state, armed.status.lost) == ("A", 0)
    assert not any(e.kind == RESET for e in events)


def test_a_turn_of_the_loop_takes_less_than_two_milliseconds(armed):
    """With the line full both ways: commands, questions, rubbish, the longest statuses, and the receiver's edges."""
    rng = random.Random(6)
    armed.watch_loop()
    for n in range(60):
        armed.send(bytes(rng.choice(b"<>ADNQ 0123456789*ABCDEF\n\xff") for _ in range(60)) + b"\n" + line(">Q"))
        armed.command("D", 1300 + n, 150 + n)
        armed.command("D", 1301 + n, 151 + n)
        armed.run_ms(rng.uniform(14, 17))  # 165 bytes take 14: more would wait for longer each time, and be late
    assert (armed.status.state, armed.status.lost) == ("A", 0)
    print(f"the loop's longest turn takes {armed.longest_ms:.2f} ms")
    assert 0.1 < armed.longest_ms < 2


# ---- resets


def test_reset_button_while_driving(armed):
    """Neutral at once; and the lines of before, played to the Arduino again, arm and move nothing."""
    armed.transmitter(0, 0)
    old = [armed.command("A"), *(armed.command("D", 1800, 232) for _ in range(3))]
    armed.drive(1800, 232, 45)
    boot = armed.boot
    armed.reset()
    start_us = armed.now_us
    events = armed.run_ms(150)
    is_neutral(events, after_us=start_us)
    assert pulses(events, "throttle", start_us)[0].at_us - start_us < 1000
    assert all(e.pulse_us <= 1800 + EDGE_US for e in events if e.kind == CUT)
    assert any(body == f"<H 4 4.1.1 {boot + 1} 0 e {car.this_car().id}" for body in armed.lines)
    for text in old:
        armed.send(text)
    is_neutral(armed.run_ms(60))
    assert (armed.status.state, armed.status.reason, armed.status.old) == ("M", "r", len(old))


def test_a_hung_loop_is_reset_by_the_watchdog(armed):
    armed.drive(1800, 232, 97)
    armed.hang()
    start_us = armed.now_us
    events = armed.run_ms(300)
    resets = [e.at_us for e in events if e.kind == RESET]
    assert len(resets) == 1
    assert (WATCHDOG_MS - 5) * 1000 <= resets[0] - start_us <= (WATCHDOG_MS + 10) * 1000
    print(f"reset {(resets[0] - start_us) / 1000:.1f} ms after the loop hung")
    # Up to it the timers go on with the last command; from it on the pins are neutral, then the human's.
    on_pins([e for e in events if e.at_us + 2000 < resets[0]], 1800, 232)
    later = widths(events, "throttle", resets[0])
    assert later
    assert max(later) <= 124 + ARDUINO_STEP_US
    on_pins(events, *REST, after_us=resets[0] + 60_000, within_us=STEP_US)
    assert any(body == f"<H 4 4.1.1 {armed.boot} 0 w {car.this_car().id}" for body in armed.lines)
    assert (armed.status.state, armed.status.reason) == ("M", "r")
    arm(armed)


def test_no_other_interrupt_disturbs_the_steering_by_more_than_a_step(board):
    """Throttle edges, lines and overflows at all phases: one that kept INT0 waiting for 6 us was seen in 0.3 %.

    A status says whole microseconds, so that up to half of one is its rounding.
    """
    rng = random.Random(5)
    board.transmitter(*REST)
    board.run_ms(150)
    errors = []
    for _ in range(300):
        steering_us, throttle_us = rng.uniform(1010, 1940), 4 * rng.randrange(30, 170)
        board.transmitter(steering_us, throttle_us)
        for _ in range(6):
            board.send(line(">Q"))
            board.run_ms(rng.uniform(9, 12))
        assert abs(board.status.receiver_throttle_us - throttle_us) <= 1
        errors.append(board.status.receiver_steering_us - steering_us)
    assert max(map(abs, errors)) <= STEP_US + 0.5


# ---- built for a gamepad: a host's lines are the human's sticks


@pytest.mark.parametrize("let_go", [False, True])
def test_a_held_throttle_of_a_gamepad_stops_on_the_pins(let_go):
    board = Uno(human="gamepad")
    board.run_ms(120)

    def hold(steering_us, throttle_us, ms):
        events = []
        for _ in range(0, ms, 20):
            board.send(line(f">S {board.boot} {board.status.uptime_ms} {steering_us} {throttle_us}"))
            events += board.run_ms(20)
        return events

    hold(1456, 120, 400)
    assert any(abs(us - 200) <= 1 for us in widths(hold(1600, 200, 300), "throttle"))
    at_us = board.now_us
    if let_go:
        hold(0, 0, 20)
    board.run_ms(400)
    moving = [(e.at_us - at_us) / 1e3 for e in pulses(board.events, "throttle", at_us) if e.pulse_us > 124]
    print(f"throttle off after {max(moving):.1f} ms")
    assert max(moving) <= (30 if let_go else 155)
    board.close()
