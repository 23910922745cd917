"""Faults of the cable and of what it carries: cut, stuck, garbled, late, replayed, or from another program."""

import random
import time
from collections.abc import Callable

from lab.driving.bench import DrivingBench
from lab.driving.cable import Change, dropping, flipping, lagging, whole_lines
from lab.driving.pins import CAR, CONTINUES, REFUSED, STOPPED
from lab.driving.policy import OTHER, PLAIN
from lab.driving.row import FaultKind
from rover_lib.onboard.car.servo_link import LATE_S, frame

FAULTS = FaultKind("link")


@FAULTS.add("serial unplugged", STOPPED, "is it still plugged in", "both ends of the pty behind the port are closed")
def _unplug_serial(bench: DrivingBench) -> None:
    bench.cable.unplug()


@FAULTS.add("serial stuck", STOPPED, "took no data", "the port's output is suspended: writes block")
def _stick(bench: DrivingBench) -> None:
    bench.cable.stick()


@FAULTS.add(
    "serial silent from the host", STOPPED, "no valid command for 150 ms", "the line to the Arduino carries nothing"
)
def _silence(bench: DrivingBench) -> None:
    bench.cable.to_arduino = lambda data: b""


COMMANDS_LOST = "the Arduino stops the car 150 ms after the last command that came through, in 5 commands' time"


@FAULTS.add(
    "link falls behind",
    STOPPED,
    "the link is behind|no valid command for 150 ms",
    "each line to the Arduino is later than the one before, by 8 ms; counted from the first that is 150 ms late",
)
def _fall_behind(bench: DrivingBench) -> float:
    """Fall behind slowly, so that lines keep coming. A cable that is 2 s late at once is silent for the Arduino."""
    behind = 0.25  # seconds in each second
    bench.cable.to_arduino = lagging(behind)
    late_s = LATE_S - 0.05 * (CAR.human == "gamepad")  # its sticks are as old as the status that they answer
    bench.wait(late_s / behind)
    return time.monotonic()


def _both_ways(bench: DrivingBench, change: Callable[[random.Random, float], Change], share: float) -> None:
    bench.cable.to_arduino = change(bench.rng, share)
    bench.cable.to_host = change(random.Random(bench.rng.random()), share)


@FAULTS.add(
    "bit flips at 1 % of bytes",
    CONTINUES,
    "the link",
    "a bit of 1 % of the bytes, in both directions",
    watch_s=2.0,
    limits=COMMANDS_LOST,
    human="receiver",  # a gamepad's sticks go the same way, and are lost when 150 ms of them are
)
def _flip(bench: DrivingBench) -> None:
    _both_ways(bench, flipping, 0.01)


@FAULTS.add(
    "lines dropped at 30 %",
    CONTINUES,
    "the link",
    "30 % of the lines, in both directions",
    watch_s=2.0,
    limits=COMMANDS_LOST,
    human="receiver",  # a gamepad's sticks go the same way, and are lost when 150 ms of them are
)
def _drop(bench: DrivingBench) -> None:
    _both_ways(bench, dropping, 0.3)


@FAULTS.add(
    "old line replayed",
    CONTINUES,
    "the link",
    "after other plans: the lines that asked for them, one every 20 ms",
    limits="none: an old sequence moves no pin and renews nothing",
)
def _replay(bench: DrivingBench) -> float:
    first = len(bench.cable.lines)
    bench.show(OTHER)
    bench.wait(0.8)
    old = bench.cable.lines[first + 10 :]
    bench.show(PLAIN)
    bench.wait(0.8)
    at_s = time.monotonic()
    for line in old[-50:]:
        bench.cable.inject(line)
        bench.wait(0.02)
    return at_s


@FAULTS.add(
    "line cut in half",
    CONTINUES,
    "the link",
    "every third line, in both directions",
    watch_s=2.0,
    limits=COMMANDS_LOST,
    human="receiver",  # a gamepad's sticks go the same way, and are lost when 150 ms of them are
)
def _cut(bench: DrivingBench) -> None:
    def cutting() -> Change:
        number = 0

        def cut(line: bytes) -> bytes:
            nonlocal number
            number += 1
            return line if number % 3 else line[: len(line) // 2]

        return whole_lines(cut)

    bench.cable.to_arduino, bench.cable.to_host = cutting(), cutting()


@FAULTS.add(
    "another program writes to the port",
    CONTINUES,
    "the link",
    "rubbish, a modem manager's questions, and whole lines for another start of the Arduino, one every 15 ms",
    limits="none by what it writes; what it reads is lost to rover drive: 0.5 s without a status stop the car",
)
def _intrude(bench: DrivingBench) -> float:
    whole = [frame(f">D 0 {n} 0 2000 200") for n in range(1, 20)] + [frame(">A 0 1 0 0 0"), frame(">N 0 2")]
    bench.cable.not_ours |= {line[:-1] for line in whole}
    at_s = time.monotonic()
    with open(bench.cable.port, "wb", buffering=0) as port:  # noqa: PTH123  # a device
        for _ in range(60):
            what = bench.rng.choice([b"AT\r", b"AT+GCAP\r", bench.rng.randbytes(20), bench.rng.choice(whole)])
            port.write(what)
            bench.wait(0.015)
    return at_s


BEHIND = "has not answered for|the link is behind"


@FAULTS.add(
    "answers fall behind", STOPPED, BEHIND, "each passes later than the one before, by half of the time between"
)
def _answers_behind(bench: DrivingBench) -> float:
    bench.cable.to_host = lagging(0.5)
    bench.wait(0.3)
    return time.monotonic()


@FAULTS.add("serial silent to the host", STOPPED, BEHIND, "the line from the Arduino carries nothing")
def _silence_answers(bench: DrivingBench) -> None:
    bench.cable.to_host = lambda data: b""


@FAULTS.add(
    "noise on the line", STOPPED, f"{BEHIND}|no valid command", "a bit of 30 % of the bytes, in both directions"
)
def _noise(bench: DrivingBench) -> None:
    _both_ways(bench, flipping, 0.3)


@FAULTS.add(
    "each line twice",
    CONTINUES,
    "the link",
    "in both directions",
    watch_s=2.0,
    limits="none: an old sequence moves no pin and renews nothing",
)
def _double(bench: DrivingBench) -> None:
    bench.cable.to_arduino = whole_lines(lambda line: line + line)
    bench.cable.to_host = whole_lines(lambda line: line + line)


@FAULTS.add(
    "no Arduino at the start", REFUSED, "cannot be opened", "the pty behind the port is closed before the drive"
)
def _no_arduino(bench: DrivingBench) -> None:
    bench.cable.unplug()


@FAULTS.add("another firmware on the Arduino", REFUSED, "make -C firmware flash|make flash", "its hello says 1.9.9")
def _other_firmware(bench: DrivingBench) -> None:
    def other(line: bytes) -> bytes:
        words = line.split(b"*")[0].decode(errors="replace").split(" ")
        return frame(" ".join([*words[:2], "1.9.9", *words[3:]])) if words[0] == "<H" else line

    bench.cable.to_host = whole_lines(other)
