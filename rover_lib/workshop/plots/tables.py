"""Gates as tables for notebooks."""

from collections.abc import Mapping, Sequence
from typing import Any

from rover_lib.workshop.judge.verdict import gate_in_words
from rover_lib.workshop.notebook_table import Table

KEPT = {True: "kept", False: "MISSED", None: "not shown"}


def gates(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Make a table of what was promised and what was found, with a gate in each row.

    rows: from `compare.gate` or `check_gates`.
    """
    kept, missed, unknown = (sum(row["passed"] is passed for row in rows) for passed in (True, False, None))
    caption = f"{kept} of {len(rows)} promises kept"
    caption += f", {missed} missed" if missed else ""
    caption += f", {unknown} not shown" if unknown else ""
    cells = [(gate_in_words(row["gate"]), _limit(row), _shown(row["found"]), KEPT[row["passed"]]) for row in rows]
    return Table(("gate", "promised", "found", "verdict"), tuple(cells), caption)


def _shown(value: Any) -> str:
    return "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def _limit(row: Mapping[str, Any]) -> str:
    """Return a gate's limit in words. A promised range stays as it was promised."""
    limit = row["limit"]
    if isinstance(limit, (list, tuple)):
        return f"{limit[0]:g} to {limit[1]:g}"
    words = {"<=": "at most ", ">=": "at least "}.get(row.get("relation", ""), "")
    return words + (f"{limit:g}" if isinstance(limit, (int, float)) else str(limit))
