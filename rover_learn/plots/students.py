"""Notebook 08: what a smaller policy costs, and what it gains."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.plots.style import MIST, SLATE, bar_values, legend, new_figure

# prefix of a row's keys, label, face colour, marker, and how far the marks are moved
DRIVES = (("", "left alone", SLATE, "o", -0.16), ("pushed_", "pushed", "white", "s", 0.16))


def frontier(students: Sequence[Mapping[str, Any]], chosen: str) -> Figure:
    """Draw the policies from most work to least: time of a plan, and hits with Wilson's 95 % interval.

    Without drives there is no panel of hits. students: rows of students.json, the teacher first. chosen: the
    recommended one's name.
    """
    drove = any(row["trials"] for row in students)
    rows = sorted(students, key=lambda row: -row["gmac"])
    fig, axes = new_figure(1, 1 + drove, height_in=2.0 + 0.75 * len(rows), sharey=True)
    first = axes[0, 0]
    _work(first, rows)
    if drove:
        _hits(axes[0, 1], rows)
    first.set_yticks(range(len(rows)), [_label(row) for row in rows])
    first.set_ylim(len(rows) - 0.4, -0.6)
    for label, row in zip(first.get_yticklabels(), rows, strict=True):
        label.set(weight="bold" if row["name"] == chosen else "normal")
    return fig


def _label(row: Mapping[str, Any]) -> str:
    share = f", {row['backbone_channels']:.0%}" if row.get("backbone_channels") else ""
    return f"{row['name']}\n{row['width']}x{row['height']}, {row['decoder_layers']} x {row['feedforward']}{share}"


def _work(ax: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    if not all(row["computed_ms"] for row in rows):
        ax.barh(range(len(rows)), [row["gmac"] for row in rows], 0.5, color=MIST)
        bar_values(ax, range(len(rows)), [row["gmac"] for row in rows], "{:.3g}")
        ax.set_xlabel("multiply-accumulates of a plan\n(10^9); not all are counted")
        return
    for y, row in enumerate(rows):
        low, high = row["computed_ms"]
        ax.plot([low, high], [y, y], color=MIST, lw=9, solid_capstyle="butt")
        ax.annotate(f"{low:.3g} to {high:.3g}", (low, y), (0, 9), textcoords="offset points", fontsize=9)
    ax.set_xlim(0, 1.35 * max(row["computed_ms"][1] for row in rows))
    ax.set_xlabel("a plan on a Raspberry Pi 5,\ncomputed (ms)")


def _hits(ax: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    for key, label, face, marker, aside in DRIVES:
        driven = [(y + aside, row) for y, row in enumerate(rows) if row[f"{key}trials"]]
        y = [at for at, _ in driven]
        share = np.array([100 * row[f"{key}hits"] / row[f"{key}trials"] for _, row in driven])
        ends = 100 * np.array([[row[f"{key}hits_wilson_{end}"] for end in ("low", "high")] for _, row in driven])
        bars = np.clip(np.abs(ends.reshape(-1, 2).T - share), 0, None)
        ax.errorbar(share, y, xerr=bars, fmt=marker, ms=6, color=SLATE, mfc=face, elinewidth=2, capsize=3, label=label)
        for at, x, (_, row) in zip(y, share, driven, strict=True):
            late = f", {row['pushed_latency_ms']:.0f} ms late" if key else ""
            ax.annotate(f"{row[f'{key}hits']}{late}", (x, at), (0, 6), textcoords="offset points", fontsize=8)
    trials = max(row["trials"] or 0 for row in rows)
    ax.set_xlabel(f"worlds hit (% of {trials}),\nwith the 95 % interval")
    legend(ax, loc="lower center", bbox_to_anchor=(0.5, 1), ncols=2)
