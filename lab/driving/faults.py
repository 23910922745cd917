"""Faults while the car drives at speed, judged by the pulses on its servo pins: `python -m lab faults OUTPUT`.

Everything is what drives the real car: `rover drive` as a process, pyserial, and the real firmware, in simavr and in
real time. Three things stand in for hardware. The camera is a FIFO of JPEGs, read by the same Camera class as a V4L2
device (which needs a kernel with v4l2loopback to be emulated). The cable is a pair of ptys with this program between
them, so that it can be cut, stuck and garbled. The transmitter's pulses are simavr's.

The policy is a small artifact that does what the corner of the picture tells it to: raise, hang, give NaN. So what
happens inside an inference comes in by the camera, and there is no hook for tests in what drives. Only what cannot
come from outside (an exception in the logger, the death of a thread) is done by the bench inside the process of the
drive, on SIGUSR2, before `rover_lib.cli.main` is called.

A row's `expected` is `stopped` (neutral, until an explicit new start), `human` (the transmitter's pulses) or
`continues` (only what drive commanded, on time). All times are of the monotonic clock that simavr's pins, the cable
and this program share.
"""

import contextlib
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lab.arduino.emulator import CC, REPOSITORY, build, compile_c
from lab.driving.bench import END_S, Drive, DrivingBench, FaultError, RoverCommand
from lab.driving.cable import Change, dropping, flipping, whole_lines
from lab.driving.pins import (
    CONTINUES,
    HUMAN,
    LATE_COMMAND_S,
    PERIOD_US,
    STEP_US,
    STOPPED,
    TICK_US,
    Gates,
    Observation,
    Verdict,
    judge,
)
from lab.driving.policy import HANG, NAN, OTHER, OUT_OF_RANGE, PLAIN, RAISE, SLOW, pictures
from rover_lib.onboard.servo_link import frame
from rover_lib.onboard.stage import write_stage
from rover_lib.world.standin import REST_US, PinEvent

ATTEMPTS = 5  # at a row that this machine spoilt
FUZZ_LINES = 1_000_000


@dataclass(frozen=True)
class FaultRow:
    """One fault, and what is expected of it.

    inject: makes it happen, waits if it takes time, and returns when it happened (None: when called).
    message: a regular expression of the line that tells of it, in the flight log or on stderr; of the drive after it if
    told_later. method: how it is injected. watch_s: how long it is watched after inject.
    start: of the drive, see Drive. exit_code: of the drive, None: it goes on.
    limits: what makes a `continues` stop after all. until_limit: that happens here.
    starves: it takes the time of this machine away. human_us: of `human`.
    """

    name: str
    expected: str
    inject: Callable[[DrivingBench], float | None]
    message: str
    method: str
    exit_code: int | None
    watch_s: float = 1.0
    start: str = ""
    told_later: bool = False
    limits: str = ""
    until_limit: bool = False
    starves: bool = False
    human_us: tuple[float, float] = REST_US


FAULTS: list[FaultRow] = []


def _fault(name: str, expected: str, message: str, method: str, **more: Any) -> Callable[[Callable], Callable]:
    more.setdefault("exit_code", {STOPPED: 3, HUMAN: 4, CONTINUES: None}[expected])

    def add(inject: Callable[[DrivingBench], float | None]) -> Callable[[DrivingBench], float | None]:
        FAULTS.append(FaultRow(name, expected, inject, message, method, **more))
        return inject

    return add


def _by_picture(name: str, instruction: int, message: str) -> None:
    _fault(name, STOPPED, message, "the picture tells the policy to")(lambda bench: bench.show(instruction))


def _by_signal(name: str, number: int, message: str, **more: Any) -> None:
    _fault(name, STOPPED, message, "a signal from outside", **more)(lambda bench: bench.signal(number))


@_fault("camera unplugged", STOPPED, "is the camera unplugged", "the FIFO's writer closes it")
def _unplug_camera(bench: DrivingBench) -> None:
    bench.feed.close()


@_fault("camera frozen", STOPPED, "the camera is frozen", "the same JPEG again and again")
def _freeze(bench: DrivingBench) -> None:
    bench.feed.freeze()


@_fault("camera black", STOPPED, "picture is black", "black pictures, with a sensor's noise")
def _blacken(bench: DrivingBench) -> None:
    bench.feed.show(*pictures(PLAIN, level=0))


@_fault("camera changes its picture's size", STOPPED, "the picture changed from", "pictures of 160x80")
def _resize(bench: DrivingBench) -> None:
    bench.feed.show(*pictures(PLAIN, size=(80, 160)))


_by_picture("inference raises", RAISE, "told to fail by the picture")
_by_picture("inference returns NaN", NAN, "NaN or Inf|not finite")
_by_picture("inference returns out of range", OUT_OF_RANGE, "outside the range")


@_fault("inference process killed", STOPPED, r"process ended \(SIGKILL\)", "SIGKILL to the child of rover drive")
def _kill_inference(bench: DrivingBench) -> None:
    for pid in bench.drive.children():
        os.kill(pid, signal.SIGKILL)


@_fault(
    "loop thread killed",
    STOPPED,
    "the loop has not ticked",
    "the loop's thread leaves by exit(2), in the process",
    start="end the loop's thread",
)
def _kill_loop(bench: DrivingBench) -> None:
    bench.signal(signal.SIGUSR2)


@_fault(
    "exception in the loop",
    STOPPED,
    "raised in the loop",
    "raised by a signal's handler, wherever the loop is",
    start="raise in the loop",
)
def _raise_in_loop(bench: DrivingBench) -> None:
    bench.signal(signal.SIGUSR2)


@_fault("host process stopped", STOPPED, "no valid command for 150 ms|said nothing for", "SIGSTOP, after 1 s SIGCONT")
def _pause_process(bench: DrivingBench) -> float:
    at_s = time.monotonic()
    bench.signal(signal.SIGSTOP)
    bench.wait(1.0)
    bench.signal(signal.SIGCONT)
    return at_s


_by_signal("SIGTERM", signal.SIGTERM, "SIGTERM: stopping", exit_code=0)
_by_signal("SIGINT", signal.SIGINT, "SIGINT: stopping", exit_code=0)
_by_signal("SIGHUP", signal.SIGHUP, "SIGHUP: stopping", exit_code=0)
_by_signal("SIGKILL", signal.SIGKILL, "the drive before this one", exit_code=-signal.SIGKILL, told_later=True)


@_fault("serial unplugged", STOPPED, "is it still plugged in", "both ends of the pty behind the port are closed")
def _unplug_serial(bench: DrivingBench) -> None:
    bench.cable.unplug()


@_fault("serial stuck", STOPPED, "took no data", "the port's output is suspended: writes block")
def _stick(bench: DrivingBench) -> None:
    bench.cable.stick()


@_fault(
    "serial silent from the host", STOPPED, "no valid command for 150 ms", "the line to the Arduino carries nothing"
)
def _silence(bench: DrivingBench) -> None:
    bench.cable.to_arduino = lambda data: b""


@_fault("Arduino reset", STOPPED, r"was reset \(reset pin\)", "the reset button")
def _reset(bench: DrivingBench) -> None:
    bench.arduino.reset()


@_fault("Arduino loop hung", STOPPED, r"was reset \(watchdog\)", "an endless loop in place of the firmware's")
def _hang(bench: DrivingBench) -> None:
    bench.arduino.hang()


@_fault("receiver lost", STOPPED, "transmitter's signal was lost", "no pulses on the receiver's pins")
def _lose_receiver(bench: DrivingBench) -> None:
    bench.arduino.transmitter(0, 0)


@_fault("receiver's throttle channel lost", STOPPED, "transmitter's signal was lost", "no pulses on that pin")
def _lose_throttle(bench: DrivingBench) -> None:
    bench.arduino.transmitter(REST_US[0], 0)


def _by_human(name: str, steering_us: float, throttle_us: float) -> None:
    human_us = (steering_us, throttle_us)
    _fault(name, HUMAN, "the human took over", f"the transmitter sends {human_us}", human_us=human_us)(
        lambda bench: bench.arduino.transmitter(*human_us)
    )


_by_human("human takes over by steering", 1600, 140)
_by_human("human takes over by throttle", 1470, 200)


@_fault(
    "frames late",
    CONTINUES,
    "no new frame",
    "none for 300 ms, then each 120 ms late",
    watch_s=0.1,
    limits="as 'camera gives no more frames', when none comes for longer than that",
)
def _frames_late(bench: DrivingBench) -> float:
    at_s = time.monotonic()
    bench.feed.pause()
    bench.wait(0.3)
    bench.feed.late_s = 0.12
    bench.show(PLAIN)
    bench.wait(1.5)
    bench.feed.late_s = 0.0
    return at_s


@_fault(
    "inference hangs for 300 ms",
    CONTINUES,
    "the policy took",
    "the picture tells the policy to",
    limits="as 'inference hangs', when it is longer",
)
def _slow_inference(bench: DrivingBench) -> float:
    at_s = time.monotonic()
    bench.show(SLOW)
    bench.wait(0.05)
    bench.show(PLAIN)
    bench.wait(0.5)
    return at_s


@_fault(
    "artifact swapped on disk",
    CONTINUES,
    "changed on disk",
    "another file is renamed onto it",
    watch_s=1.6,
    limits="none: the loaded policy drives on; the next start checks the new file",
)
def _swap(bench: DrivingBench) -> None:
    kept, other = bench.folder / "kept.pt", bench.folder / "other.pt"
    os.link(bench.artifact, kept)
    bench.undo.callback(kept.replace, bench.artifact)
    other.write_bytes(b"no artifact")
    other.replace(bench.artifact)


COMMANDS_LOST = "the Arduino stops the car 150 ms after the last command that came through, in 5 commands' time"


@_fault(
    "bit flips at 1 % of bytes",
    CONTINUES,
    "the link",
    "a bit of 1 % of the bytes, in both directions",
    watch_s=2.0,
    limits=COMMANDS_LOST,
)
def _flip(bench: DrivingBench) -> None:
    bench.cable.to_arduino = flipping(bench.rng, 0.01)
    bench.cable.to_host = flipping(random.Random(bench.rng.random()), 0.01)


@_fault(
    "lines dropped at 30 %",
    CONTINUES,
    "the link",
    "30 % of the lines, in both directions",
    watch_s=2.0,
    limits=COMMANDS_LOST,
)
def _drop(bench: DrivingBench) -> None:
    bench.cable.to_arduino = dropping(bench.rng, 0.3)
    bench.cable.to_host = dropping(random.Random(bench.rng.random()), 0.3)


@_fault(
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


@_fault(
    "line cut in half",
    CONTINUES,
    "the link",
    "every third line, in both directions",
    watch_s=2.0,
    limits=COMMANDS_LOST,
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


@_fault(
    "another program writes to the port",
    CONTINUES,
    "the link",
    "rubbish, a modem manager's questions, and whole lines for another start of the Arduino, one every 15 ms",
    limits="none by what it writes; what it reads is lost to rover drive: 0.5 s without a status stop the car",
)
def _intrude(bench: DrivingBench) -> float:
    whole = [frame(f">D 0 {n} 2000 700") for n in range(1, 20)] + [frame(">A 0 1"), frame(">N 0 2")]
    bench.cable.not_ours |= {line[:-1] for line in whole}
    at_s = time.monotonic()
    with open(bench.cable.port, "wb", buffering=0) as port:  # noqa: PTH123  # a device
        for _ in range(60):
            what = bench.rng.choice([b"AT\r", b"AT+GCAP\r", bench.rng.randbytes(20), bench.rng.choice(whole)])
            port.write(what)
            bench.wait(0.015)
    return at_s


@_fault(
    "CPU starved",
    CONTINUES,
    "this machine is busy",
    "4 busy processes of ordinary priority",
    watch_s=3.0,
    starves=True,
    limits="as 'inference hangs', when the policy gets so little that plans become too old",
)
def _starve(bench: DrivingBench) -> None:
    for _ in range(4):
        busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
        bench.undo.callback(busy.wait)
        bench.undo.callback(busy.kill)  # this one first
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, busy.pid, 0)


@_fault(
    "disk full while logging",
    CONTINUES,
    "the flight log cannot be written",
    "",
    start="disk",
    watch_s=2.0,
    limits="none: it drives without a log, and says so once",
)
def _fill_disk(bench: DrivingBench) -> None:
    bench.fill_disk()


for hours in (1, -1):
    _fault(
        f"clock stepped by {hours:+d} h",
        CONTINUES,
        re.escape(f"the system's clock was set by {hours * 3600:+d} s"),
        "a library under rover drive shifts the system's time; the machine's is left alone",
        start="clock",
        watch_s=1.6,
        limits="none: what drives asks the monotonic clock only",
    )(lambda bench, hours=hours: bench.step_clock(3600 * hours))


@_fault(
    "exception in the logger",
    CONTINUES,
    "raised in the logger",
    "each line of the flight log raises while it is made",
    start="raise in the logger",
    watch_s=2.0,
    limits="none: it drives without a log, and says so once",
)
def _fail_logger(bench: DrivingBench) -> None:
    bench.signal(signal.SIGUSR2)


@_fault(
    "inference hangs",
    CONTINUES,
    "the policy has not answered",
    "the picture tells the policy to loop for ever",
    watch_s=2.0,
    until_limit=True,
    exit_code=3,
)
def _hang_inference(bench: DrivingBench) -> None:
    bench.show(HANG)


@_fault(
    "camera gives no more frames",
    CONTINUES,
    "no new frame came",
    "the FIFO stays open, and nothing comes",
    watch_s=2.0,
    until_limit=True,
    exit_code=3,
)
def _no_frames(bench: DrivingBench) -> None:
    bench.feed.pause()


# ---- a run


def run_fault(bench: DrivingBench, fault: FaultRow, gates: Gates) -> dict[str, Any]:
    """Injects a fault into the drive that is at speed and judges it; a row of metrics.faults.

    Where this machine spoilt it, it is repeated, at most ATTEMPTS times in all. Its `recovered`, and its `log_line` if
    that is told later, are None where the next start of a drive tells them.
    """
    for attempts in range(1, ATTEMPTS + 1):
        seen, code, line = _inject(bench, fault)
        if attempts == ATTEMPTS or not _spoilt(fault, seen, gates):
            break
        bench.at_speed(fault.start)
    verdict = judge(fault.expected, seen, gates, human_us=fault.human_us, until_limit=fault.until_limit)
    if code != fault.exit_code:
        verdict.wrong.append(f"rover drive ended with {code}, expected {fault.exit_code}")
    return {
        "fault": fault.name,
        "expected": fault.expected,
        **verdict.figures,
        "recovered": not verdict.wrong if fault.exit_code is None else None,
        "log_line": line,
        "exit_code": code,
        "injected": fault.method if fault.start != "disk" else bench.disk_is,
        "limits": _limits(fault, verdict),
        "attempts": attempts,
        "stalled_ms": round(seen.stalled_ms(), 1),
        "wrong": verdict.wrong,
    }


def _inject(bench: DrivingBench, fault: FaultRow) -> tuple[Observation, int | None, str | None]:
    """Makes it happen once: what was seen, the drive's exit code, and the line that tells of it."""
    drive = bench.drive
    bench.rng.seed(fault.name)
    bench.events = bench.events[-2000:]
    drive.mark()
    called_s = time.monotonic()
    at_s = fault.inject(bench) or called_s
    bench.wait(fault.watch_s)
    end_s = time.monotonic()
    bench.wait(0.05)  # a pulse is known when it ends
    commands = [c for c in bench.cable.commands if at_s - 1 < c.at_s <= end_s]
    seen = Observation(bench.events, commands, at_s, end_s)
    code = drive.process.poll() if fault.exit_code is None else drive.wait(END_S)
    line = None if fault.told_later else _line_of(fault.message, drive, at_s)
    bench.clear_faults()
    return seen, code, line


def _spoilt(fault: FaultRow, seen: Observation, gates: Gates) -> bool:
    """Whether this machine had no time for the Arduino or for the drive, so that there is nothing to judge."""
    if seen.stalled_ms() or not seen.was_driving(gates.throttle_max_us):
        return True
    must_command = fault.expected == CONTINUES and not fault.until_limit and not fault.starves
    return must_command and seen.longest_pause_s() > LATE_COMMAND_S


def _limits(fault: FaultRow, verdict: Verdict) -> str:
    if not fault.until_limit:
        return fault.limits
    fades, stops = verdict.figures["fades_after_ms"], verdict.figures["stopped_after_ms"]
    return f"the plan's age: the throttle fades from {fades} ms on, is off at {stops} ms, and drive ends"


def _line_of(message: str, drive: Drive, since_s: float | None = None, within_s: float = 1.5) -> str | None:
    """The first line of the drive that matches."""
    deadline = time.monotonic() + within_s
    while True:
        for line in drive.messages(since_s):
            if re.search(message, line):
                return line
        if time.monotonic() > deadline:
            return None
        time.sleep(0.1)


def fuzz(lines: int = FUZZ_LINES, seed: int = 1) -> dict[str, Any]:
    """Random and mutated lines into the firmware's parser and state machine, natively: tests/firmware/fuzz.c.

    unsafe_pulses: 0 or 1, it ends at the first.
    """
    firmware = REPOSITORY / "firmware" / "rover"
    sources = REPOSITORY / "tests" / "firmware" / "fuzz.c", firmware / "protocol.c", firmware / "vehicle.c"
    with tempfile.TemporaryDirectory(prefix="rover-fuzz-") as folder:
        program = Path(folder) / "fuzz"
        compile_c(
            *CC, "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-I", firmware, "-o", program, *sources
        )
        done = subprocess.run([program, str(lines), str(seed)], capture_output=True, text=True)
    printed = (done.stdout + done.stderr).strip()
    return {"lines": lines, "seed": seed, "unsafe_pulses": int(done.returncode != 0), "said": printed}


def transmitted_and_replayed(bench: DrivingBench, steps: int = 24, step_s: float = 0.2) -> dict[str, Any]:
    """A transmitter's pulses, recorded by `rover record` and replayed by `rover drive --replay`, on the pins.

    worst_us: of all pulses of the replay, against what was transmitted in their place; None if that is another
    sequence. worst_ms: how far a step of the replay began from its time. Raises FaultError if either command fails.
    """
    rng = random.Random(0)
    sent = [REST_US]
    while len(sent) < steps - 1:
        pulses = float(rng.randint(1008, 1948)), float(rng.randint(140, 700))
        if all(abs(a - b) > 40 for a, b in zip(pulses, sent[-1], strict=True)):
            sent.append(pulses)
    sent.append(REST_US)
    bench.end_drive()
    bench.repair()
    folder, times_s = bench.folder / "episodes", []
    with contextlib.closing(RoverCommand("record", folder, *bench.devices())) as record:
        record.wait_for_message("recording")
        for pulses in sent:
            times_s.append(time.monotonic())
            bench.arduino.transmitter(*pulses)
            bench.wait(step_s)
        record.process.send_signal(signal.SIGINT)
        record.wait_for_success()
    bench.wait(0.1)
    bench.events = []
    episode = next(folder.glob("episode_*"))
    options = ["--replay", episode, "--port", bench.cable.port]
    with contextlib.closing(RoverCommand("drive", *options)) as replay:
        replay.wait_for_message("armed")
        bench.wait(steps * step_s)
        replay.wait_for_success()
    bench.wait(0.2)
    since_s = bench.cable.commands[0].at_s + 2 * PERIOD_US["steering"] * 1e-6  # before, they are the transmitter's
    return compare_steps([e for e in bench.events if e.monotonic_s > since_s], sent, times_s)


def compare_steps(
    events: Sequence[PinEvent], sent: Sequence[tuple[float, float]], times_s: Sequence[float]
) -> dict[str, Any]:
    """Steps of pulses (steering, throttle; us) that were sent at times, against those on the pins; see above."""
    result: dict[str, Any] = {"steps": len(sent), "worst_us": 0.0, "worst_ms": 0.0, "pulses": 0}
    for i, pin in enumerate(PERIOD_US):
        runs: list[list[PinEvent]] = []
        for e in events:
            if e.pin != pin or e.kind != "pulse":
                continue
            if not runs or abs(e.pulse_us - runs[-1][0].pulse_us) > 2 * STEP_US:
                runs.append([])
            runs[-1].append(e)
        result[f"{pin}_steps"] = len(runs)
        if len(runs) != len(sent):
            return result | {"worst_us": None}
        for run, pulses in zip(runs, sent, strict=True):
            # A pin does whole ticks; what simavr adds to an edge is its granularity, not the chip's.
            widths = {TICK_US[pin] * round(e.pulse_us / TICK_US[pin]) for e in run}
            result["worst_us"] = max(result["worst_us"], *(abs(us - pulses[i]) for us in widths))
            result["pulses"] += len(run)
        begun = np.array([run[0].monotonic_s for run in runs[1:]]) - np.array(times_s[1:])
        result["worst_ms"] = max(result["worst_ms"], round(float(np.abs(begun - np.median(begun)).max()) * 1e3, 1))
    return result


@dataclass
class FaultsOutcome:
    """What a run found: the rows, the fuzz and the bytes (None: left out), and all that is not as expected."""

    gates: Gates
    rows: list[dict[str, Any]] = field(default_factory=list)
    fuzz: dict[str, Any] | None = None
    bytes: dict[str, Any] | None = None
    wrong: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def summary(self) -> dict[str, Any]:
        """rows, stopped_rows, as_expected, worst_stopped_after_ms, takeover_ms, repeated, seconds."""
        stopped = [r for r in self.rows if r["expected"] == STOPPED]
        takeovers = [r["takeover_ms"] for r in self.rows if r.get("takeover_ms") is not None]
        return {
            "rows": len(self.rows),
            "stopped_rows": len(stopped),
            "as_expected": sum(not r["wrong"] for r in self.rows),
            "worst_stopped_after_ms": max((r["stopped_after_ms"] for r in stopped), default=None),
            "takeover_ms": max(takeovers, default=None),
            "repeated": sum(r["attempts"] > 1 for r in self.rows),
            "seconds": round(self.seconds, 1),
        }

    def write(self, path: Path | str) -> dict[str, Any]:
        """Writes the stage `faults`, and returns it."""
        metrics = {"faults": self.rows, "fuzz": self.fuzz, "bytes": self.bytes, "summary": self.summary}
        return write_stage(path, "faults", params=vars(self.gates), metrics=metrics | {"wrong": self.wrong})


def run_faults(
    only: Iterable[str] = (),
    *,
    gates: Gates | None = None,
    fuzz_lines: int = FUZZ_LINES,
    echo: Callable[[str], None] = lambda text: None,
) -> FaultsOutcome:
    """Injects all faults, or those of `only`, where 'fuzz' and 'bytes' are names too; about 5 minutes for all.

    echo: prints a line as each is done. Raises FaultError for names that are none and for a bench that does not drive,
    ArduinoError if there is no emulated Arduino here.
    """
    gates, only, begin = gates or Gates.of_params(), list(only), time.monotonic()
    if unknown := sorted(set(only) - {f.name for f in FAULTS} - {"fuzz", "bytes"}):
        names = [f.name for f in FAULTS]
        raise FaultError(f"no fault {unknown}", remedy=f"choose from {names}, 'fuzz' and 'bytes'")
    build()  # here, where its errors are seen
    outcome = FaultsOutcome(gates)
    chosen = [f for f in FAULTS if not only or f.name in only]
    if not only or "fuzz" in only:
        outcome.fuzz = fuzz(fuzz_lines)
        echo(f"fuzz: {outcome.fuzz['said']}")
        if outcome.fuzz["unsafe_pulses"]:
            outcome.wrong.append(f"fuzz: {outcome.fuzz['said']}")
    with DrivingBench() as bench:
        if not only or "bytes" in only:
            outcome.bytes = transmitted_and_replayed(bench)
            echo(f"bytes: {outcome.bytes}")
            if outcome.bytes["worst_us"] is None or outcome.bytes["worst_us"] > gates.bytes_us:
                outcome.wrong.append(f"bytes: {outcome.bytes}, {gates.bytes_us:g} us are allowed")
        for fault, row in _rows(bench, chosen, gates):
            _complete(fault, row)
            echo(row_text(row))
            outcome.rows.append(row)
            outcome.wrong += [f"{row['fault']}: {sentence}" for sentence in row["wrong"]]
    outcome.seconds = time.monotonic() - begin
    for name in ("rows", "stopped_rows"):
        if not only and outcome.summary[name] < getattr(gates, name):
            outcome.wrong.append(f"{outcome.summary[name]} {name}, {getattr(gates, name)} are wanted")
    return outcome


def _rows(bench: DrivingBench, chosen: Sequence[FaultRow], gates: Gates) -> Iterator[tuple[FaultRow, dict[str, Any]]]:
    """Each fault's row, once all that belongs to it is known: that it drives again only the next start tells."""
    before: tuple[FaultRow, dict[str, Any]] | None = None
    for fault in chosen:
        if before:
            _drive_again(bench, *before, fault.start)
            yield before
        else:
            bench.at_speed(fault.start)
        before = fault, run_fault(bench, fault, gates)
    if before:
        _drive_again(bench, *before, "")
        yield before


def _drive_again(bench: DrivingBench, fault: FaultRow, row: dict[str, Any], start: str) -> None:
    """The next drive; what it tells of a fault before it."""
    try:
        bench.at_speed(start)
        again = True
    except FaultError as error:
        row["wrong"].append(str(error))
        again = False
        bench.at_speed(start)
    if fault.exit_code is not None:
        row["recovered"] = again
    if fault.told_later:
        row["log_line"] = _line_of(fault.message, bench.drive)


def _complete(fault: FaultRow, row: dict[str, Any]) -> None:
    if row["log_line"] is None:
        row["wrong"].append(f"no line tells of it (wanted: {fault.message})")
    row["found"] = fault.expected if not row["wrong"] else "not as expected"


def row_text(row: dict[str, Any]) -> str:
    """A line for people: fault, expected, found, after how many milliseconds, log line."""
    ms = row.get("takeover_ms", row["stopped_after_ms"])
    ms = "" if ms is None else f"{ms:.0f} ms"
    line = " ".join((row["log_line"] or "no line").split())
    again = f" ({row['attempts']} attempts)" if row["attempts"] > 1 else ""
    return f"{row['fault']:<35} {row['expected']:<10} {row['found']:<16} {ms:>8}  {line[-70:]}{again}"
