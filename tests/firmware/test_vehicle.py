"""Who drives, in virtual time: the firmware's own state machine with a transmitter and a host.

Each attack here moved the car on firmware 1.0.0, or kept it from its human; what came of it then is in the docstrings.
"""

import itertools

import needs
import pytest

from balloon_world.simulated_arduino import REST_US
from lab.arduino.native import STEERING, THROTTLE, NativeArduino
from rover_lib.onboard.car.servo_link import State

pytestmark = needs.gcc
NEUTRAL = (1456, 120)
CAP_US = 238
HUMAN_MS = 100  # until the car is the human's, whatever happened


@pytest.fixture
def board():
    """Running, with a transmitter whose sticks rest."""
    board = NativeArduino()
    board.run(120)
    return board


def throttles(pins):
    return [throttle_us for _, throttle_us in pins]


def moved_after_ms(pins):
    """How long the throttle was above neutral."""
    moving = [n for n, us in enumerate(throttles(pins)) if us > 120]
    return moving[-1] + 1 if moving else 0


# ---- a receiver that goes on without its transmitter


@pytest.mark.parametrize("gap_ms", [0, 50, 90, 150, 2000])
@pytest.mark.parametrize("preset_us", [(1456, 400), (1500, 200), (1900, 948), (1456, 60)])
def test_a_receivers_preset_pulses_drive_nothing(armed, gap_ms, preset_us):
    """400 us after a gap drove the car for as long as one looked: 2,930 pulses in three seconds."""
    armed.drive(1600, 200, 200)
    armed.sticks = [0, 0]
    pins = armed.drive(1600, 200, gap_ms)
    armed.sticks = list(preset_us)
    pins += armed.drive(1600, 200, 3000)
    assert moved_after_ms(pins) <= HUMAN_MS
    assert armed.status.state is not State.AUTONOMOUS


def test_preset_pulses_from_the_start_drive_nothing():
    board = NativeArduino()
    board.sticks = [1456, 400]
    assert set(throttles(board.run(3000))) == {120}
    assert board.status.missing == "t"


def test_the_humans_throttle_passes_once_it_was_at_rest(board):
    board.sticks = [1600, 300]
    assert set(board.run(200)[50:]) == {(1600, 300)}  # it was at rest after the start
    board.sticks = [0, 0]
    board.run(200)
    board.sticks = [1600, 300]
    assert set(board.run(1000)[50:]) == {(1600, 120)}
    board.sticks[THROTTLE] = 130
    board.run(20)
    board.sticks[THROTTLE] = 300
    assert set(board.run(200)[5:]) == {(1600, 300)}


def test_a_takeover_by_throttle_passes_once_it_was_at_rest(armed):
    armed.drive(1600, 200, 200)
    armed.sticks[THROTTLE] = 400
    pins = armed.drive(1600, 200, 500)
    assert moved_after_ms(pins) <= HUMAN_MS
    armed.sticks[THROTTLE] = 124
    armed.run(20)
    armed.sticks[THROTTLE] = 180
    assert throttles(armed.run(20))[-1] == 180


def test_a_receiver_that_holds_its_last_pulses_arms_nothing(armed):
    armed.drive(1456, 150, 100)
    armed.command("N")
    armed.run(3_000)  # the transmitter is off, and nothing tells
    assert (armed.command("A"), armed.status.missing) == ("w", "w")
    assert set(armed.drive(1600, 200, 300)) == {NEUTRAL}


# ---- arming as a ritual


def test_arming_asks_for_one_thing_after_the_other():
    board = NativeArduino()
    for present in ([0, 0], [0, 124], [1460, 0]):
        board.sticks = present
        board.run(200)
        assert (board.command("A"), board.status.missing) == ("s", "s")
    board.sticks = [1460, 300]
    board.run(200)
    assert (board.command("A"), board.status.missing) == ("t", "t")
    board.sticks = [1460, 124]
    board.run(200)
    assert (board.command("A"), board.status.missing) == ("w", "w")
    board.wiggle()
    assert board.status.missing == "-"
    assert board.command("N") == "i"  # a human drives, and goes on
    assert set(board.drive(1700, 232, 100)) == {(1460, 124)}  # not armed
    assert (board.command("A"), board.status.state) == ("k", State.AUTONOMOUS)
    assert board.status.missing == "w"  # used up
    board.command("N")
    assert set(board.drive(1700, 232, 200)) == {NEUTRAL}
    assert (board.status.state, board.status.reason, board.status.result) == (State.STOPPED, "n", "i")


@pytest.mark.parametrize("sides", [(1750,), (1150,), (1300, 1600), (1750, 1750)])
def test_what_is_no_wiggle(board, sides):
    for steering_us in (*sides, 1456):
        board.sticks[STEERING] = steering_us
        board.run(300)
    assert board.command("A") == "w"


def test_a_stick_that_is_still_moving_is_not_let_go(board):
    for steering_us in itertools.islice(itertools.cycle((1750, 1150)), 20):
        board.sticks[STEERING] = steering_us
        board.run(60)
        assert board.status.missing == "w"
    board.sticks[STEERING] = 1490  # where it rests is its trim's affair
    board.run(1050)
    assert board.command("A") == "k"
    board.drive(1456, 150, 300)
    assert board.status.state is State.AUTONOMOUS


def test_a_stopped_car_is_at_neutral_whatever_the_resting_sticks_say(armed):
    armed.drive(1600, 200, 200)
    armed.run(300)
    armed.sticks = [1490, 140]  # not moved far enough for a takeover
    assert set(armed.run(300)) == {NEUTRAL}
    assert armed.status.state is State.STOPPED


def drive_by_hand(board, steering_us, throttle_us, ms):
    board.sticks = [steering_us, throttle_us]
    board.run(ms)


@pytest.mark.parametrize("between_ms", [100, 1400, 9000])
def test_driving_by_hand_is_no_gesture(board, between_ms):
    """It was: each side could be 30 s old, with throttle in between, and 9 ms at rest sufficed."""
    for turn in range(20):
        drive_by_hand(board, (1750, 1150)[turn % 2], 200, 400)
        drive_by_hand(board, 1456, 120 if turn % 3 else 180, between_ms)
        assert board.command("A") in ("t", "w")
    drive_by_hand(board, 1456, 120, 1500)
    assert board.command("A") == "w"


def test_the_two_sides_of_a_gesture_belong_together(board):
    for steering_us in (1750, 1150):
        drive_by_hand(board, steering_us, 120, 100)
        drive_by_hand(board, 1456, 120, 3200)
        assert board.command("A") == "w"


@pytest.mark.parametrize("held_us", [1948, 1600])
def test_a_stick_held_to_a_side_is_not_let_go(board, held_us):
    board.wiggle()
    drive_by_hand(board, held_us, 120, 2000)
    assert board.command("A") == "w"


def test_throttle_after_the_gesture_forgets_it(board):
    board.wiggle()
    drive_by_hand(board, 1456, 170, 20)
    drive_by_hand(board, 1456, 120, 2000)
    assert board.command("A") == "w"


def test_arming_waits_for_a_second_of_rest(board):
    for steering_us in (1750, 1150):
        drive_by_hand(board, steering_us, 120, 60)
    drive_by_hand(board, 1456, 120, 950)
    assert board.command("A") == "w"
    drive_by_hand(board, 1456, 120, 100)
    assert board.command("A") == "k"


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


def test_a_throttle_that_does_not_pass_keeps_no_car(board):
    """A board with another neutral than the transmitter's refused the car that has it, until that was switched off."""
    board.sticks = [0, 0]
    board.run(200)
    drive_by_hand(board, 1456, 158, 300)
    assert board.command("C", 20000, 1000, 1500, 2000, 1010, 150, 150, 711, 100) == "k"
    drive_by_hand(board, 1456, 158, 20)
    assert set(board.run(100)) == {(1456, 158)}


@pytest.mark.parametrize(("channel", "off", "missing"), [(0, 1.2, "w"), (0, 1.3, "s"), (1, 1.2, "w"), (1, 1.3, "s")])
def test_the_period_of_a_signal_may_be_off_by_a_quarter(channel, off, missing):
    board = NativeArduino()
    periods = list(board.periods_us)
    periods[channel] = round(off * periods[channel])
    board.periods_us = tuple(periods)
    board.run(400)
    assert board.status.missing == missing


def test_a_throttle_at_rest_frees_nothing_while_the_steering_is_lost(board):
    board.sticks = [0, 0]
    board.run(200)
    board.sticks = [0, 120]
    board.run(300)
    board.sticks = [1500, 300]
    assert set(throttles(board.run(400))) == {120}


def test_a_wiggle_is_good_for_one_arming_within_30_seconds(board):
    board.wiggle()
    board.run(28_500)
    assert board.status.missing == "-"
    board.run(1_500)
    assert board.command("A") == "w"
    board.wiggle()
    assert board.command("A") == "k"
    board.command("N")
    assert board.command("A") == "w"


def test_a_lost_signal_forgets_the_wiggle(board):
    board.wiggle()
    sticks, board.sticks = board.sticks, [0, 0]
    board.run(150)
    board.sticks = sticks
    board.run(500)
    assert board.command("A") == "w"


def test_a_reset_forgets_the_wiggle():
    board = NativeArduino()
    board.run(500)
    assert board.command("A") == "w"


# ---- the host is not trusted


@pytest.mark.parametrize("asked_us", [240, 500, 711])
def test_the_throttle_has_a_cap(armed, asked_us):
    """One line of 711 us was obeyed within a pulse."""
    pins = armed.drive(1456, asked_us, 1000)
    assert max(throttles(pins)) == CAP_US == armed.status.cap_us
    assert armed.status.state is State.AUTONOMOUS


def test_the_cap_goes_down_and_never_up(board):
    assert board.status.cap_us == CAP_US
    assert (board.command("L", 180), board.status.cap_us) == ("k", 180)
    assert (board.command("L", 200), board.status.cap_us) == ("k", 180)
    assert (board.command("L", 119), board.status.cap_us) == ("r", 180)
    assert (board.command("L", 712), board.status.cap_us) == ("r", 180)
    board.wiggle()
    board.command("A")
    assert (board.command("L", 150), board.status.cap_us) == ("i", 180)
    assert max(throttles(board.drive(1456, 238, 500))) == 180
    board.command("N")
    assert (board.command("L", 150), board.status.cap_us) == ("k", 150)


@pytest.mark.parametrize("every_ms", [5, 20, 33, 100])
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


def test_a_pulse_does_not_save_up_time(armed):
    """Standing still for long is no credit for a jump."""
    armed.drive(1456, 150, 3000)
    pins = armed.drive(2012, 238, 33)
    assert pins[0] == (1460, 152)


def test_nothing_slows_the_stop(armed):
    armed.drive(2012, 238, 500)
    armed.command("N")
    assert armed.run(1) == [NEUTRAL]


@pytest.mark.parametrize("stop", ["silence", "signal", "stick"])
def test_neutral_from_a_stop_is_at_once(armed, stop):
    armed.drive(2012, 238, 500)
    if stop == "signal":
        armed.sticks = [0, 0]
    if stop == "stick":
        armed.sticks[STEERING] = 1300
    pins = armed.run(300) if stop == "silence" else armed.drive(2012, 238, 300)
    assert set(throttles(pins)) <= {238, 120}
    assert moved_after_ms(pins) <= (150 if stop == "silence" else HUMAN_MS)


# ---- the human takes over, however bad the signal is


@pytest.mark.parametrize("stick_us", [200, 300, 711, 948])
def test_a_clean_throttle_takes_over(armed, stick_us):
    armed.drive(1600, 200, 200)
    armed.sticks[THROTTLE] = stick_us
    assert moved_after_ms(armed.drive(1600, 200, 500)) <= 10
    assert armed.status.reason == "h"


@pytest.mark.parametrize(("share", "read_us"), [(3, 120), (4, 120), (2, None), (3, None), (3, 90)])
def test_a_misread_throttle_takes_over(armed, share, read_us):
    """Every third pulse misread: the human never got the car, three in a row were asked for."""
    armed.misread = lambda number, us: us if number % share else read_us
    armed.drive(1600, 200, 200)
    assert armed.status.state is State.AUTONOMOUS
    armed.sticks[THROTTLE] = 400
    assert moved_after_ms(armed.drive(1600, 200, 500)) <= HUMAN_MS
    assert armed.status.state is State.MANUAL


@pytest.mark.parametrize("every", [12, 20, 50, 97])
def test_a_throttle_of_a_few_pulses_is_no_signal(armed, every):
    """One pulse each 99 ms was a signal, and the human took over after 297 ms."""
    armed.drive(1600, 200, 200)
    armed.misread = lambda number, us: None if number % every else us
    armed.sticks[THROTTLE] = 400
    assert moved_after_ms(armed.drive(1600, 200, 1000)) <= HUMAN_MS
    assert armed.status.receiver_throttle_us is None or armed.status.state is State.MANUAL


def test_noise_is_no_takeover(armed):
    armed.misread = lambda number, us: 400 if number % 3 == 0 else us
    armed.drive(1600, 200, 1000)
    assert armed.status.state is State.AUTONOMOUS


def test_a_stick_that_wavers_is_no_takeover(armed):
    for n in range(40):
        armed.sticks = [1456 + (n * 17) % 45, 120 + (n * 5) % 30]
        armed.drive(1600, 200, 50)
    assert armed.status.state is State.AUTONOMOUS


# ---- what waited in the link


@pytest.mark.parametrize(("age_ms", "result"), [(0, "k"), (60, "k"), (150, "k"), (151, "l"), (2000, "l")])
def test_a_command_that_waited_in_the_link_is_late(armed, age_ms, result):
    armed.drive(1456, 150, 500)
    armed.heard_ms = armed.now_ms - age_ms
    assert armed.command("D", 1600, 200) == result
    assert (armed.status.sequence == armed.sequence) == (result == "k")


def test_a_link_that_falls_behind_stops_the_car(armed):
    """With a link 2 s behind the brake came 2 s late. Each command is now as old as the last, and 5 ms more."""
    sent = [(armed.now_ms + n * 33, armed.now_ms + n * 38) for n in range(200)]  # when it was sent, when it comes
    begun_ms = armed.now_ms
    pins = []
    for sent_ms, comes_ms in sent:
        pins += armed.run(max(0, comes_ms - armed.now_ms))
        armed.heard_ms = sent_ms
        armed.command("D", 1456, 150)
    # The 31st is 150 ms late; from then on nothing is a command, and 150 ms later the car stops.
    assert moved_after_ms(pins) <= 38 * 31 + 151
    assert armed.status.state is State.STOPPED
    assert armed.now_ms - begun_ms > 7000


@pytest.mark.parametrize(("age_ms", "holds_ms"), [(0, 150), (50, 150), (51, 149), (100, 100), (150, 50)])
def test_a_command_holds_for_less_the_older_it_is(armed, age_ms, holds_ms):
    """It was 150 ms from when it came, whatever its age: so a car obeyed for 300 ms what was over."""
    armed.drive(1456, 150, 500)
    armed.heard_ms = armed.now_ms - age_ms
    assert armed.command("D", 1456, 150) == "k"
    assert moved_after_ms(armed.run(300)) == holds_ms - 1
    assert armed.status.reason == "t"


def test_an_arming_that_waited_in_the_link_arms_nothing(board):
    board.wiggle()
    board.heard_ms = board.now_ms - 500
    assert board.command("A") == "l"
    assert board.status.state is State.MANUAL


def test_who_has_heard_nothing_yet_is_late(armed):
    armed.heard_ms = (armed.now_ms + 1) % (1 << 32)  # from a start of the board that is to come, or that is over
    assert armed.command("D", 1600, 200) == "l"


# ---- a host that has no time for the car


@pytest.mark.parametrize("phase_ms", range(0, 33, 4))
def test_a_host_that_pauses_again_and_again_stops_the_car(armed, phase_ms):
    """110 ms of every 150 drove on, and then stopped after 269 ms. phase_ms: from its last command to its pause."""
    armed.drive(1456, 200, 495 + phase_ms)
    pins = armed.run(110)
    pins += armed.drive(1456, 200, 40)
    pins += armed.run(300)
    assert 110 < moved_after_ms(pins) <= 195
    assert (armed.status.state, armed.status.reason) == (State.STOPPED, "p")


@pytest.mark.parametrize("phase_ms", range(0, 33, 4))
def test_one_pause_is_no_reason_to_stop(armed, phase_ms):
    for _ in range(3):
        armed.drive(1456, 200, 495 + phase_ms)
        assert set(throttles(armed.run(100))) == {200}
        assert set(throttles(armed.drive(1456, 200, 99) + armed.run(8))) == {200}
        assert set(throttles(armed.drive(1456, 200, 600))) == {200}
    assert armed.status.state is State.AUTONOMOUS


def test_lines_that_were_lost_are_no_pause(armed):
    armed.drive(1456, 200, 500)
    for lost in (3, 3, 2, 3):
        armed.run(33 * lost)
        armed.sequence += lost
        armed.drive(1456, 200, 33)
    assert armed.status.state is State.AUTONOMOUS


# ---- near the wraps of clock and sequence


@pytest.mark.parametrize("before_ms", [1, 50, 400, 700, 1000, 1500])
def test_nothing_happens_when_the_clock_wraps(before_ms):
    board = NativeArduino(now_ms=(1 << 32) - before_ms)
    board.sequence = 0
    board.run(120)
    board.wiggle()
    assert board.command("A") == "k"
    assert set(throttles(board.drive(1456, 150, 1200)[20:])) == {150}
    assert board.status.uptime_ms < 3000
    assert board.status.state is State.AUTONOMOUS
    assert moved_after_ms(board.run(400)) <= 150
    assert board.status.reason == "t"


@pytest.mark.parametrize("before", [1, 2, 5])
def test_a_sequence_that_wraps_is_new(before):
    board = NativeArduino(sequence=(1 << 32) - before)
    board.run(120)
    for _ in range(10):
        assert board.command("N") == "i"
    assert board.status.sequence == 10 - before
    assert board.command("N", sequence=(1 << 32) - before) == "o"


def test_what_the_expert_and_the_recordings_do_is_within_the_limits(armed):
    """The most in 33 ms: 64 us of a recorded steering, 32 of a throttle; the balloon world's expert 99 and 6."""
    for steering_us, throttle_us in ((1456 + 99, 120 + 6), (1456, 120), (1456 + 64, 120 + 32), (1456, 120)):
        assert armed.drive(steering_us, throttle_us, 33)[-1] == (steering_us, throttle_us)
    assert armed.status.state is State.AUTONOMOUS
    assert REST_US[STEERING] == 1456
