"""Notebook 04: INT8 beside FP32."""

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.judge.compare import Fidelity
from rover_lib.workshop.plots import style
from rover_lib.workshop.plots.style import GREY, MOST_ACTIONS, Note, legend_below, line_of, new_figure

AHEAD = "step of the plan (s ahead)"


def action_error(report: Fidelity, rate_hz: float = 30.0) -> Figure | Note:
    """Draw each mode's mean error against FP32 at each step of the plan, in % of the recorded range."""
    actions, steps = report.action_names, report.reference.shape[1]
    if all(report.pct(action) is None for action in actions):
        return Note("no action changes in these recordings: nothing is judged")
    fig, fields = style.figure_of(len(actions), min(max(len(actions), 2), MOST_ACTIONS), 3.6)
    times_s = np.arange(steps) / rate_hz
    for i, (ax, action) in enumerate(zip(fields, actions, strict=True)):
        ax.set_title(action)
        if report.pct(action) is None:
            text = "never changes in these\nrecordings: not judged"
            ax.text(0.5, 0.5, text, ha="center", va="center", transform=ax.transAxes, fontsize=11)
            ax.set_axis_off()
            continue
        for mode in report.chunks:
            ax.plot(times_s, report.in_pct(report.errors(mode)[..., i].mean(0), action), **line_of(mode))
        ax.set(xlabel=AHEAD, ylabel="mean error (% of the recorded range)", ylim=(0, None))
    legend_below(fig, next(ax for ax in fields if ax.get_lines()), 5)
    return fig


def worst_frames(report: Fidelity, mode: str = "static", count: int = 3, rate_hz: float = 30.0) -> Figure | Note:
    """Draw the frames on which a mode differs most from FP32: the picture, both plans, and what was recorded.

    Of many actions, only the worst of each frame is drawn.
    """
    frames = report.worst(mode, count)
    if not frames:
        return Note("no action changes in these recordings: no frame is the worst")
    every = report.action_names if len(report.action_names) <= MOST_ACTIONS else ()
    fig, axes = new_figure(len(frames), 1 + max(len(every), 1), height_in=1.2 + 1.9 * len(frames))
    times_s = np.arange(report.reference.shape[1]) / rate_hz
    for row, worst in zip(axes, frames, strict=True):
        style.show_picture(row[0], worst.sample, f"{worst.action} {worst.error_pct:.2f} % off")
        recorded = getattr(worst.sample, "chunk", None)
        for ax, name in zip(row[1:], every or (worst.action,), strict=True):
            i = report.action_names.index(name)
            if recorded is not None:
                known = ~worst.sample.is_pad
                ax.plot(times_s[known], recorded[known, i], color=GREY, lw=3, label="driver")
            ax.plot(times_s, worst.reference[:, i], **line_of("fp32"))
            ax.plot(times_s, worst.other[:, i], ls="--", **line_of(mode))
            ax.set_ylabel(name, fontsize=9)
            low, high = report.action_range[name]
            margin = 0.05 * (high - low + 1e-6)
            ax.set_ylim(low - margin, high + margin)
    for ax in axes[-1, 1:]:
        ax.set_xlabel(AHEAD)
    legend_below(fig, axes[0, 1], 3)
    return fig
