"""Figures of notebooks 07 to 09: in how many balloon worlds policies hit, with Wilson's 95 % interval."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.judge.recorded_range import worst
from rover_lib.workshop.plots.style import BLUE, MIST, SLATE, legend_below, new_figure

Rows = Sequence[Mapping[str, Any]]

LATE = {True: ("compensated", BLUE, "o", -1), False: ("not compensated", SLATE, "s", 1)}  # label, colour, marker, side
DRIVEN = {"": ("left alone", SLATE, "o"), "pushed_": ("pushed", MIST, "s")}  # by how a row's keys begin
ARMS = (("corrected", SLATE, "o", -1.0), ("demonstrated", MIST, "s", 1.0))
PANELS = {"pushed": "pushed", "alone": "left alone", "decoy": "beside a red decoy"}


def hit_bars(ax: Axes, x: Sequence[float], rows: Rows, ends: str, of: str = "", **style: Any) -> None:
    """Draw the share of worlds hit, in %, with its interval.

    ends: how the keys of the interval's ends begin. of: how these keys, and those of hits and trials, begin.
    """
    share = np.array([100 * row[f"{of}hits"] / row[f"{of}trials"] for row in rows])
    reach = 100 * np.array([[row[f"{of}{ends}_low"], row[f"{of}{ends}_high"]] for row in rows]).reshape(-1, 2).T
    ax.errorbar(x, share, np.clip(np.abs(reach - share), 0, None), ms=6, capsize=3, **style)


def hits_by_latency(rows: Rows) -> Figure:
    """Draw the balloons hit against how long an inference takes. rows: of drive.json."""
    sets = {pushes: [r for r in rows if r["pushes"] == pushes] for pushes in sorted({r["pushes"] for r in rows})}
    fig, axes = new_figure(1, len(sets), height_in=4.1, sharey=True)
    for ax, (pushes, drives) in zip(axes[0], sets.items(), strict=True):
        latencies = sorted({r["latency_ms"] for r in drives})
        for compensate, (label, colour, marker, side) in LATE.items():
            shown = [r for r in drives if r["compensate"] == compensate]
            x = [latencies.index(r["latency_ms"]) + 0.1 * side for r in shown]
            hit_bars(ax, x, shown, "hits_wilson", fmt=marker, color=colour, elinewidth=2, label=label)
        ax.set_title(f"pushed {pushes} times on its way" if pushes else "left alone", fontsize=11)
        ax.set_xticks(range(len(latencies)), [f"{ms:g}" for ms in latencies])
        ax.set_xlabel("an inference takes (ms)")
    axes[0, 0].set_ylabel(f"worlds in which the balloon was hit\n(% of {rows[0]['trials']}), with the 95 % interval")
    legend_below(fig, axes[0, 0], 2)
    return fig


def hits_by_work(students: Rows, chosen: str) -> Figure:
    """Draw the worlds hit against what a plan costs; if nobody drove, the error to the recordings.

    students: rows of students.json, the teacher first. chosen: the recommended one's name.
    """
    counted = all(row["computed_ms"] for row in students)
    cost = {row["name"]: row["computed_ms"][1] if counted else row["gmac"] for row in students}
    fig, axes = new_figure(1, height_in=3.4)
    ax = axes[0, 0]
    for of, (label, colour, marker) in DRIVEN.items():
        if rows := [row for row in students if row[f"{of}trials"]]:
            x = [cost[row["name"]] for row in rows]
            hit_bars(ax, x, rows, "hits_wilson", of, fmt=marker, color=colour, label=label)
            ax.set_ylabel(f"worlds hit (% of {rows[0][f'{of}trials']}),\nwith the 95 % interval")
    if ax.has_data():
        legend_below(fig, ax, 2)
    else:
        errors = [worst(row[key] for key in row if key.startswith("recorded_")) for row in students]
        ax.plot(list(cost.values()), errors, "o", color=SLATE)
        ax.set_ylabel("error to the recordings\n(% of the recorded range)")
    for name, x in cost.items():
        place = {"xytext": (0, 4), "textcoords": "offset points", "xycoords": ("data", "axes fraction")}
        ax.annotate(name, (x, 1), ha="center", weight="bold" if name == chosen else "normal", fontsize=9, **place)
    ax.set_xlabel("a plan on a Raspberry Pi 5, computed (ms, high end)" if counted else "multiply-accumulates (10^9)")
    ax.set_xlim(0, 1.1 * max(cost.values()))
    return fig


def hits_by_round(policies: Rows) -> Figure:
    """Draw the worlds hit against the human seconds that it cost, for both arms.

    policies: rows of learn.json, first the one that all began with.
    """
    most = max(row["human_s"] for row in policies)
    fig, axes = new_figure(1, len(PANELS), height_in=3.4, sharey=True)
    for ax, (how, title) in zip(axes[0], PANELS.items(), strict=True):
        for arm, colour, marker, aside in ARMS:
            rows = [policies[0], *(row for row in policies if row["arm"] == arm)]
            x = [row["human_s"] + 0.008 * most * aside for row in rows]
            hit_bars(ax, x, [row[how] for row in rows], "wilson", fmt=f"{marker}-", lw=1.5, color=colour, label=arm)
        ax.set_title(f"{title} ({policies[0][how]['trials']} worlds)", fontsize=11)
        ax.set_xlabel("human seconds")
    axes[0, 0].set_ylabel("worlds hit (%)")
    legend_below(fig, axes[0, 0], 2)
    return fig
