"""The firmware's parser and state machine, compiled for this machine: fuzzed, and held against the host's own code."""

import ctypes
import functools
import re
import shutil
import subprocess
import zlib

import pytest
import uno
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.onboard import servo_link
from rover_lib.onboard.pwm import PwmCalibration

# The firmware's own source, compiled for this machine; .ci/run installs the compiler.
pytestmark = pytest.mark.skipif(not shutil.which("gcc"), reason="needs the Debian packages gcc libc6-dev")
SOURCES = uno.REPOSITORY / "firmware" / "rover"
FUZZ = uno.REPOSITORY / "tests" / "firmware" / "fuzz.c"
SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def fuzz(program, lines, seed):
    return subprocess.run([program, str(lines), str(seed)], capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("count", [100_000, pytest.param(1_000_000, marks=pytest.mark.release)])
def test_random_and_mutated_lines(count):
    """Never an unsafe pulse, no stuck state, no access out of bounds: tests/firmware/fuzz.c says what is unsafe."""
    program = uno.compiled("fuzz", *SANITIZE, FUZZ, SOURCES / "protocol.c", SOURCES / "vehicle.c")
    done = fuzz(program, count, 1)
    assert done.returncode == 0, done.stderr
    lines, commands, driven, *kinds = map(int, re.findall(r"\d+", done.stdout))
    assert lines >= count
    assert commands > 0.4 * count
    assert driven > 0.1 * count
    assert min(kinds) > 0.1 * count


@pytest.mark.parametrize(
    ("name", "file", "good", "bad"),
    [
        ("range", "vehicle.c", "!within(command->throttle_us, THROTTLE_MIN_US, THROTTLE_MAX_US)", "false"),
        ("replay", "vehicle.c", "!within(ahead, 1, SEQUENCE_WINDOW)", "ahead == 0"),
        ("boot", "vehicle.c", "command->boot != vehicle->boot ||", ""),
        ("timeout", "vehicle.c", ">= COMMAND_TIMEOUT_MS", ">= 400"),
        ("latch", "vehicle.c", "if (vehicle->state != AUTONOMOUS) return IGNORED;", "vehicle->state = AUTONOMOUS;"),
        ("signal", "vehicle.c", "if (received->present && now_ms", "if (false && now_ms"),
        ("stuck", "vehicle.c", "vehicle->sequence = command->sequence;", "vehicle->sequence |= command->sequence;"),
        ("crc", "protocol.c", "if (end[i] != hex(crc & 15))", "if (i == 1 && end[i] != hex(crc & 15))"),
        ("human", "vehicle.c", "if (moved) enter", "if (moved && channel != STEERING) enter"),
        ("stale", "protocol.c", "now_ms - reader->started_ms > LINE_LIFETIME_MS", "false"),
        ("overflow", "protocol.c", "reader->length == HOST_LINE_MAX", "reader->length == HOST_LINE_MAX + 40"),
    ],
)  # fmt: skip
@pytest.mark.slow
def test_the_fuzz_finds_planted_faults(tmp_path, name, file, good, bad):
    text = (SOURCES / file).read_text()
    assert text.count(good) == 1, f"{good!r} is no longer in {file}"
    (tmp_path / file).write_text(text.replace(good, bad))
    other = SOURCES / ("protocol.c" if file == "vehicle.c" else "vehicle.c")
    program = uno.compiled(f"fuzz-{name}", *SANITIZE, "-Wno-error", FUZZ, tmp_path / file, other)
    done = fuzz(program, 300_000, 1)
    assert done.returncode != 0, f"the fault was not found: {done.stdout}"


class Command(ctypes.Structure):
    _fields_ = (
        ("kind", ctypes.c_char),
        *((name, ctypes.c_uint32) for name in ("boot", "sequence", "steering_us", "throttle_us")),
    )


class Reader(ctypes.Structure):
    _fields_ = (
        ("line", ctypes.c_char * 63),
        ("length", ctypes.c_uint8),
        ("noise", ctypes.c_bool),
        ("started_ms", ctypes.c_uint32),
    )


class Line(ctypes.Structure):
    _fields_ = (("text", ctypes.c_char * 128), ("length", ctypes.c_uint8))


class Received(ctypes.Structure):
    _fields_ = (
        ("pulse_us", ctypes.c_uint16),
        ("period_us", ctypes.c_uint16),
        ("at_ms", ctypes.c_uint32),
        ("present", ctypes.c_bool),
    )


class Vehicle(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_char) for name in ("state", "reason", "result")),
        ("boot", ctypes.c_uint16),
        ("sequence", ctypes.c_uint32),
        ("steering_us", ctypes.c_uint16),
        ("throttle_us", ctypes.c_uint16),
        ("received", Received * 2),
        ("rest_us", ctypes.c_uint16 * 2),
        ("throttle_moved", ctypes.c_uint8),
        ("wanted_us", ctypes.c_uint16 * 2),
        ("commanded_ms", ctypes.c_uint32),
        *((name, ctypes.c_uint16) for name in ("bad_lines", "old_commands", "out_of_range", "lost_bytes")),
    )


@functools.cache
def native() -> ctypes.CDLL:
    library = ctypes.CDLL(
        str(uno.compiled("native.so", "-shared", "-fPIC", SOURCES / "protocol.c", SOURCES / "vehicle.c"))
    )
    library.crc32.restype = ctypes.c_uint32
    library.crc32.argtypes = [ctypes.c_char_p, ctypes.c_size_t]
    library.vehicle_status.restype = library.vehicle_hello.restype = ctypes.c_uint8
    library.vehicle_status.argtypes = [ctypes.POINTER(Vehicle), ctypes.c_uint32, ctypes.POINTER(Line)]
    library.vehicle_hello.argtypes = [ctypes.POINTER(Vehicle), ctypes.c_char, ctypes.POINTER(Line)]
    library.reader_take.argtypes = [
        ctypes.POINTER(Reader),
        ctypes.c_uint8,
        ctypes.c_uint32,
        ctypes.POINTER(Command),
    ]
    return library


def read(data: bytes) -> list[Command]:
    """The commands that the firmware finds in bytes."""
    reader, commands = Reader(), []
    for byte in data:
        command = Command()
        if native().reader_take(reader, byte, 0, command) == 1:
            commands.append(command)
    return commands


NUMBER = st.integers(0, 2**32 - 1)
LINES = st.one_of(
    st.builds(lambda *v: servo_link.frame(">D " + " ".join(map(str, v))), NUMBER, NUMBER, NUMBER, NUMBER),
    st.builds(lambda *v: servo_link.frame(">A " + " ".join(map(str, v))), NUMBER, NUMBER),
)


@given(st.binary(max_size=200))
def test_crc_is_zlibs(data):
    assert native().crc32(data, len(data)) == zlib.crc32(data)


@given(st.sampled_from("AND"), NUMBER, NUMBER, NUMBER, NUMBER)
def test_what_the_host_sends_is_what_the_firmware_reads(kind, boot, sequence, steering_us, throttle_us):
    values = (boot, sequence, steering_us, throttle_us) if kind == "D" else (boot, sequence)
    (command,) = read(servo_link.frame(f">{kind} " + " ".join(map(str, values))))
    assert command.kind.decode() == kind
    assert (command.boot, command.sequence) == (boot, sequence)
    assert (command.steering_us, command.throttle_us) == ((steering_us, throttle_us) if kind == "D" else (0, 0))


@given(st.binary(max_size=300))
def test_random_bytes_are_no_command(data):
    assert read(data + b"\n") == []


@given(LINES, st.data())
def test_up_to_three_flipped_bits_are_no_command(text, data):
    bits = data.draw(st.sets(st.integers(0, len(text) * 8 - 1), min_size=1, max_size=3))
    bad = bytearray(text)
    for bit in bits:
        bad[bit // 8] ^= 1 << bit % 8
    # A flip may make a '>' or an end of line, which start and end lines: never a command of what is left.
    assert read(bytes(bad)) == []


@given(st.binary(max_size=80), LINES)
def test_a_line_is_found_behind_any_rubbish(rubbish, text):
    assert len(read(rubbish + text)) == 1


U16 = st.integers(0, 65535)


@given(
    st.fixed_dictionaries(
        {
            "state": st.sampled_from("MAS"),
            "reason": st.sampled_from("rhatsn"),
            "result": st.sampled_from("-kirost"),
            "sequence": NUMBER,
            **dict.fromkeys(["boot", "steering_us", "throttle_us", "bad_lines", "old_commands"], U16),
            **dict.fromkeys(["out_of_range", "lost_bytes"], U16),
        }
    ),
    st.lists(st.tuples(st.booleans(), U16, U16), min_size=2, max_size=2),
    NUMBER,
)
def test_what_the_firmware_says_is_what_the_host_reads(fields, received, uptime_ms):
    vehicle = Vehicle(**{k: v.encode() if isinstance(v, str) else v for k, v in fields.items()})
    for channel, (present, pulse_us, period_us) in enumerate(received):
        vehicle.received[channel] = Received(pulse_us, period_us, 0, present)
    line = Line()
    length = native().vehicle_status(vehicle, uptime_ms, line)
    assert 0 < length <= 127  # it fits, however large its numbers are
    text = ctypes.string_at(ctypes.addressof(line), length)
    parsed = servo_link.parse(text[:-1], 12.5)
    assert text.endswith(b"\n")
    assert (parsed.host_s, parsed.uptime_ms, parsed.state.value) == (12.5, uptime_ms, fields["state"])
    assert {k: getattr(parsed, k) for k in fields if k != "state"} == {k: v for k, v in fields.items() if k != "state"}
    pulses = [(p, t) if present else (None, None) for present, p, t in received]
    assert (parsed.receiver_steering_us, parsed.receiver_steering_period_us) == pulses[0]
    assert (parsed.receiver_throttle_us, parsed.receiver_throttle_period_us) == pulses[1]


@given(st.integers(0, 65535), NUMBER, st.sampled_from("pebw-"))
def test_hello_is_what_the_host_reads(boot, sequence, cause):
    line = Line()
    length = native().vehicle_hello(Vehicle(boot=boot, sequence=sequence), cause.encode(), line)
    parsed = servo_link.parse(ctypes.string_at(ctypes.addressof(line), length - 1), 0)
    assert parsed == servo_link.Hello(1, "1.0.0", boot, sequence, servo_link.RESETS[cause])


def test_both_sides_have_the_same_limits():
    """vehicle.h and pwm.py are two files for two machines; the numbers are one."""
    text = (SOURCES / "vehicle.h").read_text()
    limit = {name: int(value) for name, value in re.findall(r"(\w+_US) = (\d+)", text)}
    pwm = PwmCalibration()
    neutral = pwm.neutral()
    assert (limit["STEERING_NEUTRAL_US"], limit["THROTTLE_NEUTRAL_US"]) == (neutral.steering_us, neutral.throttle_us)
    for name, channel in (("STEERING", pwm.steering), ("THROTTLE", pwm.throttle)):
        assert limit[f"{name}_MIN_US"] == channel.pulse_us(channel.low)
        assert limit[f"{name}_MAX_US"] == channel.pulse_us(channel.high)
        assert limit[f"RECEIVER_{name}_PERIOD_US"] == channel.period_us
    header = (SOURCES / "protocol.h").read_text()
    assert re.search(rf"PROTOCOL_VERSION {servo_link.PROTOCOL_VERSION}$", header, re.M)
