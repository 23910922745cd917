"""Notebook 05: how long inference takes, by host, and what heat does to it."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.plots import claims
from rover_lib.workshop.plots.style import (
    BLACK,
    COLOURS,
    GREY,
    NAMES,
    NOW_BITS,
    OTHERS,
    RED,
    claim,
    legend_below,
    new_figure,
)


def latency(benchmarks: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw how long one inference takes, by host and artifact: p50, p95, p99, and the computed floor of a Pi 5.

    benchmarks: contents of benchmark-<host>.json by host, one panel each.
    """
    counts = [len(b["metrics"]["artifacts"]) for b in benchmarks.values()]
    height_in = 1.2 + sum(0.7 + 0.36 * n for n in counts)
    fig, axes = new_figure(len(benchmarks), height_in=height_in, height_ratios=counts, sharex=True)
    floors = False
    for ax, (host, stage) in zip(axes[:, 0], benchmarks.items(), strict=True):
        artifacts = stage["metrics"]["artifacts"]
        for y, (name, v) in enumerate(artifacts.items()):
            mode = name.partition(",")[0]
            p50, p95, p99 = (v[f"latency_{p}_ms"] for p in ("p50", "p95", "p99"))
            ax.barh(y, p50, 0.62, color=COLOURS.get(mode, GREY), alpha=0.85)
            ax.plot([p50, p99], [y, y], color=BLACK, lw=1)
            ax.plot(p95, y, "|", color=BLACK, ms=14, mew=2)
            ax.plot(p99, y, "|", color=BLACK, ms=7, mew=1.5)
            if v.get("floor_ms") is not None:
                ax.plot(v["floor_ms"], y, "D", color=RED, mec="white", ms=6)
                floors = True
            text = f"{p50:.1f} / {p95:.1f} / {p99:.1f} ms"
            ax.annotate(text, (1.01, y), xycoords=("axes fraction", "data"), va="center", fontsize=9)
        ax.set_yticks(range(len(artifacts)), [NAMES.get(n, n) for n in artifacts])
        ax.set_ylim(len(artifacts) - 0.5, -0.5)
        ax.set_xlim(0, None)
        env, n = stage["env"], next(iter(artifacts.values()))["n"]
        ax.set_title(f"{host} ({env['machine']}, {env['cores']} cores), n = {n}, bar: p50", fontsize=11)
    axes[-1, 0].set_xlabel("latency of one inference, one plan of actions (ms)")
    axes[0, 0].text(1.01, 1.02, "p50 / p95 / p99", transform=axes[0, 0].transAxes, fontsize=9)
    first = axes[0, 0]
    first.plot([], [], "|", color=BLACK, ms=14, mew=2, label="p95")
    first.plot([], [], "|", color=BLACK, ms=7, mew=1.5, label="p99")
    if floors:
        first.plot([], [], "D", color=RED, mec="white", ms=6, ls="none", label="floor of a Pi 5")
    legend_below(fig, first, 3)
    claim(fig, claims.speed(benchmarks))
    return fig


def soak(benchmarks: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw what a soak did to a host over time: latency, temperature, clock, and when the firmware held it back.

    benchmarks: contents of benchmark-<host>.json with a series, by host. A reading that no host has gets no panel.
    """
    hosts = dict(zip(benchmarks, itertools.cycle(OTHERS), strict=False))
    series = {host: b["metrics"]["series"] for host, b in benchmarks.items()}

    def has(key: str) -> bool:
        return any(p.get(key) is not None for points in series.values() for p in points)

    held = has("throttled")
    readings = [r for r in (("temperature_c", "temperature\n(°C)"), ("clock_mhz", "clock of the\nslowest core (MHz)"))
                if has(r[0])]  # fmt: skip
    heights = [2.0] + [1.4] * len(readings) + [0.25 + 0.22 * len(hosts)] * held
    fig, axes = new_figure(len(heights), height_in=1.2 + sum(heights), height_ratios=heights, sharex=True)
    first, last = axes[0, 0], axes[-1, 0]
    for row, (host, colour) in enumerate(hosts.items()):
        points, main = series[host], benchmarks[host]["metrics"]["main"]
        minutes = np.array([p["t_s"] for p in points]) / 60

        for key, style, width in (("latency_p50_ms", "-", 1.8), ("latency_p95_ms", ":", 1.2)):
            label = f"{host}, {NAMES.get(main, main)}" if style == "-" else None
            times_ms = _values([p["artifacts"].get(main, {}) for p in points], key)
            first.plot(minutes, times_ms, style, color=colour, lw=width, label=label)
        for ax, (key, _) in zip(axes[1:, 0], readings, strict=False):
            ax.plot(minutes, _values(points, key), color=colour, lw=1.8)
        if held:
            since = np.r_[0.0, minutes[:-1]]  # a point describes the time since the one before
            bits = [int(p.get("throttled") or "0x0", 16) & NOW_BITS for p in points]
            spans = [(s, m - s) for s, m, b in zip(since, minutes, bits, strict=True) if b]
            last.broken_barh(spans, (row - 0.35, 0.7), color=colour)
    first.plot([], [], ":", color=BLACK, lw=1.2, label="p95 (line: p50)")
    first.set(ylabel="latency of one\ninference (ms)", ylim=(0, None), xlim=(0, None))
    for ax, (_, label) in zip(axes[1:, 0], readings, strict=False):
        ax.set_ylabel(label)
    if held:
        last.set_yticks(range(len(hosts)), list(hosts))
        last.set_ylim(len(hosts) - 0.5, -0.5)
        last.set_title("held back by the firmware: under-voltage, capped clock, throttled or too warm", fontsize=9)
    last.set_xlabel("time (min)")
    legend_below(fig, first, 3)
    return fig


def _values(points: Sequence[Mapping[str, Any]], key: str) -> np.ndarray:
    """Return one reading over time, NaN where it is missing."""
    return np.array([np.nan if p.get(key) is None else p[key] for p in points], float)
