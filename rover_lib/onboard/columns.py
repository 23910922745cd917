"""Rows of text as columns: the first to the left, numbers to the right. And figures where there may be none."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

UNITS = {"mb": "MB", "ms": "ms", "s": "s", "pct": "%", "g": "10^9", "fps": "1/s", "hz": "Hz", "c": "Celsius"}


def in_words(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return figures for people: names in words with their unit, and without what was not measured."""
    named = {}
    for key, value in figures.items():
        words, _, unit = key.rpartition("_")
        name = f"{words}, {UNITS[unit]}" if words and unit in UNITS else key
        if value is not None:
            named[name.replace("_", " ")] = value
    return named


def align(rows: Sequence[Sequence[str]]) -> list[str]:
    """A line for each row, a header among them. Rows are of one length."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for first, *rest in rows:
        cells = [first.ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(rest, widths[1:], strict=True))]
        lines.append("  ".join(cells).rstrip())
    return lines


def number(value: float | None, form: str = ".1f") -> str:
    """A number in that form; a dash where nothing was measured."""
    return "-" if value is None or not math.isfinite(value) else format(value, form)


def ratio(over: float | None, under: float | None) -> float | None:
    """Return over / under, None where one of them was not measured, or is 0."""
    return over / under if over and under else None


def benchmark_rows(metrics: Mapping[str, Any]) -> list[list[str]]:
    """The artifacts of a benchmark beside each other, a header first; ratios are to the first. metrics: of its JSON."""
    timed = metrics["artifacts"]
    first = next(iter(timed.values()))
    rows = [["", "MB", "p50 ms", "p95 ms", "p99 ms", "times faster", "times smaller", "memory MB", "n"]]
    for name, v in timed.items():
        times = [number(v[f"latency_{p}_ms"]) for p in ("p50", "p95", "p99")]
        faster = ratio(first["latency_p50_ms"], v["latency_p50_ms"])
        smaller = ratio(first["size_mb"], v["size_mb"])
        memory = number(v["peak_memory_mb"], ".0f")
        rows.append([name, number(v["size_mb"]), *times, number(faster), number(smaller), memory, str(v["n"])])
    return rows
