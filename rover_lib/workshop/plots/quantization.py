"""Notebook 03: what quantization changes, layer by layer and block by block."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from rover_lib.workshop.int8.observe import Calibration
from rover_lib.workshop.plots import claims
from rover_lib.workshop.plots.style import (
    BLACK,
    GREY,
    MIST,
    PARTS,
    RED,
    SLATE,
    action_colour,
    bar_values,
    claim,
    few_actions,
    judged_keys,
    legend,
    legend_below,
    new_figure,
    part_colours,
)


def outlier_channels(calibration: Calibration, count: int = 16) -> Figure:
    """Draw the largest activation of each channel, before and after channel scales.

    Left: the largest channel divided by the median one, for the `count` projections in which that was largest. Right:
    the worst projection of all, channel by channel.
    """
    layers = {n: c for n, c in calibration.channels.items() if "in_max_scaled" in c}

    def peak(x: torch.Tensor) -> float:
        """Return the largest channel divided by the median one, without dead channels."""
        x = x[x > 1e-6 * x.max()]
        return float(x.max() / x.median()) if len(x) else 1.0

    # After `up`, INT8 sees only what leaves the activation function, and that is the input of `down`.
    sides = {n: ("in",) if n.endswith(".up") else ("in", "out") for n in layers}
    pairs = [(n, s) for n in layers for s in sides[n]]
    worst, side = max(pairs, key=lambda row: peak(layers[row[0]][f"{row[1]}_max"]))
    uneven = sorted(layers, key=lambda n: max(peak(layers[n][f"{s}_max"]) for s in sides[n]), reverse=True)[:count]
    layers = {n: c for n, c in layers.items() if n in uneven}  # in the order in which data passes them
    fig, axes = new_figure(1, 2, height_in=max(3.7, 1.3 + 0.2 * len(layers)))
    left, right = axes[0]
    y = {name: i for i, name in enumerate(layers)}
    for at, where, marker in (("in", "input", "o"), ("out", "output", "s")):
        shown = [n for n in layers if at in sides[n]]
        for key, colour, label in ((f"{at}_max", MIST, "before"), (f"{at}_max_scaled", SLATE, "after")):
            peaks = [peak(layers[n][key]) for n in shown]
            face = "none" if label == "before" else colour
            left.scatter(
                peaks, [y[n] for n in shown], color=colour, marker=marker, s=16, fc=face, label=f"{where}, {label}"
            )
    left.set_yticks(list(y.values()), list(layers), fontsize=8)
    left.invert_yaxis()
    left.set(xscale="log", xlabel="largest channel / median channel")
    left.set_title(f"the {len(layers)} most uneven projections", fontsize=11)
    for key, colour, label in ((f"{side}_max", MIST, "before"), (f"{side}_max_scaled", SLATE, "after channel scales")):
        x = np.sort(np.asarray(layers[worst][key]))[::-1]
        right.plot(np.arange(1, len(x) + 1), 100 * x / x[0], color=colour, lw=1.8, label=label)
    right.set(xlabel="channel, largest first", ylabel="activation (% of the largest)", ylim=(0, 105))
    right.set_title(f"{worst}, {'input' if side == 'in' else 'output'}", fontsize=11)
    legend(right)
    legend_below(fig, left, 4)
    claim(fig, claims.even(*(peak(layers[worst][key]) for key in (f"{side}_max", f"{side}_max_scaled"))))
    return fig


def errors_by_choice(
    table: Mapping[str, Mapping[str, float | None]], title: str, budget_pct: float | None = None
) -> Figure:
    """Draw the error of each action for each choice, say of observers. table: {choice: {<action>_mae_pct}}."""
    table, what = few_actions(table)
    choices = list(table)
    fig, axes = new_figure(1, height_in=1.6 + 0.42 * len(choices))
    ax = axes[0, 0]
    keys = judged_keys(ax, next(iter(table.values())))
    height = 0.8 / max(len(keys), 1)
    for i, key in enumerate(keys):
        y = np.arange(len(choices)) + (i - (len(keys) - 1) / 2) * height
        values = [table[c][key] for c in choices]
        ax.barh(y, values, height, color=action_colour(key, i), label=key.removesuffix("_mae_pct"))
        bar_values(ax, y, values, "{:.2f}")
    if budget_pct is not None:
        ax.axvline(budget_pct, color=BLACK, ls="--", lw=1, label=f"limit, {budget_pct:g} %")
    ax.set_yticks(range(len(choices)), choices)
    ax.invert_yaxis()
    ax.set_xlabel(f"{what} against FP32 (% of the recorded range)")
    ax.set_title(title, fontsize=11)
    legend(ax, loc="upper left", bbox_to_anchor=(1, 1))
    claim(fig, claims.least_wrong(table))
    return fig


def sensitivity(
    table: Mapping[str, Mapping[str, float | None]], steps: Sequence[Mapping[str, Any]], budget_pct: float
) -> Figure:
    """Draw on the left each block quantized alone, and on the right what leaving some in float gains and costs.

    table: {block: {<action>_mae_pct}}. steps: from `Chooser.mixed`, {float_blocks, cost_pct, <action>_mae_pct} each.
    """
    table, what = few_actions(table)
    shown, _ = few_actions({str(i): step for i, step in enumerate(steps)})
    blocks = list(table)
    fig, axes = new_figure(1, 2, height_in=max(3.9, 1.5 + 0.26 * len(blocks)), width_ratios=(1.5, 1))
    left, right = axes[0]
    keys = judged_keys(right, next(iter(table.values())))
    height = 0.8 / max(len(keys), 1)
    for i, key in enumerate(keys):
        name, colour = key.removesuffix("_mae_pct"), action_colour(key, i)
        y = np.arange(len(blocks)) + (i - (len(keys) - 1) / 2) * height
        left.barh(y, [table[b][key] for b in blocks], height, color=colour, label=name)
        right.plot([s["cost_pct"] for s in steps], [s[key] for s in shown.values()], "o-", color=colour, label=name)
    left.set_yticks(range(len(blocks)), blocks)
    left.invert_yaxis()
    left.set_xlabel(f"{what} (% of the recorded range)")
    left.set_title("this block alone in INT8", fontsize=11)
    right.axhline(budget_pct, color=BLACK, ls="--", lw=1, label=f"budget, {budget_pct:g} %")
    right.set(xlabel="more instructions (%, computed)", ylabel="mean error (% of the recorded range)")
    right.set_ylim(0, None)
    right.margins(x=0.15)
    right.set_title("blocks left in float, one by one", fontsize=11)
    legend(right)
    claim(fig, claims.most_sensitive(table))
    return fig


def layers(rows: Sequence[Mapping[str, Any]], clipped_warn_pct: float) -> Figure:
    """Draw signal to noise and clipped share of every INT8 layer, in the order in which data passes them.

    rows: from `inspect_layers`.
    """
    fig, axes = new_figure(2, 1, height_in=4.9, sharex=True)
    upper, lower = axes[:, 0]
    x = np.arange(len(rows))
    parts, colours = {r["block"].split(".")[0] for r in rows}, part_colours(r["block"] for r in rows)
    upper.bar(x, [r["snr_db"] for r in rows], color=colours)
    upper.set_ylabel("signal to noise (dB)")
    upper.set_title("higher is better; errors from earlier layers are included", fontsize=11)
    lower.bar(x, [r["clipped_pct"] for r in rows], color=colours)
    lower.axhline(clipped_warn_pct, color=RED, ls="--", lw=1.2)
    lower.text(len(rows) - 0.5, clipped_warn_pct, "warning ", color=RED, ha="right", va="bottom", fontsize=9)
    lower.set(ylabel="clipped (% of values)", xlabel="INT8 layer, in the order of the data")
    lower.set_ylim(0, 1.25 * max(clipped_warn_pct, *(r["clipped_pct"] for r in rows)))
    for part, colour in (*PARTS.items(), ("image_project", GREY)):
        if part in parts:
            lower.bar(0, 0, color=colour, label=part)
    legend_below(fig, lower, 4)
    claim(fig, claims.clipped(rows, clipped_warn_pct))
    return fig
