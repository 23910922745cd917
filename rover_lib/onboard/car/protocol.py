"""The lines between host and Arduino, by the protocol of firmware/README.md: what they say, and how it is checked."""

import re
import zlib
from dataclasses import dataclass
from enum import Enum
from typing import Any

PROTOCOL_VERSION = 4
LINE_MAX = 128  # bytes of a line from the Arduino
SEQUENCES = 1 << 32


class State(Enum):
    """Who drives."""

    MANUAL = "M"  # the human's transmitter
    AUTONOMOUS = "A"  # the host
    STOPPED = "S"  # nobody: neutral until the host arms again or the human moves a stick


REASONS = {
    "r": "after a reset",
    "h": "the human moved a stick",
    "a": "armed by the host",
    "t": "no valid command for 150 ms",
    "p": "the host paused again and again",
    "s": "the transmitter's signal was lost",
    "n": "the host asked for neutral",
}
RESULTS = {
    "-": "no command yet",
    "k": "done",
    "i": "ignored: not for who drives now",
    "r": "out of range",
    "o": "an old command, or one for another start of the Arduino",
    "l": "late: it had waited in the link",
    "e": "refused: too long ago since somebody asked for it",
    "c": "refused: the Arduino was not told of this car since its reset",
    "s": "refused: the transmitter gives no signal",
    "t": "refused: the throttle stick is not at rest",
    "w": "refused: nobody has just wiggled the steering stick",
}
MISSING = {  # what the Arduino still needs before it can be armed, and what the human does about it
    "s": "switch the transmitter on",
    "t": "let go of the throttle stick",
    "w": "move the steering stick far to both sides within 3 s and let go of it for a second, without any throttle",
    "-": "nothing is missing",
}
RESETS = {"p": "power-on", "e": "reset pin", "b": "brown-out", "w": "watchdog", "-": "unknown"}


@dataclass(frozen=True)
class Hello:
    """What the Arduino says after each reset, and when asked.

    boot: number of this start, 0 to 65535. sequence: of the last command that it accepted as new. car: the id of the
    car that it drives its pins for.
    """

    protocol: int
    firmware: str
    boot: int
    sequence: int
    reset: str  # a value of RESETS
    car: int = 0


@dataclass(frozen=True)
class Telemetry:
    """One status of the Arduino. Pulses and periods are whole microseconds; None means "no pulse", and 0 never does.

    host_s: when it arrived here, by the link's clock. uptime_ms: the Arduino's clock, which wraps at 2^32. sequence: of
    the last command that it accepted as new; result: what became of the last command, a key of RESULTS. missing: what
    arming lacks, a key of MISSING. steering_us, throttle_us: on its pins. cap_us: the pulse of the most throttle that
    the host gets; with reverse, as far to the other side. receiver_*: the transmitter's. The last four are counters,
    which stop at 65535; old_commands: replayed or late ones, and those for another start.
    """

    host_s: float
    boot: int
    uptime_ms: int
    sequence: int
    result: str
    state: State
    reason: str  # why the state is what it is, a key of REASONS
    missing: str
    steering_us: int
    throttle_us: int
    cap_us: int
    receiver_steering_us: int | None
    receiver_steering_period_us: int | None
    receiver_throttle_us: int | None
    receiver_throttle_period_us: int | None
    bad_lines: int
    old_commands: int
    out_of_range: int
    lost_bytes: int

    @property
    def why(self) -> str:
        """Who drives and why, in words."""
        return f"{self.state.name.lower()}: {REASONS[self.reason]}"

    def accepts(self, sequence: int) -> bool:
        """Whether the Arduino has accepted the command with this number, or a later one."""
        return (self.sequence - sequence) % SEQUENCES < SEQUENCES // 2

    @property
    def receiver(self) -> tuple[int | None, int | None, int | None, int | None]:
        """The transmitter's pulses of steering and throttle, and then their periods."""
        pulses = self.receiver_steering_us, self.receiver_throttle_us
        return *pulses, self.receiver_steering_period_us, self.receiver_throttle_period_us


def frame(body: str) -> bytes:
    """Return the line for a body: the body, its CRC-32 and the line feed."""
    return f"{body}*{zlib.crc32(body.encode('ascii')):08X}\n".encode("ascii")


_NUMBER = r"(0|[1-9][0-9]{0,9})"
_PULSE = rf"(?:{_NUMBER} {_NUMBER}|- -)"
_HELLO = re.compile(rf"<H {_NUMBER} (\S+)(?: {_NUMBER} {_NUMBER} ([pebw-]) {_NUMBER})?(?: .*)?", re.ASCII)
_STATUS = re.compile(
    rf"<S {_NUMBER} {_NUMBER} {_NUMBER} ([{''.join(RESULTS)}]) ([MAS]) ([{''.join(REASONS)}]) "
    rf"([{''.join(MISSING)}]) {_NUMBER} {_NUMBER} {_NUMBER} {_PULSE} {_PULSE} {_NUMBER} {_NUMBER} {_NUMBER} {_NUMBER}",
    re.ASCII,
)


def parse(line: bytes, host_s: float) -> Hello | Telemetry | None:
    """Parse a line of the Arduino, without its line feed. Return None if it is garbled or not of the protocol."""
    if len(line) > LINE_MAX or not line.startswith(b"<"):
        return None
    body, star, crc = line.rpartition(b"*")
    if not star or crc != b"%08X" % zlib.crc32(body):
        return None
    text = body.decode("ascii", "replace")
    if match := _HELLO.fullmatch(text):
        protocol, firmware, boot, sequence, reset, car = match.groups()
        if int(protocol) == PROTOCOL_VERSION and boot is None:
            return None
        # In another protocol only the first two fields are sure to mean the same.
        return Hello(int(protocol), firmware, int(boot or 0), int(sequence or 0), RESETS[reset or "-"], int(car or 0))
    match = _STATUS.fullmatch(text)
    if not match:
        return None
    boot, uptime, sequence, result, state, reason, missing, *numbers = match.groups()
    values: list[Any] = [None if n is None else int(n) for n in numbers]  # the pattern says which may be None
    return Telemetry(host_s, int(boot), int(uptime), int(sequence), result, State(state), reason, missing, *values)
