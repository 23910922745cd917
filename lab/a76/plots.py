"""Notebook 06: instructions counted on an emulated Cortex-A76."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.plots.counting import whole_size
from rover_lib.workshop.plots.style import (
    BLUE,
    GREY,
    MIST,
    NAMES,
    OTHERS,
    RED,
    SKY,
    SLATE,
    action_colour,
    bar_values,
    judged_keys,
    legend,
    legend_below,
    new_figure,
)

NEAR = 2  # rows with less than this many times the fewest instructions are shown again, enlarged
GROUP_COLOURS = (BLUE, SKY, *OTHERS[1:], MIST, GREY)  # the first two are the INT8 products


def draw_counts(metrics: Mapping[str, Any]) -> Figure:
    """Draw instructions against the floor, and beside them the error on the same core. metrics: those of arm.json."""
    rows = whole_size(metrics)
    fig, axes = new_figure(1, 2, height_in=1.7 + 0.4 * len(rows), sharey=True, width_ratios=(1.5, 1))
    (left, right), y = axes[0], np.arange(len(rows))
    total, simd = (np.array([m[key] for m in rows.values()]) for key in ("instructions_g", "simd_g"))
    left.barh(y, simd, color=SLATE, label="SIMD (vector) instructions")
    left.barh(y, total - simd, left=simd, color=MIST, label="all others")
    bar_values(left, y, total, "{:.3g}")
    floor_g = next(m["floor_g"] for m in rows.values())
    left.axvline(floor_g, color=RED, ls="--", lw=1.2, label=f"floor: dot products alone, {floor_g:.2g}")
    left.set_yticks(y, [NAMES.get(n, n) for n in rows])
    left.invert_yaxis()
    left.set_xlabel("instructions of one inference (10^9)")
    left.set_title("counted on an emulated Cortex-A76", fontsize=11)
    first = next(iter(metrics["artifacts"].values()))
    keys = judged_keys(right, {k: v for k, v in first.items() if "workstation" not in k})
    height = 0.8 / max(len(keys), 1)
    judged = {
        at: m
        for at, (name, m) in enumerate(rows.items())
        if keys and m.get(keys[0]) is not None and m.get("reference") != f"policy_{name}"
    }
    frames = sorted({m["frames_on_the_core"] for m in judged.values()})
    over = " to ".join(str(n) for n in frames[:: len(frames) - 1 or 1])
    for i, key in enumerate(keys):
        at = [at + (i - (len(keys) - 1) / 2) * height for at in judged]
        values = [m[key] for m in judged.values()]
        right.barh(at, values, height, color=action_colour(key, i), label=key.removesuffix("_mae_pct"))
        bar_values(right, at, values, "{:.2f}")
    right.set_xlabel("mean error against FP32\n(% of the recorded range)")
    right.set_title(f"computed on it, {over} frames", fontsize=11)
    legend(left, loc="lower right")
    legend(right, loc="upper right")
    return fig


def draw_counts_by_kernel(groups: Mapping[str, Mapping[str, float]]) -> Figure:
    """Draw what the instructions do. groups: {artifact or peer: {group: 10**9 instructions}}, all in the same order."""
    totals = {name: sum(by_group.values()) for name, by_group in groups.items()}
    near = {name: by_group for name, by_group in groups.items() if totals[name] < NEAR * min(totals.values())}
    panels = [groups, near] if 1 < len(near) < len(groups) else [groups]
    rows = [len(shown) for shown in panels]
    fig, axes = new_figure(len(panels), height_in=1.3 + 0.5 * len(panels) + 0.36 * sum(rows), height_ratios=rows)
    for ax, shown in zip(axes[:, 0], panels, strict=True):
        y, left = np.arange(len(shown)), np.zeros(len(shown))
        for colour, group in zip(GROUP_COLOURS, next(iter(shown.values())), strict=True):
            width = np.array([by_group[group] for by_group in shown.values()])
            ax.barh(y, width, left=left, color=colour, label=group)
            left += width
        bar_values(ax, y, left, "{:.3g}")
        ax.set_yticks(y, [NAMES.get(n, n) for n in shown])
        ax.invert_yaxis()
    axes[0, 0].set_title("counted on an emulated Cortex-A76", fontsize=11)
    if len(panels) > 1:
        axes[1, 0].set_title("those of the fewest instructions, closer", fontsize=11)
    axes[-1, 0].set_xlabel("instructions of one inference (10^9)")
    legend_below(fig, axes[0, 0], 4)
    return fig
