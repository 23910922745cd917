"""Arduinos without a board: what goes for both, what only the real firmware does, and the rules of the stand-in."""

import fcntl
import functools
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import needs
import pytest
import serial
from uno import body_of, line, status_of

from lab.arduino import emulator as arduino
from lab.arduino.emulator import Arduino, ArduinoError
from rover_lib.onboard.pwm import ARDUINO_STEP_US, PwmCalibration
from rover_lib.onboard.servo_link import ServoLink, State
from rover_lib.world.standin import REST_US, StandIn

until = functools.partial(needs.until, seconds=3.0)
with_firmware = [pytest.mark.emulated, needs.simavr]
KINDS = ["stand-in", pytest.param("firmware", marks=with_firmware)]


@pytest.fixture
def emulated():
    with Arduino(transmitter=REST_US) as board:
        yield board


@pytest.fixture(params=KINDS)
def board(request):
    kind = {"stand-in": StandIn, "firmware": lambda: Arduino(transmitter=REST_US, every_pulse=False)}[request.param]
    with kind() as board:
        yield board


def arm(link):
    until(lambda: link.latest() and link.latest().receiver_steering_us and link.latest().receiver_throttle_us)
    return link.arm()


def drive(link, seconds, steering=0.4, throttle=0.3):
    needs.keep_sending(lambda: link.send_action(steering, throttle), seconds)


def test_a_link_arms_drives_and_stops(board):
    sent = PwmCalibration().pulses(0.4, 0.3)
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
        link.send_action(0.4, 0.3)  # latched
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
        assert all(min(abs(us - wanted), abs(us - neutral)) <= ARDUINO_STEP_US for us in widths), widths
        assert abs(widths[0] - wanted) <= ARDUINO_STEP_US
        assert abs(widths[-1] - neutral) <= ARDUINO_STEP_US
    fell = max(e.end_s for e in events if e.pin == "throttle")
    assert 0.1 < fell - stopped < 0.4


def test_opening_the_port_again_resets_it(board):
    with ServoLink(board.port) as link:
        arm(link)
        boot = link.hello.boot
    time.sleep(0.1)  # it looks at its port now and then: a port that is opened at once again was never closed
    with ServoLink(board.port) as link:
        assert link.hello.boot == boot + 1
        until(lambda: link.latest())
        assert link.latest().state is State.MANUAL
    assert [e.kind for e in board.pulses() if e.kind in ("open", "reset")][-4:] == ["open", "reset"] * 2


# ---- the stand-in's rules: no line but the right one moves a pin


class Raw:
    """The stand-in's port, without a link."""

    def __init__(self, board):
        self.port = serial.Serial(board.port, timeout=1)
        hello = next(body for body in iter(self.read, None) if body.startswith("<H"))
        self.boot, self.sequence = int(hello.split()[3]), int(hello.split()[4])

    def read(self):
        while True:
            if body := body_of(self.port.readline()[:-1]):
                return body

    def say(self, text):
        """What the status says after it."""
        self.port.reset_input_buffer()
        self.port.write(text)
        time.sleep(0.03)
        self.port.reset_input_buffer()
        self.port.readline()
        return status_of(next(body for body in iter(self.read, None) if body.startswith("<S")))

    def command(self, kind, *values):
        self.sequence += 1
        return line(f">{kind} {' '.join(map(str, (self.boot, self.sequence, *values)))}")


@pytest.fixture
def raw():
    with StandIn() as board:
        raw = Raw(board)
        yield raw
        raw.port.close()


def test_the_stand_in_ignores_what_the_firmware_ignores(raw):
    assert raw.say(raw.command("D", 1500, 200)).result == "i"
    arming = raw.command("A")
    assert raw.say(arming).state == "A"
    old = raw.command("D", 1500, 200)
    status = raw.say(old)
    assert (status.result, status.steering_us, status.throttle_us) == ("k", 1500, 200)
    status = raw.say(old)
    assert (status.result, status.old) == ("o", 1)
    raw.boot += 1
    assert raw.say(raw.command("D", 1900, 600)).old == 2
    raw.boot -= 1
    for bad in (b">D 1 2 3\n", old.replace(b"1500", b"1900"), old[:9] + old, line(">D 1 99"), b">" + b"x" * 80 + b"\n"):
        raw.say(raw.command("D", 1500, 200))
        assert raw.say(bad).throttle_us in (200, 120)
    status = raw.say(b"")
    assert status.bad == 5
    for pulses in ((899, 200), (2013, 200), (1500, 119), (1500, 712)):
        raw.say(raw.command("A"))
        assert raw.say(raw.command("D", *pulses)).result == "r"
    raw.say(raw.command("A"))
    status = raw.say(raw.command("N"))
    assert (status.state, status.reason, status.throttle_us) == ("S", "n", 120)
    time.sleep(0.2)
    assert raw.say(arming).state == "S"  # replayed


def test_an_out_of_range_command_is_no_sign_of_life(raw):
    raw.say(raw.command("A"))
    end = time.monotonic() + 0.25
    while time.monotonic() < end:
        raw.port.write(raw.command("D", 1500, 900))
        time.sleep(0.02)
    assert raw.say(b"").reason == "t"


def test_unplugging_the_stand_in(raw):
    board = StandIn()
    board.close()
    board.close()
    assert not Path(board.port).exists()


# ---- the real firmware


@pytest.mark.parametrize("name", ["gcc-avr", "libsimavr-dev"])
def test_missing_packages_are_named_with_the_command(monkeypatch, name):
    monkeypatch.setitem(arduino.PACKAGES, name, lambda: None)
    with pytest.raises(ArduinoError, match=rf"{name}, which are not here: sudo apt-get install .*{name}"):
        arduino.build.__wrapped__()


def test_without_a_checkout(monkeypatch, tmp_path):
    monkeypatch.setattr(arduino, "PACKAGES", {})
    monkeypatch.setattr(arduino, "FIRMWARE", tmp_path / "firmware")
    with pytest.raises(ArduinoError, match="needs a checkout"):
        arduino.build.__wrapped__()


class TestFirmware:
    pytestmark = with_firmware

    def test_it_is_built_once(self):
        first = arduino.build.__wrapped__()
        made = first.program.stat().st_mtime_ns
        assert arduino.build.__wrapped__() == first
        assert first.program.stat().st_mtime_ns == made

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

    def test_of_steady_pins_only_changes(self):
        with Arduino(transmitter=REST_US, every_pulse=False) as board:
            time.sleep(0.3)
            board.pulses()
            time.sleep(0.3)
            assert len(board.pulses()) < 40  # what is measured of the transmitter wavers by a step
            board.transmitter(1700, 300)
            time.sleep(0.2)
            assert {round(e.pulse_us / 100) for e in board.pulses() if e.kind == "pulse"} >= {17, 3}

    def test_transmitter_reset_and_hang(self, emulated):
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

    def test_a_log_that_nobody_reads_is_lost_and_holds_nothing_up(self):
        with Arduino(transmitter=REST_US) as board:
            fcntl.fcntl(board._process.stdout.fileno(), fcntl.F_SETPIPE_SZ, 4096)
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
        with Arduino(nice=nice) as board:
            assert os.getpriority(os.PRIO_PROCESS, board.pid) == nice

    def test_when_it_has_ended(self, emulated):
        os.kill(emulated.pid, signal.SIGKILL)
        with pytest.raises(ArduinoError, match=r"has ended \(exit status -9"):
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
            "import os, time; from lab.arduino.emulator import Arduino; board = Arduino()\n"
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
            until(lambda: gone(pid), seconds=2)
            assert not os.path.lexists(port)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(parent.pid, signal.SIGKILL)
            parent.stdout.close()


def gone(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.emulated
@needs.simavr
def test_a_slow_arduino_is_the_same_by_its_own_clock():
    with Arduino(transmitter=REST_US, slow=4) as board:
        time.sleep(1.2)
        pulses = [e for e in board.pulses() if e.pin == "steering" and e.kind == "pulse"][2:]
    assert len(pulses) >= 6
    assert all(abs(e.period_us - 21316) < 2 for e in pulses)
    apart_s = [b.monotonic_s - a.monotonic_s for a, b in pairwise(pulses)]
    assert sorted(apart_s)[len(apart_s) // 2] == pytest.approx(4 * 0.021316, rel=0.01)
