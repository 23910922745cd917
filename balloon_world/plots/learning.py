"""Notebook 09: what corrections gained, beside as many seconds of demonstrations."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.plots.style import MIST, SLATE, Note, legend_below, new_figure

# name, colour, marker, and to which side the marks are moved
ARMS = (("corrected", SLATE, "o", -1.0), ("demonstrated", MIST, "s", 1.0))
PANELS = (("pushed", "pushed"), ("alone", "left alone"), ("decoy", "beside a red decoy"))


def hits_by_round(policies: Sequence[Mapping[str, Any]]) -> Figure | Note:
    """Draw the worlds hit against the human seconds that it cost, for both arms, with Wilson's 95 % interval.

    policies: rows of learn.json, first the one that all began with.
    """
    if not policies:
        return Note("nothing has been learned yet: there is no figure")
    fig, axes = new_figure(1, len(PANELS), height_in=3.4, sharey=True)
    for ax, (how, title) in zip(axes[0], PANELS, strict=True):
        _arms(ax, policies, how)
        ax.set_title(f"{title} ({policies[0][how]['trials']} worlds)", fontsize=11)
        ax.set_xlabel("human seconds")
    axes[0, 0].set_ylabel("worlds hit (%)")
    legend_below(fig, axes[0, 0], 2)
    return fig


def _arms(ax: Axes, policies: Sequence[Mapping[str, Any]], how: str) -> None:
    first = policies[0]
    most = max(row["human_s"] for row in policies)
    for arm, colour, marker, aside in ARMS:
        rows = [first, *(row for row in policies if row["arm"] == arm)]
        x = np.array([row["human_s"] for row in rows]) + 0.008 * most * aside
        share = np.array([100 * row[how]["hits"] / row[how]["trials"] for row in rows])
        ends = 100 * np.array([[row[how]["wilson_low"], row[how]["wilson_high"]] for row in rows])
        bars = np.clip(np.abs(ends.T - share), 0, None)
        ax.errorbar(x, share, yerr=bars, fmt=f"{marker}-", ms=6, lw=1.5, color=colour, capsize=3, label=arm)
