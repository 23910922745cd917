"""Gates as tables for notebooks, and a benchmark held to what was promised."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from rover_lib.workshop.judge.verdict import gate_in_words
from rover_lib.workshop.notebook_table import Table

HIGHER_IS_BETTER = ("throughput_fps", "control_rate_hz")
GATE_KEYS = {"memory_mb": "peak_memory_mb", "model_size_mb": "size_mb"}  # gates that go by another name in a benchmark
KEPT = {True: "kept", False: "MISSED", None: "not shown"}


def gates(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Make a table of what was promised and what was found, with a gate in each row.

    rows: from `compare.gate` or `check_gates`.
    """
    counts = Counter(row["passed"] for row in rows)
    caption = f"{counts[True]} of {len(rows)} promises kept"
    for passed, words in ((False, "missed"), (None, "not shown")):
        if counts[passed]:
            caption += f", {counts[passed]} {words}"
    cells = [(gate_in_words(row["gate"]), _limit(row), _shown(row["found"]), KEPT[row["passed"]]) for row in rows]
    return Table(("gate", "promised", "found", "verdict"), tuple(cells), caption)


def check_gates(metrics: Mapping[str, Any], promised: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Hold a benchmark's metrics to the section `gates.original` of params.yml; return rows of `gates`.

    A gate is a number or a [low, high] range that was promised. Doing better than promised passes: a latency need only
    not be above its range, a rate not below it. A single number must be stayed under. A text, such as throttled "0x0",
    must be equal. passed is None if it was not measured.
    """
    rows = []
    for gate, limit in promised.items():
        value = metrics.get(GATE_KEYS.get(gate, gate))
        passed = None if value is None else _passes(gate, value, limit)
        rows.append({"gate": gate, "limit": limit, "found": value, "passed": passed})
    return rows


def _passes(gate: str, value: Any, limit: Any) -> bool:
    if isinstance(limit, str):
        return bool(value == limit)
    low, high = limit if isinstance(limit, list) else (limit, limit)
    if gate in HIGHER_IS_BETTER:
        return bool(value >= low)
    return bool(value <= high if isinstance(limit, list) else value < high)


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _limit(row: Mapping[str, Any]) -> str:
    """Return a gate's limit in words. A promised range stays as it was promised."""
    limit = row["limit"]
    if isinstance(limit, (list, tuple)):
        return f"{limit[0]:g} to {limit[1]:g}"
    words = {"<=": "at most ", ">=": "at least "}.get(row.get("relation", ""), "")
    return words + (f"{limit:g}" if isinstance(limit, (int, float)) else str(limit))
