"""Notebooks 07 to 09: how often a car hits, and what a student costs."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.plots import style


def hits(lines: Mapping[str, Sequence[tuple[float, Mapping[str, Any]]]], xlabel: str) -> Figure:
    """Draw the share of worlds that were hit over x, a line of (x, counts of drives) for each name."""
    fig, ((ax,),) = style.new_figure(1)
    beside = max(x for points in lines.values() for x, _ in points) / 150  # no line shall hide another
    for i, (name, points) in enumerate(lines.items()):
        share = np.array([100 * counts["hits"] / counts["trials"] for _, counts in points])
        ends = [[100 * value for key, value in counts.items() if "wilson" in key] for _, counts in points]
        how = {"color": style.OTHERS[i], "marker": "osD^"[i], "capsize": 3, "label": name}
        ax.errorbar([x + i * beside for x, _ in points], share, np.abs(np.array(ends).T - share), **how)
    ax.set(xlabel=xlabel, ylabel="balloons hit (%)")
    ax.legend(frameon=False, fontsize=9)
    return fig


def students(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw each policy's error to the recordings over what its plan costs. rows: of students.json."""
    counted = all(row["instructions_g"] for row in rows)
    cost, label = ("instructions_g", "10^9 instructions") if counted else ("gmac", "10^9 multiply-accumulates")
    fig, ((ax,),) = style.new_figure(1)
    for i, key in enumerate(key for key in rows[0] if key.startswith("recorded_")):
        action = key.removeprefix("recorded_").removesuffix("_pct")
        errors = [row[key] for row in rows]
        ax.plot([row[cost] for row in rows], errors, "o", color=style.action_colour(action, i), label=action)
        for row in rows if errors[0] is not None else ():  # nor are the others judged
            ax.annotate(row["name"], (row[cost], row[key]), (6, 4), textcoords="offset points", fontsize=9)
    ax.set(xlabel=f"{label} for a plan", ylabel="error to the recordings (%)", xlim=(0, None))
    ax.set_ylim(0, 1.15 * ax.get_ylim()[1])
    ax.legend(frameon=False, fontsize=9, loc="lower right")
    return fig
