"""Notebook 03: how much of the error each block causes."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from rover_lib.workshop.plots import style
from rover_lib.workshop.plots.style import BLACK, legend, new_figure

Errors = Mapping[str, Mapping[str, float | None]]  # {choice or block: {<action>_mae_pct}}


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
