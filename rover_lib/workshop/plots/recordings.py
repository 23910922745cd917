"""Notebooks 01 and 02: the checkpoint, the recordings, and what calibration saw in them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from rover_lib.workshop.act import block_of
from rover_lib.workshop.int8 import frames
from rover_lib.workshop.int8.observe import Calibration
from rover_lib.workshop.plots import style
from rover_lib.workshop.plots.style import BLUE, GREY, MIST, OTHERS, RED, SLATE, Note, legend, new_figure
from rover_lib.workshop.recordings.episodes import Episode, Recordings, Sample
from rover_lib.workshop.recordings.samples import ACTION_NAMES, HANDLED


def checkpoint_size(report: Mapping[str, Any]) -> Figure:
    """Draw where a checkpoint's megabytes are, and how many remain. report: `Checkpoint.report`."""
    acting_mb = 4 * report["parameters_acting"] / 1e6
    training_mb = 4 * report["parameters"] / 1e6 - acting_mb
    other_mb = max(report["file_mb"] - report["optimizer_mb"] - acting_mb - training_mb, 0)
    parts = {
        "weights that act": (acting_mb, SLATE),
        "weights of training only (VAE)": (training_mb, MIST),
        "optimizer state": (report["optimizer_mb"], OTHERS[1]),
        "everything else": (other_mb, GREY),
    }
    fig, ax = style.bars_figure(3, 2.0)
    left = 0.0
    for name, (size_mb, colour) in parts.items():
        if size_mb > 0.005 * report["file_mb"]:
            ax.barh(0, size_mb, left=left, color=colour, label=name)
            left += size_mb
    ax.barh([1, 2], [acting_mb, report["int8_floor_mb"]], color=[SLATE, BLUE])
    style.bar_values(ax, range(3), [report["file_mb"], acting_mb, report["int8_floor_mb"]], "{:.1f} MB")
    style.name_rows(ax, ["checkpoint file", "FP32, only what acts", "INT8, a byte per weight"])
    ax.set_xlabel("size (MB, 10^6 bytes)")
    legend(ax, loc="lower right")
    return fig


def work_per_block(parameters: Mapping[str, int], macs: Mapping[str, int]) -> Figure:
    """Draw parameters and multiply-accumulates of every block, in the order in which data passes them."""
    blocks = [b for b in macs if macs[b] or parameters.get(b)]
    fig, axes = new_figure(1, 2, height_in=1.5 + 0.21 * len(blocks), sharey=True)
    for ax, counts, what in zip(axes[0], (parameters, macs), ("parameters", "multiply-accumulates"), strict=True):
        ax.barh(range(len(blocks)), [counts.get(b, 0) / 1e6 for b in blocks], color=style.part_colours(blocks))
        ax.set_xlabel(f"{what} (10^6), {sum(counts.values()) / 1e6:.1f} in all")
    style.name_rows(axes[0, 0], blocks)
    style.label_parts(ax, style.PARTS)
    legend(ax, loc="lower right")
    return fig


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


def faults(recordings: Recordings) -> Figure | Note:
    """Draw what was wrong in the recordings, by kind, coloured by what was done about it."""
    counted = recordings.faults_by_kind()
    bars = [(kind, count, handled) for handled, kinds in counted.items() for kind, count in kinds.items()]
    bars.sort(key=lambda bar: -bar[1])
    kinds, counts, _ = zip(*bars, strict=True) if bars else ((), (), ())
    used = f"{len(recordings.episodes)} episodes give {len(recordings.samples)} samples"
    if not bars:
        return Note(f"{used}; no fault was found in them")
    colours = dict(zip(HANDLED, (BLUE, SLATE, OTHERS[1], RED), strict=True))
    fig, ax = style.bars_figure(len(bars), 1.6)
    ax.barh(range(len(bars)), counts, color=[colours[handled] for *_, handled in bars])
    style.bar_values(ax, range(len(bars)), counts, "{:d}")
    style.name_rows(ax, [kind.replace("_", " ") for kind in kinds])
    ax.set(xlabel="times", title=used)
    style.label_parts(ax, {handled: colours[handled] for handled in counted})
    legend(ax, loc="lower right")
    return fig


def odd_frames(calibration: Calibration, samples: Sequence[Sample], count: int = 4) -> Figure:
    """Draw each frame's largest value in each block, against the median frame's, and the oddest frames as pictures.

    samples: those that calibrated, in their order.
    """
    by_block: dict[str, list[torch.Tensor]] = {}
    for place, times in frames.oddness(calibration.frames).items():
        by_block.setdefault(block_of(place), []).append(times)
    table = torch.stack([torch.stack(times).amax(0) for times in by_block.values()])
    oddest = table.amax(0).argsort(descending=True, stable=True)[:count].tolist()
    fig, axes = new_figure(2, len(oddest), height_in=2.4 + 0.16 * len(table))
    grid = axes[0, 0].get_gridspec()
    for ax in axes[0]:
        ax.remove()
    top = fig.add_subplot(grid[0, :])
    grid.set_height_ratios([1.2 + 0.16 * len(table), 1.6])
    shown = top.imshow(table.log10().clamp(-1, 2), aspect="auto", cmap="coolwarm", vmin=-2, vmax=2)
    top.set_yticks(range(len(table)), list(by_block), fontsize=7)
    top.set_xlabel("calibration frame")
    fig.colorbar(shown, ax=top, ticks=[-1, 0, 1, 2], format=lambda x, _: f"{10.0**x:g}", label="times the median")
    for ax, i in zip(axes[1], oddest, strict=True):
        style.show_picture(ax, samples[i], f"{samples[i].episode.removeprefix('episode_')}\nframe {samples[i].row}")
    return fig
