"""Notebook 05: how long inference takes, by host."""

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.plots import style
from rover_lib.workshop.plots.style import BLACK, COLOURS, GREY, NAMES, RED, legend_below, new_figure


def latency(benchmarks: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw how long one inference takes, by host and artifact: p50, p95, p99, and the computed floor of a Pi 5.

    benchmarks: contents of benchmark-<host>.json by host, one panel each.
    """
    counts = [len(b["metrics"]["artifacts"]) for b in benchmarks.values()]
    height_in = 1.2 + sum(0.7 + 0.36 * n for n in counts)
    fig, axes = new_figure(len(benchmarks), height_in=height_in, height_ratios=counts, sharex=True)
    for ax, (host, stage) in zip(axes[:, 0], benchmarks.items(), strict=True):
        _times(ax, stage["metrics"]["artifacts"])
        env, n = stage["env"], next(iter(stage["metrics"]["artifacts"].values()))["n"]
        ax.set_title(f"{host} ({env['machine']}, {env['cores']} cores), n = {n}, bar: p50")
    first = axes[0, 0]
    axes[-1, 0].set_xlabel("latency of one inference, one plan of actions (ms)")
    first.text(1.01, 1.02, "p50 / p95 / p99", transform=first.transAxes, fontsize=9)
    for marker, size, colour, label in (("|", 14, BLACK, "p95"), ("|", 7, BLACK, "p99"), ("D", 6, RED, "floor, Pi 5")):
        first.plot([], [], marker, ms=size, color=colour, label=label)
    legend_below(fig, first, 3)
    return fig


def _times(ax: Axes, artifacts: Mapping[str, Mapping[str, Any]]) -> None:
    for y, (name, v) in enumerate(artifacts.items()):
        p50, p95, p99 = (v[f"latency_{p}_ms"] for p in ("p50", "p95", "p99"))
        ax.barh(y, p50, 0.62, color=COLOURS.get(name.partition(",")[0], GREY), alpha=0.85)
        ax.plot([p50, p99], [y, y], color=BLACK, lw=1)
        ax.plot(p95, y, "|", color=BLACK, ms=14, mew=2)
        ax.plot(p99, y, "|", color=BLACK, ms=7, mew=1.5)
        if v.get("floor_ms") is not None:
            ax.plot(v["floor_ms"], y, "D", color=RED, mec="white", ms=6)
        style.annotate_row(ax, y, f"{p50:.1f} / {p95:.1f} / {p99:.1f} ms")
    ax.set_yticks(range(len(artifacts)), [NAMES.get(n, n) for n in artifacts])
    ax.set(xlim=(0, None), ylim=(len(artifacts) - 0.5, -0.5))
