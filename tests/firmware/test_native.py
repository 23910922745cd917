"""The firmware's parser and state machine, compiled for this machine: fuzzed, and held against the host's own code."""

import ctypes
import functools
import re
import subprocess

import needs
import pytest
import uno
from hypothesis import given
from hypothesis import strategies as st

from lab.driving.virtual import library
from rover_lib.onboard.car import car, servo_link
from rover_lib.onboard.errors import RoverError

pytestmark = needs.gcc
FOLDER = uno.REPOSITORY / "firmware" / "rover"
SOURCES = FOLDER / "protocol.c", FOLDER / "vehicle.c"
FUZZ = uno.REPOSITORY / "tests" / "firmware" / "fuzz.c"
READ_COMMAND = 1
CarNumbers = ctypes.c_uint16 * 9
PULSES = "PERIOD", "MIN", "NEUTRAL", "MAX"
SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def fuzz(program, lines, seed):
    return subprocess.run([program, str(lines), str(seed)], capture_output=True, text=True, timeout=600)


@pytest.mark.slow
@pytest.mark.parametrize("count", [100_000, pytest.param(10_000_000, marks=pytest.mark.release)])
@pytest.mark.parametrize("human", ["receiver", "gamepad"])
def test_random_and_mutated_lines(count, human):
    """Never an unsafe pulse, no stuck state, no access out of bounds: tests/firmware/fuzz.c says what is unsafe."""
    gamepad = ["-DHUMAN_GAMEPAD"] * (human == "gamepad")
    done = fuzz(uno.compiled(f"fuzz-{human}", *SANITIZE, *gamepad, FUZZ, *SOURCES), count, 1)
    assert done.returncode == 0, done.stderr
    numbers = map(int, re.findall(r"\d+", done.stdout))
    lines, commands, driven, *kinds, starts, clock_wraps, sequence_wraps, cars = numbers
    assert lines >= count and commands > 0.4 * count and driven > 0.05 * count and cars > count / 1000
    assert min(kinds) > 0.1 * count and min(starts, clock_wraps, sequence_wraps) > count / 50_000


@pytest.mark.parametrize(
    ("name", "file", "good", "bad"),
    [
        ("late", "vehicle.c", "now_ms - command->heard_ms > LATE_MS", "false"),
        ("car's cap", "vehicle.c", "within(car->cap_us, 1, CAP_MAX_US)", "within(car->cap_us, 1, 200)"),
        ("told", "vehicle.c", "!vehicle->car_told ||", ""),
        ("replay", "vehicle.c", "!within(ahead, 1, SEQUENCE_WINDOW)", "ahead == 0"),
        ("crc", "protocol.c", "if (end[i] != hex(crc & 15))", "if (i == 1 && end[i] != hex(crc & 15))"),
        ("overflow", "protocol.c", "reader->length == HOST_LINE_MAX", "reader->length == HOST_LINE_MAX + 40"),
    ],
)  # fmt: skip
@pytest.mark.slow
def test_the_fuzz_finds_planted_faults(tmp_path, name, file, good, bad):
    text = (FOLDER / file).read_text()
    assert text.count(good) == 1, f"{good!r} is no longer in {file}"
    (tmp_path / file).write_text(text.replace(good, bad))
    other = FOLDER / ("protocol.c" if file == "vehicle.c" else "vehicle.c")
    sanitize = SANITIZE if name == "overflow" else ()  # the fuzz itself sees the rest, in a third of the time
    judge = uno.compiled("judge-sanitized.o" if sanitize else "judge.o", *sanitize, "-c", FUZZ)
    program = uno.compiled(f"fuzz-{name}", *sanitize, "-Wno-error", judge, tmp_path / file, other)
    done = fuzz(program, 300_000, 1)
    assert done.returncode != 0, f"the fault was not found: {done.stdout}"


class Command(ctypes.Structure):
    """As in protocol.h."""

    _fields_ = (
        ("kind", ctypes.c_char),
        *((name, ctypes.c_uint32) for name in ("boot", "sequence", "heard_ms", "steering_us", "throttle_us")),
        *((name, ctypes.c_uint32) for name in ("asked_ms", "car")),
        ("numbers", CarNumbers),
    )


@functools.cache
def native():
    code = ctypes.CDLL(str(library()))
    code.car_id.restype = ctypes.c_uint32
    code.car_allowed.restype = ctypes.c_bool
    return code


def read(data: bytes) -> list[Command]:
    """The commands that the firmware finds in bytes."""
    reader, commands = ctypes.create_string_buffer(128), []  # a struct reader is 96 bytes
    for byte in data:
        command = Command()
        if native().reader_take(reader, ctypes.c_uint8(byte), 0, ctypes.byref(command)) == READ_COMMAND:
            commands.append(command)
    return commands


NUMBER = st.integers(0, 2**32 - 1)
SENT = (("D", 5, NUMBER), ("A", 5, NUMBER), ("C", 11, st.integers(0, 65535)))
LINES = st.sampled_from(SENT).flatmap(
    lambda sent: st.lists(sent[2], min_size=sent[1], max_size=sent[1]).map(
        lambda numbers: servo_link.frame(f">{sent[0]} " + " ".join(map(str, numbers)))
    )
)


@given(st.sampled_from("ANDL"), st.lists(NUMBER, min_size=5, max_size=5))
def test_what_the_host_sends_is_what_the_firmware_reads(kind, numbers):
    fields = {"A": "heard_ms asked_ms car", "N": "", "L": "throttle_us", "D": "heard_ms steering_us throttle_us"}
    sent = dict(zip(["boot", "sequence", *fields[kind].split()], numbers, strict=False))
    (command,) = read(servo_link.frame(f">{kind} " + " ".join(map(str, sent.values()))))
    assert command.kind.decode() == kind
    for name in ("boot", "sequence", "heard_ms", "steering_us", "throttle_us", "asked_ms", "car"):
        assert getattr(command, name) == sent.get(name, 0)


@given(LINES, st.data())
def test_up_to_three_flipped_bits_are_no_command(text, data):
    bits = data.draw(st.sets(st.integers(0, len(text) * 8 - 1), min_size=1, max_size=3))
    bad = bytearray(text)
    for bit in bits:
        bad[bit // 8] ^= 1 << bit % 8
    # A flip may make a '>' or an end of line, which start and end lines: never a command of what is left.
    assert read(bytes(bad)) == []


def test_what_is_nearly_a_line_is_no_command():
    for body in (
        *("<D 0 1 2 1900 232", ">D  0 1 2 1900 232", ">D 0 1 2 1900 232 ", ">D 0 1 2 1900 232 0", ">D 0 1 2 1900", ">"),
        *(f">D 0 1 2 {n} 232" for n in ("+1900", "01900", "-1900", "0x76C", 1900 + 2**32, "1900" + " " * 60)),
        *(">d 0 1 2 1900 232", ">X 0 1 2 1900 232", ""),
    ):
        assert read(servo_link.frame(body)) == []  # with the right checksum
    good = servo_link.frame(">D 0 1 2 1900 232")
    for bad in (good[:-10] + b"\n", good[:-9] + b"\n", good[:-1] + b"0\n", good[:-2] + b"\n", good[1:]):
        assert read(bad) == []


@given(st.binary(max_size=80), LINES)
def test_a_line_is_found_behind_any_rubbish(rubbish, text):
    assert len(read(rubbish + text)) == 1


def test_both_sides_have_the_same_limits():
    """vehicle.h and car.py are two files for two machines; the numbers are one."""
    text = (FOLDER / "vehicle.h").read_text()
    limit = {name: int(value) for name, value in re.findall(r"\b(\w+_US) = (\d+)", text)}
    default = [limit[f"{name}_{what}_US"] for name in ("STEERING", "THROTTLE") for what in PULSES]
    assert (*default, limit["CAP_MAX_US"]) == car.DEFAULT_NUMBERS
    names = ["PERIOD_MIN", "PERIOD_MAX", "FAST_PERIOD_MIN", "FAST_PERIOD_MAX", "FAST_NEUTRAL_MIN", "FAST_NEUTRAL_MAX"]
    names += ["PULSE_MIN", "PULSE_MAX", "STEERING_NEUTRAL_MIN", "THROTTLE_NEUTRAL_MIN", "NEUTRAL_MAX", "STEERING_THROW"]
    for name in [*names, "CAP_MAX"]:
        assert limit[f"{name}_US"] == getattr(car, f"{name}_US"), name
    assert limit["THROTTLE_MAX_US"] == car.FAST_PULSE_MAX_US
    assert int(re.search(r"LATE_MS = (\d+)", text)[1]) == servo_link.LATE_S * 1000


@given(st.data())
def test_both_sides_allow_the_same_cars(data):
    """What car.py makes a Car of, the firmware takes, by the same name; what it refuses for its pulses, it refuses."""
    around = {3000: 60, 20000: 9000, 25000: 60, 1010: 20}
    period = st.sampled_from(list(around)).flatmap(lambda us: st.integers(us - around[us], us + around[us]))
    pulse = st.integers(700, 2300)
    fast = st.integers(30, 1000)
    steering = data.draw(st.tuples(period, *[pulse] * 3))
    throttle = data.draw(st.one_of(st.tuples(period, *[pulse] * 3), st.tuples(st.integers(990, 1030), *[fast] * 3)))
    keys = "period_us", "right_us", "neutral_us", "left_us"
    content = {"steering": dict(zip(keys, steering, strict=True))}
    keys = "period_us", "reverse_us", "neutral_us", "forward_us"
    content["throttle"] = dict(zip(keys, throttle, strict=True)) | {"cap_us": data.draw(st.integers(0, 150))}
    if data.draw(st.booleans()):
        del content["throttle"]["reverse_us"]
    try:
        found = car.Car.of(content)
    except RoverError:
        return
    numbers = CarNumbers(*found.numbers)
    assert native().car_allowed(numbers), found.numbers
    assert native().car_id(numbers) == found.id
    # And each of its numbers beyond a limit is one that the firmware refuses by itself.
    for i, bad in ((0, 2999), (0, 25001), (1, 799), (2, 1299), (3, 2201), (4, 999), (4, 25001), (8, 119), (8, 0)):
        other = list(found.numbers)
        other[i] = bad
        assert not native().car_allowed(CarNumbers(*other)), other
