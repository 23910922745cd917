"""Notebook 06: instructions counted on an emulated Cortex-A76."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.plots import style

TITLE = "counted on an emulated Cortex-A76"
GROUP_COLOURS = (style.BLUE, style.SKY, *style.OTHERS[1:], style.MIST, style.GREY)  # the first two: INT8 products


def whole_size(metrics: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return the artifacts at the image size of training, by mode, and other engines' peers, most instructions first.

    A peer that only counts one of the artifacts again is left out. metrics: those of arm.json.
    """
    ours = {stem.removeprefix("policy_"): m for stem, m in metrics["artifacts"].items()}
    ours = {mode: m for mode, m in ours.items() if not re.search(r"_\d+x\d+$", mode)}
    counted = ours | {name: m for name, m in metrics.get("peers", {}).items() if "artifact" not in m}
    return dict(sorted(counted.items(), key=lambda item: -item[1]["instructions_g"]))


def draw_counts(metrics: Mapping[str, Any]) -> Figure:
    """Draw instructions against the floor, and beside them the error on the same core. metrics: those of arm.json."""
    rows = whole_size(metrics)
    fig, axes = style.new_figure(1, 2, height_in=1.7 + 0.4 * len(rows), sharey=True, width_ratios=(1.5, 1))
    (left, right), y = axes[0], np.arange(len(rows))
    total, simd = (np.array([m[key] for m in rows.values()]) for key in ("instructions_g", "simd_g"))
    left.barh(y, simd, color=style.SLATE, label="SIMD (vector) instructions")
    left.barh(y, total - simd, left=simd, color=style.MIST, label="all others")
    style.bar_values(left, y, total, "{:.3g}")
    floor_g = next(m["floor_g"] for m in rows.values())
    left.axvline(floor_g, color=style.RED, ls="--", lw=1.2, label=f"floor: dot products alone, {floor_g:.2g}")
    left.set_yticks(y, [style.NAMES.get(n, n) for n in rows])
    left.invert_yaxis()
    left.set_xlabel("instructions of one inference (10^9)")
    left.set_title(TITLE, fontsize=11)
    first = next(iter(metrics["artifacts"].values()))
    keys = style.judged_keys(right, {k: v for k, v in first.items() if "workstation" not in k})
    height = 0.8 / max(len(keys), 1)
    judged = {at: m for at, (name, m) in enumerate(rows.items()) if m["reference"] != f"policy_{name}"}
    frames = sorted({m["frames_on_the_core"] for m in judged.values()})
    over = " to ".join(str(n) for n in frames[:: len(frames) - 1 or 1])
    for i, key in enumerate(keys):
        places = [at + (i - (len(keys) - 1) / 2) * height for at in judged]
        values = [m[key] for m in judged.values()]
        right.barh(places, values, height, color=style.action_colour(key, i), label=key.removesuffix("_mae_pct"))
        style.bar_values(right, places, values, "{:.2f}")
    right.set_xlabel("mean error against FP32\n(% of the recorded range)")
    right.set_title(f"computed on it, {over} frames", fontsize=11)
    style.legend(left, loc="lower right")
    style.legend(right, loc="upper right")
    return fig


def draw_counts_by_kernel(groups: Mapping[str, Mapping[str, float]]) -> Figure:
    """Draw what the instructions do. groups: {artifact or peer: {group: 10**9 instructions}}, all in the same order."""
    fig, axes = style.new_figure(1, height_in=1.8 + 0.36 * len(groups))
    ax, y, left = axes[0, 0], np.arange(len(groups)), np.zeros(len(groups))
    for colour, group in zip(GROUP_COLOURS, next(iter(groups.values())), strict=True):
        width = np.array([by_group[group] for by_group in groups.values()])
        ax.barh(y, width, left=left, color=colour, label=group)
        left += width
    style.bar_values(ax, y, left, "{:.3g}")
    ax.set_yticks(y, [style.NAMES.get(n, n) for n in groups])
    ax.invert_yaxis()
    ax.set_title(TITLE, fontsize=11)
    ax.set_xlabel("instructions of one inference (10^9)")
    style.legend_below(fig, ax, 4)
    return fig
