"""Notebook 01: the recordings."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.plots import style
from rover_lib.workshop.plots.style import new_figure
from rover_lib.workshop.recordings.episodes import Episode
from rover_lib.workshop.recordings.samples import ACTION_NAMES


def episode_overview(episode: Episode, actions: Sequence[str] = ACTION_NAMES, pictures: int = 5) -> Figure:
    """Draw one episode: what the cameras saw, and what was done; for a car also the pulses that its servos got."""
    samples = episode.samples
    shown = np.linspace(0, len(samples) - 1, pictures).round().astype(int)
    lines: dict[str, Any] = {name: [s.chunk[0, i] for s in samples] for i, name in enumerate(actions)}
    if tuple(actions) == ACTION_NAMES:
        pulses = np.array([s.pulses_us or list(vars(s.car.pwm.pulses(*s.chunk[0].tolist())).values()) for s in samples])
        computed = "" if samples[0].pulses_us else ",\ncomputed"
        lines |= {f"{name}\npulse (us{computed})": pulses[:, i] for i, name in enumerate(actions)}
    heights = (1.3, *[0.6] * len(lines))
    fig, axes = new_figure(len(heights), pictures, height_in=2.0 + 0.9 * len(lines), height_ratios=heights)
    for ax, i in zip(axes[0], shown, strict=True):
        style.show_picture(ax, samples[i], f"{samples[i].time_s:.1f} s")
    grid = axes[0, 0].get_gridspec()
    for row, (name, values) in enumerate(lines.items(), 1):
        for ax in axes[row]:
            ax.remove()
        ax = fig.add_subplot(grid[row, :])
        ax.plot([s.time_s for s in samples], values, color=style.action_colour(name.split("\n")[0], row - 1), lw=1.5)
        ax.set_ylabel(name, fontsize=8, rotation=0, ha="right")
        ax.tick_params(labelsize=8, labelbottom=row == len(lines))
        ax.spines[["top", "right"]].set_visible(False)
    ax.set_xlabel("time in the episode (s)")
    label = episode.label or "no label"
    fig.suptitle(f"{episode.id}: {label}, {len(samples)} samples of {episode.frames} frames", fontsize=11)
    return fig
