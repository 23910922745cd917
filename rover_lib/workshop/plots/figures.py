"""The figures: of the recordings (notebook 01), of each block's error (03), of INT8 beside FP32 (04)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.judge.compare import Fidelity
from rover_lib.workshop.judge.recorded_range import worst
from rover_lib.workshop.plots import style
from rover_lib.workshop.plots.style import GREY, MOST_ACTIONS, Note, legend_below, line_of, new_figure
from rover_lib.workshop.recordings.episodes import Episode, Recordings, Split
from rover_lib.workshop.recordings.samples import ACTION_NAMES

AHEAD = "step of the plan (s ahead)"
PICTURES = 5  # of an episode
MOST_EPISODES = 12


def episode_overview(episode: Episode, actions: Sequence[str]) -> Figure:
    """Draw one episode: what the cameras saw, and what was done; for a car also the pulses that its servos got."""
    samples = episode.samples
    shown = np.linspace(0, len(samples) - 1, PICTURES).round().astype(int)
    lines: dict[str, Any] = {name: [s.chunk[0, i] for s in samples] for i, name in enumerate(actions)}
    if tuple(actions) == ACTION_NAMES:
        pulses = np.array([s.pulses_us or list(vars(s.car.pwm.pulses(*s.chunk[0].tolist())).values()) for s in samples])
        computed = "" if samples[0].pulses_us else ",\ncomputed"
        lines |= {f"{name}\npulse (us{computed})": pulses[:, i] for i, name in enumerate(actions)}
    heights = (1.3, *[0.6] * len(lines))
    fig, axes = new_figure(len(heights), PICTURES, height_in=2.0 + 0.9 * len(lines), height_ratios=heights)
    for ax, i in zip(axes[0], shown, strict=True):
        style.show_picture(ax, samples[i], f"{samples[i].time_s:.1f} s")
    grid = axes[0, 0].get_gridspec()
    for row, (name, values) in enumerate(lines.items(), 1):
        for ax in axes[row]:
            ax.remove()
        ax = fig.add_subplot(grid[row, :])
        ax.plot([s.time_s for s in samples], values, color=style.action_colour(name.split("\n")[0], row - 1), lw=1.5)
        ax.set_ylabel(name, fontsize=9, rotation=0, ha="right")
        ax.tick_params(labelsize=9, labelbottom=row == len(lines))
    ax.set_xlabel("time in the episode (s)")
    label = episode.label or "no label"
    fig.suptitle(f"{episode.id}: {label}, {len(samples)} samples of {episode.frames} frames", fontsize=11)
    return fig


def used_frames(recordings: Recordings, parts: Split) -> Figure:
    """Draw for each episode when its pictures could be used, and when not, with the share that was left out.

    Those episodes are drawn of which most was left out, MOST_EPISODES at most. Colours tell what each part is for.
    """
    rows = []
    for episode in recordings.episodes:
        spans, step_s = _spans(episode)
        left_out_s = max(episode.duration_s + step_s - sum(width for _, width in spans), 0.0)
        rows.append((left_out_s / (episode.duration_s + step_s), episode, spans, step_s))
    rows.sort(key=lambda row: (-round(row[0], 3), row[1].id))
    part_of: dict[str, str] = {}
    for part, ids in parts.episodes.items():
        part_of |= dict.fromkeys(ids, part)
    colours = dict(zip(parts.episodes, (style.MIST, style.OTHERS[1], style.SLATE), strict=False))
    shown = rows[:MOST_EPISODES]
    fig, axes = new_figure(1, height_in=1.6 + 0.26 * len(shown))
    ax = axes[0, 0]
    for y, (share, episode, spans, step_s) in enumerate(shown):
        ax.barh(y, episode.duration_s + step_s, 0.7, color=style.RED)
        ax.broken_barh(spans, (y - 0.35, 0.7), color=colours.get(part_of.get(episode.id, ""), style.GREY))
        label = f" {100 * share:.1f} % left out" if round(share, 3) else " all used"
        ax.text(episode.duration_s + step_s, y, label, va="center", fontsize=9)
    for part, colour in (*colours.items(), ("left out", style.RED)):
        ax.bar(0, 0, color=colour, label=part.replace("_", " "))
    ax.set_yticks(range(len(shown)), [episode.id for _, episode, *_ in shown])
    ax.invert_yaxis()
    ax.set_xlabel("time in the episode (s)")
    ax.set_xlim(0, 1.18 * max(episode.duration_s for _, episode, *_ in shown))
    ax.set_title(f"{len(shown)} of {len(rows)} episodes, those with most left out first")
    legend_below(fig, ax, 4)
    return fig


def _spans(episode: Episode) -> tuple[list[tuple[float, float]], float]:
    """When an episode's samples follow each other without a gap, (begin, width) in s, and the step between two."""
    times_s = np.array([s.time_s for s in episode.samples])
    step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 1 / 30
    pieces = np.split(times_s, np.flatnonzero(np.diff(times_s) > 1.5 * step_s) + 1)
    return [(float(piece[0]), float(piece[-1] - piece[0] + step_s)) for piece in pieces], step_s


def sensitivity(table: Mapping[str, Mapping[str, float | None]]) -> Figure:
    """Draw the error with each block alone in INT8, by action; of many actions only the worst of each block.

    table: {block: {<action>_mae_pct}}.
    """
    fig, axes = new_figure(1, height_in=1.2 + 0.26 * len(table))
    ax = axes[0, 0]
    first = next(iter(table.values()))
    keys = []
    for key, value in first.items():
        if key.endswith("_mae_pct") and value is None:
            ax.plot([], [], " ", label=f"{key.removesuffix('_mae_pct')}: not judged")
        elif key.endswith("_mae_pct"):
            keys.append(key)
    bars = {key.removesuffix("_mae_pct"): [row[key] for row in table.values()] for key in keys}
    if len(keys) > MOST_ACTIONS:
        bars = {f"the worst of {len(keys)} actions": [worst(row[key] for key in keys) for row in table.values()]}
    height = 0.8 / max(len(bars), 1)
    for i, (action, values) in enumerate(bars.items()):
        y = np.arange(len(table)) + (i - (len(bars) - 1) / 2) * height
        ax.barh(y, values, height, color=style.action_colour(action, i), label=action)
    ax.set_yticks(range(len(table)), list(table))
    ax.invert_yaxis()
    ax.set_xlabel("mean error with this block alone in INT8 (% of the recorded range)")
    ax.legend()
    return fig


def action_error(report: Fidelity, rate_hz: float = 30.0) -> Figure | Note:
    """Draw each mode's mean error against FP32 at each step of the plan, in % of the recorded range."""
    actions = report.action_names
    if all(report.pct(action) is None for action in actions):
        return Note("no action changes in these recordings: nothing is judged")
    fig, fields = style.figure_of(len(actions), min(max(len(actions), 2), MOST_ACTIONS), 3.6)
    times_s = np.arange(report.reference.shape[1]) / rate_hz
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


def action_against(report: Fidelity) -> Figure | Note:
    """Draw static INT8's actions against FP32's on the same frames, whole plans, for each action that is judged."""
    actions = [action for action in report.action_names if report.pct(action) is not None][:MOST_ACTIONS]
    if not actions:
        return Note("no action changes in these recordings: nothing is compared")
    fig, fields = style.figure_of(len(actions), MOST_ACTIONS, 3.8)
    for ax, action in zip(fields, actions, strict=True):
        i = report.action_names.index(action)
        exact = report.reference[..., i].ravel()
        rounded = report.chunks["static"][..., i].ravel()
        ends = [min(exact.min(), rounded.min()), max(exact.max(), rounded.max())]
        ax.plot(ends, ends, color=GREY, lw=1)
        ax.plot(exact, rounded, ".", ms=3, color=style.COLOURS["static"], alpha=0.4, rasterized=True)
        ax.set(xlabel=f"{action} of FP32", ylabel=f"{action} of static", aspect="equal")
        ax.set_title(f"r = {np.corrcoef(exact, rounded)[0, 1]:.5f}")
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
    for row, found in zip(axes, frames, strict=True):
        style.show_picture(row[0], found.sample, f"{found.action} {found.error_pct:.2f} % off")
        known = ~found.sample.is_pad
        for ax, name in zip(row[1:], every or (found.action,), strict=True):
            i = report.action_names.index(name)
            ax.plot(times_s[known], found.sample.chunk[known, i], color=GREY, lw=3, label="driver")
            ax.plot(times_s, found.reference[:, i], **line_of("fp32"))
            ax.plot(times_s, found.other[:, i], ls="--", **line_of(mode))
            ax.set_ylabel(name, fontsize=9)
            low, high = report.action_range[name]
            margin = 0.05 * (high - low + 1e-6)
            ax.set_ylim(low - margin, high + margin)
    for ax in axes[-1, 1:]:
        ax.set_xlabel(AHEAD)
    legend_below(fig, axes[0, 1], 3)
    return fig


def familiarity(found: Mapping[str, Any] | None, samples: Sequence[Any]) -> Figure | Note:
    """Draw the largest score of each held-out drive beside the threshold, and the pictures that are least familiar.

    found: a mode's "familiar" of quantize.json, if it has a threshold. samples: those of the held-out drives.
    """
    if not found:
        return Note("too few drives are held out to tell what is unfamiliar: nothing stops the policy there")
    fig, (ax, *fields) = style.figure_of(1 + len(found["least"]), 4, 2.3)
    ax.bar(range(len(found["largest"])), sorted(found["largest"].values()), color=GREY)
    ax.axhline(1, color=style.RED, lw=1.2)
    ax.set(xlabel="held-out drives", ylabel="largest score, of the threshold", xticks=[])
    pictures = {(sample.episode, sample.row): sample for sample in samples}
    for ax, least in zip(fields, found["least"], strict=True):
        style.show_picture(ax, pictures[least["episode"], least["row"]], f"{least['strange']:.2f} of the threshold")
    return fig
