"""Notebook 06: times on a Raspberry Pi 5 that are computed from counts, against published ones."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.plots.style import BLACK, BLUE, MIST, SLATE, legend, name_rows, new_figure

RUNTIMES = {"ncnn": SLATE, "executorch": BLUE}
SHOWN = ("teacher", "fast", "faster")  # of our policies


def draw_clock(clock: Mapping[str, Any]) -> Figure:
    """Draw published against computed times, a dot a network, and beside them our policies by threads.

    clock: metrics of clock.json.
    """
    fig, axes = new_figure(1, 2, height_in=4.4, width_ratios=(1.3, 1))
    _published(axes[0, 0], clock["networks"])
    _ours(axes[0, 1], clock["policies"])
    return fig


def _published(ax: Axes, networks: Sequence[Mapping[str, Any]]) -> None:
    for runtime, threads in ((runtime, threads) for runtime in RUNTIMES for threads in (1, 4)):
        rows = [r for r in networks if (r["runtime"], r["threads"]) == (runtime, threads)]
        x, y = [r["published_ms"] for r in rows], [r["predicted_ms"] for r in rows]
        below = [r["predicted_ms"] - r["predicted_low_ms"] for r in rows]
        above = [r["predicted_high_ms"] - r["predicted_ms"] for r in rows]
        colour, label = RUNTIMES[runtime], f"{runtime}, {threads} thread{'s' * (threads > 1)}"
        face = "white" if threads == 1 else colour
        ax.errorbar(x, y, [below, above], fmt="o", ms=4, color=colour, mfc=face, elinewidth=0.6, label=label)
    for row in networks:
        if row["odd"]:
            at = (row["published_ms"], row["predicted_ms"])
            ax.annotate(row["name"], at, (4, -9), textcoords="offset points", fontsize=8)
    ends = [min(r["published_ms"] for r in networks), max(r["published_ms"] for r in networks)]
    ax.plot(ends, ends, color=BLACK, lw=0.8)
    ax.set(xscale="log", yscale="log", xlabel="published for a Raspberry Pi 5 (ms)", ylabel="computed without it (ms)")
    legend(ax, loc="upper left")


def _ours(ax: Axes, policies: Sequence[Mapping[str, Any]]) -> None:
    rows = [r for r in policies if r["name"] in SHOWN]
    for y, row in enumerate(rows):
        low, ms, high = (row[f"predicted{end}_ms"] for end in ("_low", "", "_high"))
        ax.plot([low, high], [y, y], color=MIST, lw=7, solid_capstyle="butt")
        ax.plot(ms, y, "|", color=BLACK, ms=9, mew=2)
        text = f"{float(f'{low:.2g}'):g} to {float(f'{high:.2g}'):g}"
        ax.annotate(text, (high, y), (4, -3), textcoords="offset points", fontsize=8)
    name_rows(ax, [f"{r['name']}, {r['threads']}" for r in rows])
    left, right = min(r["predicted_low_ms"] for r in rows), max(r["predicted_high_ms"] for r in rows)
    ax.set(xscale="log", xlabel="a plan of ours, computed (ms)", xlim=(left / 1.2, right * 3))
    ax.set_title("policy, threads", fontsize=10, loc="left")
