"""Break what can break while the car drives, and see whether it stops: `python -m lab faults OUTPUT`.

Most faults are stories in virtual time (rows.py); twelve are on the pins of an emulated Arduino in real time
(on_pins.py). A fault expects one of these: `stopped` (neutral, until an explicit new start), `human` (the transmitter's
pulses), `continues` (only what the drive commanded, on time), or `refused` (it is there before the start, and the car
is never armed).
"""

import itertools
import logging
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from lab.driving.on_pins import run_on_pins
from lab.driving.pins import DEFAULT, GATES, STOPPED
from lab.driving.rows import all_rows, run_row
from rover_lib.onboard.car import servo_link
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import write_stage


def run_faults(output: Path | None, only: Collection[str], car: Car, echo: Callable[[str], None]) -> dict[str, Any]:
    """Inject all faults, or those named in `only`; return the metrics, and write them to `output` as stage `faults`.

    A fault of the default car that is on pins is not repeated in virtual time; other cars have all in virtual time.
    echo: called with a line when a fault is done. Raises RoverError for unknown names, for a car with a gamepad, if the
    bench does not drive, or if there is no emulated Arduino or no gcc here.
    """
    if car.human != DEFAULT.human:
        raise RoverError(f"{car.name}: its human holds a gamepad", remedy="'python -m lab random' drives with one, too")
    begin = time.monotonic()
    on_pins = all_rows("pins") if car == DEFAULT else {}
    names = list(dict.fromkeys([*all_rows(), *on_pins]))
    if unknown := set(only) - set(names):
        raise RoverError("no such fault", found=sorted(unknown), remedy=f"choose from {names}")
    logging.getLogger(servo_link.__name__).setLevel(logging.ERROR)  # it would warn of what is broken here on purpose
    selection = [name for name in names if name in (only or names)]
    done = []
    in_stories = (run_row(all_rows()[name], car) for name in selection if name not in on_pins)
    for row in itertools.chain(in_stories, run_on_pins([on_pins[name] for name in selection if name in on_pins])):
        done.append(row)
        ms = row.get("takeover_ms", row["stopped_after_ms"])
        echo(f"{row['fault']:<35} {row['expected']:<10} {row['found']:<16} {'' if ms is None else f'{ms:.0f} ms'}")
    summary = summary_of(done) | {"seconds": round(time.monotonic() - begin, 1)}
    wrong = [f"{row['fault']}: {sentence}" for row in done for sentence in row["wrong"]]
    metrics = {"faults": done, "summary": summary, "wrong": wrong}
    if output:
        write_stage(output, "faults", params=GATES, metrics=metrics)
    return metrics


def summary_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the counts of rows, and the worst times (ms)."""
    stopped = [r for r in rows if r["expected"] == STOPPED]
    takeovers = [r["takeover_ms"] for r in rows if r.get("takeover_ms") is not None]
    return {
        "rows": len(rows),
        "stopped_rows": len(stopped),
        "as_expected": sum(not r["wrong"] for r in rows),
        "worst_stopped_after_ms": max((r["stopped_after_ms"] for r in stopped), default=None),
        "takeover_ms": max(takeovers, default=None),
        "repeated": sum(r["attempts"] > 1 for r in rows),
    }
