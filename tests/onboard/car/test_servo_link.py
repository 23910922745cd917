"""The link, by its rules, against an Arduino made of a pty and a thread."""

import fcntl
import functools
import os
import termios
import threading
import time

import numpy as np
import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.servo_link import Hello, LinkError, ServoLink, State, Telemetry, frame, parse
from tests.helpers import needs
from tests.helpers.pty_board import Board, board_of, obedient

DEFAULT = Car().id
until = functools.partial(needs.until, seconds=2.0)
STATUS = "<S 7 1234 5 k M r w 1456 120 238 1460 21316 - - 1 2 3 4"


def test_what_the_arduino_says():
    said = parse(frame(STATUS)[:-1], 2.5)
    pulses = (1456, 120, 238, 1460, 21316, None, None)
    assert said == Telemetry(2.5, 7, 1234, 5, "k", State.MANUAL, "r", "w", *pulses, 1, 2, 3, 4)
    assert said.why == "manual: after a reset"
    assert parse(frame(f"<H 4 4.2.0 7 0 w {DEFAULT}")[:-1], 0) == Hello(4, "4.2.0", 7, 0, "watchdog", DEFAULT)
    assert parse(frame("<H 5 5.1 whatever comes then")[:-1], 0).protocol == 5


@given(st.data())
def test_a_garbled_status_says_nothing(data):
    good = frame(STATUS)[:-1]
    at = data.draw(st.integers(0, len(good) - 1))
    flip = data.draw(st.integers(1, 255))
    assert parse(good[:at] + bytes([good[at] ^ flip]) + good[at + 1 :], 0) is None
    changes = {" M ": " X ", "1460 21316": "1460 -", "1456": "01456", "<S": ">S", "- - 1": "- - 5 1"}
    wrong = data.draw(st.sampled_from(list(changes)))
    assert parse(frame(STATUS.replace(wrong, changes[wrong]))[:-1], 0) is None


def test_a_drive_ends_in_neutral():
    with board_of(answer=obedient) as board:
        attributes = termios.tcgetattr(board._slave)
        attributes[2] |= termios.HUPCL
        termios.tcsetattr(board._slave, termios.TCSANOW, attributes)
        with pytest.raises(KeyError), ServoLink(board.port) as link:
            assert link.hello == Hello(4, "4.2.0", 7, 0, "reset pin", DEFAULT)
            assert link.arm().state is State.AUTONOMOUS
            number = link.send(1500, 200)
            until(lambda: link.latest().sequence == number)
            assert (link.latest().steering_us, link.latest().throttle_us) == (1500, 200)
            assert 0 <= time.monotonic() - link.latest().host_s < 0.5
            link.send(1456, 120)
            raise KeyError("the loop's fault")
        assert board.heard[-1].startswith(">N 7 ")
        assert ">D 7 2 999 1500 200" in board.heard  # 999: when it sent the status that was heard last
        assert ">D 7 3 999 1456 120" in board.heard  # throttle 0 is a stopped car
        with pytest.raises(LinkError, match="closed"):
            link.send(1500, 200)
        # Its edge, when the port is opened again, resets an Arduino: the human's pulses were gone for up to 2 s.
        assert not termios.tcgetattr(board._slave)[2] & termios.HUPCL


def test_pulses_out_of_range_are_not_sent():
    with board_of(answer=obedient) as board:
        with ServoLink(board.port) as link:
            for bad in ((899, 120), (1456, 712), (1456.0, 120), (None, 120), (True, 120)):
                with pytest.raises(LinkError, match="pulse must be"):
                    link.send(*bad)
            link.send(np.int64(900), np.int64(711))
        until(lambda: board.heard[-1].startswith(">N"))
        assert [b for b in board.heard if b.startswith(">D")] == [">D 7 1 999 900 711"]


@pytest.mark.parametrize(
    ("human", "said"), [("receiver", "5 5.0.0 something else"), ("gamepad", f"4 4.1.1-gamepad 7 0 e {DEFAULT}")]
)
def test_another_firmware_is_refused(human, said):
    """4.1.1 judged a gamepad's sticks after the cap."""
    with board_of(hello=f"<H {said}") as board:
        with pytest.raises(LinkError, match="put the matching firmware on it: make") as error:
            ServoLink(board.port, car=Car(human=human)).open()
        assert error.value.found.startswith(said.split()[1])
        assert board.heard == []


def test_an_arduino_that_is_not_reset_is_asked():
    with board_of(hello=None) as board:
        board.hello = f"<H 4 4.2.0 7 40 p {DEFAULT}"
        threading.Thread(target=needs.keep_sending, args=(lambda: board.say(STATUS), 1.2), daemon=True).start()
        with ServoLink(board.port) as link:
            assert link.hello.sequence == 40 and board.heard[0] == ">Q"


def test_the_arduino_is_told_when_somebody_asked():
    """It counts the age of a request by its own clock, which goes on while this machine is suspended."""
    with board_of(answer=lambda board, body: board.status("M", "r", "e")) as board, ServoLink(board.port) as link:
        asked = link.latest().uptime_ms
        link.request()
        board.status("M", "r", "-", ms=asked + 5000)
        until(lambda: link.latest().uptime_ms == asked + 5000)
        link.request(keep=True)
        with pytest.raises(LinkError, match="too long ago since somebody asked for it"):
            link.arm()
        assert next(b for b in board.heard if b.startswith(">A")).split()[4] == str(asked)
        link.request()
        board.status("M", "r", "-", boot=9)
        board.say(f"<H 4 4.2.0 9 0 w {DEFAULT}")
        until(lambda: link.hello.boot == 9)
        with pytest.raises(LinkError, match="reset since the car was asked for"):
            link.arm()


@pytest.mark.parametrize("of", [{"sequence": 4294967290}, {"boot": 9}])
def test_a_status_that_is_not_of_now_is_no_answer(of):
    other = board_of(answer=lambda board, body: board.status("A", "a", **of))
    with other as board, ServoLink(board.port) as link, pytest.raises(LinkError, match="no answer to arming"):
        link.arm()


def test_what_waited_in_the_port_is_dropped_and_nobody_else_gets_it():
    with board_of(hello="") as board:
        board.hello = f"<H 4 4.2.0 7 0 e {DEFAULT}"
        board.say(f"<H 4 4.2.0 3 99 e {DEFAULT}")  # of before the port was opened
        time.sleep(0.05)
        threading.Timer(0.2, board.greet).start()
        with ServoLink(board.port) as link:
            assert link.hello.boot == 7
            with pytest.raises(serial.SerialException):
                serial.Serial(board.port, exclusive=True)
            excluded = fcntl.ioctl(board._slave, 0x80045440, bytes(4))  # TIOCGEXCL, for programs that lock nothing
            assert int.from_bytes(excluded, "little") == 1


def test_an_unplugged_arduino():
    board = Board(answer=obedient)
    with ServoLink(board.port) as link:
        link.arm()
        board.close()
        with pytest.raises(LinkError, match="still plugged in"):
            needs.keep_sending(lambda: link.send(1500, 200), 1.0)
        with pytest.raises(LinkError, match="still plugged in"):
            link.latest()


def test_a_stuck_port_does_not_stop_the_loop():
    with board_of(answer=obedient) as board, ServoLink(board.port) as link:
        link.arm()
        board.reading = False
        with pytest.raises(LinkError, match="took no data"):  # a write that waits would wait for ever
            for _ in range(20000):
                link.send(1500, 200)
        board.reading = True


def test_silence_is_an_error_and_garbled_lines_are_dropped():
    now = [0.0]
    with board_of(answer=obedient) as board, ServoLink(board.port, clock=lambda: time.monotonic() + now[0]) as link:
        os.write(board.master, b"<S 1 2 3*00000000\n" + b"x" * 1000 + b"\n\n" + frame(STATUS))
        until(lambda: link.latest().sequence == 5)
        assert link.garbled == 2
        now[0] = 0.6
        with pytest.raises(LinkError, match=r"said nothing for 0\.6 s"):
            link.latest()


def test_the_age_of_what_is_not_acknowledged():
    """With a link 2 s behind nothing said so: the host knows how old the oldest command is that nobody has answered."""
    with board_of(answer=obedient) as board, ServoLink(board.port) as link:
        link.arm()
        until(lambda: link.unacknowledged_s(link._clock()) == 0)
        board.answer = lambda board, body: None
        first, second = link.send(1500, 200), link.send(1500, 200)
        assert link.unacknowledged_s(link._clock() + 2) > 2
        board.status("A", "a", sequence=first)
        until(lambda: len(link._unanswered) == 1)
        assert link.unacknowledged_s(link._clock() + 2) > 2  # the second waits too
        board.status("A", "a", sequence=second)
        until(lambda: link.unacknowledged_s(link._clock()) == 0)
        link.send(1500, 200)
        board.hello = f"<H 4 4.2.0 8 0 w {DEFAULT}"  # another start will never answer
        board.say(board.hello)
        until(lambda: link.unacknowledged_s(link._clock()) == 0)
        link.send(1500, 200)
        until(lambda: board.heard[-1] == ">D 8 1 999 1500 200")  # which the Arduino ignores until it is armed again
        assert link.hello.reset == "watchdog"


def test_the_cap_is_lowered():
    def answer(board, body):
        if body[1] == "L":
            board.status(cap_us=min(int(body.split()[3]), 238))

    with board_of(answer=answer) as board, ServoLink(board.port) as link:
        assert link.lower_cap(180).cap_us == 180
        assert link.lower_cap(300).cap_us == 238
        with pytest.raises(LinkError, match="throttle pulse"):
            link.lower_cap(119)
