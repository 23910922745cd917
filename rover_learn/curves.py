"""How a training went: its losses and held-out errors as JSON, and as a figure."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rover_lib.workshop.plots.style import new_figure

FILE = "curves.json"
ROUND = ", round "  # between the name of a phase and the number of its round


def leave_curves(
    folder: Path,
    losses: Mapping[str, Sequence[float]],
    errors: Mapping[str, Sequence[Sequence[float]]],
    actions: Mapping[str, Mapping[str, Any]],
) -> None:
    """Write curves.json and curves.png into a new folder.

    losses: of each step, by phase; the rounds of a phase are one after the other. errors: [step or round, *held-out
    errors by action], by phase, in % of the range. actions: what was learned of each, as of `Judges.summary`.
    """
    folder.mkdir()
    losses = _join_rounds(losses)
    (folder / FILE).write_text(json.dumps({"losses": losses, "errors": errors, "actions": actions}) + "\n")
    figure, rows = new_figure(2, max(len(losses), 1), height_in=5.5)
    for ax, (phase, values) in zip(rows[0], losses.items(), strict=False):
        ax.plot(values)
        ax.set(title=phase, xlabel="step", yscale="log")
    rows[0][0].set_ylabel("loss")
    for ax, (phase, rows_of_phase) in zip(rows[1], errors.items(), strict=False):
        steps = [row[0] for row in rows_of_phase]
        for i, (name, entry) in enumerate(actions.items(), 1):
            (line,) = ax.plot(steps, [row[i] for row in rows_of_phase], "o-", label=name)
            ax.axhline(entry["blind_pct"], color=line.get_color(), linestyle=":", label=f"{name}, without eyes")
        ax.set(title=phase, xlabel="step, or round")
        ax.legend()
    rows[1][0].set_ylabel("held-out error, % of the range")
    figure.savefig(folder / "curves.png")


def _join_rounds(losses: Mapping[str, Sequence[float]]) -> dict[str, list[float]]:
    joined: dict[str, list[float]] = {}
    for phase, values in losses.items():
        if values:
            joined.setdefault(phase.partition(ROUND)[0], []).extend(values)
    return joined


def read_actions(folder: Path) -> dict[str, dict[str, Any]]:
    """Return what a training says of each action."""
    return json.loads((folder / FILE).read_text())["actions"]
