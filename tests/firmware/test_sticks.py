"""A gamepad's sticks, which the host sends: the firmware built with HUMAN=gamepad, in virtual time."""

import pytest

from lab.driving.native import THROTTLE, NativeArduino
from rover_lib.onboard.car.servo_link import State, frame
from tests.helpers import needs
from tests.helpers.vehicle import CAP_US, NEUTRAL, moved_after_ms

pytestmark = needs.gcc


@pytest.fixture
def board():
    """Running; somebody holds the gamepad's button, and the sticks rest."""
    board = NativeArduino(gamepad=True)
    board.run(300)
    return board


def test_a_board_with_a_receiver_knows_no_sticks():
    board = NativeArduino()
    board.sticks = [0, 0]
    for _ in range(50):
        board.run(20)
        board.send_sticks(1750, 200, board.now_ms - 15)
    assert board.status.missing == "s"
    assert board.run(1) == [NEUTRAL]


def test_the_human_drives(board):
    board.sticks = [1700, 180]
    assert board.run(40)[-1] == (1700, 180)
    status = board.status
    assert (status.receiver_steering_us, status.receiver_steering_period_us) == (1700, 21316)
    assert (status.receiver_throttle_us, status.receiver_throttle_period_us) == (180, 1016)
    board.sticks[THROTTLE] = 711  # these come through a host, too
    assert board.run(40)[-1] == (1700, CAP_US)


@pytest.mark.parametrize("stop", ["let go", "silence", "late"])
@pytest.mark.parametrize("autonomous", [False, True])
def test_each_loss_stops_within_200_ms(board, stop, autonomous):
    if autonomous:
        board.wiggle()
        board.command("A")
        board.drive(1600, 200, 300)
    else:
        board.sticks = [1700, 200]
        board.run(300)
    sticks = board.sticks
    board.sticks = [0, 0]
    if stop == "let go":
        board.send_sticks(0, 0, board.now_ms)
    pins = []
    for _ in range(20):
        if stop == "late":  # the host goes on, but its lines take longer and longer
            board.send_sticks(*sticks, board.now_ms - 140)
        pins += board.drive(1600, 200, 30) if autonomous else board.run(30)
    assert moved_after_ms(pins) <= (1 if stop == "let go" else 151)
    assert not autonomous or (board.status.state, board.status.reason) == (State.STOPPED, "s")
    board.sticks = [1456, 200]  # and what was held is not taken up again
    assert not moved_after_ms(board.run(500))


def test_no_line_counts_twice(board):
    """Nor an older one, one of another start, one that is too old, or one from the future."""
    board.sticks = [0, 0]
    board.run(1000)
    now, boot, before = board.now_ms, board.status.boot, board.status.old_commands
    board.send_sticks(1456, 120, now - 20)
    for other_boot, heard in ((0, now - 20), (0, now - 40), (1, now - 1), (0, now - 151), (0, now + 1)):
        for _ in range(10):
            board.send(frame(f">S {boot + other_boot} {heard} 1456 120"))
    assert board.status.receiver_steering_us is None
    assert board.status.old_commands == before + 50


def test_no_other_pulses(board):
    wrong = (0, 120), (899, 120), (2013, 120), (1456, 39), (1456, 981), (70000, 120), (1456, 65656)
    for n, pulses in enumerate(wrong, 1):
        board.send_sticks(*pulses, board.now_ms)
        assert board.status.out_of_range == n
        assert board.run(1) == [NEUTRAL]


@pytest.mark.parametrize("throttle_us", [190, 60])
def test_a_raw_stick_is_judged_and_the_cap_stands_at_the_pins(board, throttle_us):
    """A cap near neutral put each stick at rest: it armed, and took nothing over. So did one that was pulled back."""
    assert board.command("L", 126) == "k"
    board.wiggle()
    board.sticks[THROTTLE] = throttle_us
    board.run(40)
    assert board.command("A") == "t"
    board.sticks[THROTTLE] = 120
    board.run(200)
    board.wiggle()
    assert board.command("A") == "k"
    board.sticks[THROTTLE] = throttle_us
    assert {us for _, us in board.drive(1456, 126, 400)[100:]} == {120}
    assert (board.status.state, board.status.reason) == (State.MANUAL, "h")
    board.sticks[THROTTLE] = 120
    board.run(200)
    board.sticks[THROTTLE] = throttle_us
    assert board.run(40)[-1] == (1456, min(126, max(120, throttle_us)))
    assert not board.may_keep
