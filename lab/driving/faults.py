"""Inject faults while the car drives at speed, and judge the pulses on its servo pins: `python -m lab faults OUTPUT`.

Everything that drives is what drives the real car: `rover drive` as a process, pyserial, and the real firmware, in
simavr and in real time. Three pieces of hardware are replaced. The camera is a FIFO of JPEGs, read by the same Camera
class as a V4L2 device (to emulate one takes a kernel with v4l2loopback). The cable is a pair of ptys with this program
between them, so that it can be cut, stuck and garbled. The transmitter's pulses come from simavr.

The policy is a small artifact that does what the corner of the picture tells it to: raise, hang, give NaN. So a fault
inside an inference comes in through the camera, and the code that drives needs no hook for tests. A few faults cannot
come from outside, such as an exception in the logger or the death of a thread. For these the bench prepares the drive's
process before `rover_lib.cli.main` is called, and SIGUSR2 brings them about.

The rows are in rows/, in a module for each kind. A row expects one of these: `stopped` (neutral, until an explicit new
start), `human` (the transmitter's pulses), `continues` (only what the drive commanded, on time), or `refused` (the
fault is there before `rover drive` is started, and the car is never armed). All times are of the monotonic clock that
simavr's pins, the cable and this program share.
"""

import contextlib
import random
import re
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from balloon_world.simulated_arduino import REST_US, PinEvent
from lab.arduino.emulator import CC, REPOSITORY, build, compile_c
from lab.driving.bench import (
    END_S,
    IN_TERMINAL,
    START_S,
    Drive,
    DrivingBench,
    FaultError,
    RoverCommand,
    rover_after,
)
from lab.driving.pins import (
    CAR,
    CONTINUES,
    LATE_COMMAND_S,
    PERIOD_US,
    REFUSED,
    SLEW_US_PER_MS,
    STOPPED,
    TICK_US,
    Gates,
    Observation,
    Verdict,
    judge,
)
from lab.driving.row import FaultRow
from lab.driving.rows import FAULTS, KINDS
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US
from rover_lib.onboard.stage import write_stage

SLEWED_MS = 2  # for rounding to the milliseconds in which the Arduino slews, and for pulses that it measured a step off
TICK_S = 0.04  # a tick of a drive, and by how much it may be late
KNOWN_S = 0.05  # how long it takes until a pulse has ended and been read
ATTEMPTS = 5  # how often a row is tried if this machine was too busy
FUZZ_LINES = 1_000_000


def run_fault(bench: DrivingBench, fault: FaultRow, gates: Gates) -> dict[str, Any]:
    """Inject a fault into the drive that is at speed, judge it, and return a row of metrics.faults.

    If this machine was too busy for the fault to be judged, it is repeated, up to ATTEMPTS times in all. Two values are
    None in the row if only the next start of a drive tells them: `recovered` and `log_line`.
    """
    for attempts in range(1, ATTEMPTS + 1):
        seen, code, line = (_start_with if fault.expected == REFUSED else _inject)(bench, fault)
        if attempts == ATTEMPTS or not _spoilt(fault, seen, gates):
            break
        bench.at_speed(fault.start)
    verdict = judge(fault.expected, seen, gates, human_us=fault.human_us, until_limit=fault.until_limit)
    if code != fault.exit_code:
        verdict.wrong.append(f"rover drive ended with {code}, expected {fault.exit_code}")
    return {
        "fault": fault.name,
        "kind": fault.kind,
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
    """Inject a fault once. Returns what was seen, the drive's exit code, and the line that tells of the fault."""
    drive = bench.drive
    bench.rng.seed(fault.name)
    bench.events = bench.events[-2000:]
    drive.mark()
    called_s = time.monotonic()
    at_s = fault.inject(bench) or called_s
    bench.wait(fault.watch_s)
    end_s = time.monotonic()
    bench.wait(KNOWN_S)
    commands = [c for c in bench.cable.commands if at_s - 1 < c.at_s <= end_s]
    seen = Observation(bench.events, commands, at_s, end_s)
    code = drive.process.poll() if fault.exit_code is None else drive.wait(END_S)
    line = None if fault.told_later else _line_of(fault.message, drive, at_s)
    bench.clear_faults()
    return seen, code, line


def _start_with(bench: DrivingBench, fault: FaultRow) -> tuple[Observation, int | None, str | None]:
    """Do as _inject does, but inject the fault before the drive is started."""
    bench.rng.seed(fault.name)
    bench.end_drive()
    bench.wait(0.1)  # until its last pulses are over
    bench.events = []
    at_s = time.monotonic()
    drive = bench.start(fault.start, fault.inject)
    while drive.running and time.monotonic() < at_s + START_S:
        bench.wait(0.1)
    bench.wait(fault.watch_s)
    end_s = time.monotonic()
    bench.wait(KNOWN_S)
    seen = Observation(bench.events, bench.cable.commands, at_s, end_s)
    code, line = drive.wait(0), _line_of(fault.message, drive)
    bench.clear_faults()
    return seen, code, line


def _spoilt(fault: FaultRow, seen: Observation, gates: Gates) -> bool:
    """Whether this machine had no time for the Arduino or the drive, so that there is nothing to judge."""
    if seen.stalled_ms() or (fault.expected != REFUSED and not seen.was_driving(gates.throttle_max_us)):
        return True
    must_command = fault.expected == CONTINUES and not fault.until_limit and not fault.starves
    return must_command and seen.longest_pause_s() > max(LATE_COMMAND_S, fault.paused_s + TICK_S)


def _limits(fault: FaultRow, verdict: Verdict) -> str:
    if not fault.until_limit:
        return fault.limits
    fades, stops = verdict.figures["fades_after_ms"], verdict.figures["stopped_after_ms"]
    return f"the plan's age: the throttle fades from {fades} ms on, is off at {stops} ms, and drive ends"


def _line_of(message: str, drive: Drive, since_s: float | None = None, within_s: float = 1.5) -> str | None:
    """Return the first of the drive's messages that matches, or None if there is none within that time."""
    deadline = time.monotonic() + within_s
    while True:
        for line in drive.messages(since_s):
            if re.search(message, line):
                return line
        if time.monotonic() > deadline:
            return None
        time.sleep(0.1)


def fuzz(lines: int = FUZZ_LINES, seed: int = 1) -> dict[str, Any]:
    """Run tests/firmware/fuzz.c: give random and mutated lines to the firmware's parser and state machine, natively.

    In the result, unsafe_pulses is 0 or 1, as the program ends at the first unsafe pulse.
    """
    firmware = REPOSITORY / "firmware" / "rover"
    sources = REPOSITORY / "tests" / "firmware" / "fuzz.c", firmware / "protocol.c", firmware / "vehicle.c"
    with tempfile.TemporaryDirectory(prefix="rover-fuzz-") as folder:
        program = Path(folder) / "fuzz"
        gamepad = ["-DHUMAN_GAMEPAD"] * (CAR.human == "gamepad")
        sanitized = "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
        compile_c(*CC, *gamepad, *sanitized, "-I", firmware, "-o", program, *sources)
        done = subprocess.run([program, str(lines), str(seed)], capture_output=True, text=True)
    printed = (done.stdout + done.stderr).strip()
    return {"lines": lines, "seed": seed, "unsafe_pulses": int(done.returncode != 0), "said": printed}


def record_and_replay(bench: DrivingBench, steps: int = 24, step_s: float = 0.25) -> dict[str, Any]:
    """Record a transmitter's pulses by `rover record`, replay them by `rover drive --replay`, and compare the pins.

    Returns compare_steps()'s result. Raises FaultError if either command fails.
    """
    rng = random.Random(0)
    sent = [REST_US]
    while len(sent) < steps - 1:
        # These ranges are -256 to 304 and, for a car without a car.yml, 4 to 116, which the cap lets through.
        steering_us, throttle_us = rng.randint(-256, 304), rng.randint(4, CAR.cap_us - 2)
        pulses = REST_US[0] + steering_us, REST_US[1] + throttle_us
        if all(abs(a - b) > 40 for a, b in zip(pulses, sent[-1], strict=True)):
            sent.append(pulses)
    sent.append(REST_US)
    bench.end_drive()
    bench.repair()
    folder, times_s = bench.folder / "episodes", []
    with contextlib.closing(RoverCommand("record", folder, *bench.devices(), run=rover_after(bench.inside))) as record:
        record.wait_for_message("recording")
        for pulses in sent:
            times_s.append(time.monotonic())
            bench.human.transmitter(*pulses)
            bench.wait(step_s)
        record.process.send_signal(signal.SIGINT)
        record.wait_for_success()
    bench.wait(0.1)
    bench.events = []
    episode = next(folder.glob("episode_*"))
    options = ["--replay", episode, "--port", bench.cable.port]
    bench.human.ready(True)
    with contextlib.closing(RoverCommand("drive", *options, run=rover_after(bench.inside + IN_TERMINAL))) as replay:
        replay.wait_for_message("armed")
        bench.human.ready(False)
        bench.wait(steps * step_s)
        replay.wait_for_success()
    bench.wait(0.2)
    since_s = bench.cable.commands[0].at_s + 2 * PERIOD_US["steering"] * 1e-6  # before, the transmitter's pulses pass
    return compare_steps([e for e in bench.events if e.monotonic_s > since_s], sent, times_s)


def compare_steps(
    events: Sequence[PinEvent], sent: Sequence[tuple[float, float]], times_s: Sequence[float]
) -> dict[str, Any]:
    """Compare steps of pulses (steering, throttle; us), sent at those times, with the pulses on the pins.

    In the result, worst_us is the largest error of a pulse against what was sent in its place, or None if the steps on
    the pins are not those that were sent. worst_ms: by how much a step's delay differs from the median delay at most.
    """
    result: dict[str, Any] = {"steps": len(sent), "worst_us": 0.0, "worst_ms": 0.0, "pulses": 0}
    for i, pin in enumerate(PERIOD_US):
        pulses = [e for e in events if e.pin == pin and e.kind == "pulse"]
        off_us, begun_s = _follow(pin, pulses, [step[i] for step in sent])
        result[f"{pin}_steps"] = len(begun_s) + 1
        if len(begun_s) + 1 != len(sent):
            return result | {"worst_us": None}
        result["worst_us"] = max(result["worst_us"], *off_us)
        result["pulses"] += len(off_us)
        delays_s = np.array(begun_s) - np.array(times_s[1:])
        result["worst_ms"] = max(
            result["worst_ms"], round(float(np.abs(delays_s - np.median(delays_s)).max()) * 1e3, 1)
        )
    return result


def _follow(pin: str, pulses: Sequence[PinEvent], levels: Sequence[float]) -> tuple[list[float], list[float]]:
    """Return how far (us) each pulse is from its level, and when each level but the first was set out for.

    The firmware moves a pin no faster than its slew. So the pulses on the way from one level to the next belong to
    neither and are not counted, as long as each comes nearer to the next level and they take no longer than the slew.
    """
    off_us: list[float] = []
    begun_s: list[float] = []
    on_the_way, last = False, levels[0]
    for e in pulses:
        # A pin's pulses have whole ticks. The rest comes from simavr's granularity, not from the chip.
        us = TICK_US[pin] * round(e.pulse_us / TICK_US[pin])
        level, after = levels[len(begun_s) : len(begun_s) + 2] if len(begun_s) + 1 < len(levels) else (levels[-1],) * 2
        if not on_the_way and abs(us - level) > ARDUINO_STEP_US and (us - level) * (after - level) > 0:
            begun_s.append(e.monotonic_s)
            on_the_way, last, level = True, level, after
        if on_the_way:
            way_us = abs(level - levels[len(begun_s) - 1])
            most_s = (way_us / SLEW_US_PER_MS[pin] + SLEWED_MS) * 1e-3 + PERIOD_US[pin] * 1e-6
            nearer = min(last, level) <= us <= max(last, level) and e.monotonic_s - begun_s[-1] <= most_s
            on_the_way = nearer and abs(us - level) > ARDUINO_STEP_US
            last = us
        if not on_the_way:
            off_us.append(abs(us - level))
    if on_the_way:
        off_us.append(abs(last - levels[len(begun_s)]))
    return off_us, begun_s


@dataclass
class FaultsOutcome:
    """What a run found: the rows, the results of fuzz and bytes (None if left out), and what is not as expected."""

    gates: Gates
    rows: list[dict[str, Any]] = field(default_factory=list)
    fuzz: dict[str, Any] | None = None
    bytes: dict[str, Any] | None = None
    wrong: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def summary(self) -> dict[str, Any]:
        """The counts of rows, the worst times (ms), and how long the run took (seconds)."""
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
        """Write the stage `faults`, and return it."""
        metrics = {"faults": self.rows, "fuzz": self.fuzz, "bytes": self.bytes, "summary": self.summary}
        return write_stage(path, "faults", params=vars(self.gates), metrics=metrics | {"wrong": self.wrong})


def run_faults(
    only: Iterable[str] = (),
    *,
    kinds: Iterable[str] = (),
    gates: Gates | None = None,
    fuzz_lines: int = FUZZ_LINES,
    echo: Callable[[str], None] = lambda text: None,
) -> FaultsOutcome:
    """Inject all faults, or only those named in `only` and those of `kinds`. 'fuzz' and 'bytes' are names too.

    All faults take about 6 minutes. echo: called with a line when a fault is done. Raises FaultError for unknown names
    and if the bench does not drive, and ArduinoError if there is no emulated Arduino here.
    """
    gates, begin = gates or Gates.of_params(), time.monotonic()
    only, kinds = set(only), set(kinds)
    everything = not only and not kinds
    if unknown := sorted(only - {f.name for f in FAULTS} - {"fuzz", "bytes"}):
        names = [f.name for f in FAULTS]
        raise FaultError(f"no fault {unknown}", remedy=f"choose from {names}, 'fuzz' and 'bytes'")
    if unknown := sorted(kinds - KINDS.keys()):
        raise FaultError(f"no faults of kind {unknown}", remedy=f"choose from {sorted(KINDS)}")
    build()  # before the bench needs it, so that its errors are seen
    outcome = FaultsOutcome(gates)
    chosen = [f for f in FAULTS if everything or f.name in only or f.kind in kinds]
    # The fuzz runs beside the bytes, which wait for the emulated clock; no fault is injected meanwhile.
    with ThreadPoolExecutor() as beside, DrivingBench() as bench:
        fuzzing = beside.submit(fuzz, fuzz_lines) if everything or "fuzz" in only else None
        if (everything and CAR.human == "receiver") or "bytes" in only:
            outcome.bytes = record_and_replay(bench)
            echo(f"bytes: {outcome.bytes}")
            if outcome.bytes["worst_us"] is None or outcome.bytes["worst_us"] > gates.bytes_us:
                outcome.wrong.append(f"bytes: {outcome.bytes}, {gates.bytes_us:g} us are allowed")
        if fuzzing:
            outcome.fuzz = fuzzing.result()
            echo(f"fuzz: {outcome.fuzz['said']}")
            if outcome.fuzz["unsafe_pulses"]:
                outcome.wrong.append(f"fuzz: {outcome.fuzz['said']}")
        for fault, row in _rows(bench, chosen, gates):
            if row["log_line"] is None:
                row["wrong"].append(f"no line tells of it (wanted: {fault.message})")
            row["found"] = fault.expected if not row["wrong"] else "not as expected"
            echo(row_text(row))
            outcome.rows.append(row)
            outcome.wrong += [f"{row['fault']}: {sentence}" for sentence in row["wrong"]]
    outcome.seconds = time.monotonic() - begin
    for name in ("rows", "stopped_rows"):
        if everything and outcome.summary[name] < getattr(gates, name):
            outcome.wrong.append(f"{outcome.summary[name]} {name}, {getattr(gates, name)} are wanted")
    return outcome


def _rows(bench: DrivingBench, chosen: Sequence[FaultRow], gates: Gates) -> Iterator[tuple[FaultRow, dict[str, Any]]]:
    """Yield each fault's row as soon as all of it is known. Only the next start tells whether the car drives again.

    The faults that expect a refused drive come last, and a single drive after all of them.
    """
    refused = [fault for fault in chosen if fault.expected == REFUSED]
    waiting: list[tuple[FaultRow, dict[str, Any]]] = []
    for fault in chosen:
        if fault.expected != REFUSED:
            _drive_again(bench, waiting, fault.start)
            yield from waiting
            waiting = [(fault, run_fault(bench, fault, gates))]
    if waiting:
        _drive_again(bench, waiting, "")
        yield from waiting
    waiting = [(fault, run_fault(bench, fault, gates)) for fault in refused]
    if waiting:
        _drive_again(bench, waiting, "")
        yield from waiting


def _drive_again(bench: DrivingBench, waiting: Sequence[tuple[FaultRow, dict[str, Any]]], start: str) -> None:
    """Start the next drive, and complete the rows of the faults before it with what it tells of them."""
    again = True
    try:
        bench.at_speed(start)
    except FaultError as error:
        if not waiting:
            raise
        again = False
        waiting[-1][1]["wrong"].append(str(error))
        bench.at_speed(start)
    for fault, row in waiting:
        if fault.exit_code is not None:
            row["recovered"] = again
        if fault.told_later:
            row["log_line"] = _line_of(fault.message, bench.drive)


def row_text(row: dict[str, Any]) -> str:
    """Return a line for people: fault, expected, found, after how many milliseconds, log line."""
    ms = row.get("takeover_ms", row["stopped_after_ms"])
    ms = "" if ms is None else f"{ms:.0f} ms"
    line = " ".join((row["log_line"] or "no line").split())
    again = f" ({row['attempts']} attempts)" if row["attempts"] > 1 else ""
    return f"{row['fault']:<35} {row['expected']:<10} {row['found']:<16} {ms:>8}  {line[-70:]}{again}"
