"""The rover's Arduino without a board: the real firmware in simavr, or where that is not to be had a stand-in.

Both are a serial port that a ServoLink opens, and both say what their servo pins do, as PinEvents.
"""

import contextlib
import fcntl
import functools
import os
import pty
import re
import secrets
import select
import shutil
import subprocess
import tempfile
import threading
import time
import tty
import zlib
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.pwm import PwmCalibration
from rover_lib.workshop.cache import cached_folder, key_of

REPOSITORY = Path(__file__).parents[2]
FIRMWARE = REPOSITORY / "firmware"
EMULATOR = REPOSITORY / "emulated" / "arduino.c"
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
BOOT_S = 0.2  # of the boot loader; a board's takes 1 to 2 s
LOG_BYTES = 1 << 20  # of the pins that wait to be read: 20 s of every pulse
START_S = 10.0
STOP_S = 3.0
REST_US = (1456.0, 120.0)  # a transmitter whose sticks nobody touches


class ArduinoError(RoverError):
    """An emulated Arduino that cannot be built or started, or that has ended."""


class PinEvent(NamedTuple):
    """Something on the servo pins, or that explains what they do.

    kind: 'pulse'; 'cut', a pulse that a reset ended; 'line', one of the host came in whole; 'reset', the pins float;
    'open', of the port; 'stall', this machine had no time for the Arduino, pulse_us is for how long; 'lost', so many
    events (pulse_us) that were not read in time. monotonic_s: time.monotonic() at which the pin rose, or it happened.
    pin: 'steering', 'throttle' or ''. period_us: since the pin rose before that, 0 for the first after a reset.
    """

    monotonic_s: float
    kind: str
    pin: str
    pulse_us: float
    period_us: float

    @property
    def end_s(self) -> float:
        """When the pin fell: from then on the servo knows the pulse."""
        return self.monotonic_s + self.pulse_us * 1e-6 if self.pin else self.monotonic_s


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


_NUMBER = r"(0|[1-9][0-9]{0,9})"
_COMMAND = re.compile(rf">(?:Q|([AN]) {_NUMBER} {_NUMBER}|(D) {_NUMBER} {_NUMBER} {_NUMBER} {_NUMBER})", re.ASCII)
_STATUS_S = 0.02
_TIMEOUT_S = 0.150
_SEQUENCE_WINDOW = 65535
_LINE_MAX = 64


class StandIn:
    """A stand-in for the Arduino, for machines without simavr: protocol version 1 of firmware/README.md on a pty.

    It is no firmware and proves nothing about the firmware. Like it, it resets when its port is opened, starts in
    manual with a transmitter at rest, drives only when armed and within range, rejects what is old or another start's,
    and is in neutral 150 ms after the last command, until it is armed again. Unlike it, there is no human who could
    take over, no watchdog, a line may take as long as it likes, and a pulse starts when its command comes.
    """

    def __init__(self, boot_s: float = BOOT_S):
        calibration = PwmCalibration()
        self._channels = (calibration.steering, calibration.throttle)
        self._neutral = tuple(channel.neutral_us for channel in self._channels)
        self._ranges = [(c.pulse_us(c.low), c.pulse_us(c.high)) for c in self._channels]
        self._boot_s = boot_s
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        os.close(slave)  # so that POLLHUP tells whether somebody has the port open
        os.set_blocking(self._master, False)
        self._events: deque[PinEvent] = deque(maxlen=10_000)
        self._pins: tuple[int, ...] = ()
        self._boot = 0
        self._reset()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stand-in Arduino", daemon=True)
        self._thread.start()

    def __enter__(self) -> "StandIn":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def pulses(self) -> list[PinEvent]:
        """What changed on the pins since the last call; at most 10,000 events are kept."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def close(self) -> None:
        """Unplugs it."""
        if not self._closing.is_set():
            self._closing.set()
            self._thread.join()
            os.close(self._master)

    def _reset(self) -> None:
        self._boot = (self._boot + 1) % 65536
        self._sequence = 0
        self._result, self._state, self._reason = "-", "M", "r"
        self._bad = self._old = self._out_of_range = 0
        self._line: bytes | None = None  # what came since a '>'
        self._started = time.monotonic()
        self._commanded = self._status_due = 0.0
        self._pins = ()
        self._event("reset")
        self._set_pins(*self._neutral)

    def _run(self) -> None:
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        is_open = False
        while not self._closing.is_set():
            due = min(self._status_due, self._commanded + _TIMEOUT_S) if self._state == "A" else self._status_due
            wait_s = min(max(due - time.monotonic(), 0.0), _STATUS_S)
            said = dict(poller.poll(wait_s * 1000)).get(self._master, 0)
            was_open, is_open = is_open, not said & select.POLLHUP
            if not is_open:
                self._judge_time()
                time.sleep(0.005)
                continue
            if not was_open:
                self._event("open")
                self._reset()
                self._closing.wait(self._boot_s)
                self._read()  # the boot loader has it
                self._started = time.monotonic()
                self._say("")  # ends a line that the reset cut
                self._hello("e")
            self._judge_time()
            for byte in self._read():
                self._take(byte)
            if time.monotonic() >= self._status_due:
                self._status()

    def _read(self) -> bytes:
        try:
            return os.read(self._master, 4096)
        except OSError:  # nothing there, or just closed
            return b""

    def _say(self, body: str) -> None:
        line = f"{body}*{zlib.crc32(body.encode()):08X}\n" if body else "\n"
        with contextlib.suppress(OSError):  # what nobody reads is lost, as on a wire
            os.write(self._master, line.encode())

    def _hello(self, reset: str = "-") -> None:
        self._say(f"<H 1 stand-in {self._boot} {self._sequence} {reset}")

    def _status(self) -> None:
        now = time.monotonic()
        self._status_due = now + _STATUS_S
        uptime_ms = int((now - self._started) * 1000) % (1 << 32)
        receiver = " ".join(
            f"{us} {channel.period_us}" for us, channel in zip(self._neutral, self._channels, strict=True)
        )
        self._say(
            f"<S {self._boot} {uptime_ms} {self._sequence} {self._result} {self._state} {self._reason} "
            f"{self._pins[0]} {self._pins[1]} {receiver} {self._bad} {self._old} {self._out_of_range} 0"
        )

    def _take(self, byte: int) -> None:
        if byte == ord(">"):
            self._bad += bool(self._line)
            self._line = b">"
        elif byte == ord("\n"):
            line, self._line = self._line, None
            if line is not None:
                self._command(line)
        elif self._line is not None:
            self._line += bytes([byte])
            if len(self._line) > _LINE_MAX:
                self._bad += 1
                self._line = None

    def _command(self, line: bytes) -> None:
        body, _, crc = line.rpartition(b"*")
        found = _COMMAND.fullmatch(body.decode("ascii", "replace"))
        if not found or crc != b"%08X" % zlib.crc32(body):
            self._bad += 1
            return
        if body == b">Q":
            self._hello()
            return
        kind = found[1] or found[4]
        boot, sequence, *pulses = (int(number) for number in found.groups() if number and number.isdigit())
        if boot != self._boot or not 1 <= (sequence - self._sequence) % (1 << 32) <= _SEQUENCE_WINDOW:
            self._old += 1
            self._result = "o"
        else:
            self._sequence = sequence
            self._result = self._obey(kind, pulses)
        self._status()

    def _obey(self, kind: str, pulses: list[int]) -> str:
        now = time.monotonic()
        if kind == "A":
            if self._state != "A":  # a host that repeats itself renews nothing
                self._commanded = now
                self._enter("A", "a")
            return "k"
        if kind == "D" and not all(low <= us <= high for us, (low, high) in zip(pulses, self._ranges, strict=True)):
            self._out_of_range += 1
            return "r"
        if self._state != "A":
            return "i"
        if kind == "N":
            self._enter("S", "n")
        else:
            self._commanded = now
            self._set_pins(*pulses)
        return "k"

    def _judge_time(self) -> None:
        if self._state == "A" and time.monotonic() - self._commanded >= _TIMEOUT_S:
            self._enter("S", "t")

    def _enter(self, state: str, reason: str) -> None:
        self._state, self._reason = state, reason
        self._set_pins(*self._neutral)

    def _set_pins(self, *pulses: int) -> None:
        for i, channel in enumerate(self._channels):
            if not self._pins or pulses[i] != self._pins[i]:
                self._event("pulse", channel.name, pulses[i], channel.period_us)
        self._pins = pulses

    def _event(self, kind: str, pin: str = "", *measured: Any) -> None:
        pulse_us, period_us = measured or (0.0, 0.0)
        self._events.append(PinEvent(time.monotonic(), kind, pin, float(pulse_us), float(period_us)))
