"""Notebook 03: how much of the error each block causes."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.judge.recorded_range import worst
from rover_lib.workshop.plots import style

Errors = Mapping[str, Mapping[str, float | None]]  # {block: {<action>_mae_pct}}


def sensitivity(table: Errors) -> Figure:
    """Draw the error with each block alone in INT8, by action; of many actions only the worst of each block."""
    fig, axes = style.new_figure(1, height_in=1.2 + 0.26 * len(table))
    ax = axes[0, 0]
    keys = style.judged_keys(ax, next(iter(table.values())))
    bars = {key.removesuffix("_mae_pct"): [row[key] for row in table.values()] for key in keys}
    if len(keys) > style.MOST_ACTIONS:
        bars = {f"the worst of {len(keys)} actions": [worst(row[key] for key in keys) for row in table.values()]}
    height = 0.8 / max(len(bars), 1)
    for i, (action, values) in enumerate(bars.items()):
        y = np.arange(len(table)) + (i - (len(bars) - 1) / 2) * height
        ax.barh(y, values, height, color=style.action_colour(action, i), label=action)
    ax.set_yticks(range(len(table)), list(table))
    ax.invert_yaxis()
    ax.set_xlabel("mean error with this block alone in INT8 (% of the recorded range)")
    style.legend(ax)
    return fig
