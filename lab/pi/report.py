"""What a run on an emulated Pi found, and what of it is not as it should be: runs/pi-fast.json, runs/pi.json."""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lab.params import lab_params
from rover_lib.onboard.stage import write_stage


@dataclass
class PiReport:
    """stage: pi-fast or pi, whose gates are in lab/params.yml (with _). inputs: hashes of what was deployed.

    say: told of each step. wrong: a sentence for all that is not as it should be; nothing, if all is. The report is
    written after each step, so that a run which somebody ends leaves what it found.
    """

    stage: str
    path: Path
    say: Callable[[str], None] = lambda text: None
    inputs: dict[str, str] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    gates: dict[str, Any] = field(init=False)  # of lab/params.yml as it was at the beginning

    def __post_init__(self) -> None:
        self.gates = lab_params()[self.stage.replace("-", "_")]

    @property
    def steps(self) -> list[dict[str, Any]]:
        return self.metrics.setdefault("steps", [])

    def write(self) -> dict[str, Any]:
        """Writes the stage, and returns it."""
        metrics = {**self.metrics, "wrong": self.wrong}
        return write_stage(self.path, self.stage, params=self.gates, metrics=metrics, inputs=self.inputs)

    def gate(self, name: str, wanted: str, found: Any, holds: bool) -> None:
        """One of the report's promises; a broken one is wrong."""
        self.metrics.setdefault("gates", []).append({"gate": name, "wanted": wanted, "found": found, "holds": holds})
        if not holds:
            self.wrong.append(f"{name}: wanted {wanted}, found {found}")

    def limit(self, name: str, found: float | None, most: float, unit: str) -> None:
        """A gate that a figure holds if it is there and at most so large."""
        self.gate(name, f"at most {most} {unit}", found, found is not None and found <= most)

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[dict[str, Any]]:
        """Times one; it is in the report whether it works or not."""
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
