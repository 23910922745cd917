"""Collect what a run on an emulated Pi finds, and what is not as it should be: runs/pi-fast.json, runs/pi.json."""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from lab.params import lab_params
from rover_lib.onboard.stage import write_stage


class Row(NamedTuple):
    """What was wanted of something, what was found, and whether the wanted holds."""

    row: str
    wanted: str
    found: Any
    holds: bool


@dataclass
class PiReport:
    """The report of a run on an emulated Pi.

    stage: 'pi-fast' or 'pi', whose gates are in lab/params.yml (as pi_fast and pi). inputs: hashes of what was
    deployed. say: called with each step. wrong: a sentence for everything that is not as it should be. The report is
    written after each step, so that a run that somebody ends leaves what it has found.
    """

    stage: str
    path: Path
    say: Callable[[str], None] = lambda text: None
    inputs: dict[str, str] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    gates: dict[str, Any] = field(init=False)  # those of lab/params.yml at the beginning

    def __post_init__(self) -> None:
        self.gates = lab_params()[self.stage.replace("-", "_")]

    @property
    def steps(self) -> list[dict[str, Any]]:
        return self.metrics.setdefault("steps", [])

    def write(self) -> dict[str, Any]:
        """Write the stage, and return it."""
        metrics = {**self.metrics, "wrong": self.wrong}
        return write_stage(self.path, self.stage, params=self.gates, metrics=metrics, inputs=self.inputs)

    def gate(self, name: str, wanted: str, found: Any, holds: bool) -> None:
        """Add a gate to the report, and a sentence to `wrong` if it does not hold."""
        self.metrics.setdefault("gates", []).append({"gate": name, "wanted": wanted, "found": found, "holds": holds})
        if not holds:
            self.wrong.append(f"{name}: wanted {wanted}, found {found}")

    def limit(self, name: str, found: float | None, most: float, unit: str) -> None:
        """Add a gate that holds if the figure is not None and at most `most`."""
        self.gate(name, f"at most {most} {unit}", found, found is not None and found <= most)

    def rows(self, of: str, rows: Sequence[Row]) -> None:
        """Make a gate of each row, and add them all to the metric `of`."""
        for row in rows:
            self.metrics.setdefault(of, []).append(row._asdict())
            self.gate(row.row, row.wanted, row.found, row.holds)

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[dict[str, Any]]:
        """Time a step; it is in the report whether it works or not."""
        row: dict[str, Any] = {"step": name, "ok": False}
        self.steps.append(row)
        self.say(f"{name} ...")
        begun = time.monotonic()
        try:
            yield row
            row["ok"] = True
        finally:
            row["seconds"] = round(time.monotonic() - begun, 1)
            self.say(f"{row['seconds']:7.1f} s  {name}{'' if row['ok'] else ': failed'}")
            self.write()
