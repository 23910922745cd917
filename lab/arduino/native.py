"""Compile the firmware's parser and state machine as a library for this machine, and run a board in virtual time.

The sources are firmware/rover/protocol.c and vehicle.c as they are flashed. What surrounds them on the chip (timers,
captures, the serial line) is replaced by a few lines here; use the emulator to test that. A second of virtual time
takes some 10 ms.
"""

import ctypes
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lab.arduino.emulator import CC, FIRMWARE, compile_c
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.servo_link import Hello, Telemetry, frame, parse
from rover_lib.workshop.cache import cache_folder, key_of

SOURCES = (FIRMWARE / "rover" / "protocol.c", FIRMWARE / "rover" / "vehicle.c")
STEERING, THROTTLE = range(2)
READ_COMMAND, READ_BAD = 1, 2
WIGGLE_US = (1750, 1750, 1750, 1150, 1150, 1150)  # the stick's pulses, 21 ms apart
LET_GO_MS = 1050  # a little longer than the firmware wants the stick to rest after a wiggle


TYPES: dict[str, Any] = {
    **{"char": ctypes.c_char, "bool": ctypes.c_bool},
    **{"u8": ctypes.c_uint8, "u16": ctypes.c_uint16, "u32": ctypes.c_uint32},
}


def _struct(name: str, members: str) -> type[ctypes.Structure]:
    """Make a C struct of the firmware's, and a type of that name. members: such as 'u8 a b; u16 c[2]; bool d'."""
    fields = []
    for kind, *names in (member.split() for member in members.split(";")):
        for field, _, n in (each.rstrip("]").partition("[") for each in names):
            fields.append((field, TYPES[kind] * int(n) if n else TYPES[kind]))
    TYPES[name] = type(name, (ctypes.Structure,), {"_fields_": fields})
    return TYPES[name]


# As in protocol.h
Command = _struct(
    "Command", "char kind; u32 boot sequence heard_ms steering_us throttle_us asked_ms car; u16 numbers[9]"
)
Reader = _struct("Reader", "char line[87]; u8 length; bool noise; u32 started_ms")
Line = _struct("Line", "char text[128]; u8 length")
# As in vehicle.h
CarNumbers = _struct("CarNumbers", "u16 numbers[9]")
Received = _struct("Received", "u16 pulse_us period_us; u32 at_ms[8]; u8 oldest seen; bool present")
Moment = _struct("Moment", "bool seen; u32 at_ms")
Vehicle = _struct(
    "Vehicle",
    "char state reason result; CarNumbers car; u32 car_id; bool car_told; u16 boot; u32 sequence;"
    "u16 steering_us throttle_us; Received received[2]; Moment wiggle[3]; u16 still_us; u32 still_ms;"
    "u8 throttle_off_rest; bool throttle_free; u16 rest_us[2]; u8 throttle_moved; u16 cap_us lowered_us wanted_us[2];"
    "u32 commanded_ms slewed_ms driven_ms paused_ms; bool wary; u32 sticks_ms;"
    "u16 bad_lines old_commands out_of_range lost_bytes",
)


@functools.cache
def library(gamepad: bool = False) -> ctypes.CDLL:
    """Load the firmware's C code for this machine, from the cache or compiled now. Raises ArduinoError without gcc.

    gamepad: as it is built with HUMAN=gamepad.
    """
    command = (*CC, "-DHUMAN_GAMEPAD") if gamepad else CC
    headers = sorted((FIRMWARE / "rover").glob("*.h"))

    def make(folder: Path) -> None:
        compile_c(*command, "-shared", "-fPIC", "-o", folder / "native.so", *SOURCES)

    folder = cache_folder("native-firmware", key_of({"command": command}, *SOURCES, *headers), make)
    native = ctypes.CDLL(str(folder / "native.so"))
    vehicle, u32 = ctypes.POINTER(Vehicle), ctypes.c_uint32
    native.crc32.restype = u32
    native.crc32.argtypes = [ctypes.c_char_p, ctypes.c_size_t]
    native.reader_take.argtypes = [ctypes.POINTER(Reader), ctypes.c_uint8, u32, ctypes.POINTER(Command)]
    native.vehicle_start.argtypes = [vehicle, ctypes.c_uint16, ctypes.POINTER(CarNumbers)]
    native.car_allowed.restype = ctypes.c_bool
    native.car_allowed.argtypes = [ctypes.POINTER(CarNumbers)]
    native.vehicle_may_keep.restype = ctypes.c_bool
    native.vehicle_may_keep.argtypes = [vehicle]
    native.car_id.restype = u32
    native.car_id.argtypes = [ctypes.POINTER(CarNumbers)]
    native.vehicle_received.argtypes = [vehicle, ctypes.c_int, ctypes.c_uint16, ctypes.c_uint16, u32]
    native.vehicle_command.argtypes = [vehicle, ctypes.POINTER(Command), u32]
    native.vehicle_tick.argtypes = [vehicle, u32]
    native.vehicle_status.restype = native.vehicle_hello.restype = ctypes.c_uint8
    native.vehicle_status.argtypes = [vehicle, u32, ctypes.POINTER(Line)]
    native.vehicle_hello.argtypes = [vehicle, ctypes.c_char, ctypes.POINTER(Line)]
    return native


def said(speak: Callable[..., int], *arguments: object) -> bytes:
    """Return the line, with its line break, that vehicle_status or vehicle_hello makes for these arguments."""
    line = Line()
    length = speak(*arguments, ctypes.byref(line))
    return ctypes.string_at(ctypes.addressof(line), length)


class NativeArduino:
    """A board in virtual time, a millisecond at a time. A transmitter's pulses and the host's lines go in, pulses out.

    You may set these: sticks: the transmitter's pulses (us), where 0 stands for no signal. misread: a function of a
    throttle pulse's number and length that returns what the board measures (None: no pulse). periods_us: of the
    transmitter's pulses.
    gamepad: the firmware is built with HUMAN=gamepad, and a host sends the sticks, every 20 ms.
    now_ms: the board's clock, which wraps at 32 bits. sequence: of the last command. car: the car of the transmitter
    and of the host. The board is told of it too, unless it is the default.
    """

    def __init__(self, now_ms: int = 0, sequence: int = 0, car: Car | None = None, gamepad: bool = False):
        self.gamepad = gamepad
        self.car = car or Car()
        neutral = self.car.pwm.neutral()
        self.sticks: list[float] = [neutral.steering_us, neutral.throttle_us]
        self.misread: Callable[[int, float], float | None] = lambda number, pulse_us: pulse_us
        self.now_ms = now_ms
        self.sequence = sequence
        # The board's time that the host claims to have heard last; None stands for now_ms.
        self.heard_ms: int | None = None
        self.asked_ms: int | None = None  # the same, of when somebody asked to arm it
        self._vehicle, self._reader = Vehicle(), Reader()
        self._native = library(gamepad)
        self._due_us = [0.0, 0.0]
        self._us = 0.0  # since the start
        self._pulses = 0
        self.periods_us = self.car.numbers[0], self.car.numbers[4]
        self.start(Car())
        self._vehicle.sequence = sequence
        if not self.car.is_default:
            assert self.command("C", *self.car.numbers) == "k"

    def start(self, kept: Car | None) -> None:
        """Reset the board. kept: the car that it knows afterwards; None: none."""
        numbers = (ctypes.c_uint16 * 9)(*(kept.numbers if kept else ()))
        self._native.vehicle_start(self._vehicle, 7, CarNumbers(numbers))

    @property
    def may_keep(self) -> bool:
        """Whether the board may write its car into the EEPROM now."""
        return self._native.vehicle_may_keep(self._vehicle)

    @property
    def status(self) -> Telemetry:
        """The board's status line, as the host reads it."""
        text = said(self._native.vehicle_status, self._vehicle, self.now_ms)
        telemetry = parse(text[:-1], 0.0)
        assert isinstance(telemetry, Telemetry), text
        return telemetry

    @property
    def hello(self) -> Hello:
        """The board's hello, as it is after a power-on."""
        hello = parse(said(self._native.vehicle_hello, self._vehicle, b"p")[:-1], 0.0)
        assert isinstance(hello, Hello)
        return hello

    def run(self, ms: int) -> list[tuple[int, int]]:
        """Let time pass; return the pins' pulses (steering, throttle; us) after each millisecond."""
        pins = []
        for _ in range(ms):
            self.now_ms = (self.now_ms + 1) % (1 << 32)
            self._us += 1000
            self._receive()
            self._native.vehicle_tick(self._vehicle, self.now_ms)
            pins.append((self._vehicle.steering_us, self._vehicle.throttle_us))
        return pins

    def send_sticks(self, steering_us: float, throttle_us: float, heard_ms: int) -> str:
        """Send the sticks of a gamepad, by a host that last heard the board at that time."""
        return self.send(frame(f">S {self._vehicle.boot} {heard_ms % (1 << 32)} {steering_us:.0f} {throttle_us:.0f}"))

    def _receive(self) -> None:
        if self.gamepad:
            if self.now_ms % 20 == 0 and self.sticks[STEERING]:
                self.send_sticks(self.sticks[STEERING], self.sticks[THROTTLE], self.now_ms - 15)
            return
        for channel, period_us in enumerate(self.periods_us):
            while self._due_us[channel] <= self._us:
                self._due_us[channel] += period_us
                pulse_us: float | None = self.sticks[channel]
                if channel == THROTTLE and pulse_us:
                    self._pulses += 1
                    pulse_us = self.misread(self._pulses, pulse_us)
                if pulse_us:
                    self._native.vehicle_received(self._vehicle, channel, round(pulse_us), period_us, self.now_ms)

    def wiggle(self) -> None:
        """Let the human move the steering stick both ways and let go, and wait until that counts."""
        rest_us = self.sticks[STEERING]
        for pulse_us in WIGGLE_US:
            self.sticks[STEERING] = pulse_us
            self.run(self.periods_us[STEERING] // 1000)
        self.sticks[STEERING] = rest_us
        self.run(LET_GO_MS)

    def send(self, data: bytes) -> str:
        """Give the board bytes from the host; return the result of the last command, a key of servo_link.RESULTS."""
        command = Command()
        for byte in data:
            reading = self._native.reader_take(self._reader, byte, self.now_ms, command)
            if reading == READ_COMMAND and command.kind != b"Q":
                self._native.vehicle_command(self._vehicle, command, self.now_ms)
                self._native.vehicle_tick(self._vehicle, self.now_ms)
        return self._vehicle.result.decode()

    def command(self, kind: str, *pulses_us: int, sequence: int | None = None) -> str:
        """Send the host's next command and return its result.

        kind: "A", "N", "L" with a throttle pulse, "D" with both pulses, or "C" with a car's numbers.
        """
        if sequence is None:
            self.sequence = sequence = (self.sequence + 1) % (1 << 32)
        heard_ms = self.now_ms if self.heard_ms is None else self.heard_ms
        dated: tuple[int, ...] = (heard_ms % (1 << 32),) if kind in "AD" else ()
        if kind == "A":
            dated += ((self.now_ms if self.asked_ms is None else self.asked_ms) % (1 << 32), self.car.id)
        return self.send(frame(" ".join(map(str, (f">{kind}", self._vehicle.boot, sequence, *dated, *pulses_us)))))

    def drive(self, steering_us: int, throttle_us: int, ms: int, every_ms: int = 33) -> list[tuple[int, int]]:
        """Send a drive command every `every_ms` for `ms` milliseconds; return the pins' pulses as run() does."""
        pins = []
        for start in range(0, ms, every_ms):
            self.command("D", steering_us, throttle_us)
            pins += self.run(min(every_ms, ms - start))
        return pins
