"""Notebook 05: how long inference takes, by host, and what heat does to it."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.plots import style
from rover_lib.workshop.plots.style import BLACK, COLOURS, GREY, NAMES, NOW_BITS, OTHERS, RED, legend_below, new_figure


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


def soak(benchmarks: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw what a soak did to a host over time: latency, temperature, clock, and when the firmware held it back.

    benchmarks: contents of benchmark-<host>.json with a series, by host. A reading that a host lacks is not drawn.
    """
    fig, axes = new_figure(4, height_in=7.0, height_ratios=(2.0, 1.4, 1.4, 0.7), sharex=True)
    times, temperature, clock, held = axes[:, 0]
    for row, (host, colour) in enumerate(zip(benchmarks, itertools.cycle(OTHERS), strict=False)):
        metrics = benchmarks[host]["metrics"]
        points, main = metrics["series"], metrics["main"]
        minutes = np.array([p["t_s"] for p in points]) / 60
        ours = [p["artifacts"].get(main, {}) for p in points]
        label = f"{host}, {NAMES.get(main, main)}"
        times.plot(minutes, _values(ours, "latency_p50_ms"), color=colour, lw=1.8, label=label)
        times.plot(minutes, _values(ours, "latency_p95_ms"), ":", color=colour, lw=1.2)
        temperature.plot(minutes, _values(points, "temperature_c"), color=colour, lw=1.8)
        clock.plot(minutes, _values(points, "clock_mhz"), color=colour, lw=1.8)
        since = np.r_[0.0, minutes[:-1]]  # a point describes the time since the one before
        bits = [int(p.get("throttled") or "0x0", 16) & NOW_BITS for p in points]
        spans = [(s, m - s) for s, m, b in zip(since, minutes, bits, strict=True) if b]
        held.broken_barh(spans, (row - 0.35, 0.7), color=colour)
    times.plot([], [], ":", color=BLACK, lw=1.2, label="p95 (line: p50)")
    times.set(ylabel="latency of one\ninference (ms)", ylim=(0, None), xlim=(0, None))
    temperature.set_ylabel("temperature\n(°C)")
    clock.set_ylabel("clock of the\nslowest core (MHz)")
    held.set_yticks(range(len(benchmarks)), list(benchmarks))
    what = "held back by the firmware: under-voltage, capped clock, throttled or too warm"
    held.set(xlabel="time (min)", title=what, ylim=(len(benchmarks) - 0.5, -0.5))
    legend_below(fig, times, 3)
    return fig


def _values(points: Sequence[Mapping[str, Any]], key: str) -> np.ndarray:
    """Return one reading over time, NaN where it is missing."""
    return np.array([np.nan if p.get(key) is None else p[key] for p in points], float)
