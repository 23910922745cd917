"""The serial link to the rover's Arduino: commands out, telemetry in, by the protocol of firmware/README.md.

The Arduino keeps the car safe. This adds three things: it sends nothing out of range, it sends neutral when the link is
left, and it notes when each status came.
"""

import contextlib
import fcntl
import logging
import math
import os
import shlex
import termios
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from numbers import Integral
from typing import Any

import serial

from rover_lib.onboard.car.car import DEFAULT_NUMBERS, PERIOD_MIN_US, PULSE_MIN_US, Car, this_car
from rover_lib.onboard.car.gamepad import Gamepad, open_gamepad
from rover_lib.onboard.car.ports import find_port, other_ports
from rover_lib.onboard.car.protocol import (
    LINE_MAX,
    MISSING,
    PROTOCOL_VERSION,
    RESULTS,
    SEQUENCES,
    Hello,
    State,
    Telemetry,
    frame,
    parse,
)
from rover_lib.onboard.car.pwm import Channel
from rover_lib.onboard.errors import CarError, RoverError

FIRMWARE_VERSION = "4.2.0"  # open() accepts no other; firmware/rover/protocol.h has the same
BAUD = 115200
BOOT_S = 4.0  # a boot loader starts the sketch after 1 to 2 s
SILENT_S = 0.3  # nothing may be sent before: while an Arduino resets, its boot loader listens
HELLO_EVERY_S = 0.5
REPEAT_S = 0.05
ANSWER_S = 0.5
STALE_S = 0.5  # a status that is older means silence: the Arduino sends one every 20 ms
LATE_S = 0.150  # the Arduino rejects older commands, and a link as slow as this is unfit for driving
DATED = (">A", ">D")  # commands that carry the time of the newest status that the host had read
READ_TIMEOUT_S = 0.05
REACH_US = 64  # of a gamepad's throttle stick, at least: the Arduino takes more than 32 for moved
LEAST_US = 40, PULSE_MIN_US  # of a throttle's pulse: a fast one, like the recorded car's, and others
RELAY_EVERY_S = 0.015  # a gamepad's sticks at most: beside 100 commands a second, the line has room for these

# serial.SerialException is an OSError, termios.error is not; TypeError: pyserial's, if another thread closed it.
PORT_ERRORS = (OSError, termios.error, TypeError)

_log = logging.getLogger(__name__)


class LinkError(RoverError):
    """The Arduino is missing, speaks another protocol, refuses to be armed, or no longer answers."""


def _keep(port: serial.Serial) -> None:
    """Keep others from opening the port, and closing it from changing DTR, whose edge resets an Arduino."""
    fcntl.ioctl(port.fileno(), termios.TIOCEXCL)  # for programs that know nothing of pyserial's lock
    attributes = termios.tcgetattr(port.fileno())
    attributes[2] &= ~termios.HUPCL
    termios.tcsetattr(port.fileno(), termios.TCSANOW, attributes)


class ServoLink:
    """The link to the Arduino on `port`. Leaving its context, for whatever reason, sends neutral before it closes.

        with ServoLink("/dev/ttyUSB0") as link:
            link.arm()
            while ...:
                link.send(steering_us, throttle_us)  # at least every 150 ms

    Any thread may call any method. When the port fails, each call raises LinkError, and the Arduino stops by itself.
    With a car whose human has a gamepad, the thread that reads the statuses answers them with its sticks. If the
    Arduino resets itself, the link goes on, but the Arduino ignores drive commands until arm().
    """

    def __init__(self, port: str, *, car: Car | None = None, clock: Callable[[], float] = time.monotonic):
        """port: "" means the only Arduino's. car: None means this machine's. Raises RoverError if either is unclear."""
        self.port = port or find_port()
        self.car = car or this_car()
        self.calibration = self.car.pwm
        self._clock = clock
        self._gamepad: Gamepad | None = None
        self._relayed_s = 0.0
        self._told_boot: int | None = None  # the start in which the Arduino learned of the car
        self._serial: serial.Serial | None = None
        self._reader: threading.Thread | None = None
        self._closing = threading.Event()
        self._heard = threading.Condition()  # guards the six below
        self.hello: Hello | None = None  # the newest
        self.turned: Telemetry | None = None  # the status with which the present state or start of the Arduino began
        self._telemetry: Telemetry | None = None
        self._requested: Telemetry | None = None  # the newest status when somebody asked to arm the car
        self._failure: LinkError | None = None
        self._unanswered: deque[tuple[int, float]] = deque(maxlen=256)  # number of a command, and when it was sent
        self._sending = threading.RLock()  # guards the two below, and keeps lines whole; never taken inside _heard
        self._boot = self._sequence = 0
        self._asked = 0.0
        self.garbled = 0  # lines of the Arduino that were dropped

    def __enter__(self) -> "ServoLink":
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def open(self) -> Hello:
        """Open the port for this program alone, wait for the hello and a first status, and tell the Arduino of the car.

        The first opening after the Arduino was plugged in resets most boards; a later one does not interrupt it.
        Raises LinkError for a port that cannot be opened, no hello within BOOT_S, another firmware, or one
        that refuses this car. Raises CarError as open_gamepad() does.
        """
        try:
            self._serial = serial.Serial(self.port, BAUD, timeout=READ_TIMEOUT_S, exclusive=True)
            _keep(self._serial)
            self._serial.reset_input_buffer()  # drop what came earlier
        except (*PORT_ERRORS, ValueError) as error:
            self._release()
            remedy = "is it plugged in, is the user in group dialout, and does no other program have the port?"
            raise LinkError(f"{self.port}: cannot be opened ({error})", remedy=remedy) from error
        self._reader = threading.Thread(target=self._read, args=(self._serial,), name="servo link", daemon=True)
        self._reader.start()
        try:
            hello = self._wait_for_hello()
            self._tell_car(hello)
            if self.car.human == "gamepad":  # last, so that the firmware is known to be right even without one
                self._gamepad = open_gamepad()
            return hello
        except BaseException:
            self._release()
            raise

    def _wait_for_hello(self) -> Hello:
        self._asked = opened = self._clock()
        while not (hello := self._await(lambda: self.hello, REPEAT_S)):
            now = self._clock()
            running = self._telemetry
            if now - opened > BOOT_S:
                flash = f"make -C firmware flash PORT={shlex.quote(str(self.port))}"
                remedy = f"is it the rover's, and is the firmware on it ({flash})?"
                remedy = other_ports(self.port) or remedy
                raise LinkError(f"{self.port}: no hello from an Arduino within {BOOT_S:g} s", remedy=remedy)
            # If it goes on talking, opening the port did not reset it. A boot loader must not be talked to.
            due = SILENT_S if running and running.host_s - opened > SILENT_S / 2 else BOOT_S / 2
            if now - opened > due and now - self._asked > HELLO_EVERY_S / 2:
                self._asked = now
                self._write(frame(">Q"))
        build = FIRMWARE_VERSION
        make = "make -C firmware flash"
        if self.car.human == "gamepad":
            build = f"{build}-gamepad"
            make = f"{make} HUMAN=gamepad"
        if (hello.protocol, hello.firmware) != (PROTOCOL_VERSION, build):
            problem = f"{self.port}: the Arduino must have firmware {build} (protocol {PROTOCOL_VERSION})"
            actual = f"{hello.firmware} (protocol {hello.protocol})"
            raise LinkError(problem, found=actual, remedy=f"put the matching firmware on it: {make} PORT={self.port}")
        if not self._await(lambda: self._telemetry, STALE_S):
            raise LinkError(f"{self.port}: the Arduino sends no status", remedy="press its reset button")
        return hello

    def _await(self, condition: Callable[[], Any], timeout_s: float) -> Any:
        """Wait until a condition holds, and return its value. Raises LinkError if the port fails meanwhile."""
        with self._heard:
            self._heard.wait_for(lambda: condition() or self._failure, timeout=timeout_s)
            if self._failure:
                raise self._failure
            return condition()

    def tell(self, car: Car) -> None:
        """Make the Arduino drive its pins for this car from now on. Raises LinkError if it refuses the car."""
        self.car = car
        self.calibration = car.pwm
        if hello := self.hello:
            self._tell_car(replace(hello, car=0))

    def _tell_car(self, hello: Hello) -> None:
        """Tell the Arduino this car's neutral, pulses and cap; until it knows them, it refuses to arm."""
        if self.car.numbers == DEFAULT_NUMBERS and hello.car == self.car.id:
            self._told_boot = hello.boot
            return
        for telemetry in self._ask(">C", *self.car.numbers):
            if telemetry.result == "k":
                self._told_boot = telemetry.boot
                return
            if telemetry.result in "rt":
                problem = f"{self.port}: the Arduino refuses {self.car.name!r} of car.yml ({RESULTS[telemetry.result]})"
                remedy = "let go of the throttle stick, or measure the car with `rover calibrate`"
                raise LinkError(problem, remedy=remedy)
        raise self._no_answer("being told of the car")

    def close(self) -> None:
        """Send neutral, then close the port. Raises nothing: an Arduino that cannot be reached stops by itself."""
        if not self._serial:
            return
        try:
            self.neutral()
        except LinkError as error:
            _log.warning("closing without an answer to neutral, the Arduino stops by itself: %s", error)
        finally:
            self._release()

    def _release(self) -> None:
        self._closing.set()
        port = self._serial
        self._serial = None
        if port:
            with contextlib.suppress(*PORT_ERRORS, AttributeError):
                port.cancel_read()
            if self._reader and self._reader is not threading.current_thread():
                self._reader.join(1.0)
            for leave in (
                port.reset_output_buffer,  # or the kernel would wait up to 30 s for a line that is stuck
                lambda: fcntl.ioctl(port.fileno(), termios.TIOCNXCL),  # a pseudo-terminal would stay exclusive
                port.close,
            ):
                with contextlib.suppress(*PORT_ERRORS):
                    leave()
        self._reader = None
        if self._gamepad:
            self._gamepad.close()

    def request(self, *, keep: bool = False) -> None:
        """Note that somebody asks for the car now. keep: an earlier request, not tried yet, stays as old as it is."""
        with self._heard:
            self._requested = (keep and self._requested) or self._telemetry

    def arm(self) -> Telemetry:
        """Hand the car to the host, which must send commands from then on. Return the status that confirms it.

        The Arduino counts from request(), or from now. Raises LinkError if it refuses, or does not answer within 0.5 s.
        """
        hello = self.hello
        with self._heard:
            before = self._requested or self._telemetry
            self._requested = None
        if hello and before and before.boot != hello.boot:
            raise LinkError(f"{self.port}: the Arduino was reset since the car was asked for", remedy="ask again")
        if hello and self._told_boot != hello.boot:
            self._tell_car(hello)
        for telemetry in self._ask(">A", before.uptime_ms if before else 0, self.car.id):
            if telemetry.state is State.AUTONOMOUS:
                return telemetry
            if telemetry.result in "cestw":
                remedy = self.remedy(telemetry.result) if telemetry.result in MISSING else "ask again"
                raise LinkError(f"{self.port}: arming was {RESULTS[telemetry.result]}", remedy=remedy)
        raise self._no_answer("arming")

    def remedy(self, missing: str) -> str:
        """Return what this car's human does about what is missing, a key of MISSING.

        A gamepad that was gone is opened again, if the same one is back. Never waits.
        """
        if missing != "s" or self.car.human != "gamepad":
            return MISSING[missing]
        if self._gamepad and self._gamepad.gone:
            self._gamepad.close()
            try:
                self._gamepad = open_gamepad(again=self._gamepad)
            except CarError as error:
                return str(error)
        return "hold L1 of the gamepad"

    def neutral(self) -> Telemetry:
        """Stop the car until arm() if the host drives it. Return the status that confirms it.

        Raises LinkError if the Arduino does not answer within 0.5 s; it stops by itself then.
        """
        for telemetry in self._ask(">N"):
            if telemetry.state is not State.AUTONOMOUS:
                return telemetry
        raise self._no_answer("neutral")

    def lower_cap(self, throttle_us: int) -> Telemetry:
        """Lower the host's throttle limit until the Arduino's next reset. Return the status that confirms it.

        With reverse, the same distance from neutral limits it there. Raises LinkError for a pulse out of range, and
        without an answer within 0.5 s: the cap is not changed while the car drives.
        """
        most_us = self._whole(self.calibration.throttle, throttle_us)
        neutral_us = self.calibration.throttle.neutral_us
        for telemetry in self._ask(">L", most_us):
            if telemetry.cap_us - neutral_us <= abs(most_us - neutral_us):
                return telemetry
        raise self._no_answer("the throttle's cap")

    def _ask(self, kind: str, *values: int) -> Iterator[Telemetry]:
        """Send a command every REPEAT_S until ANSWER_S is over; yield each status that the Arduino sends after it."""
        first = None
        end = self._clock() + ANSWER_S
        while self._clock() < end:
            number = self._send(kind, *values)
            if first is None:
                first = number
            until = self._clock() + REPEAT_S
            telemetry = None
            while (rest_s := until - self._clock()) > 0:
                self._await(lambda: self._telemetry is not telemetry, rest_s)  # noqa: B023
                telemetry = self._telemetry
                # An earlier status says nothing about the command.
                if telemetry and telemetry.accepts(first) and telemetry.boot == self._boot:
                    yield telemetry

    def send(self, steering_us: int, throttle_us: int) -> int:
        """Send two pulses, whole microseconds, without waiting for an answer. Return the command's number.

        Raises LinkError for pulses out of range, which are not sent, and if the port failed.
        """
        steering_us = self._whole(self.calibration.steering, steering_us)
        throttle_us = self._whole(self.calibration.throttle, throttle_us)
        return self._send(">D", steering_us, throttle_us)

    @staticmethod
    def _whole(channel: Channel, pulse_us: object) -> int:
        low, high = channel.ends_us
        whole_us = int(pulse_us) if isinstance(pulse_us, Integral) and not isinstance(pulse_us, bool) else None
        if whole_us is None or not low <= whole_us <= high:
            problem = f"{channel.name} pulse must be whole microseconds from {low} to {high}"
            raise LinkError(problem, found=repr(pulse_us), remedy="it was not sent")
        return whole_us

    def latest(self) -> Telemetry | None:
        """Return the newest status, None before the first. Raises LinkError if it is older than 0.5 s."""
        if self._failure:
            raise self._failure
        telemetry = self._telemetry
        if telemetry and (age := self._clock() - telemetry.host_s) > STALE_S:
            raise LinkError(f"{self.port}: the Arduino said nothing for {age:.1f} s", remedy="is it still plugged in?")
        return telemetry

    def unacknowledged_s(self, now_s: float) -> float:
        """Return the age in seconds, by the link's clock, of the oldest command without an answer; 0 if there is none.

        Above LATE_S, stop the car: it obeys commands from the past.
        """
        with self._heard:
            return now_s - self._unanswered[0][1] if self._unanswered else 0.0

    def round_trip_s(self) -> float:
        """Ask for a hello, and return the seconds until it came. Raises LinkError if none comes within 0.5 s."""
        before = self.hello
        start = self._clock()
        self._write(frame(">Q"))
        if not self._await(lambda: self.hello is not before, ANSWER_S):
            raise self._no_answer("a question")
        return self._clock() - start

    def _no_answer(self, what: str) -> LinkError:
        last = self._telemetry.why if self._telemetry else "none"
        return LinkError(f"{self.port}: no answer to {what} within {ANSWER_S:g} s", found=f"as last status {last}")

    def _send(self, kind: str, *values: int) -> int:
        if self._failure:
            raise self._failure
        heard = self._telemetry
        if kind in DATED:
            if not heard:
                raise LinkError(f"{self.port}: the Arduino has sent no status yet")
            values = (heard.uptime_ms, *values)
        with self._sending:
            self._sequence = number = (self._sequence + 1) % SEQUENCES
            with self._heard:  # before writing: the answer may arrive before this thread runs again
                self._unanswered.append((number, self._clock()))
            self._write(frame(" ".join([kind, *map(str, (self._boot, number, *values))])))
            return number

    def _write(self, line: bytes) -> None:
        port = self._serial
        if not port:
            raise LinkError(f"{self.port}: the link is closed")
        try:
            with self._sending:
                # Not pyserial's write, which may wait for ever, or report a line as failed that went out whole.
                try:
                    count = os.write(port.fileno(), line)
                except BlockingIOError:
                    count = 0
                if count == len(line):
                    return
                # What waits in the buffer would be old when it got through: the next line sent must be the newest.
                with contextlib.suppress(*PORT_ERRORS):
                    port.reset_output_buffer()
        except PORT_ERRORS as error:
            raise self._fail(f"{self.port}: writing failed ({error})") from error
        raise LinkError(f"{self.port}: the port took no data, its buffer is full; the Arduino stops by itself")

    def _fail(self, what: str) -> LinkError:
        with self._heard:
            self._failure = self._failure or LinkError(what, remedy="is it still plugged in?")
            self._heard.notify_all()
            return self._failure

    def _read(self, port: serial.Serial) -> None:
        """Drain the port as fast as it fills. The reader thread runs this."""
        pending = b""
        skipping = False
        while not self._closing.is_set():
            try:
                data = port.read(max(1, port.in_waiting))
            except PORT_ERRORS as error:
                if not self._closing.is_set():
                    self._fail(f"{self.port}: reading failed ({error})")
                return
            now = self._clock()
            *lines, pending = (pending + data).split(b"\n")
            for line in lines:
                if not skipping:
                    self._hear(line, now)
                skipping = False
            if self._gamepad and lines:
                self._relay(self._gamepad, now)
            if len(pending) > LINE_MAX:
                pending = b""
                skipping = True
                self.garbled += 1

    def _relay(self, gamepad: Gamepad, now: float) -> None:
        """Answer the newest status with the gamepad's sticks, or with 0 and 0 while the human has let go."""
        heard = self._telemetry
        if not heard or heard.host_s != now or now - self._relayed_s < RELAY_EVERY_S:
            return
        self._relayed_s = now
        pulses_us = (0, 0)
        if sticks := gamepad.sticks():
            channel = self.calibration.throttle
            # Also backwards on a car that cannot, and beyond a small cap: the Arduino judges the stick, then limits it.
            reach_us = math.copysign(max(self.car.cap_us, REACH_US), channel.span_pct)
            pulses_us = (
                self.calibration.steering.pulse_us(-sticks[0] * self.car.left),
                max(round(channel.neutral_us + sticks[1] * reach_us), LEAST_US[channel.period_us >= PERIOD_MIN_US]),
            )
        with contextlib.suppress(LinkError):  # the next call of another thread raises what it means
            self._write(frame(f">S {heard.boot} {heard.uptime_ms} {pulses_us[0]} {pulses_us[1]}"))

    def _hear(self, line: bytes, now: float) -> None:
        message = parse(line, now)
        if message is None:
            self.garbled += bool(line)
            return
        if isinstance(message, Hello):
            with self._sending:
                if not self.hello or message.boot != self._boot:
                    self._boot = message.boot
                    self._sequence = message.sequence
        elif self.hello and message.boot != self._boot and now - self._asked > HELLO_EVERY_S:
            self._asked = now  # it was reset, and the hello of its new start was lost
            with contextlib.suppress(LinkError):
                self._write(frame(">Q"))
        with self._heard:
            if isinstance(message, Hello):
                if self.hello and message.boot != self.hello.boot:
                    self._unanswered.clear()
                self.hello = message
            else:
                before = self._telemetry
                self._telemetry = message
                if not before or (before.boot, before.state) != (message.boot, message.state):
                    self.turned = message
                while self._unanswered and message.accepts(self._unanswered[0][0]):
                    self._unanswered.popleft()
            self._heard.notify_all()
