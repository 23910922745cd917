"""The stand-in's rules: no line but the right one moves a pin. What goes for the firmware too is in test_emulator."""

import contextlib
import time

import needs
import pytest
import serial
from uno import body_of, line, status_of

from balloon_world.simulated_arduino import StandIn
from rover_lib.onboard.car.car import Car


class Raw:
    """The stand-in's port, without a link."""

    def __init__(self, board):
        self.port = serial.Serial(board.port, timeout=1)
        hello = next(body for body in iter(self.read, None) if body.startswith("<H"))
        self.boot, self.sequence = int(hello.split()[3]), int(hello.split()[4])
        self.send(b"")

    def read(self):
        while True:
            if body := body_of(self.port.readline()[:-1]):
                return body

    def send(self, text):
        """What the status says after it."""
        self.port.reset_input_buffer()
        self.port.write(text)
        time.sleep(0.03)
        self.port.reset_input_buffer()
        self.port.readline()
        status = status_of(next(body for body in iter(self.read, None) if body.startswith("<S")))
        self.heard_ms = status.uptime_ms
        return status

    def command(self, kind, *values):
        self.sequence += 1
        dated = (self.heard_ms,) if kind in "AD" else ()
        dated += (self.heard_ms, Car().id) if kind == "A" else ()
        return line(f">{kind} {' '.join(map(str, (self.boot, self.sequence, *dated, *values)))}")


@contextlib.contextmanager
def opened():
    with StandIn() as board:
        raw = Raw(board)
        yield raw
        raw.port.close()


@pytest.mark.slow
@needs.real_time
def test_the_stand_in_ignores_what_the_firmware_ignores():
    with opened() as raw:
        assert raw.send(raw.command("D", 1500, 200)).result == "i"
        arming = raw.command("A")
        assert raw.send(arming).state == "A"
        old = raw.command("D", 1500, 200)
        status = raw.send(old)
        assert (status.result, status.steering_us, status.throttle_us) == ("k", 1500, 200)
        status = raw.send(old)
        assert (status.result, status.old) == ("o", 1)
        raw.boot += 1
        assert raw.send(raw.command("D", 1900, 600)).old == 2
        raw.boot -= 1
        for bad in (
            b">D 1 2 3\n",
            old.replace(b"1500", b"1900"),
            old[:9] + old,
            line(">D 1 99"),
            b">" + b"x" * 80 + b"\n",
        ):
            raw.send(raw.command("D", 1500, 200))
            assert raw.send(bad).throttle_us in (200, 120)
        status = raw.send(b"")
        assert status.bad == 5
        for pulses in ((899, 200), (2013, 200), (1500, 119), (1500, 712)):
            raw.send(raw.command("A"))
            assert raw.send(raw.command("D", *pulses)).result == "r"
        raw.send(raw.command("A"))
        status = raw.send(raw.command("N"))
        assert (status.state, status.reason, status.throttle_us) == ("S", "n", 120)
        time.sleep(0.2)
        assert raw.send(arming).state == "S"  # replayed


@needs.real_time
def test_an_out_of_range_command_is_no_sign_of_life():
    with opened() as raw:
        raw.send(raw.command("A"))
        end = time.monotonic() + 0.25
        while time.monotonic() < end:
            raw.port.write(raw.command("D", 1500, 900))
            time.sleep(0.02)
        assert raw.send(b"").reason == "t"
