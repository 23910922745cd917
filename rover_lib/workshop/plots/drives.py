"""The figures of drives: on one map (notebooks 04, 07), and hits with their intervals (07, 09)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.plots import style

ON_A_MAP = 12  # drives; more of them would cover each other


def paths(trials: Mapping[str, Any]) -> Figure | style.Note:
    """Draw the paths of FP32 and static INT8 through the same worlds on one map, and how far apart they are on the way.

    trials: `TrialReport` by mode, whose paths are (ticks, 2) metres from the start, and balloons (2,) metres.
    """
    if not {"fp32", "static"} <= trials.keys():
        return style.Note("nothing was driven: there is no map")
    first = trials["fp32"]
    second = trials["static"]
    fig, axes = style.new_figure(1, 2, height_in=4.2)
    map_of, apart = axes[0]
    wide = style.line_of("fp32") | {"lw": 4.0, "color": style.GREY}
    for trial, line in ((first, wide), (second, style.line_of("static") | {"lw": 1.5})):
        for i, path in enumerate(trial.paths[:ON_A_MAP]):
            map_of.plot(-path[:, 1], path[:, 0], **line | {"label": line["label"] if i == 0 else None})
    _balloons(map_of, first.balloons[:ON_A_MAP])
    map_of.set(aspect="equal", xlabel="m to the right", ylabel="m ahead", title="seen from above")
    for ours, theirs in zip(first.paths, second.paths, strict=True):
        both = min(len(ours), len(theirs))
        distance_cm = 100 * np.linalg.norm(ours[:both] - theirs[:both], axis=1)
        apart.plot(np.arange(both) / 30, distance_cm, color=style.COLOURS["static"], lw=1, alpha=0.5)
    apart.set(xlabel="time in the drive (s)", ylabel="distance between the two (cm)", ylim=(0, None))
    apart.set_title(f"all {first.trials} drives")
    style.legend_below(fig, map_of, 3)
    return fig


def _balloons(ax: Axes, balloons: Sequence[Any]) -> None:
    places = np.array(balloons)
    ax.plot(-places[:, 1], places[:, 0], "o", color=style.BALLOON, ms=8, label="balloon", zorder=0)


def pushed_paths(drives: Mapping[str, Sequence[Any]]) -> Figure | style.Note:
    """Draw drives with pushes on a map for each lateness.

    drives: by what stands above the map, a few drives, each with path (ticks, 2) m, balloon (2,) m and outcome.
    """
    if not drives:
        return style.Note("nothing was driven with pushes")
    fig, fields = style.figure_of(len(drives), 3, 3.6)
    for ax in fields[1:]:  # on one scale
        ax.sharex(fields[0])
        ax.sharey(fields[0])
    for ax, (title, driven) in zip(fields, drives.items(), strict=True):
        _balloons(ax, [drive.balloon for drive in driven])
        for drive in driven:
            hit = drive.outcome == "hit"
            line: dict[str, Any] = {"color": style.COLOURS["static"], "label": "hit"}
            if not hit:
                line = {"color": style.BALLOON, "label": "missed", "ls": "--"}
            ax.plot(-drive.path[:, 1], drive.path[:, 0], lw=1.5, **line)
        ax.set(aspect="equal", xlabel="m to the right", title=title)
    fields[0].set_ylabel("m ahead")
    handles: dict[str, Any] = {}
    for ax in fields:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    fig.legend(handles.values(), handles, loc="outside lower center", ncols=3)
    return fig


def hits_over_lateness(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the share of hits over how late plans are, with 95 % intervals. rows: of drive.json."""
    fig, axes = style.new_figure(1, 2, height_in=3.4, sharey=True)
    for ax, pushed in zip(axes[0], (False, True), strict=True):
        ax.set_title("pushed on the way" if pushed else "left alone")
        for compensate, colour, aside in ((True, style.COLOURS["static"], -4), (False, style.OTHERS[1], 4)):
            # A plan that takes no time leaves nothing to compensate: it stands for both.
            of = [r for r in rows if r["compensate"] == compensate or not r["latency_ms"]]
            of = [r for r in of if bool(r["pushes"]) == pushed]
            if of:
                x = [r["latency_ms"] + aside for r in of]
                _intervals(ax, x, of, "hits_wilson_", colour, "compensated" if compensate else "not compensated")
        ax.set(xlabel="from a look to its plan (ms)", ylim=(-2, 102))
        ax.grid(axis="y", color=style.MIST, lw=0.5)
    axes[0, 0].set_ylabel("balloons hit (%)")
    style.legend_below(fig, axes[0, 0], 2)
    return fig


def hits_by_round(policies: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the share of hits after each round, by corrections and by demonstrations. policies: of learn.json."""
    fig, axes = style.new_figure(1, 3, height_in=3.4, sharey=True)
    titles = {"pushed": "pushed on the way", "alone": "left alone", "decoy": "beside a red decoy"}
    before = [p for p in policies if p["arm"] == "before"]
    for ax, (how, title) in zip(axes[0], titles.items(), strict=True):
        colours = {"corrected": style.COLOURS["static"], "demonstrated": style.OTHERS[1]}
        for (arm, colour), aside in zip(colours.items(), (-1.5, 1.5), strict=True):
            of = before + [p for p in policies if p["arm"] == arm]
            x = [p["human_s"] + aside for p in of]
            _intervals(ax, x, [p[how] for p in of], "wilson_", colour, arm)
        ax.set(xlabel="seconds of a human", title=title, ylim=(50, 102))
        ax.grid(axis="y", color=style.MIST, lw=0.5)
    axes[0, 0].set_ylabel("balloons hit (%)")
    style.legend_below(fig, axes[0, 0], 2)
    return fig


def _intervals(
    ax: Axes, x: Sequence[float], of: Sequence[Mapping[str, Any]], key: str, colour: str, label: str
) -> None:
    """Draw shares of hits with their intervals, in percent. key: of the interval, without low and high."""
    share = np.array([r["hits"] / r["trials"] for r in of])
    low = np.array([r[f"{key}low"] for r in of])
    high = np.array([r[f"{key}high"] for r in of])
    ends = 100 * np.clip(np.array([share - low, high - share]), 0, None)
    ax.errorbar(x, 100 * share, ends, color=colour, marker="o", ms=5, lw=1.5, capsize=3, label=label)
