"""Notebook 03: what quantization changes, layer by layer and block by block."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from rover_lib.workshop.int8.observe import Calibration
from rover_lib.workshop.plots import style
from rover_lib.workshop.plots.style import BLACK, GREY, MIST, RED, SLATE, legend, legend_below, new_figure

Errors = Mapping[str, Mapping[str, float | None]]  # {choice or block: {<action>_mae_pct}}


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
    shown = [n for n in layers if n in uneven]  # in the order in which data passes them
    fig, axes = new_figure(1, 2, height_in=max(3.7, 1.3 + 0.2 * len(shown)))
    left, right = axes[0]
    for at, where, marker in (("in", "input", "o"), ("out", "output", "s")):
        y = [i for i, n in enumerate(shown) if at in sides[n]]
        for key, colour, label in ((f"{at}_max", MIST, "before"), (f"{at}_max_scaled", SLATE, "after")):
            peaks = [peak(layers[shown[i]][key]) for i in y]
            left.scatter(peaks, y, color=colour, marker=marker, s=16, label=f"{where}, {label}")
    style.name_rows(left, shown)
    left.tick_params(axis="y", labelsize=8)
    uneven_title = f"the {len(shown)} most uneven projections"
    left.set(xscale="log", xlabel="largest channel / median channel", title=uneven_title)
    for key, colour, label in ((f"{side}_max", MIST, "before"), (f"{side}_max_scaled", SLATE, "after channel scales")):
        x = np.sort(np.asarray(layers[worst][key]))[::-1]
        right.plot(np.arange(1, len(x) + 1), 100 * x / x[0], color=colour, lw=1.8, label=label)
    right.set(xlabel="channel, largest first", ylabel="activation (% of the largest)", title=f"{worst}, {side}put")
    legend(right)
    legend_below(fig, left, 4)
    return fig


def errors_by_choice(table: Errors, title: str, budget_pct: float | None = None) -> Figure:
    """Draw the error of each action for each choice, say of observers. table: {choice: {<action>_mae_pct}}."""
    table, what = style.few_actions(table)
    fig, ax = style.bars_figure(len(table), 1.6)
    style.draw_errors(ax, table, style.judged_keys(ax, next(iter(table.values()))), values=True)
    if budget_pct is not None:
        ax.axvline(budget_pct, color=BLACK, ls="--", lw=1, label=f"limit, {budget_pct:g} %")
    ax.set(xlabel=f"{what} against FP32 (% of the recorded range)", title=title)
    legend(ax, loc="upper left", bbox_to_anchor=(1, 1))
    return fig


def sensitivity(table: Errors, steps: Sequence[Mapping[str, Any]], budget_pct: float) -> Figure:
    """Draw on the left each block quantized alone, and on the right what leaving some in float gains and costs.

    table: {block: {<action>_mae_pct}}. steps: from `Chooser.mixed`, {float_blocks, cost_pct, <action>_mae_pct} each.
    """
    table, what = style.few_actions(table)
    shown, _ = style.few_actions({str(i): step for i, step in enumerate(steps)})
    fig, axes = new_figure(1, 2, height_in=max(3.9, 1.5 + 0.26 * len(table)), width_ratios=(1.5, 1))
    left, right = axes[0]
    keys = style.judged_keys(right, next(iter(table.values())))
    style.draw_errors(left, table, keys)
    for i, key in enumerate(keys):
        costs, errors = [s["cost_pct"] for s in steps], [s[key] for s in shown.values()]
        right.plot(costs, errors, "o-", color=style.action_colour(key, i), label=key.removesuffix("_mae_pct"))
    left.set(xlabel=f"{what} (% of the recorded range)", title="this block alone in INT8")
    right.axhline(budget_pct, color=BLACK, ls="--", lw=1, label=f"budget, {budget_pct:g} %")
    right.set(xlabel="more instructions (%, computed)", ylabel="mean error (% of the recorded range)", ylim=(0, None))
    right.margins(x=0.15)
    right.set_title("blocks left in float, one by one")
    legend(right)
    return fig


def layers(rows: Sequence[Mapping[str, Any]], clipped_warn_pct: float) -> Figure:
    """Draw signal to noise and clipped share of every INT8 layer, in the order in which data passes them.

    rows: from `inspect_layers`.
    """
    fig, axes = new_figure(2, 1, height_in=4.9, sharex=True)
    upper, lower = axes[:, 0]
    colours = style.part_colours(r["block"] for r in rows)
    upper.bar(range(len(rows)), [r["snr_db"] for r in rows], color=colours)
    upper.set(ylabel="signal to noise (dB)", title="higher is better; errors from earlier layers are included")
    lower.bar(range(len(rows)), [r["clipped_pct"] for r in rows], color=colours)
    lower.axhline(clipped_warn_pct, color=RED, ls="--", lw=1.2, label="warning")
    most_pct = 1.25 * max(clipped_warn_pct, *(r["clipped_pct"] for r in rows))
    lower.set(ylabel="clipped (% of values)", xlabel="INT8 layer, in the order of the data", ylim=(0, most_pct))
    style.label_parts(lower, style.PARTS | {"image_project": GREY})
    legend_below(fig, lower, 5)
    return fig
