"""A board without a receiver, flashed with HUMAN=gamepad, in simavr: what a host's lines do to its pins."""

import needs
import pytest
from uno import Uno, line, widths

pytestmark = [pytest.mark.emulated, needs.simavr]


def sticks(board, steering_us, throttle_us, ms, every_ms=20):
    """Send sticks for that long, each by the newest status; return the events."""
    events = []
    for _ in range(0, ms, every_ms):
        board.send(line(f">S {board.boot} {board.status.uptime_ms} {steering_us} {throttle_us}"))
        events += board.run_ms(every_ms)
    return events


@pytest.mark.parametrize("let_go", [False, True])
def test_a_held_throttle_stops_on_the_pins(let_go):
    board = Uno(human="gamepad")
    board.run_ms(120)
    board.transmitter(1800, 400)  # nothing listens to a receiver
    sticks(board, 1456, 120, 400)
    assert (board.status.receiver_steering_us, board.status.receiver_throttle_us) == (1456, 120)
    driven = widths(sticks(board, 1600, 200, 300), "throttle")
    assert any(abs(us - 200) <= 1 for us in driven)
    lines, at_us = len(board.lines), board.now_us
    if let_go:
        sticks(board, 0, 0, 20)
    board.run_ms(400)
    after = [e for e in board.events if e.kind == 1 and e.channel == 1 and e.at_us > at_us]
    moving = [(e.at_us - at_us) / 1e3 for e in after if e.pulse_us > 124]
    print(f"throttle off after {max(moving):.1f} ms")
    assert max(moving) <= (30 if let_go else 155)
    assert len(board.lines) - lines <= 22  # sticks ask for no status, which would ask for sticks
    assert board.status.bad == 0
    board.close()


def test_a_board_with_a_receiver_refuses_sticks():
    board = Uno()
    board.run_ms(120)
    sticks(board, 1600, 120, 180)
    board.run_ms(30)
    assert (board.status.bad, board.status.missing, board.status.state) == (9, "s", "M")
    board.close()
