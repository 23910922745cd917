"""Who drives, in virtual time: the firmware's own state machine with a transmitter and a host.

Each attack here moved the car on firmware 1.0.0, or kept it from its human; what came of it then is in the docstrings.
"""

import itertools

import pytest

from lab.driving.native import THROTTLE, NativeArduino
from rover_lib.onboard.car.servo_link import State
from tests.helpers import needs
from tests.helpers.vehicle import CAP_US, NEUTRAL, moved_after_ms, throttles

pytestmark = needs.gcc
HUMAN_MS = 100  # until the car is the human's, whatever happened


@pytest.fixture
def board():
    """Running, with a transmitter whose sticks rest."""
    board = NativeArduino()
    board.run(120)
    return board


@pytest.fixture
def armed(board):
    """Running, and armed by its human."""
    board.wiggle()
    assert board.command("A") == "k"
    return board


# ---- a receiver that goes on without its transmitter


@pytest.mark.parametrize("gap_ms", [0, 90, 2000])
@pytest.mark.parametrize("preset_us", [(1456, 400), (1900, 948)])
def test_a_receivers_preset_pulses_drive_nothing(armed, gap_ms, preset_us):
    """400 us after a gap drove the car for as long as one looked: 2,930 pulses in three seconds."""
    armed.drive(1600, 200, 200)
    armed.sticks = [0, 0]
    pins = armed.drive(1600, 200, gap_ms)
    armed.sticks = list(preset_us)
    pins += armed.drive(1600, 200, 3000)
    assert moved_after_ms(pins) <= HUMAN_MS
    assert armed.status.state is not State.AUTONOMOUS


# ---- arming as a ritual


def test_arming_asks_for_one_thing_after_the_other():
    board = NativeArduino()
    needed = ([0, 0], "s"), ([0, 124], "s"), ([1460, 0], "s"), ([1460, 300], "t"), ([1460, 124], "w")
    for board.sticks, missing in needed:
        board.run(200)
        assert (board.command("A"), board.status.missing) == (missing, missing)
    board.wiggle()
    assert board.status.missing == "-"
    assert board.command("N") == "i"  # a human drives, and goes on
    assert set(board.drive(1700, 232, 100)) == {(1460, 124)}  # not armed
    assert (board.command("A"), board.status.state) == ("k", State.AUTONOMOUS)
    assert board.status.missing == "w"  # used up
    board.command("N")
    assert set(board.drive(1700, 232, 200)) == {NEUTRAL}
    assert (board.status.state, board.status.reason, board.status.result) == (State.STOPPED, "n", "i")


def test_a_stopped_car_is_at_neutral_whatever_the_resting_sticks_say(armed):
    armed.drive(1600, 200, 200)
    armed.run(300)
    armed.sticks = [1490, 140]  # not moved far enough for a takeover
    assert set(armed.run(300)) == {NEUTRAL}
    assert armed.status.state is State.STOPPED


def drive_by_hand(board, steering_us, throttle_us, ms):
    board.sticks = [steering_us, throttle_us]
    board.run(ms)


def test_driving_by_hand_is_no_gesture(board):
    """It was: each side could be 30 s old, with throttle in between, and 9 ms at rest sufficed."""
    for turn in range(6):
        drive_by_hand(board, (1750, 1150)[turn % 2], 200, 400)
        drive_by_hand(board, 1456, 120 if turn % 3 else 180, 100)
        assert board.command("A") in ("t", "w")
    drive_by_hand(board, 1456, 120, 1500)
    assert board.command("A") == "w"


def test_the_two_sides_of_a_gesture_belong_together(board):
    for steering_us in (1750, 1150):
        drive_by_hand(board, steering_us, 120, 100)
        drive_by_hand(board, 1456, 120, 3200)
        assert board.command("A") == "w"


def test_a_stick_held_to_a_side_is_not_let_go(board):
    board.wiggle()
    drive_by_hand(board, 1600, 120, 2000)
    assert board.command("A") == "w"


@pytest.mark.parametrize(("age_ms", "result"), [(30_900, "k"), (31_100, "e"), (3_600_000, "e"), (-5000, "e")])
def test_a_request_has_an_age(board, age_ms, result):
    """A drive that had waited in a terminal for an hour armed the car."""
    board.run(32_000)
    board.wiggle()
    board.asked_ms = board.now_ms - age_ms
    assert board.command("A") == result


@pytest.mark.parametrize(("throttle_us", "result"), [(300, "t"), (124, "k")])
def test_a_human_who_drives_keeps_the_car_when_another_is_told(board, throttle_us, result):
    """Throttle and steering went to neutral until there were signals again."""
    drive_by_hand(board, 1600, throttle_us, 300)
    assert board.command("C", 20000, 1000, 1500, 2000, 1010, 130, 130, 711, 100) == result
    assert set(board.run(300)) == {(1600, throttle_us)}
    board.sticks[1] = 300
    assert board.run(10)[-1] == (1600, 300)


@pytest.mark.parametrize(("channel", "off", "missing"), [(0, 1.2, "w"), (0, 1.3, "s"), (1, 1.2, "w"), (1, 1.3, "s")])
def test_the_period_of_a_signal_may_be_off_by_a_quarter(board, channel, off, missing):
    board.periods_us = tuple(round(us * (off if i == channel else 1)) for i, us in enumerate(board.periods_us))
    board.run(400)
    assert board.status.missing == missing


def test_a_throttle_at_rest_frees_nothing_while_the_steering_is_lost(board):
    for board.sticks, ms in (([0, 0], 200), ([0, 120], 300), ([1500, 300], 400)):
        pins = board.run(ms)
    assert set(throttles(pins)) == {120}


def test_a_wiggle_is_good_for_one_arming_within_30_seconds(board):
    board.wiggle()
    board.run(28_500)
    assert board.status.missing == "-"
    board.run(1_500)
    assert board.command("A") == "w"
    board.wiggle()
    assert [board.command(kind) for kind in "ANA"] == ["k", "k", "w"]


# ---- the host is not trusted


def test_the_throttle_has_a_cap(armed):
    """One line of 711 us was obeyed within a pulse."""
    assert max(throttles(armed.drive(1456, 711, 1000))) == CAP_US == armed.status.cap_us
    assert armed.status.state is State.AUTONOMOUS


def test_the_cap_goes_down_and_never_up(board):
    for asked_us, result, cap_us in ((180, "k", 180), (200, "k", 180), (119, "r", 180), (712, "r", 180)):
        assert (board.command("L", asked_us), board.status.cap_us) == (result, cap_us)
    board.wiggle()
    board.command("A")
    assert (board.command("L", 150), board.status.cap_us) == ("i", 180)
    assert max(throttles(board.drive(1456, 238, 500))) == 180
    board.command("N")
    assert (board.command("L", 150), board.status.cap_us) == ("k", 150)


@pytest.mark.parametrize("every_ms", [5, 100])
def test_no_pulse_jumps(armed, every_ms):
    """From 900 to 2012 us and from 120 to 711 within one pulse, both ways."""
    pins = [NEUTRAL]
    for n in range(40):
        pins += armed.drive(*((900, 120), (2012, 238))[n % 2], 300, every_ms)
    for (steering_us, throttle_us), (next_steering_us, next_throttle_us) in itertools.pairwise(pins):
        assert abs(next_steering_us - steering_us) <= 4
        assert abs(next_throttle_us - throttle_us) <= 2
    assert {900, 2012} <= {steering_us for steering_us, _ in pins}
    assert {120, 238} <= set(throttles(pins))


# ---- the human takes over, however bad the signal is


@pytest.mark.parametrize(("share", "read_us"), [(3, 120), (2, 0), (3, 90), (3, 400)])
def test_a_misread_throttle_takes_over_and_noise_does_not(armed, share, read_us):
    """Every third pulse misread: the human never got the car, three in a row were asked for."""
    armed.misread = share, read_us
    armed.drive(1600, 200, 500)
    assert armed.status.state is State.AUTONOMOUS
    armed.sticks[THROTTLE] = 400
    assert moved_after_ms(armed.drive(1600, 200, 500)) <= HUMAN_MS
    assert armed.status.state is State.MANUAL


# ---- what waited in the link


@pytest.mark.parametrize(("age_ms", "holds_ms"), [(0, 150), (50, 150), (51, 149), (150, 50), (151, 0), (2000, 0)])
def test_a_command_that_waited_in_the_link_holds_for_less_or_is_late(armed, age_ms, holds_ms):
    """It was 150 ms from when it came, whatever its age: so a car obeyed for 300 ms what was over."""
    armed.drive(1456, 150, 500)
    armed.heard_ms = armed.now_ms - age_ms
    assert armed.command("D", 1456, 150) == ("k" if holds_ms else "l")
    assert (armed.status.sequence == armed.sequence) == (holds_ms > 0)
    if holds_ms:
        assert moved_after_ms(armed.run(300)) == holds_ms - 1
        assert armed.status.reason == "t"


# ---- a host that has no time for the car


@pytest.mark.parametrize("phase_ms", range(0, 33, 8))
def test_a_host_that_pauses_again_and_again_stops_the_car(armed, phase_ms):
    """110 ms of every 150 drove on, and then stopped after 269 ms. phase_ms: from its last command to its pause."""
    armed.drive(1456, 200, 495 + phase_ms)
    pins = armed.run(110) + armed.drive(1456, 200, 40) + armed.run(300)
    assert 110 < moved_after_ms(pins) <= 195
    assert (armed.status.state, armed.status.reason) == (State.STOPPED, "p")


@pytest.mark.parametrize("phase_ms", range(0, 33, 8))
def test_one_pause_is_no_reason_to_stop(armed, phase_ms):
    for _ in range(3):
        armed.drive(1456, 200, 495 + phase_ms)
        pins = armed.run(100) + armed.drive(1456, 200, 99) + armed.run(8) + armed.drive(1456, 200, 600)
        assert set(throttles(pins)) == {200}
    assert armed.status.state is State.AUTONOMOUS


# ---- near the wrap of the clock


@pytest.mark.parametrize("before_ms", [1000, 2000])
def test_nothing_happens_when_the_clock_wraps(before_ms):
    """In the gesture, and while it drives."""
    board = NativeArduino(now_ms=(1 << 32) - before_ms)
    board.run(120)
    board.wiggle()
    assert board.command("A") == "k"
    assert set(throttles(board.drive(1456, 150, 1200)[20:])) == {150}
    assert board.status.uptime_ms < 3000 and board.status.state is State.AUTONOMOUS
    assert moved_after_ms(board.run(400)) <= 150 and board.status.reason == "t"
