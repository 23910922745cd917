"""Notebook 07: what latency does to a drive, and what compensation gives back."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.plots.style import BLUE, RED, SLATE, legend_below, new_figure

HOW = {True: ("compensated", BLUE, "o", -1), False: ("not compensated", SLATE, "s", 1)}  # label, colour, marker, side


def hit_bars(ax: Axes, x: Sequence[float], rows: Sequence[Mapping[str, Any]], key: str, **style: Any) -> np.ndarray:
    """Draw the share of worlds hit, in %, with Wilson's 95 % interval; return it. key: of the interval's ends."""
    share = np.array([100 * row["hits"] / row["trials"] for row in rows])
    ends = 100 * np.array([[row[f"{key}_low"], row[f"{key}_high"]] for row in rows]).reshape(-1, 2).T
    ax.errorbar(x, share, np.clip(np.abs(ends - share), 0, None), ms=6, capsize=3, **style)
    return share


def hits_by_latency(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the balloons hit, with Wilson's 95 % interval, against how long an inference takes. rows: of drive.json."""
    sets = [("left alone", [r for r in rows if not r["pushes"]]), ("pushed", [r for r in rows if r["pushes"]])]
    sets = [(title, drives) for title, drives in sets if drives]
    counts = [len({r["latency_ms"] for r in drives}) for _, drives in sets]
    fig, axes = new_figure(1, len(sets), height_in=4.1, sharey=True, width_ratios=[c + 1 for c in counts])
    for ax, (title, drives) in zip(axes[0], sets, strict=True):
        places = {ms: x for x, ms in enumerate(sorted({r["latency_ms"] for r in drives}))}
        for compensate, (label, colour, marker, side) in HOW.items():
            shown = [r for r in drives if r["compensate"] == compensate]
            x = [places[r["latency_ms"]] + 0.1 * side for r in shown]
            share = hit_bars(ax, x, shown, "hits_wilson", fmt=marker, color=colour, elinewidth=2, label=label)
            for at, y, r in zip(x, share, shown, strict=True):
                ax.annotate(f"{r['hits']}", (at, y), (9 * side, 0), textcoords="offset points", color=colour,
                            ha="left" if side > 0 else "right", va="center", fontsize=8)  # fmt: skip
        for ms, place in places.items():
            if stopped := max(r["stopped"] for r in drives if r["latency_ms"] == ms):
                ax.annotate(f"{stopped} stopped:\nplan too old", (place, 30), ha="center", fontsize=9, color=RED)
        pushes = max(r["pushes"] for r in drives)
        ax.set_title(f"{title} {pushes} times on its way" if pushes else title, fontsize=11)
        ax.set_xticks(list(places.values()), [f"{ms:g}" for ms in places])
        ax.set(xlabel="an inference takes (ms)", xlim=(-0.6, len(places) - 0.4), ylim=(-4, 104))
    axes[0, 0].set_ylabel(f"worlds in which the balloon was hit\n(% of {rows[0]['trials']}), with the 95 % interval")
    legend_below(fig, axes[0, 0], 2)
    return fig
