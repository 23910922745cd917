"""The rover's Arduino without a board: the real firmware in simavr.

It is a serial port that a ServoLink opens, and says what its servo pins do, as PinEvents.
"""

import contextlib
import fcntl
import functools
import os
import re
import secrets
import shutil
import subprocess
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.cache import cached_folder, key_of
from rover_lib.world.standin import BOOT_S, REST_US, PinEvent

REPOSITORY = Path(__file__).parents[2]
FIRMWARE = REPOSITORY / "firmware"
EMULATOR = Path(__file__).with_name("arduino.c")
PACKAGES = {  # Debian's, and what shows that each is there
    "gcc": lambda: shutil.which("gcc"),
    "make": lambda: shutil.which("make"),
    "gcc-avr": lambda: shutil.which("avr-gcc"),
    "binutils-avr": lambda: shutil.which("avr-ar"),
    "avr-libc": lambda: Path("/usr/lib/avr/include/avr/io.h").exists(),
    "arduino-core-avr": lambda: Path("/usr/share/arduino/hardware/arduino/avr/cores/arduino").exists(),
    "libsimavr-dev": lambda: Path("/usr/include/simavr/sim_avr.h").exists(),
    "libelf-dev": lambda: Path("/usr/include/libelf.h").exists(),
}
CC = ("gcc", "-O2", "-g", "-Wall", "-Wextra", "-Werror")
WITH_SIMAVR = ("-I/usr/include/simavr", str(EMULATOR), "-lsimavr", "-lelf", "-lutil", "-lm")
LOG_BYTES = 1 << 20  # of the pins that wait to be read: 20 s of every pulse
START_S = 10.0
STOP_S = 3.0


class ArduinoError(RoverError):
    """An emulated Arduino that cannot be built or started, or that has ended."""


class Built(NamedTuple):
    """The firmware as it is flashed, an ELF file, and the emulated Arduino, a program."""

    firmware: Path
    program: Path


def missing_packages() -> list[str]:
    """Debian packages that the emulated Arduino needs and this machine lacks."""
    return [name for name, there in PACKAGES.items() if not there()]


@functools.cache
def build() -> Built:
    """Firmware and emulated Arduino, from the cache or made now (some seconds).

    Raises ArduinoError where Debian packages or the repository's sources are missing, or the compiler complains.
    """
    if missing := missing_packages():
        raise ArduinoError(
            f"the emulated Arduino needs the Debian packages {' '.join(missing)}, which are not here: "
            f"sudo apt-get install --no-install-recommends {' '.join(missing)}"
        )
    sources = [EMULATOR, FIRMWARE / "Makefile", *sorted(p for p in (FIRMWARE / "rover").glob("*") if p.is_file())]
    if not all(source.is_file() for source in sources):
        raise ArduinoError(f"no firmware in {FIRMWARE}: the emulated Arduino needs a checkout of the repository")

    def make(folder: Path) -> None:
        call("make", "-C", FIRMWARE, f"BUILD={folder}/firmware")
        call(*CC, "-DPROGRAM", "-o", folder / "arduino", *WITH_SIMAVR)

    folder = cached_folder("arduino", key_of({"names": [source.name for source in sources]}, *sources), make)
    return Built(folder / "firmware" / "rover.elf", folder / "arduino")


@functools.cache
def symbol(name: str) -> int:
    """Flash address of a function of the firmware."""
    found = re.search(rf"^([0-9a-f]+) \w {name}$", call("avr-nm", build().firmware), re.M)
    if not found:
        raise ArduinoError(f"{build().firmware}: the firmware has no function {name}")
    return int(found[1], 16)


def call(*command: object) -> str:
    """Run a command, return what it said. Raises ArduinoError with the end of its complaint if it fails."""
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True)
    if done.returncode:
        said = " | ".join((done.stderr or done.stdout).strip().splitlines()[-3:])
        raise ArduinoError(f"{command[0]} failed ({said}): is this the repository's own source?")
    return done.stdout


class Arduino:
    """The real firmware in simavr, in real time, as a process of its own that ends with this one.

    port: for a ServoLink. Opening it resets the Arduino, as a real one's. pid: of the process.
    """

    def __init__(
        self,
        *,
        every_pulse: bool = True,
        transmitter: tuple[float, float] = (0.0, 0.0),
        boot_s: float = BOOT_S,
        nice: int = 0,
        slow: float = 1.0,
    ):
        """every_pulse: pulses() has each pulse, a thousand a second; otherwise those that differ from the one before.

        transmitter: its pulses from the start on, see transmitter(). nice: scheduling priority; a real Arduino has a
        processor of its own, -10 comes near that (below 0 only for root, silently left out for others). slow: its
        clock runs so many times slower than this machine's: pulses are by its own, monotonic_s by this machine's.
        Raises ArduinoError as build() does, and if the program does not start.
        """
        built = build()
        # A link that the program makes, and removes even where this process was killed.
        self.port = str(Path(tempfile.gettempdir()) / f"rover-arduino-{secrets.token_hex(8)}")
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115, open as long as the process
        self._reading = threading.Lock()
        self._rest = b""
        log = "all" if every_pulse else "changes"
        command = [built.program, built.firmware, "--link", self.port, "--log", log, "--reset-on-open"]
        self._process = subprocess.Popen(
            [*command, "--boot-ms", f"{boot_s * 1000:.0f}", "--slow", f"{slow:g}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            bufsize=0,
            start_new_session=True,  # a terminal's ^C is not for it
        )
        self.pid = self._process.pid
        os.set_blocking(self._process.stdout.fileno(), False)
        fcntl.fcntl(self._process.stdout.fileno(), fcntl.F_SETPIPE_SZ, LOG_BYTES)
        try:
            with contextlib.suppress(PermissionError):
                os.setpriority(os.PRIO_PROCESS, self.pid, nice)
            end = time.monotonic() + START_S
            while not os.path.lexists(self.port):  # Path.exists would follow the link
                self._check()
                if time.monotonic() > end:
                    raise ArduinoError(
                        f"the emulated Arduino did not start within {START_S:g} s: is this machine busy?"
                    )
                time.sleep(0.005)
            self.transmitter(*transmitter)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Arduino":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def transmitter(self, steering_us: float, throttle_us: float) -> None:
        """The pulses that the receiver gets, from the next on; 0 is no signal."""
        self._tell(f"transmitter {steering_us} {throttle_us}")

    def reset(self) -> None:
        """The reset button."""
        self._tell("reset")

    def hang(self) -> None:
        """The firmware's loop() becomes an endless one, until the next reset."""
        self._tell(f"hang {symbol('loop'):x}")

    def pulses(self) -> list[PinEvent]:
        """What happened since the last call, in the order of its end.

        With every_pulse call it every 10 s at least: what does not fit the pipe is lost, and 'lost' then says how much.
        Raises ArduinoError if the process has ended.
        """
        with self._reading:
            data, ended = self._rest, False
            with contextlib.suppress(BlockingIOError):
                while more := self._read():
                    data += more
                ended = True
            *lines, self._rest = data.split(b"\n")
        if ended and not lines:
            raise self._ended()
        return [
            PinEvent(float(at), kind, pin, float(pulse), float(period))
            for at, kind, pin, pulse, period in (line.decode().split(",") for line in lines)
        ]

    def close(self) -> None:
        """Ends the process. Raises nothing."""
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        with self._reading:
            self._process.stdout.close()
        self._errors.close()
        Path(self.port).unlink(missing_ok=True)

    def _read(self) -> bytes:
        """b"" when it has ended; BlockingIOError while it has nothing to say."""
        return b"" if self._process.stdout.closed else os.read(self._process.stdout.fileno(), 1 << 16)

    def _tell(self, text: str) -> None:
        try:
            self._process.stdin.write(f"{text}\n".encode())
        except (OSError, ValueError):
            raise self._ended() from None

    def _check(self) -> None:
        if self._process.poll() is not None:
            raise self._ended()

    def _ended(self) -> ArduinoError:
        if self._errors.closed:
            return ArduinoError("the emulated Arduino was closed: make a new one")
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(STOP_S)
        self._errors.seek(0)
        said = self._errors.read()[-500:].decode(errors="replace").strip().replace("\n", " | ")
        return ArduinoError(
            f"the emulated Arduino has ended (exit status {self._process.returncode}, it said: {said}): start a new one"
        )


NICE = -10  # a real Arduino has a processor of its own
BOARD = f"{__name__}:board"  # for a VirtualCar, which makes it in its own process


def board() -> Arduino:
    """The real firmware as a virtual car's board: a transmitter at rest, and only pulses that changed are read."""
    return Arduino(every_pulse=False, transmitter=REST_US, nice=NICE)
