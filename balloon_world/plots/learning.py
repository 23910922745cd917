"""Notebook 09: what corrections gained, beside as many seconds of demonstrations."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from balloon_world.plots.late_plans import hit_bars
from rover_lib.workshop.plots.style import MIST, SLATE, legend_below, new_figure

# name, colour, marker, and to which side the marks are moved
ARMS = (("corrected", SLATE, "o", -1.0), ("demonstrated", MIST, "s", 1.0))
PANELS = (("pushed", "pushed"), ("alone", "left alone"), ("decoy", "beside a red decoy"))


def hits_by_round(policies: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the worlds hit against the human seconds that it cost, for both arms, with Wilson's 95 % interval.

    policies: rows of learn.json, first the one that all began with.
    """
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
        x = [row["human_s"] + 0.008 * most * aside for row in rows]
        hit_bars(ax, x, [row[how] for row in rows], "wilson", fmt=f"{marker}-", lw=1.5, color=colour, label=arm)
