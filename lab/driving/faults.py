"""Break what can break while the car drives, and see whether it stops: `python -m lab faults OUTPUT`.

Most faults are stories in virtual time (rows.py); twelve are on the pins of an emulated Arduino in real time
(on_pins.py). A fault expects one of these: `stopped` (neutral, until an explicit new start), `human` (the transmitter's
pulses), `continues` (only what the drive commanded, on time), or `refused` (it is there before the start, and the car
is never armed).
"""

import itertools
import logging
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lab.arduino.emulator import CC, REPOSITORY, compile_c
from lab.driving.on_pins import PIN_ROWS, PinRow, run_on_pins
from lab.driving.pins import STOPPED, Gates
from lab.driving.rows import FaultRow, rows_of, run_row
from rover_lib.onboard.car import servo_link
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import write_stage

FUZZ_LINES = 1_000_000


def fuzz(lines: int = FUZZ_LINES, seed: int = 1, human: str = "receiver") -> dict[str, Any]:
    """Run tests/firmware/fuzz.c: give random and mutated lines to the firmware's parser and state machine, natively.

    In the result, unsafe_pulses is 0 or 1, as the program ends at the first unsafe pulse.
    """
    firmware = REPOSITORY / "firmware" / "rover"
    sources = REPOSITORY / "tests" / "firmware" / "fuzz.c", firmware / "protocol.c", firmware / "vehicle.c"
    with tempfile.TemporaryDirectory(prefix="rover-fuzz-") as folder:
        program = Path(folder) / "fuzz"
        gamepad = ["-DHUMAN_GAMEPAD"] * (human == "gamepad")
        sanitized = "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
        compile_c(*CC, *gamepad, *sanitized, "-I", firmware, "-o", program, *sources)
        done = subprocess.run([program, str(lines), str(seed)], capture_output=True, text=True)
    printed = (done.stdout + done.stderr).strip()
    return {"lines": lines, "seed": seed, "unsafe_pulses": int(done.returncode != 0), "said": printed}


@dataclass
class FaultsOutcome:
    """What a run found: the rows, the result of fuzz (None if left out), and what is not as expected."""

    gates: Gates
    rows: list[dict[str, Any]] = field(default_factory=list)
    fuzz: dict[str, Any] | None = None
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

    def add(self, row: dict[str, Any]) -> None:
        self.rows.append(row)
        self.wrong += [f"{row['fault']}: {sentence}" for sentence in row["wrong"]]

    def write(self, path: Path | str) -> dict[str, Any]:
        """Write the stage `faults`, and return it."""
        metrics = {"faults": self.rows, "fuzz": self.fuzz, "summary": self.summary, "wrong": self.wrong}
        return write_stage(path, "faults", params=vars(self.gates), metrics=metrics)


def run_faults(
    only: Iterable[str] = (),
    *,
    kinds: Iterable[str] = (),
    car: Car | None = None,
    fuzz_lines: int = FUZZ_LINES,
    echo: Callable[[str], None] = lambda text: None,
) -> FaultsOutcome:
    """Inject all faults, or only those named in `only` and those of `kinds`. 'fuzz' is a name too.

    A fault of the default car that is on pins is not repeated in virtual time; other cars have all in virtual time.
    echo: called with a line when a fault is done. Raises RoverError for unknown names and if the bench does not drive,
    and RoverError if there is no emulated Arduino or no gcc here.
    """
    car, only, kinds, begin = car or Car(), set(only), set(kinds), time.monotonic()
    everything = not only and not kinds

    def chosen(row: FaultRow | PinRow) -> bool:
        return everything or row.name in only or row.kind in kinds

    on_pins = PIN_ROWS if car == Car() else ()
    rows = [row for row in rows_of(car) if row.name not in {row.name for row in on_pins}]
    all_rows = [*rows, *on_pins]
    if unknown := sorted(only - {row.name for row in all_rows} - {"fuzz"}):
        raise RoverError("no such fault", found=unknown, remedy=f"choose from {[r.name for r in all_rows]} and 'fuzz'")
    if unknown := sorted(kinds - {row.kind for row in all_rows}):
        raise RoverError("no such kind of fault", found=unknown, remedy=f"{sorted({row.kind for row in all_rows})}")
    logging.getLogger(servo_link.__name__).setLevel(logging.ERROR)  # it would warn of what is broken here on purpose
    outcome = FaultsOutcome(Gates.of_params(car))
    if everything or "fuzz" in only:
        outcome.fuzz = fuzz(fuzz_lines, human=car.human)
        echo(f"fuzz: {outcome.fuzz['said']}")
        if outcome.fuzz["unsafe_pulses"]:
            outcome.wrong.append(f"fuzz: {outcome.fuzz['said']}")
    in_stories = (run_row(fault, car) for fault in rows if chosen(fault))
    for row in itertools.chain(in_stories, run_on_pins([fault for fault in on_pins if chosen(fault)], outcome.gates)):
        outcome.add(row)
        echo(row_text(row))
    outcome.seconds = time.monotonic() - begin
    for name in ("rows", "stopped_rows"):
        if everything and outcome.summary[name] < getattr(outcome.gates, name):
            outcome.wrong.append(f"{outcome.summary[name]} {name}, {getattr(outcome.gates, name)} are wanted")
    return outcome


def row_text(row: dict[str, Any]) -> str:
    """Return a line for people: fault, expected, found, after how many milliseconds, log line."""
    ms = row.get("takeover_ms", row["stopped_after_ms"])
    ms = "" if ms is None else f"{ms:.0f} ms"
    line = " ".join((row["log_line"] or "no line").split())
    again = f" ({row['attempts']} attempts)" if row["attempts"] > 1 else ""
    return f"{row['fault']:<35} {row['expected']:<10} {row['found']:<16} {ms:>8}  {line[-70:]}{again}"
