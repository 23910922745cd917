"""An emulated Arduino for tests: simavr runs the firmware as it is flashed, and pulses are measured on its pins."""

import ctypes
import functools
import tempfile
import weakref
from pathlib import Path
from types import SimpleNamespace

from lab.arduino import emulator as arduino
from rover_lib.onboard.car import car
from rover_lib.onboard.car.protocol import Hello, parse
from rover_lib.onboard.car.protocol import frame as line
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US

REPOSITORY = arduino.REPOSITORY
symbol = arduino.symbol
PULSE, CUT, LINE_IN, RESET = 1, 2, 3, 4
PIN = {"steering": 0, "throttle": 1}
EEPROM_BYTES = len(arduino.eeprom_of(car.Car()))


FOLDER = tempfile.TemporaryDirectory(prefix="rover-uno-")  # removed when this process ends


def compiled(name: str, *arguments: object) -> Path:
    """Compile `arguments` with gcc, unless that was done before, and return the path. Warnings are errors."""
    path = Path(FOLDER.name, name)
    if not path.exists():
        arduino.compile_c(*arduino.CC, "-I", REPOSITORY / "firmware/rover", "-o", path, *arguments)
    return path


class _Event(ctypes.Structure):
    _fields_ = (
        ("at_us", ctypes.c_double), ("pulse_us", ctypes.c_double), ("period_us", ctypes.c_double),
        ("kind", ctypes.c_int32), ("channel", ctypes.c_int32),
    )  # fmt: skip


@functools.cache
def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(str(compiled("libarduino.so", "-shared", "-fPIC", *arduino.WITH_SIMAVR)))
    pointer, real = ctypes.c_void_p, ctypes.c_double
    library.uno_new.restype = pointer
    library.uno_now_us.restype = library.uno_longest_us.restype = real
    # Of the others, ctypes knows each argument's type by itself.
    library.uno_transmitter.argtypes = [pointer, ctypes.c_int, real, real]
    library.uno_run_us.argtypes = [pointer, real]
    return library


class Uno:
    """The board, which runs only when told to.

    events: all measurements, in the order in which they ended. lines: all lines that it sent, without their CRC.
    status: the newest, as the host reads it, with the state's letter.
    """

    def __init__(self, eeprom: bytes | None = None, human: str = "receiver"):
        """eeprom: its first bytes; None: of a board that has kept the default car. human: as the firmware is built."""
        self._c = _library()
        firmware = arduino.build(human).firmware
        self._uno = ctypes.c_void_p(self._c.uno_new(str(firmware).encode()))
        assert self._uno, f"simavr cannot load {firmware}"
        weakref.finalize(self, self._c.uno_free, self._uno)
        kept = arduino.eeprom_of(car.Car()) if eeprom is None else eeprom
        self._c.uno_eeprom(self._uno, ctypes.create_string_buffer(kept, len(kept) or 1), len(kept), True)
        self.events: list[SimpleNamespace] = []
        self.lines: list[str] = []
        self._rest = b""
        self.sequence = 0
        self.boot = None
        self.car_id = car.this_car().id  # the car that the host names when it arms

    @property
    def now_us(self) -> float:
        return self._c.uno_now_us(self._uno)

    def run_ms(self, ms: float) -> list[SimpleNamespace]:
        """Let time pass, and return the new events."""
        state = self._c.uno_run_us(self._uno, ms * 1000)
        assert state == 0, f"the firmware stopped: simavr's state {state}"
        buffer, new = (_Event * 512)(), []
        while n := self._c.uno_events(self._uno, buffer, 512):
            new += [SimpleNamespace(**{name: getattr(e, name) for name, _ in _Event._fields_}) for e in buffer[:n]]
        self.events += new
        text = ctypes.create_string_buffer(4096)
        while n := self._c.uno_read(self._uno, text, len(text)):
            self._rest += text.raw[:n]
        *whole, self._rest = self._rest.split(b"\n")
        for text_line in filter(None, whole):
            message = parse(text_line, 0.0)
            assert message or any(e.kind == RESET for e in new), f"the firmware sent {text_line!r}"
            if message:
                self.lines.append(text_line.decode().rpartition("*")[0])
            if isinstance(message, Hello):
                self.boot, self.sequence = message.boot, message.sequence
            elif message:
                counted = {"old": message.old_commands, "lost": message.lost_bytes}
                self.status = SimpleNamespace(**vars(message) | {"state": message.state.value} | counted)
        return new

    def send(self, data: bytes) -> None:
        self._c.uno_send(self._uno, (ctypes.c_uint16 * len(data))(*data), len(data))

    def command(self, kind: str, *values: int) -> bytes:
        """Send the next command: "A", "N", "L" with a throttle, "D" with two pulses, "C". Returns its line."""
        if kind == "A":
            values = (self.status.uptime_ms, self.car_id)
        if kind in "AD":
            values = (self.status.uptime_ms, *values)
        self.sequence += 1
        text = line(" ".join(map(str, (f">{kind}", self.boot, self.sequence, *values))))
        self.send(text)
        return text

    def transmitter(self, steering_us: float, throttle_us: float, periods_us: tuple[float, float] = (0, 0)) -> None:
        """Move the human's sticks, from their next pulse on. 0 means no signal, and the nominal period."""
        for channel, pulse_us in enumerate((steering_us, throttle_us)):
            self._c.uno_transmitter(self._uno, channel, pulse_us, periods_us[channel])

    def wiggle(self) -> None:
        """Let the human move the steering stick to both sides and let go of it, and run until that has counted."""
        self._c.uno_wiggle(self._uno)
        self.run_ms(1250)

    def reset(self) -> None:
        self._c.uno_reset(self._uno)

    def power(self) -> None:
        """Switch it off and on."""
        self._c.uno_power(self._uno)

    @property
    def eeprom(self) -> bytes:
        """The EEPROM's first bytes: the boot's number, and the car."""
        buffer = ctypes.create_string_buffer(EEPROM_BYTES)
        self._c.uno_eeprom(self._uno, buffer, EEPROM_BYTES, False)
        return buffer.raw

    def hang(self) -> None:
        """Turn loop() into an endless loop until the next reset."""
        self._c.uno_hang(self._uno, symbol("loop"))

    def watch_loop(self) -> None:
        """From now on, measure the longest turn of loop(), up to where it has nothing left to do but sleep."""
        self._c.uno_watch(self._uno, symbol("loop"), symbol("_Z4restv"))

    @property
    def longest_ms(self) -> float:
        """The longest turn of loop() since watch_loop()."""
        return self._c.uno_longest_us(self._uno) / 1000

    def drive(self, steering_us: int, throttle_us: int, ms: float, every_ms: float = 33) -> list[SimpleNamespace]:
        """Send drive commands every `every_ms` for `ms`, and return the events."""
        end, events = self.now_us + ms * 1000, []
        while self.now_us < end:
            self.command("D", steering_us, throttle_us)
            events += self.run_ms(max(0.1, min(every_ms, (end - self.now_us) / 1000)))
        return events


def pulses(events: list[SimpleNamespace], pin: str, after_us: float = 0) -> list[SimpleNamespace]:
    """Return the whole pulses of "steering" or "throttle" that began at `after_us` or later."""
    return [e for e in events if e.kind == PULSE and e.channel == PIN[pin] and e.at_us >= after_us]


def widths(events: list[SimpleNamespace], pin: str, after_us: float = 0) -> set[float]:
    return {e.pulse_us for e in pulses(events, pin, after_us)}


EDGE_US = 0.3  # an instruction of simavr takes up to four cycles of 0.0625 us
STEP_US = ARDUINO_STEP_US + EDGE_US
ANSWER_MS = 25  # a command takes up to 4 ms on the wire, a status 7, and may wait for one that is under way


def arm(board: Uno) -> None:
    board.wiggle()
    board.command("A")
    board.run_ms(ANSWER_MS)
    assert (board.status.state, board.status.reason, board.status.result) == ("A", "a", "k"), board.lines[-3:]


def on_pins(
    events: list, steering_us: float, throttle_us: float, after_us: float = 0, within_us: float = EDGE_US
) -> None:
    """Check that there are pulses of both pins, and that all are these."""
    for pin, wanted in (("steering", steering_us), ("throttle", throttle_us)):
        measured = widths(events, pin, after_us)
        assert measured, f"no {pin} pulses"
        assert all(abs(us - wanted) <= within_us for us in measured), f"{pin}: {sorted(measured)} us, wanted {wanted}"
