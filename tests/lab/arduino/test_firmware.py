"""The Arduino's firmware, compiled as it is flashed, in simavr: judged by the pulses on its pins, in microseconds."""

import json
import random
import subprocess

import needs
import pytest
import uno
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


def test_flashing_needs_a_port():
    done = subprocess.run(["make", "-C", "firmware", f"BUILD={uno.firmware().parent}", "flash"], cwd=uno.REPOSITORY,
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode != 0
    assert "make flash needs PORT=" in done.stderr


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


@pytest.mark.parametrize("lost", ["steering", "throttle", "both"])
def test_manual_without_signal_is_neutral(manual, lost):
    """And when it is back, the throttle passes once it has been at rest."""
    manual.transmitter(1700, 400)
    manual.run_ms(60)
    start_us = manual.now_us
    manual.transmitter(None if lost == "throttle" else 0, None if lost == "steering" else 0)
    events = manual.run_ms(300)
    is_neutral(events, after_us=start_us + STOP_MS * 1000)
    status = manual.status
    assert status.state == "M"
    assert (status.receiver_steering_us == "-") == (lost != "throttle")
    assert (status.receiver_throttle_us == "-") == (lost != "steering")
    manual.transmitter(1700, 400)
    manual.run_ms(80)
    on_pins(manual.run_ms(60), 1700, 120, within_us=STEP_US)
    manual.transmitter(1700, 124)
    manual.run_ms(20)
    manual.transmitter(1700, 400)
    manual.run_ms(20)
    on_pins(manual.run_ms(60), 1700, 400, within_us=STEP_US)


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
        # It holds the command until then, and not longer.
        assert TIMEOUT_MS * 1000 - 2000 <= last_us - command_us <= (TIMEOUT_MS + 3) * 1000
        is_neutral(events, after_us=command_us + (TIMEOUT_MS + 24) * 1000)
        assert (armed.status.state, armed.status.reason) == ("S", "t")
        # Commands that come after all change nothing.
        is_neutral(armed.drive(1800, 232, 100))
        assert armed.status.result == "i"
        arm(armed)
    print(f"throttle off at most {latest / 1000:.1f} ms after the last command")


@pytest.mark.parametrize(
    ("pin", "sticks"), [("steering", (1560, 124)), ("steering", (1300, 124)), ("throttle", (1460, 240))]
)
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


@pytest.mark.parametrize("lost", ["steering", "throttle", "both"])
def test_losing_the_transmitter_stops_and_stays(armed, lost):
    armed.drive(1800, 232, 97)
    start_us = armed.now_us
    armed.transmitter(None if lost == "throttle" else 0, None if lost == "steering" else 0)
    events = armed.drive(1800, 232, 300)
    on_pins([e for e in events if e.at_us < start_us + (SIGNAL_MS - 50) * 1000], 1800, 232)
    is_neutral(events, after_us=start_us + STOP_MS * 1000)
    assert (armed.status.state, armed.status.reason) == ("S", "s")
    last_us = max(e.at_us + e.pulse_us for e in pulses(events, "throttle") if e.pulse_us > 124)
    print(f"{lost} lost: throttle off {(last_us - start_us) / 1000:.1f} ms after")
    armed.command("A")
    armed.run_ms(ANSWER_MS)
    assert armed.status.result == "s"
    armed.transmitter(*REST)
    is_neutral(armed.drive(1800, 232, 150))  # its return is no arming
    arm(armed)
    armed.drive(1800, 232, 90)
    on_pins(armed.drive(1800, 232, 50), 1800, 232)


def test_what_is_no_servo_pulse_is_no_signal(board):
    for steering_us, throttle_us, periods in (
        (790, 124, {}),
        (2300, 124, {}),
        (1460, 20, {}),
        (1460, 1000, {}),
        (1460, 124, {"steering_period_us": 2 * STEERING_PERIOD_US}),
        (1460, 124, {"throttle_period_us": 2 * THROTTLE_PERIOD_US}),
        (1460, 124, {"throttle_period_us": THROTTLE_PERIOD_US / 2}),
    ):
        board.transmitter(steering_us, throttle_us, **periods)
        board.run_ms(150)
        is_neutral(board.run_ms(60))
        assert "-" in (board.status.receiver_steering_us, board.status.receiver_throttle_us)
    board.transmitter(*REST)
    board.run_ms(120)
    on_pins(board.run_ms(60), *REST, within_us=STEP_US)


# ---- lines: which of them are commands, tests/firmware has natively; here is what the wire does to them


def test_lines_of_another_start_never_move_a_pin(armed):
    """A whole drive, recorded and played to the Arduino after a reset: it arms nothing."""
    old = [armed.command("A")] + [armed.command("D", 1900, 232) for _ in range(5)]
    armed.run_ms(30)
    boot = armed.boot
    armed.reset()
    armed.run_ms(150)
    assert armed.boot == boot + 1
    assert armed.lines[-1].startswith("<S")
    assert any(body == f"<H 4 4.1.1 {armed.boot} 0 e {car.this_car().id}" for body in armed.lines)
    for text in old:
        armed.send(text)
    events = armed.run_ms(60)
    on_pins(events, *REST, within_us=STEP_US)
    assert (armed.status.state, armed.status.old) == ("M", len(old))


def test_bytes_with_framing_errors_are_counted_and_dropped(armed):
    armed.send(armed.next_line("D", 1900, 232), framing_errors=True)
    is_neutral(armed.run_ms(60), after_us=armed.now_us - 30_000)
    assert armed.status.lost > 20


def test_every_command_of_100_hz_is_acknowledged(armed):
    sent = {}
    armed.drive(1300, 120, 60)
    before = len(armed.lines)
    bytes_before = armed.now_us
    for n in range(100):
        armed.command("D", 1300 + n, 120 + n)
        sent[armed.sequence] = (1300 + n, 120 + n)
        armed.run_ms(ANSWER_MS)
    statuses = [uno.status_of(s) for s in armed.lines[before:]]
    acknowledged = {s.sequence: (s.steering_us, s.throttle_us) for s in statuses if s.result == "k"}
    assert acknowledged.keys() >= sent.keys()
    # A status follows its command at once, and the pins a millisecond later.
    assert all(abs(pins - wanted) <= 1 for k in sent for pins, wanted in zip(acknowledged[k], sent[k], strict=True))
    assert armed.status.lost == armed.status.bad == 0
    load = sum(len(s) + 10 for s in armed.lines[before:]) / (armed.now_us - bytes_before) * 1e6 / 11520
    assert load < 0.9
    print(f"{load:.0%} of the line from the Arduino")


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
    armed.transmitter(0, 0)
    armed.drive(1800, 232, 45)
    assert armed.status.state == "A"
    armed.reset()
    start_us = armed.now_us
    events = armed.run_ms(150)
    is_neutral(events, after_us=start_us)
    assert pulses(events, "throttle", start_us)[0].at_us - start_us < 1000
    assert all(e.pulse_us <= 1800 + EDGE_US for e in events if e.kind == CUT)
    assert (armed.status.state, armed.status.reason) == ("M", "r")
    is_neutral(armed.drive(1800, 232, 60))


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


def test_a_loop_that_hangs_again_and_again_never_drives(armed):
    armed.drive(1800, 232, 50)
    for _ in range(4):
        armed.hang()
        start_us = armed.now_us
        events = armed.run_ms(100)
        reset_us = next(e.at_us for e in events if e.kind == RESET)
        assert max(widths(events, "throttle", reset_us)) <= 124 + ARDUINO_STEP_US
        assert start_us < reset_us
    assert armed.status.state == "M"


def test_no_other_interrupt_disturbs_the_steering_by_more_than_a_step(board):
    """Throttle edges, lines and overflows at all phases: one that kept INT0 waiting for 6 us was seen in 0.3 %.

    A status says whole microseconds, so that up to half of one is its rounding.
    """
    rng = random.Random(5)
    board.transmitter(*REST)
    board.run_ms(150)
    errors = []
    for _ in range(800):
        steering_us, throttle_us = rng.uniform(1010, 1940), 4 * rng.randrange(30, 170)
        board.transmitter(steering_us, throttle_us)
        for _ in range(6):
            board.send(line(">Q"))
            board.run_ms(rng.uniform(9, 12))
        assert abs(board.status.receiver_throttle_us - throttle_us) <= 1
        errors.append(board.status.receiver_steering_us - steering_us)
    assert max(map(abs, errors)) <= STEP_US + 0.5
