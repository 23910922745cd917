"""A board in virtual time for a test that is host and human itself, a millisecond at a time.

It is the real sketch, compiled for this machine (lab/driving/board.c). A second of virtual time takes some 10 ms.
"""

import ctypes
from typing import Any

from lab.driving.virtual import STEERING, THROTTLE, Board
from rover_lib.onboard.car.car import DEFAULT_NUMBERS, Car
from rover_lib.onboard.car.protocol import Hello, Telemetry, frame, parse

BOOT = 7
WIGGLE_US = (1750, 1150)  # the stick's pulses, three periods each
LET_GO_MS = 1050  # a little longer than the firmware wants the stick to rest after a wiggle
STICKS_EVERY_MS = 20


class NativeArduino:
    """A board that a transmitter's pulses and the host's lines go into, and pulses come out of; one at a time.

    You may set: sticks: the transmitter's pulses (us), where 0 stands for no signal. misread: (one in, us): one in so
    many throttle pulses is read as another. heard_ms, asked_ms: what the host claims to have heard last, and when asked
    to arm; None stands for now_ms. sequence: of the last command. car: told to the board, unless it is the
    default. gamepad: the firmware is built with HUMAN=gamepad, and a host sends the sticks, every 20 ms.
    """

    def __init__(self, now_ms: int = 0, car: Car | None = None, gamepad: bool = False):
        self.gamepad = gamepad
        self.car = car or Car()
        self.sticks: list[float] = [self.car.numbers[2], self.car.numbers[6]]
        self.misread = 0, 0
        self.sequence = 0
        self.heard_ms: int | None = None
        self.asked_ms: int | None = None
        self.periods_us = self.car.numbers[0], self.car.numbers[4]
        self._ms = now_ms
        self.start(Car())
        if self.car.numbers != DEFAULT_NUMBERS:
            assert self.command("C", *self.car.numbers) == "k"

    def start(self, kept: Car | None) -> None:
        """Reset the board. kept: the car that it knows afterwards; None: none."""
        human = "gamepad" if self.gamepad else "receiver"
        self._board = Board(self.now_ms, BOOT, "p", kept.numbers if kept else (0,) * 9, human)

    @property
    def now_ms(self) -> int:
        """The board's clock, which wraps at 32 bits."""
        return self._ms % (1 << 32)

    @property
    def may_keep(self) -> bool:
        """Whether the board may write its car into the EEPROM now."""
        return bool(self._board.c.board_may_keep() & 1)

    def _line(self, hello: bool) -> Any:
        """Return the board's line, as the host reads it. hello: as it is after a power-on, instead of its status."""
        text = ctypes.create_string_buffer(256)
        length = self._board.c.board_line(hello, text)
        return parse(text.raw[: length - 1], 0.0)

    @property
    def status(self) -> Telemetry:
        """The board's status line, as the host reads it."""
        return self._line(False)

    @property
    def hello(self) -> Hello:
        """The board's hello, as it is after a power-on."""
        return self._line(True)

    def run(self, ms: int) -> list[tuple[int, int]]:
        """Let time pass; return the pins' pulses (steering, throttle; us) after each millisecond."""
        if not self.gamepad:
            self._board.transmit(STEERING, round(self.sticks[0]), period_us=self.periods_us[0])
            self._board.transmit(THROTTLE, round(self.sticks[1]), 1, *self.misread, self.periods_us[1])
        pins = []
        while ms > 0:
            step = min(ms, STICKS_EVERY_MS - self._ms % STICKS_EVERY_MS) if self.gamepad else ms
            trace = (ctypes.c_uint16 * (2 * step))()
            self._board.c.board_trace(step, trace)
            pins += list(zip(trace[::2], trace[1::2], strict=True))
            self._ms, ms = self._ms + step, ms - step
            if self.gamepad and self._ms % STICKS_EVERY_MS == 0 and self.sticks[0]:
                self.send_sticks(self.sticks[0], self.sticks[1], self.now_ms - 15)
        return pins

    def send_sticks(self, steering_us: float, throttle_us: float, heard_ms: int) -> str:
        """Send the sticks of a gamepad, by a host that last heard the board at that time."""
        return self.send(frame(f">S {BOOT} {heard_ms % (1 << 32)} {steering_us:.0f} {throttle_us:.0f}"))

    def wiggle(self) -> None:
        """Let the human move the steering stick both ways and let go, and wait until that counts."""
        rest_us = self.sticks[0]
        for pulse_us in WIGGLE_US:
            self.sticks[0] = pulse_us
            self.run(3 * (self.periods_us[0] // 1000))
        self.sticks[0] = rest_us
        self.run(LET_GO_MS)

    def send(self, data: bytes) -> str:
        """Give the board bytes from the host; return the result of the last command, a key of servo_link.RESULTS."""
        return chr(self._board.c.board_tell(data, len(data)) & 0xFF)

    def command(self, kind: str, *pulses_us: int, sequence: int | None = None) -> str:
        """Send the host's next command and return its result.

        kind: "A", "N", "L" with a throttle pulse, "D" with both pulses, or "C" with a car's numbers.
        """
        if sequence is None:
            self.sequence = sequence = (self.sequence + 1) % (1 << 32)
        numbers: list[int] = []
        if kind in "AD":
            numbers.append(self.now_ms if self.heard_ms is None else self.heard_ms)
        if kind == "A":
            numbers += [self.now_ms if self.asked_ms is None else self.asked_ms, self.car.id]
        words = [f">{kind}", BOOT, sequence, *(number % (1 << 32) for number in numbers), *pulses_us]
        return self.send(frame(" ".join(map(str, words))))

    def drive(self, steering_us: int, throttle_us: int, ms: int, every_ms: int = 33) -> list[tuple[int, int]]:
        """Send a drive command every `every_ms` for `ms` milliseconds; return the pins' pulses as run() does."""
        pins = []
        for start in range(0, ms, every_ms):
            self.command("D", steering_us, throttle_us)
            pins += self.run(min(every_ms, ms - start))
        return pins
