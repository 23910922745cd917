"""Emulate the rover's Arduino: the real firmware runs in simavr.

A ServoLink opens its serial port, and PinEvents tell what happens on its servo pins.
"""

import contextlib
import functools
import os
import re
import secrets
import struct
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

from balloon_world.child_process import Child
from balloon_world.simulated_arduino import BOOT_S, REST_US, PinEvent
from lab.debian import install_packages, missing_packages
from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.run_program import run

REPOSITORY = Path(__file__).parents[2]
FIRMWARE = REPOSITORY / "firmware"
EMULATOR = Path(__file__).with_name("arduino.c")
NEEDS = {  # commands and files, each with the Debian package that it comes from
    "gcc": "gcc",
    "make": "make",
    "avr-gcc": "gcc-avr",
    "avr-ar": "binutils-avr",
    "/usr/lib/avr/include/avr/io.h": "avr-libc",
    "/usr/share/arduino/hardware/arduino/avr/cores/arduino": "arduino-core-avr",
    "/usr/include/simavr/sim_avr.h": "libsimavr-dev",
    "/usr/include/libelf.h": "libelf-dev",
}
CC = ("gcc", "-O2", "-g", "-Wall", "-Wextra", "-Werror")
WITH_SIMAVR = ("-I/usr/include/simavr", str(EMULATOR), "-lsimavr", "-lelf", "-lutil", "-lm")
LOG_BYTES = 1 << 20  # how much of the pins' events may wait to be read: 20 s of every pulse
START_S = 10.0
NICE = -10  # a real Arduino has a processor of its own


class Built(NamedTuple):
    """The firmware's ELF file, as it is flashed, and the program that is the emulated Arduino."""

    firmware: Path
    program: Path


@functools.cache
def build(human: str = "receiver") -> Built:
    """Return the firmware and the emulated Arduino, from the cache or built now, which takes some seconds.

    human: as in `make -C firmware HUMAN=gamepad`. Raises RoverError for missing Debian packages, unless INSTALL is set.
    """
    install_packages(missing_packages(NEEDS), "the emulated Arduino")
    sources = [EMULATOR, FIRMWARE / "Makefile", *sorted(p for p in (FIRMWARE / "rover").glob("*") if p.is_file())]

    def make(folder: Path) -> None:
        compile_c("make", "-C", FIRMWARE, f"HUMAN={human}", f"BUILD={folder}/firmware")
        compile_c(*CC, "-DPROGRAM", "-o", folder / "arduino", *WITH_SIMAVR)

    key = key_of({"names": [source.name for source in sources], "human": human}, *sources)
    folder = cache_folder("arduino", key, make)
    return Built(folder / "firmware" / "rover.elf", folder / "arduino")


def compile_c(*command: object) -> None:
    """Run a compiler, or make. Raises RoverError with the last lines that it printed."""
    run(*command, error=RoverError, remedy="is this the repository's own source?")


@functools.cache
def symbol(name: str) -> int:
    """Return the address of one of the firmware's functions in flash memory."""
    firmware = build().firmware
    line = re.search(rf"^([0-9a-f]+) \w {name}$", run("avr-nm", firmware, error=RoverError), re.M)
    assert line, f"{firmware}: no function {name}"
    return int(line[1], 16)


def eeprom_of(car: Car, version: int = 1) -> bytes:
    """Return the first bytes of the EEPROM of a board that has kept a car: boot number, version, numbers, CRC-32."""
    return struct.pack("<HB9HI", 0, version, *car.numbers, ~car.id & 0xFFFFFFFF)


def _set_nice(pid: int, nice: int) -> None:
    """Set the priority of a process that leads a session, and that of its session (sched(7)), as far as one may."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, pid, nice)
    with contextlib.suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(f"{nice}\n")


class EmulatedArduino(contextlib.AbstractContextManager["EmulatedArduino"]):
    """The real firmware in simavr, in real time, in its own process, which ends with this one.

    port: for a ServoLink. Opening it resets the Arduino, as with a real one, unless the last user of the port left DTR
    up. pid: of the process.
    """

    def __init__(
        self,
        *,
        every_pulse: bool = True,
        transmitter: tuple[float, float] = (0.0, 0.0),
        ready: bool = False,
        nice: int = 0,
        car: Car | None = None,
    ):
        """every_pulse: whether pulses() returns each pulse, or only those that differ from the one before.

        transmitter: its pulses from the start on. ready: see ready(). nice: scheduling priority, for root. car: whose
        transmitter it is, of which the board does not know yet; None: this_car(), which its EEPROM has kept. Raises
        RoverError as build() does, and if the program does not start.
        """
        built = build()
        # The program makes this link, and removes it even if the present process was killed.
        self.port = str(Path(tempfile.gettempdir()) / f"rover-arduino-{secrets.token_hex(8)}")
        self._reading = threading.Lock()
        self._rest = b""
        options = ["--link", self.port, "--log", "all" if every_pulse else "changes", "--reset-on-open"]
        options += ["--eeprom", "" if car else eeprom_of(this_car()).hex()]
        car = car or this_car()
        options += ["--boot-ms", f"{BOOT_S * 1000:.0f}", "--periods", str(car.numbers[0]), str(car.numbers[4])]
        command = built.program, built.firmware, *options
        self._process = Child("the emulated Arduino", *command, error=RoverError, talks=True)
        self.pid = self._process.pid
        self._process.keep_unread(LOG_BYTES)
        try:
            _set_nice(self.pid, nice)
            deadline = time.monotonic() + START_S
            while not os.path.lexists(self.port):  # not Path.exists, which would follow the link
                if not self._process.running:
                    raise self._process.ended()
                if time.monotonic() > deadline:
                    raise RoverError("the emulated Arduino did not start in time", remedy="is this machine busy?")
                time.sleep(0.005)
            self.transmitter(*transmitter)
            self.ready(ready)
        except BaseException:
            self.close()
            raise

    def __exit__(self, *exc: object) -> None:
        self.close()

    def transmitter(self, steering_us: float, throttle_us: float) -> None:
        """Set the pulses that the receiver gets from the next one on; 0 stands for no signal."""
        self._process.send_line(f"transmitter {steering_us} {throttle_us}")

    def wiggle(self) -> None:
        """Let the human move the steering stick to both sides and let go. It takes 0.14 s, and counts 0.25 s later."""
        self._process.send_line("wiggle")

    def ready(self, ready: bool) -> None:
        """Set whether the human wiggles the stick unasked whenever a car that was not stopped lacks only that."""
        self._process.send_line(f"ready {ready:d}")

    def reset(self) -> None:
        """Press the reset button."""
        self._process.send_line("reset")

    def power(self) -> None:
        """Switch its power off and on again."""
        self._process.send_line("power")

    def unplug(self) -> None:
        """Pull the serial cable out, and plug it in again: who had the port open has to open it anew."""
        self._process.send_line("unplug")

    def hang(self) -> None:
        """Make the firmware's loop() an endless loop until the next reset."""
        self._process.send_line(f"hang {symbol('loop'):x}")

    def pulses(self) -> list[PinEvent]:
        """Return what happened since the last call, ordered by when it ended. RoverError if the process has ended.

        With every_pulse, call it at least every 10 s: what does not fit into the pipe is lost, as a 'lost' event says.
        """
        with self._reading:
            try:
                while data := self._process.read():
                    self._rest += data
            except RoverError:
                if b"\n" not in self._rest:
                    raise
            *lines, self._rest = self._rest.split(b"\n")
        return [
            PinEvent(float(at), kind, pin, float(pulse), float(period))
            for at, kind, pin, pulse, period in (line.decode().split(",") for line in lines)
        ]

    def close(self) -> None:
        """End the process. Raises nothing."""
        with self._reading:
            self._process.close()
        Path(self.port).unlink(missing_ok=True)


BOARD = f"{__name__}:board"  # the board for a VirtualCar, which makes it in its own process


def board() -> EmulatedArduino:
    """Make a virtual car's board with the real firmware, with a ready human and events only for changed pulses."""
    return EmulatedArduino(every_pulse=False, transmitter=REST_US, ready=True, nice=NICE)
