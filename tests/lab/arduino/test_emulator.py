"""Arduinos without a board: what goes for the stand-in too, and what only the real firmware does."""

import fcntl
import os
import signal
import subprocess
import sys
import termios
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import needs
import pytest
import serial
from needs import ended, until

from balloon_world.simulated_arduino import REST_US, StandIn
from lab.arduino import emulator as arduino
from lab.arduino.emulator import NICE, ArduinoError, EmulatedArduino, board
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US, PwmCalibration
from rover_lib.onboard.car.servo_link import ServoLink, State

with_firmware = [pytest.mark.emulated, needs.simavr]
BOARDS = [pytest.param(StandIn, id="stand-in"), pytest.param(board, id="firmware", marks=with_firmware)]


@pytest.fixture
def emulated():
    with EmulatedArduino(transmitter=REST_US, ready=True, nice=NICE) as board:
        yield board


def arm(link):
    until(lambda: link.latest().missing == "-")
    return link.arm()


def drive(link, seconds, steering=0.1, throttle=0.1):
    needs.keep_sending(lambda: link.send_action(steering, throttle), seconds)


@pytest.mark.parametrize("kind", BOARDS)
@needs.real_time
def test_a_link_arms_drives_and_stops(kind):
    with kind() as board:
        sent = PwmCalibration().pulses(0.1, 0.1)
        with ServoLink(board.port) as link:
            assert link.hello.reset == "reset pin"
            assert arm(link).why == "autonomous: armed by the host"
            armed = time.monotonic()
            drive(link, 0.3)
            assert (link.latest().steering_us, link.latest().throttle_us) == (sent.steering_us, sent.throttle_us)
            stopped = time.monotonic()
            until(lambda: link.latest().state is not State.AUTONOMOUS)
            assert link.latest().why == "stopped: no valid command for 150 ms"
            assert time.monotonic() - stopped > 0.1
            time.sleep(0.05)
            link.send_action(0.1, 0.1)  # latched
            time.sleep(0.1)
            assert (link.latest().state, link.latest().result) == (State.STOPPED, "i")
            assert (link.latest().steering_us, link.latest().throttle_us) == (1456, 120)
            assert link.resets == link.latest().bad_lines == link.latest().old_commands == 0
            assert link.round_trip_s() < 0.2
        events = [e for e in board.pulses() if e.monotonic_s > armed and e.kind == "pulse"]
        for pin, wanted, neutral in (("steering", sent.steering_us, 1456), ("throttle", sent.throttle_us, 120)):
            widths = [e.pulse_us for e in events if e.pin == pin]
            if abs(widths[0] - neutral) <= ARDUINO_STEP_US:
                widths = widths[1:]  # it began between arming and the first command
            assert len(widths) >= 2
            low, high = neutral - ARDUINO_STEP_US, wanted + ARDUINO_STEP_US
            assert all(low <= us <= high for us in widths), widths  # between the two: on its way
            assert any(abs(us - wanted) <= ARDUINO_STEP_US for us in widths)
            assert abs(widths[-1] - neutral) <= ARDUINO_STEP_US
        fell = max(e.end_s for e in events if e.pin == "throttle")
        assert 0.1 < fell - stopped < 0.4


@pytest.mark.parametrize("kind", BOARDS)
@needs.real_time
def test_opening_the_port_again_does_not_reset_it(kind):
    """As it did: the human's pulses were gone for the boot loader's time."""
    with kind() as board:
        with ServoLink(board.port) as link:
            arm(link)
            boot = link.hello.boot
        time.sleep(0.1)  # it looks at its port now and then: a port that is opened at once again was never closed
        with ServoLink(board.port) as link:
            assert (link.hello.boot, link.latest().state) == (boot, State.STOPPED)
            arm(link)
        events = [e.kind for e in board.pulses() if e.kind in ("open", "reset")]
        assert events[-3:] == ["open", "reset", "open"]


@pytest.mark.parametrize("kind", BOARDS)
@needs.real_time
def test_a_program_that_lets_dtr_fall_resets_it(kind):
    with kind() as board:
        with ServoLink(board.port) as link:
            boot = link.hello.boot
        time.sleep(0.1)
        with serial.Serial(board.port) as port:
            attributes = termios.tcgetattr(port.fileno())
            attributes[2] |= termios.HUPCL
            termios.tcsetattr(port.fileno(), termios.TCSANOW, attributes)
            time.sleep(0.1)
        time.sleep(0.1)
        with ServoLink(board.port) as link:
            assert link.hello.boot == boot + 1


# ---- the real firmware


@pytest.mark.parametrize("name", ["gcc-avr", "libsimavr-dev"])
def test_missing_packages_are_named_with_the_command(monkeypatch, name):
    monkeypatch.setitem(arduino.NEEDS, "/nowhere", name)
    with pytest.raises(ArduinoError, match=rf"{name}.*, which are not here; sudo apt-get install .*{name}"):
        arduino.build.__wrapped__()


def test_without_a_checkout(monkeypatch, tmp_path):
    monkeypatch.setattr(arduino, "NEEDS", {})
    monkeypatch.setattr(arduino, "FIRMWARE", tmp_path / "firmware")
    with pytest.raises(ArduinoError, match="needs a checkout"):
        arduino.build.__wrapped__()


class TestFirmware:
    pytestmark = with_firmware

    @needs.real_time
    def test_every_pulse_is_there(self, emulated):
        time.sleep(0.1)
        emulated.pulses()
        time.sleep(0.5)
        events = emulated.pulses()
        for pin, period_us, width_us in (("throttle", 1016, 120), ("steering", 21316, 1456)):
            pulses = [e for e in events if e.kind == "pulse" and e.pin == pin]
            if not any(e.kind == "stall" for e in events):
                assert len(pulses) == pytest.approx(0.5e6 / period_us, abs=0.05e6 / period_us + 1)
                rises = [e.monotonic_s for e in pulses]
                assert all(abs((b - a) * 1e6 - period_us) < 2 for a, b in pairwise(rises))
            assert all(abs(e.pulse_us - width_us) <= ARDUINO_STEP_US for e in pulses)
        assert 0 <= time.monotonic() - events[-1].end_s < 0.2

    @needs.real_time
    def test_of_steady_pins_only_changes(self):
        with EmulatedArduino(transmitter=REST_US, every_pulse=False) as board:
            time.sleep(0.3)
            board.pulses()
            time.sleep(0.3)
            assert len(board.pulses()) < 40  # what is measured of the transmitter wavers by a step
            board.transmitter(1700, 300)
            time.sleep(0.2)
            assert {round(e.pulse_us / 100) for e in board.pulses() if e.kind == "pulse"} >= {17, 3}

    @needs.real_time
    def test_transmitter_reset_and_hang(self, emulated):
        time.sleep(0.3)  # its throttle was at rest
        emulated.transmitter(1700, 300)
        until(lambda: any(abs(e.pulse_us - 300) <= 4 for e in emulated.pulses() if e.pin == "throttle"))
        emulated.reset()
        seen = []
        until(lambda: seen.extend(emulated.pulses()) or any(e.kind == "reset" for e in seen))
        emulated.hang()
        hung, seen = time.monotonic(), []
        until(lambda: seen.extend(emulated.pulses()) or any(e.kind == "reset" for e in seen))
        reset_s = next(e.monotonic_s for e in seen if e.kind == "reset")
        assert 0.03 < reset_s - hung < 0.2

    @needs.real_time
    def test_a_log_that_nobody_reads_is_lost_and_holds_nothing_up(self):
        with EmulatedArduino(transmitter=REST_US, ready=True) as board:
            fcntl.fcntl(board._process.process.stdout, fcntl.F_SETPIPE_SZ, 4096)
            with ServoLink(board.port) as link:
                arm(link)
                drive(link, 0.5)
                assert link.latest().state is State.AUTONOMOUS
                board.pulses()
                time.sleep(0.05)
                lost = [e for e in board.pulses() if e.kind == "lost"]
            assert len(lost) == 1
            assert lost[0].pulse_us > 200

    def test_priority(self):
        nice = -10 if os.geteuid() == 0 else os.getpriority(os.PRIO_PROCESS, 0) + 1  # only root may raise it
        with EmulatedArduino(nice=nice) as board:
            assert os.getpriority(os.PRIO_PROCESS, board.pid) == nice
            session = Path(f"/proc/{board.pid}/autogroup")
            assert os.geteuid() != 0 or not session.exists() or session.read_text().split()[-1] == str(nice)

    def test_when_it_has_ended(self, emulated):
        os.kill(emulated.pid, signal.SIGKILL)
        with pytest.raises(ArduinoError, match=r"has ended \(exit status -9\)"):
            until(lambda: emulated.pulses() and False)
        with pytest.raises(ArduinoError, match="has ended"):
            emulated.reset()
        emulated.close()
        emulated.close()
        with pytest.raises(ArduinoError, match="was closed"):
            emulated.pulses()
        assert not os.path.lexists(emulated.port)

    def test_it_ends_with_its_parent(self):
        """Also where a sister that was forked keeps the pipe open."""
        program = (
            "import os, time; from lab.arduino.emulator import EmulatedArduino; board = EmulatedArduino()\n"
            "if os.fork() == 0: time.sleep(5); os._exit(0)\n"
            "print(board.pid, board.port, flush=True); time.sleep(30)"
        )
        parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, start_new_session=True)
        try:
            pid, port = parent.stdout.readline().decode().split()
            pid = int(pid)
            os.kill(pid, 0)
            assert os.path.lexists(port)
            parent.kill()
            parent.wait()
            until(lambda: ended(pid))
            assert not os.path.lexists(port)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(parent.pid, signal.SIGKILL)
            parent.stdout.close()


@pytest.mark.emulated
@needs.simavr
@needs.real_time
def test_a_slow_arduino_is_the_same_by_its_own_clock():
    with EmulatedArduino(transmitter=REST_US, slow=4) as board:
        time.sleep(1.2)
        pulses = [e for e in board.pulses() if e.pin == "steering" and e.kind == "pulse"][2:]
    assert len(pulses) >= 6
    assert all(abs(e.period_us - 21316) < 2 for e in pulses)
    apart_s = [b.monotonic_s - a.monotonic_s for a, b in pairwise(pulses)]
    assert sorted(apart_s)[len(apart_s) // 2] == pytest.approx(4 * 0.021316, rel=0.01)
