"""The result of a sweep: the error to the recordings against the time of a plan."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from rover_lib.workshop.plots.style import BLUE, GREEN, legend, new_figure, note


def pareto(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw a point for each run, larger for a larger artifact. The runs that no other beats are joined and named."""
    fig, axes = new_figure(1, height_in=4.5)
    ax = axes[0, 0]
    judged = [row for row in rows if row["to_recorded_pct"] is not None]
    if not judged:
        note(ax, "no action changes in these recordings, so none is judged")
        return fig
    for best, colour, label in ((False, BLUE, "beaten by another"), (True, GREEN, "no other is better in everything")):
        chosen = sorted((r for r in judged if r["best"] is best), key=lambda r: r["latency_p50_ms"])
        x, y = [r["latency_p50_ms"] for r in chosen], [r["to_recorded_pct"] for r in chosen]
        areas = [8 + 4 * r["size_mb"] for r in chosen]
        ax.scatter(x, y, areas, color=colour, alpha=0.6, label=label)
        if best:
            ax.plot(x, y, color=colour, lw=1)
            for row in chosen:
                at = (row["latency_p50_ms"], row["to_recorded_pct"])
                ax.annotate(row["name"], at, (6, 6), textcoords="offset points", fontsize=8)
    ax.set_xlabel("a plan of static INT8, p50 (ms), measured on " + ", ".join(sorted({r["host"] for r in judged})))
    ax.set_ylabel("error to the recordings,\nthe worse action (% of its range)")
    ax.set_ylim(0, None)
    ax.margins(x=0.2)
    legend(ax, loc="lower right")
    return fig
