"""One function per figure; each returns a matplotlib Figure and touches nothing else.

    plots.save(plots.action_error(report), run_dir, "04_action_error")

Colours are Okabe and Ito's, which colour-blind people can tell apart; a mode has the same one in every figure.
Figures are drawn for a notebook's width at 100 dots per inch.
"""

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.table import Table

from rover_lib.onboard.host import THROTTLED_BITS
from rover_lib.onboard.plan import Follower, Plan, Settings
from rover_lib.onboard.pwm import PwmCalibration
from rover_lib.workshop.compare import Fidelity
from rover_lib.workshop.episodes import Episode, Recordings, Sample
from rover_lib.workshop.observe import Calibration, RangeObserver
from rover_lib.workshop.scheme import OBSERVERS

WIDTH_IN, DPI = 9.0, 100
BLACK, ORANGE, SKY, GREEN, BLUE, RED, PURPLE = (
    "#333333",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
)
GREY = "#B0B0B0"
NOW_BITS = sum(1 << bit for bit in THROTTLED_BITS)  # of get_throttled; the others are since the machine's start
COLOURS = {
    "fp32": BLACK,
    "dynamic": ORANGE,
    "static": BLUE,
    "mixed": GREEN,
    "static_affine": RED,
    "lerobot": PURPLE,
    "steering": BLUE,
    "throttle": ORANGE,
}
NAMES = {
    "fp32": "FP32",
    "dynamic": "dynamic",
    "static": "static",
    "mixed": "mixed",
    "static_affine": "static, affine",
    "lerobot": "LeRobot, eager FP32",
    "torch_affine": "torch, affine",
    "onnxruntime": "ONNX Runtime INT8",
    "executorch": "ExecuTorch INT8",
}

# Instructions of one inference of the full policy (15 GMAC, 360x640), in 1e9: label, all, SIMD among them. What
# notebook 03 shows of a run that `make arm` has not counted. Source: `make arm NAME=full PEERS=1`, as in notebook 06.
COUNTED = (
    ("FP32, TorchScript", 6.08, 3.81),
    ("INT8 affine (quint8): QNNPACK's kernels", 5.03, 4.34),
    ("INT8 in ONNX Runtime 1.31.1", 1.66, 1.12),
    ("INT8 in ExecuTorch 1.5.1: XNNPACK", 1.49, 1.08),
    ("INT8 symmetric (qint8), ours: XNNPACK", 1.44, 1.08),
    ("dot-product instructions alone", 0.94, 0.94),
)


def _axes(rows: int, columns: int = 1, height_in: float = 3.2, **options: Any) -> tuple[Figure, np.ndarray]:
    """A figure and its (rows, columns) axes, closed for pyplot: who shows the figure is the caller's affair."""
    fig, axes = plt.subplots(
        rows, columns, figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained", squeeze=False, **options
    )
    plt.close(fig)
    for ax in axes.flat:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=9)
    return fig, axes


def _legend(ax: Axes, **options: Any) -> None:
    ax.legend(frameon=False, fontsize=9, **options)


def _legend_below(fig: Figure, ax: Axes, columns: int) -> None:
    """One legend for all of a figure's axes."""
    handles, labels = ax.get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def _values(ax: Axes, y: Sequence[float], x: Sequence[float], form: str) -> None:
    """The numbers behind horizontal bars, with room for them."""
    for at, value in zip(y, x, strict=True):
        ax.annotate(form.format(value), (value, at), (4, 0), textcoords="offset points", va="center", fontsize=9)
    ax.margins(x=0.16)


def _note(ax: Axes, text: str) -> None:
    """A sentence where there is nothing to draw."""
    ax.text(0.5, 0.5, text, ha="center", va="center", transform=ax.transAxes, fontsize=11)
    ax.set_axis_off()


def _judged(ax: Axes, errors: Mapping[str, float | None]) -> list[str]:
    """The keys <action>_mae_pct of actions that are judged; those that are not are named in the legend of `ax`."""
    keys = [k for k in errors if k.endswith("_mae_pct")]
    for key in keys:
        if errors[key] is None:
            ax.plot([], [], " ", label=f"{key.removesuffix('_mae_pct')}: not judged")
    return [k for k in keys if errors[k] is not None]


def save(figure: Figure, run_dir: Path | str, name: str) -> Figure:
    """Write run_dir/figures/<name>.png and return the figure, so that a cell that ends with this also shows it."""
    path = Path(run_dir) / "figures" / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)
    return figure


# --- 01: the checkpoint and the recordings --------------------------------------------------------


def checkpoint_size(report: Mapping[str, Any]) -> Figure:
    """Where a checkpoint's megabytes are, and what remains of them. report: `Checkpoint.report`."""
    acting_mb = 4 * report["parameters_acting"] / 1e6
    training_mb = 4 * report["parameters"] / 1e6 - acting_mb
    other_mb = max(report["file_mb"] - report["optimizer_mb"] - acting_mb - training_mb, 0)
    parts = {
        "weights that act": (acting_mb, BLUE),
        "weights of training only (VAE)": (training_mb, SKY),
        "optimizer state": (report["optimizer_mb"], ORANGE),
        "everything else": (other_mb, GREY),
    }
    rows = ["checkpoint file", "FP32, only what acts", "INT8, a byte per weight"]
    fig, axes = _axes(1, height_in=2.8)
    ax, left = axes[0, 0], 0.0
    for name, (size_mb, colour) in parts.items():
        if size_mb > 0.005 * report["file_mb"]:
            ax.barh(0, size_mb, left=left, color=colour, label=name)
            left += size_mb
    ax.barh([1, 2], [acting_mb, report["int8_floor_mb"]], color=BLUE)
    _values(ax, range(3), [report["file_mb"], acting_mb, report["int8_floor_mb"]], "{:.1f} MB")
    ax.set_yticks(range(3), rows)
    ax.invert_yaxis()
    ax.set_xlabel("size (MB, 10^6 bytes)")
    ax.set_title(
        f"{report['file_mb'] / report['int8_floor_mb']:.1f}x in all: {report['file_mb'] / acting_mb:.1f}x left out, "
        f"{acting_mb / report['int8_floor_mb']:.1f}x by INT8",
        fontsize=11,
    )
    _legend(ax, loc="lower right")
    return fig


def work_per_block(parameters: Mapping[str, int], macs: Mapping[str, int]) -> Figure:
    """Parameters and multiply-accumulates of every block, in the order of the data."""
    blocks = [b for b in macs if macs[b] or parameters.get(b)]
    fig, axes = _axes(1, 2, height_in=1.2 + 0.21 * len(blocks), sharey=True)
    left, right = axes[0]
    y = np.arange(len(blocks))
    colours = [{"backbone": SKY, "encoder": GREEN, "decoder": ORANGE}.get(b.split(".")[0], GREY) for b in blocks]
    left.barh(y, [parameters.get(b, 0) / 1e6 for b in blocks], color=colours)
    right.barh(y, [macs[b] / 1e6 for b in blocks], color=colours)
    left.set_yticks(y, blocks)
    left.invert_yaxis()
    left.set_xlabel(f"parameters (10^6), {sum(parameters.values()) / 1e6:.2f} in all")
    right.set_xlabel(f"multiply-accumulates (10^6), {sum(macs.values()) / 1e6:.0f} in all")
    left.set_title("what must be stored", fontsize=11)
    right.set_title("what must be computed", fontsize=11)
    for part, colour in (("backbone", SKY), ("encoder", GREEN), ("decoder", ORANGE)):
        right.barh(0, 0, color=colour, label=part)
    _legend(right, loc="lower right")
    return fig


def episode_overview(episode: Episode, pictures: int = 5) -> Figure:
    """One drive: what the camera saw, what the driver did, and the pulses that the servos got."""
    samples = episode.samples
    shown = [samples[i] for i in np.linspace(0, len(samples) - 1, pictures).round().astype(int)]
    fig = plt.figure(figsize=(WIDTH_IN, 6.2), dpi=DPI, layout="constrained")
    plt.close(fig)
    grid = fig.add_gridspec(3, pictures, height_ratios=(1.1, 1.3, 1.3))
    for i, sample in enumerate(shown):
        ax = fig.add_subplot(grid[0, i])
        ax.imshow(sample.frame_bgr()[..., ::-1])
        ax.set_title(f"{sample.time_s:.1f} s", fontsize=9)
        ax.axis("off")
    times_s = [s.time_s for s in samples]
    actions = np.stack([s.chunk[0] for s in samples])
    pulses = [PwmCalibration().pulses(*(float(v) for v in a)) for a in actions]
    upper, lower = fig.add_subplot(grid[1, :]), fig.add_subplot(grid[2, :])
    rows = (
        (upper, actions[:, 0], actions[:, 1], "{} (share of full)"),
        (lower, [p.steering_us for p in pulses], [p.throttle_us for p in pulses], "{} pulse (us)"),
    )
    for ax, steering, throttle, unit in rows:
        other = ax.twinx()
        ax.plot(times_s, steering, color=BLUE, lw=1.5)
        other.plot(times_s, throttle, color=ORANGE, lw=1.5, ls="--")
        ax.set_ylabel(unit.format("steering"), color=BLUE)
        other.set_ylabel(unit.format("throttle"), color="#8A5F00")  # the same orange, dark enough to read
        ax.spines["top"].set_visible(False)
        other.spines["top"].set_visible(False)
    lower.set_xlabel("time in the episode (s)")
    fig.suptitle(
        f"{episode.id}: {episode.label or 'no label'}, {len(samples)} samples of {episode.frames} frames",
        fontsize=11,
    )
    return fig


def faults(recordings: Recordings) -> Figure:
    """What was wrong in the recordings, by kind; every count was skipped, none became an action."""
    counts: dict[str, int] = {}
    for fault in recordings.faults:
        counts[fault.kind] = counts.get(fault.kind, 0) + fault.count
    kinds = sorted(counts, key=lambda k: -counts[k])
    fig, axes = _axes(1, height_in=1.3 + 0.28 * max(len(kinds), 1))
    ax = axes[0, 0]
    used = len(recordings.samples)
    if kinds:
        ax.barh(range(len(kinds)), [counts[k] for k in kinds], color=RED)
        _values(ax, range(len(kinds)), [counts[k] for k in kinds], "{:d}")
        ax.set_yticks(range(len(kinds)), [k.replace("_", " ") for k in kinds])
        ax.invert_yaxis()
        ax.set_xlabel("times")
    else:
        _note(ax, "no faults found")
    ax.set_title(f"{len(recordings.episodes)} episodes give {used} samples; faults that were skipped:", fontsize=11)
    return fig


# --- 02: calibration ------------------------------------------------------------------------------


def calibration_coverage(
    pool: Sequence[Sample],
    chosen: Sequence[Sample],
    held_out: Sequence[Sample],
    names=("steering", "throttle"),
) -> Figure:
    """Which recorded actions the calibration samples cover, beside those that judge later."""
    fig, axes = _axes(1, 3, height_in=3.4)
    sets = (
        ("could calibrate", pool, GREY, "o", 8),
        ("held out", held_out, ORANGE, "x", 14),
        ("calibrate", chosen, BLUE, "o", 10),
    )
    for label, samples, colour, marker, size in sets:
        first = np.stack([s.chunk[0] for s in samples])
        axes[0, 0].scatter(
            *first.T[:2],
            s=size,
            c=colour,
            marker=marker,
            lw=0.8,
            alpha=0.8,
            label=f"{label} ({len(samples)})",
        )
    axes[0, 0].set(xlabel=f"{names[0]} (share of full)", ylabel=f"{names[1]} (share of full)")
    axes[0, 0].set_title("one point per frame", fontsize=11)
    for i in range(2):
        ax = axes[0, i + 1]
        every = np.concatenate([s.chunk[:, i] for s in pool])
        bins = np.linspace(every.min(), every.max(), 25) if every.max() > every.min() else 25
        for samples, colour, style in ((pool, GREY, "stepfilled"), (chosen, BLUE, "step")):
            values = np.concatenate([s.chunk[:, i] for s in samples])
            ax.hist(
                values,
                bins,
                weights=np.full(len(values), 100 / len(values)),
                color=colour,
                histtype=style,
                lw=1.5,
            )
        ax.set(xlabel=f"{names[i]} (share of full)", ylabel="actions (%)")
        ax.set_title(f"{names[i]} over whole plans", fontsize=11)
    _legend_below(fig, axes[0, 0], 3)
    return fig


def observer_ranges(calibration: Calibration, count: int = 3) -> Figure:
    """What calibration saw in a few layers, and the range that each observer would give INT8's 256 steps to.

    Of each part of the policy the layer where the observers disagree most.
    """
    found = []
    for layer, observers in _observers(calibration).items():
        ranges = {name: observers[name].range() for name in OBSERVERS}
        widths = [high - low for low, high in ranges.values()]
        found.append((max(widths) / max(min(widths), 1e-12), layer, observers["minmax"], ranges))
    found.sort(key=lambda row: -row[0])
    best = {}
    for row in found:
        best.setdefault(row[1].split(".")[0], row)
    found = list(best.values())[:count]
    fig, axes = _axes(1, len(found), height_in=3.6)
    styles = {"minmax": (BLACK, ":"), "percentile": (ORANGE, "--"), "histogram": (BLUE, "-")}
    for ax, (_, layer, seen, ranges) in zip(axes[0], found, strict=False):
        share = 100 * seen.histogram / seen.histogram.sum()
        limit = seen.limit.item()
        edges = np.linspace(-limit, limit, 129)
        ax.bar(edges[:-1], share.view(128, -1).sum(1), np.diff(edges), align="edge", color=GREY)
        for name, (colour, style) in styles.items():
            for i, x in enumerate(ranges[name]):
                ax.axvline(x, color=colour, ls=style, lw=1.6, label=name if i == 0 else None)
        low, high = ranges["minmax"]
        ax.set_xlim(low - 0.06 * (high - low), high + 0.06 * (high - low))
        ax.set_yscale("log")
        ax.set_title(layer, fontsize=10)
        ax.set_xlabel("activation (no unit)")
    axes[0, 0].set_ylabel("values seen (%, logarithmic)")
    _legend_below(fig, axes[0, 0], 3)
    return fig


def _observers(calibration: Calibration) -> dict[str, dict[str, Any]]:
    """For each layer with a recorded range: an observer of each choice with what calibration saw there."""
    states: dict[str, dict[str, torch.Tensor]] = {}
    for key, tensor in calibration.observers.items():
        name, _, buffer = key.rpartition(".")
        states.setdefault(name, {})[buffer] = tensor
    by_range = {(s["min_val"].item(), s["max_val"].item()): s for s in states.values() if "histogram" in s}
    found = {}
    for layer, ends in calibration.ranges.items():
        state = by_range.get((ends["min"], ends["max"]))
        if state is None:
            continue
        found[layer] = {}
        for choice in OBSERVERS:
            o = RangeObserver(dtype=torch.qint8, quant_min=-128, quant_max=127, choice=choice, percentile=99.99)
            for buffer in ("min_val", "max_val", "limit", "histogram"):
                getattr(o, buffer).copy_(state[buffer])
            found[layer][choice] = o
    return found


# --- 03: quantization -----------------------------------------------------------------------------


def outlier_channels(calibration: Calibration, count: int = 16) -> Figure:
    """The largest activation per channel, before and after channel scales.

    Left: a projection's largest channel over its median one, of the `count` projections where that was worst. Right:
    the worst of all, channel by channel.
    """
    layers = {n: c for n, c in calibration.channels.items() if "in_max_scaled" in c}

    def peak(x: torch.Tensor) -> float:
        """How much larger the largest channel is than the middle one, of those that are not dead."""
        x = x[x > 1e-6 * x.max()]
        return float(x.max() / x.median()) if len(x) else 1.0

    # Behind `up` INT8 sees the other side of the activation function, which is the input of `down`.
    sides = {n: ("in",) if n.endswith(".up") else ("in", "out") for n in layers}
    pairs = [(n, s) for n in layers for s in sides[n]]
    worst, side = max(pairs, key=lambda row: peak(layers[row[0]][f"{row[1]}_max"]))
    uneven = sorted(layers, key=lambda n: max(peak(layers[n][f"{s}_max"]) for s in sides[n]), reverse=True)[:count]
    layers = {n: c for n, c in layers.items() if n in uneven}  # in the order of the data
    fig, axes = _axes(1, 2, height_in=max(3.4, 1.0 + 0.2 * len(layers)))
    left, right = axes[0]
    y = {name: i for i, name in enumerate(layers)}
    for at, where, marker in (("in", "input", "o"), ("out", "output", "s")):
        shown = [n for n in layers if at in sides[n]]
        for key, colour, label in ((f"{at}_max", RED, "before"), (f"{at}_max_scaled", BLUE, "after")):
            peaks = [peak(layers[n][key]) for n in shown]
            face = "none" if label == "before" else colour
            left.scatter(
                peaks, [y[n] for n in shown], color=colour, marker=marker, s=16, fc=face, label=f"{where}, {label}"
            )
    left.set_yticks(list(y.values()), list(layers), fontsize=8)
    left.invert_yaxis()
    left.set(xscale="log", xlabel="largest channel / median channel")
    left.set_title(f"the {len(layers)} most uneven projections", fontsize=11)
    for key, colour, label in (
        (f"{side}_max", RED, "before"),
        (f"{side}_max_scaled", BLUE, "after channel scales"),
    ):
        x = np.sort(np.asarray(layers[worst][key]))[::-1]
        right.plot(np.arange(1, len(x) + 1), 100 * x / x[0], color=colour, lw=1.8, label=label)
    right.set(xlabel="channel, largest first", ylabel="activation (% of the largest)", ylim=(0, 105))
    right.set_title(f"{worst}, {'input' if side == 'in' else 'output'}", fontsize=11)
    _legend(right)
    _legend_below(fig, left, 4)
    return fig


def instruction_counts(found: Mapping[str, Any] | None = None) -> Figure:
    """Why symmetric: instructions of one inference, by what ran.

    found: metrics of the run's arm.json; if None, the full policy's, as recorded in COUNTED.
    """
    rows, title = list(COUNTED), "full policy at 360x640, recorded, not of this run"
    if found is not None:
        counted = whole_size(found)
        rows = [(NAMES.get(n, n), m["instructions_g"], m["simd_g"]) for n, m in counted.items()]
        floor_g, gmac = (next(iter(counted.values()))[key] for key in ("floor_g", "gmac"))
        rows.append(("dot-product instructions alone", floor_g, floor_g))
        title = f"this run's artifacts, {gmac:.3g} GMAC"
    fig, axes = _axes(1, height_in=1.2 + 0.36 * len(rows))
    ax, y = axes[0, 0], np.arange(len(rows))
    total, simd = (np.array([row[i] for row in rows]) for i in (1, 2))
    _simd_bars(ax, y, total, simd)
    ax.set_yticks(y, [row[0] for row in rows])
    ax.invert_yaxis()
    ax.set_xlabel("instructions of one inference (10^9)")
    ax.set_title(f"{title}; counted on an emulated Cortex-A76", fontsize=10, loc="right")
    _legend(ax, loc="lower right")
    return fig


def _simd_bars(ax: Axes, y: np.ndarray, total: np.ndarray, simd: np.ndarray) -> None:
    ax.barh(y, simd, color=BLUE, label="SIMD (vector) instructions")
    ax.barh(y, total - simd, left=simd, color=SKY, label="all others")
    _values(ax, y, total, "{:.3g}")


def errors_by_choice(
    table: Mapping[str, Mapping[str, float | None]], title: str, budget_pct: float | None = None
) -> Figure:
    """Error of each action for each choice, say of observers. table: {choice: {<action>_mae_pct}}."""
    choices = list(table)
    fig, axes = _axes(1, height_in=1.3 + 0.42 * len(choices))
    ax = axes[0, 0]
    keys = _judged(ax, next(iter(table.values())))
    height = 0.8 / max(len(keys), 1)
    for i, key in enumerate(keys):
        y = np.arange(len(choices)) + (i - (len(keys) - 1) / 2) * height
        values = [table[c][key] for c in choices]
        ax.barh(y, values, height, color=_action_colour(key, i), label=key.removesuffix("_mae_pct"))
        _values(ax, y, values, "{:.2f}")
    if budget_pct is not None:
        ax.axvline(budget_pct, color=BLACK, ls="--", lw=1, label=f"limit, {budget_pct:g} %")
    ax.set_yticks(range(len(choices)), choices)
    ax.invert_yaxis()
    ax.set_xlabel("mean error against FP32 (% of the recorded range)")
    ax.set_title(title, fontsize=11)
    _legend(ax, loc="upper left", bbox_to_anchor=(1, 1))
    return fig


def _action_colour(key: str, index: int) -> str:
    return COLOURS.get(key.split("_")[0], (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)[index % 6])


def sensitivity(
    table: Mapping[str, Mapping[str, float | None]], steps: Sequence[Mapping[str, Any]], budget_pct: float
) -> Figure:
    """Left: each block quantized alone. Right: what leaving the worst ones in float buys.

    table: {block: {<action>_mae_pct}}; steps: of `choose_mixed`, {float_blocks, <action>_mae_pct}.
    """
    blocks = list(table)
    fig, axes = _axes(1, 2, height_in=max(3.6, 1.2 + 0.26 * len(blocks)), width_ratios=(1.5, 1))
    left, right = axes[0]
    keys = _judged(right, next(iter(table.values())))
    height = 0.8 / max(len(keys), 1)
    for i, key in enumerate(keys):
        name, colour = key.removesuffix("_mae_pct"), _action_colour(key, i)
        y = np.arange(len(blocks)) + (i - (len(keys) - 1) / 2) * height
        left.barh(y, [table[b][key] for b in blocks], height, color=colour, label=name)
        right.plot(range(len(steps)), [s[key] for s in steps], "o-", color=colour, label=name)
    left.set_yticks(range(len(blocks)), blocks)
    left.invert_yaxis()
    left.set_xlabel("mean error (% of the recorded range)")
    left.set_title("this block alone in INT8", fontsize=11)
    right.axhline(budget_pct, color=BLACK, ls="--", lw=1, label=f"budget, {budget_pct:g} %")
    right.set_xticks(range(len(steps)))
    right.set(xlabel="blocks left in float", ylabel="mean error (% of the recorded range)", ylim=(0, None))
    right.margins(x=0.15)
    right.set_title("all others in INT8", fontsize=11)
    _legend(right)
    return fig


def layers(rows: Sequence[Mapping[str, Any]], clipped_warn_pct: float) -> Figure:
    """Signal to noise and clipped share of every INT8 layer, in the order of the data. rows: `inspect_layers`."""
    fig, axes = _axes(2, 1, height_in=4.6, sharex=True)
    upper, lower = axes[:, 0]
    x = np.arange(len(rows))
    parts = [r["block"].split(".")[0] for r in rows]
    colours = [{"backbone": SKY, "encoder": GREEN, "decoder": ORANGE}.get(p, GREY) for p in parts]
    upper.bar(x, [r["snr_db"] for r in rows], color=colours)
    upper.set_ylabel("signal to noise (dB)")
    upper.set_title("higher is better; errors from earlier layers are included", fontsize=11)
    lower.bar(x, [r["clipped_pct"] for r in rows], color=colours)
    lower.axhline(clipped_warn_pct, color=RED, ls="--", lw=1.2)
    lower.text(len(rows) - 0.5, clipped_warn_pct, "warning ", color=RED, ha="right", va="bottom", fontsize=9)
    lower.set(ylabel="clipped (% of values)", xlabel="INT8 layer, in the order of the data")
    lower.set_ylim(0, 1.25 * max(clipped_warn_pct, *(r["clipped_pct"] for r in rows)))
    for part, colour in (("backbone", SKY), ("encoder", GREEN), ("decoder", ORANGE), ("image_project", GREY)):
        if part in parts:
            lower.bar(0, 0, color=colour, label=part)
    _legend_below(fig, lower, 4)
    return fig


# --- 04: comparison -------------------------------------------------------------------------------


def sizes(metrics: Mapping[str, Any]) -> Figure:
    """Artifact files, weights with weights. metrics: of compare.json."""
    found = {"fp32": metrics["fp32"]["size_mb"]} | {m: v["size_mb"] for m, v in metrics["modes"].items()}
    fig, axes = _axes(1, height_in=1.0 + 0.34 * len(found))
    ax, y = axes[0, 0], range(len(found))
    ax.barh(y, list(found.values()), color=[COLOURS.get(m, GREY) for m in found])
    for at, size_mb in enumerate(found.values()):
        text = f"{size_mb:.1f} MB" + (f", {found['fp32'] / size_mb:.1f}x smaller" if at else "")
        ax.annotate(text, (size_mb, at), (4, 0), textcoords="offset points", va="center", fontsize=9)
    ax.margins(x=0.25)
    ax.set_yticks(y, [NAMES.get(m, m) for m in found])
    ax.invert_yaxis()
    ax.set_xlabel("artifact file (MB, 10^6 bytes)")
    return fig


def action_error(report: Fidelity, rate_hz: float = 30.0) -> Figure:
    """Mean error of every mode against FP32 at each step of the plan: percent of the recorded range, and pulse."""
    actions, steps = report.action_names, report.reference.shape[1]
    fig, axes = _axes(1, len(actions), height_in=3.6)
    times_s = np.arange(steps) / rate_hz
    for i, action in enumerate(actions):
        ax, pct = axes[0, i], report.pct(action)
        ax.set_title(action, fontsize=11)
        if pct is None:
            _note(ax, "never changes in these\nrecordings: not judged")
            continue
        for mode in report.chunks:
            error = report.in_pct(report.errors(mode)[..., i].mean(0), action)
            ax.plot(times_s, error, color=COLOURS.get(mode, GREY), lw=1.8, label=NAMES.get(mode, mode))
        ax.set(xlabel="step of the plan (s ahead)", ylabel="mean error (% of the recorded range)", ylim=(0, None))
        us = report.us(action) / pct
        if np.isfinite(us):
            other = ax.secondary_yaxis("right", functions=(lambda p, u=us: p * u, lambda e, u=us: e / u))
            other.set_ylabel("the same as pulse (us)")
            other.tick_params(labelsize=9)
    judged = [ax for ax in axes[0] if ax.get_lines()]
    if judged:
        _legend_below(fig, judged[0], 5)
    return fig


def worst_frames(report: Fidelity, mode: str = "static", count: int = 3, rate_hz: float = 30.0) -> Figure:
    """The frames on which a mode differs most from FP32: the picture and both plans, with the recording's own."""
    found = report.worst(mode, count)
    names = report.action_names
    fig, axes = _axes(max(len(found), 1), 1 + len(names), height_in=0.9 + 1.9 * max(len(found), 1))
    if not found:
        for ax in axes[0]:
            _note(ax, "not judged")
        return fig
    times_s = np.arange(report.reference.shape[1]) / rate_hz
    for row, worst in zip(axes, found, strict=True):
        row[0].imshow(worst.sample.frame_bgr()[..., ::-1])
        row[0].axis("off")
        row[0].set_title(f"{worst.action} {worst.error_pct:.2f} % off", fontsize=10)
        recorded = getattr(worst.sample, "chunk", None)
        for i, name in enumerate(names):
            ax = row[1 + i]
            if recorded is not None:
                known = ~worst.sample.is_pad
                ax.plot(times_s[known], recorded[known, i], color=GREY, lw=3, label="driver")
            ax.plot(times_s, worst.reference[:, i], color=BLACK, lw=1.8, label="FP32")
            ax.plot(
                times_s,
                worst.other[:, i],
                color=COLOURS.get(mode, BLUE),
                lw=1.8,
                ls="--",
                label=f"{mode} INT8",
            )
            ax.set_ylabel(f"{name}", fontsize=9)
            low, high = report.action_range[name]
            ax.set_ylim(low - 0.05 * (high - low + 1e-6), high + 0.05 * (high - low + 1e-6))
    for ax in axes[-1, 1:]:
        ax.set_xlabel("step of the plan (s ahead)")
    _legend_below(fig, axes[0, 1], 3)
    return fig


def hits(metrics: Mapping[str, Any]) -> Figure:
    """Balloons hit in unseen worlds, with Wilson's 95 % interval: how little so few drives say. metrics: of compare."""
    rows = {"fp32": metrics["fp32"]} | dict(metrics["modes"])
    rows = {m: v for m, v in rows.items() if v["trials"]}
    fig, axes = _axes(1, height_in=1.2 + 0.36 * max(len(rows), 1))
    ax = axes[0, 0]
    for y, (mode, v) in enumerate(rows.items()):
        colour = COLOURS.get(mode, GREY)
        ax.plot([100 * v["hits_wilson_low"], 100 * v["hits_wilson_high"]], [y, y], color=colour, lw=3, alpha=0.5)
        ax.plot(100 * v["hits"] / v["trials"], y, "o", color=colour, ms=8)
        ax.annotate(
            f"{v['hits']} of {v['trials']}",
            (1.01, y),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=10,
        )
    ax.set_yticks(range(len(rows)), [NAMES.get(m, m) for m in rows])
    ax.set_ylim(len(rows) - 0.5, -0.5)
    lows = [100 * v["hits_wilson_low"] for v in rows.values()]
    ax.set_xlim(max(0, min(lows, default=0) - 5), 101)
    ax.set_xlabel("worlds in which the balloon was hit (%), with the 95 % interval")
    return fig


def drives_from_above(trials: Mapping[str, Any], count: int = 4) -> Figure:
    """The worlds in which the modes' drives part most. trials: closed-loop reports by mode, FP32 among them."""

    def apart(index: int) -> float:
        base, gap = trials["fp32"].per_world[index].trajectory, 0.0
        for trial in trials.values():
            other = trial.per_world[index].trajectory
            n = min(len(base.x_m), len(other.x_m))
            gap = max(gap, np.hypot(base.x_m[:n] - other.x_m[:n], base.y_m[:n] - other.y_m[:n]).max())
        return gap

    worlds = sorted(range(len(trials["fp32"].per_world)), key=lambda i: -apart(i))[:count]
    fig, axes = _axes(1, count, height_in=3.8)
    for ax, i in zip(axes[0], worlds, strict=False):
        for mode, trial in trials.items():
            path = trial.per_world[i].trajectory
            style = "-" if mode == "fp32" else "--"
            # forward is up; positive y is to the left of the car
            ax.plot(-path.y_m, path.x_m, style, color=COLOURS.get(mode, GREY), lw=1.8, label=NAMES.get(mode, mode))
        x, y = trials["fp32"].per_world[i].trajectory.balloon_xy_m
        ax.add_patch(Circle((-y, x), 0.16, color=RED))
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel("to the right (m)")
        missed = [NAMES.get(m, m) for m, t in trials.items() if not t.per_world[i].hit]
        outcome = "all hit" if not missed else "all missed" if len(missed) == len(trials) else ""
        outcome = outcome or (f"{missed[0]} missed" if len(missed) == 1 else f"{len(missed)} of {len(trials)} missed")
        ax.set_title(f"{100 * apart(i):.0f} cm apart, {outcome}", fontsize=9)
    axes[0, 0].set_ylabel("ahead of the start (m)")
    _legend_below(fig, axes[0, 0], 5)
    return fig


def gates(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """The gates as a table: what was promised, what was found."""
    verdict = {True: ("pass", "#DCF0E8"), False: ("FAIL", "#F9DDCB"), None: ("not measured", "#EFEFEF")}

    def shown(value: Any) -> str:
        return "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)

    cells = [[r["gate"], _limit(r), shown(r["found"]), verdict[r["passed"]][0]] for r in rows]
    fig, axes = _axes(1, height_in=0.5 + 0.27 * (len(rows) + 1))
    axes[0, 0].axis("off")
    table = axes[0, 0].table(
        cells,
        colLabels=["gate", "promised", "found", "verdict"],
        colWidths=(0.46, 0.2, 0.16, 0.18),
        cellLoc="left",
        colLoc="left",
        bbox=(0, 0, 1, 1),
    )
    _plain_table(table)
    for (row, column), cell in table.get_celld().items():
        if row and column == 3:
            cell.set_facecolor(verdict[rows[row - 1]["passed"]][1])
    return fig


def _plain_table(table: Table) -> None:
    table.auto_set_font_size(False)
    table.set_fontsize(10)
    for (row, _), cell in table.get_celld().items():
        cell.set_edgecolor("#DDDDDD")
        if row == 0:
            cell.set_text_props(weight="bold")


def _limit(row: Mapping[str, Any]) -> str:
    """A gate's limit in words; a promised range as it was promised."""
    limit = row["limit"]
    if isinstance(limit, (list, tuple)):
        return f"{limit[0]:g} to {limit[1]:g}"
    words = {"<=": "at most ", ">=": "at least "}.get(row.get("relation", ""), "")
    return words + (f"{limit:g}" if isinstance(limit, (int, float)) else str(limit))


# --- 05: benchmark ----------------------------------------------------------------------------------------


def latency(benchmarks: Mapping[str, Mapping[str, Any]]) -> Figure:
    """How long one inference takes, by host and artifact: p50, p95, p99, and the floor of a Pi 5 by arithmetic.

    benchmarks: contents of benchmark-<host>.json by host, one panel each.
    """
    counts = [len(b["metrics"]["artifacts"]) for b in benchmarks.values()]
    height_in = 0.9 + sum(0.7 + 0.36 * n for n in counts)
    fig, axes = _axes(len(benchmarks), height_in=height_in, height_ratios=counts, sharex=True)
    floors = False
    for ax, (host, stage) in zip(axes[:, 0], benchmarks.items(), strict=True):
        found = stage["metrics"]["artifacts"]
        for y, (name, v) in enumerate(found.items()):
            mode = name.partition(",")[0]
            p50, p95, p99 = (v[f"latency_{p}_ms"] for p in ("p50", "p95", "p99"))
            ax.barh(y, p50, 0.62, color=COLOURS.get(mode, GREY), alpha=0.85)
            ax.plot([p50, p99], [y, y], color=BLACK, lw=1)
            ax.plot(p95, y, "|", color=BLACK, ms=14, mew=2)
            ax.plot(p99, y, "|", color=BLACK, ms=7, mew=1.5)
            if v.get("floor_ms") is not None:
                ax.plot(v["floor_ms"], y, "D", color=RED, mec="white", ms=6)
                floors = True
            text = f"{p50:.1f} / {p95:.1f} / {p99:.1f} ms"
            ax.annotate(text, (1.01, y), xycoords=("axes fraction", "data"), va="center", fontsize=9)
        ax.set_yticks(range(len(found)), [NAMES.get(n, n) for n in found])
        ax.set_ylim(len(found) - 0.5, -0.5)
        ax.set_xlim(0, None)
        env, n = stage["env"], next(iter(found.values()))["n"]
        ax.set_title(f"{host} ({env['machine']}, {env['cores']} cores), n = {n}, bar: p50", fontsize=11)
    axes[-1, 0].set_xlabel("latency of one inference, one plan of actions (ms)")
    axes[0, 0].text(1.01, 1.02, "p50 / p95 / p99", transform=axes[0, 0].transAxes, fontsize=9)
    first = axes[0, 0]
    first.plot([], [], "|", color=BLACK, ms=14, mew=2, label="p95")
    first.plot([], [], "|", color=BLACK, ms=7, mew=1.5, label="p99")
    if floors:
        first.plot([], [], "D", color=RED, mec="white", ms=6, ls="none", label="floor of a Pi 5")
    _legend_below(fig, first, 3)
    return fig


HOST_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, BLACK)


def soak(benchmarks: Mapping[str, Mapping[str, Any]]) -> Figure:
    """What a soak did to a host, over time: latency, temperature, clock, and when the firmware held it back.

    benchmarks: contents of benchmark-<host>.json with a series, by host. What no host can tell has no panel.
    """
    hosts = dict(zip(benchmarks, itertools.cycle(HOST_COLOURS), strict=False))
    series = {host: b["metrics"]["series"] for host, b in benchmarks.items()}

    def told(key: str) -> bool:
        return any(p.get(key) is not None for points in series.values() for p in points)

    held = told("throttled")
    readings = [r for r in (("temperature_c", "temperature\n(°C)"), ("clock_mhz", "clock of the\nslowest core (MHz)"))
                if told(r[0])]  # fmt: skip
    heights = [2.0] + [1.4] * len(readings) + [0.25 + 0.22 * len(hosts)] * held
    fig, axes = _axes(len(heights), height_in=1.2 + sum(heights), height_ratios=heights, sharex=True)
    first, last = axes[0, 0], axes[-1, 0]
    for row, (host, colour) in enumerate(hosts.items()):
        points, main = series[host], benchmarks[host]["metrics"]["main"]
        minutes = np.array([p["t_s"] for p in points]) / 60

        def values(key: str, part: Callable[[Any], Mapping[str, Any]], points: Any = points) -> np.ndarray:
            return np.array([np.nan if (v := part(p).get(key)) is None else v for p in points], float)

        for key, style, width in (("latency_p50_ms", "-", 1.8), ("latency_p95_ms", ":", 1.2)):
            label = f"{host}, {NAMES.get(main, main)}" if style == "-" else None
            times_ms = values(key, lambda p, main=main: p["artifacts"].get(main, {}))
            first.plot(minutes, times_ms, style, color=colour, lw=width, label=label)
        for ax, (key, _) in zip(axes[1:, 0], readings, strict=False):
            ax.plot(minutes, values(key, lambda p: p), color=colour, lw=1.8)
        if held:
            since = np.r_[0.0, minutes[:-1]]  # a point tells of the time since the one before
            bits = [int(p.get("throttled") or "0x0", 16) & NOW_BITS for p in points]
            spans = [(s, m - s) for s, m, b in zip(since, minutes, bits, strict=True) if b]
            last.broken_barh(spans, (row - 0.35, 0.7), color=colour)
    first.plot([], [], ":", color=BLACK, lw=1.2, label="p95 (line: p50)")
    first.set(ylabel="latency of one\ninference (ms)", ylim=(0, None), xlim=(0, None))
    for ax, (_, label) in zip(axes[1:, 0], readings, strict=False):
        ax.set_ylabel(label)
    if held:
        last.set_yticks(range(len(hosts)), list(hosts))
        last.set_ylim(len(hosts) - 0.5, -0.5)
        last.set_title("held back by the firmware: under-voltage, capped clock, throttled or too warm", fontsize=9)
    last.set_xlabel("time (min)")
    _legend_below(fig, first, 3)
    return fig


# --- 06: the ruler --------------------------------------------------------------------------------

NEAR = 2  # times the fewest instructions: shown once more, closer
GROUP_COLOURS = (BLUE, SKY, BLACK, RED, PURPLE, ORANGE, "#F0E442", GREEN, "#8C6D31", GREY)


def whole_size(metrics: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Artifacts of the image size of training, by mode, and peers that are none of them, most instructions first.

    metrics: of arm.json.
    """
    ours = {stem.removeprefix("policy_"): m for stem, m in metrics["artifacts"].items()}
    ours = {mode: m for mode, m in ours.items() if not re.search(r"_\d+x\d+$", mode)}
    counted = ours | {name: m for name, m in metrics.get("peers", {}).items() if "artifact" not in m}
    return dict(sorted(counted.items(), key=lambda item: -item[1]["instructions_g"]))


def counted(metrics: Mapping[str, Any]) -> Figure:
    """Instructions against the floor, and beside them the error on the same core. metrics: of arm.json."""
    rows = whole_size(metrics)
    fig, axes = _axes(1, 2, height_in=1.4 + 0.4 * len(rows), sharey=True, width_ratios=(1.5, 1))
    (left, right), y = axes[0], np.arange(len(rows))
    total, simd = (np.array([m[key] for m in rows.values()]) for key in ("instructions_g", "simd_g"))
    _simd_bars(left, y, total, simd)
    floor_g = next(m["floor_g"] for m in rows.values())
    left.axvline(floor_g, color=RED, ls="--", lw=1.2, label=f"floor: dot products alone, {floor_g:.2g}")
    left.set_yticks(y, [NAMES.get(n, n) for n in rows])
    left.invert_yaxis()
    left.set_xlabel("instructions of one inference (10^9)")
    left.set_title("counted on an emulated Cortex-A76", fontsize=11)
    first = next(iter(metrics["artifacts"].values()))
    keys = _judged(right, {k: v for k, v in first.items() if "workstation" not in k})
    height = 0.8 / max(len(keys), 1)
    judged = [
        m if keys and m.get(keys[0]) is not None and m.get("reference") != f"policy_{n}" else None
        for n, m in rows.items()
    ]
    frames = sorted({m["frames_on_the_core"] for m in judged if m})
    over = " to ".join(str(n) for n in frames[:: len(frames) - 1 or 1])
    for i, key in enumerate(keys):
        known = [(at, m[key]) for at, m in enumerate(judged) if m is not None]
        at, values = [at + (i - (len(keys) - 1) / 2) * height for at, _ in known], [value for _, value in known]
        right.barh(at, values, height, color=_action_colour(key, i), label=key.removesuffix("_mae_pct"))
        _values(right, at, values, "{:.2f}")
    right.set_xlabel("mean error against FP32\n(% of the recorded range)")
    right.set_title(f"computed on it, {over} frames", fontsize=11)
    _legend(left, loc="lower right")
    _legend(right, loc="upper right")
    return fig


def counted_by_kernel(groups: Mapping[str, Mapping[str, float]]) -> Figure:
    """What the instructions do. groups: {artifact or peer: {group: 10**9 instructions}}, groups in one order."""
    totals = {name: sum(found.values()) for name, found in groups.items()}
    near = {name: found for name, found in groups.items() if totals[name] < NEAR * min(totals.values())}
    panels = [groups, near] if 1 < len(near) < len(groups) else [groups]
    rows = [len(shown) for shown in panels]
    fig, axes = _axes(len(panels), height_in=1.3 + 0.5 * len(panels) + 0.36 * sum(rows), height_ratios=rows)
    for ax, shown in zip(axes[:, 0], panels, strict=True):
        y, left = np.arange(len(shown)), np.zeros(len(shown))
        for colour, group in zip(GROUP_COLOURS, next(iter(shown.values())), strict=True):
            width = np.array([found[group] for found in shown.values()])
            ax.barh(y, width, left=left, color=colour, label=group)
            left += width
        _values(ax, y, left, "{:.3g}")
        ax.set_yticks(y, [NAMES.get(n, n) for n in shown])
        ax.invert_yaxis()
    axes[0, 0].set_title("counted on an emulated Cortex-A76", fontsize=11)
    if len(panels) > 1:
        axes[1, 0].set_title("those of the fewest instructions, closer", fontsize=11)
    axes[-1, 0].set_xlabel("instructions of one inference (10^9)")
    _legend_below(fig, axes[0, 0], 4)
    return fig


def counted_by_size(metrics: Mapping[str, Any]) -> Figure:
    """What a smaller image saves: static INT8 and its floor by image size. metrics: of arm.json."""
    rows = [m for stem, m in metrics["artifacts"].items() if re.fullmatch(r"policy_static(_\d+x\d+)?", stem)]
    rows.sort(key=lambda m: m["gmac"])
    fig, axes = _axes(1, height_in=3.4)
    ax, x = axes[0, 0], np.array([m["image_height"] * m["image_width"] for m in rows]) / 1e3
    lines = (("instructions_g", BLUE, "o-", "all instructions"), ("simd_g", SKY, "s-", "SIMD instructions"))
    for key, colour, style, label in (*lines, ("floor_g", RED, "--", "floor: dot products alone")):
        ax.plot(x, [m[key] for m in rows], style, color=colour, lw=1.8, label=label)
    for at, m in zip(x, rows, strict=True):
        ax.annotate(f"{m['instructions_g']:.3g}", (at, m["instructions_g"]), (0, 7), textcoords="offset points",
                    ha="center", fontsize=9)  # fmt: skip
    ax.set_xticks(x, [f"{m['image_width']}x{m['image_height']}" for m in rows])
    ax.set(ylim=(0, 1.12 * max(m["instructions_g"] for m in rows)), ylabel="instructions of one inference (10^9)")
    ax.set_xlabel("image, width x height in pixels; the axis is in proportion to their number")
    ax.set_title("static INT8, counted on an emulated Cortex-A76", fontsize=11)
    ax.set_xlim(0, None)
    _legend(ax, loc="lower right")
    return fig


def computed_times(metrics: Mapping[str, Any]) -> Figure:
    """The computed range of a Raspberry Pi 5's time, in a table of its own. metrics: of arm.json."""
    rows = sorted(metrics["artifacts"].items(), key=lambda item: -item[1]["instructions_g"])
    cells = []
    for stem, m in rows:
        mode, time_ms = re.sub(r"^policy_|_\d+x\d+$", "", stem), m["computed_pi5_ms"]
        size = f"{m['image_width']}x{m['image_height']}"
        cells.append([NAMES.get(mode, mode), size, f"{time_ms['low']:.3g} to {time_ms['high']:.3g}"])
    fig, axes = _axes(1, height_in=0.4 + 0.27 * (len(rows) + 1))
    axes[0, 0].axis("off")
    heads = ["artifact", "image", "computed time on a Pi 5 (ms), not measured"]
    table = axes[0, 0].table(
        cells, colLabels=heads, colWidths=(0.35, 0.2, 0.45), cellLoc="left", colLoc="left", bbox=(0, 0, 1, 1)
    )
    _plain_table(table)
    return fig


# --- 07: late plans -------------------------------------------------------------------------------

HOW = {True: ("compensated", BLUE, "o", -1), False: ("not compensated", ORANGE, "s", 1)}  # label, colour, marker, side


def _late(rows: Sequence[Mapping[str, Any]], *, pushed: bool = False) -> list[Mapping[str, Any]]:
    """Those without ensembling. rows: of drive.json."""
    return [r for r in rows if r["ensemble"] is None and bool(r["pushes"]) == pushed]


def throttle_over_age(rows: Sequence[Mapping[str, Any]], settings: Settings, chunk: int, rate_hz: float) -> Figure:
    """What the loop leaves of the throttle at each age of a plan, and the ages that each latency brings.

    rows: of drive.json. chunk, rate_hz: of the policy's plans.
    """
    follower = Follower(settings, rate_hz)
    follower.add(Plan(1, 0.0, 0.0, np.zeros((chunk, 2))), 0.0)
    ages_s = np.arange(0, follower.stop_s() + 0.2, 0.001)
    commands = [follower.command(age) for age in ages_s]
    ages = {r["latency_ms"]: (r["plan_age_min_ms"], r["plan_age_max_ms"]) for r in _late(rows) if r["compensate"]}
    ages = {ms: ends for ms, ends in ages.items() if ends[0] is not None}
    fig, axes = _axes(2, height_in=2.6 + 0.26 * len(ages), sharex=True, height_ratios=(1.6, 0.3 + 0.22 * len(ages)))
    upper, lower = axes[:, 0]
    upper.plot(1e3 * ages_s, [100 * c.fade if c else 0 for c in commands], color=BLUE, lw=2)
    upper.set_ylabel("throttle left (%)")
    stop_ms = 1e3 * follower.stop_s()
    for ax in axes[:, 0]:
        ax.axvline(stop_ms, color=RED, ls="--", lw=1.2)
    upper.annotate("stopped", (stop_ms, 60), (6, 0), textcoords="offset points", color=RED, fontsize=9)
    for y, (low, high) in enumerate(ages.values()):
        lower.plot([low, high], [y, y], "o-", color=BLACK, lw=4, ms=5)
    lower.set_yticks(range(len(ages)), [f"{ms:g} ms" for ms in ages])
    lower.set_ylim(len(ages) - 0.5, -0.5)
    lower.set(xlabel="age of the plan in use, since its frame (ms)", ylabel="an inference takes", xlim=(-15, None))
    return fig


def hits_by_latency(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Balloons hit, with Wilson's 95 % interval, against how long an inference takes. rows: of drive.json."""
    sets = [(title, _late(rows, pushed=pushed)) for title, pushed in (("left alone", False), ("pushed", True))]
    sets = [(title, found) for title, found in sets if found]
    counts = [len({r["latency_ms"] for r in found}) for _, found in sets]
    fig, axes = _axes(1, len(sets), height_in=3.8, sharey=True, width_ratios=[c + 1 for c in counts])
    for ax, (title, found) in zip(axes[0], sets, strict=True):
        places = {ms: x for x, ms in enumerate(sorted({r["latency_ms"] for r in found}))}
        for compensate, (label, colour, marker, side) in HOW.items():
            shown = [r for r in found if r["compensate"] == compensate]
            x = [places[r["latency_ms"]] + 0.1 * side for r in shown]
            share = np.array([100 * r["hits"] / r["trials"] for r in shown])
            ends = 100 * np.array([[r["hits_wilson_low"], r["hits_wilson_high"]] for r in shown]).reshape(-1, 2).T
            bars = np.clip(np.abs(ends - share), 0, None)
            ax.errorbar(x, share, bars, fmt=marker, ms=6, color=colour, elinewidth=2, capsize=3, label=label)
            for at, y, r in zip(x, share, shown, strict=True):
                ax.annotate(f"{r['hits']}", (at, y), (9 * side, 0), textcoords="offset points", color=colour,
                            ha="left" if side > 0 else "right", va="center", fontsize=8)  # fmt: skip
        for ms, x in places.items():
            if stopped := max(r["stopped"] for r in found if r["latency_ms"] == ms):
                ax.annotate(f"{stopped} stopped:\nplan too old", (x, 30), ha="center", fontsize=9, color=RED)
        pushes = max(r["pushes"] for r in found)
        ax.set_title(f"{title} {pushes} times on its way" if pushes else title, fontsize=11)
        ax.set_xticks(list(places.values()), [f"{ms:g}" for ms in places])
        ax.set(xlabel="an inference takes (ms)", xlim=(-0.6, len(places) - 0.4), ylim=(-4, 104))
    axes[0, 0].set_ylabel(f"worlds in which the balloon was hit\n(% of {rows[0]['trials']}), with the 95 % interval")
    _legend_below(fig, axes[0, 0], 2)
    return fig


def beside_the_path(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """How far a late drive leaves the path of the first latency's, at most: median of the worlds, and 90 % of them.

    rows: of drive.json; latencies at which cars were stopped are left out.
    """
    found = [r for r in _late(rows) if not r["stopped"]]
    places = {ms: x for x, ms in enumerate(sorted({r["latency_ms"] for r in found}))}
    fig, axes = _axes(1, height_in=3.0)
    ax = axes[0, 0]
    for compensate, (label, colour, _, side) in HOW.items():
        shown = [r for r in found if r["compensate"] == compensate]
        x = [places[r["latency_ms"]] + 0.19 * side for r in shown]
        middle, most = (np.array([r[f"aside_p{q}_cm"] for r in shown]) for q in (50, 90))
        ax.bar(x, middle, 0.36, color=colour, alpha=0.85, label=label)
        ax.vlines(x, middle, most, color=BLACK, lw=1)
        ax.plot(x, most, "_", color=BLACK, ms=10, mew=1.5)
        for at, y, value in zip(x, most, middle, strict=True):
            ax.annotate(f"{value:.1f}", (at, y), (0, 3), textcoords="offset points", ha="center", fontsize=9)
    ax.set_xticks(list(places.values()), [f"{ms:g}" for ms in places])
    ax.set(xlabel="an inference takes (ms)", ylabel=f"beside the path of\n{min(places, default=0):g} ms, at most (cm)")
    ax.set_title("bar and number: median of the worlds; line: 90 % of them", fontsize=11)
    _legend(ax, loc="upper left")
    return fig


def plans_from_above(drives: Sequence[Mapping[str, Any]]) -> Figure:
    """Drives of one world with all their plans, each from where it looked. drives: `from_above` of drive.json."""
    fig, axes = _axes(max(len(drives), 1), height_in=0.5 + 3.1 * max(len(drives), 1))
    for ax, drive in zip(axes[:, 0], drives, strict=False):
        label, colour, _, _ = HOW[drive["compensate"]]
        ax.plot(drive["x_m"], drive["y_m"], color=colour, lw=7, alpha=0.35, label="driven")
        for i, plan in enumerate(drive["plans"]):
            ax.plot(plan["x_m"], plan["y_m"], color=BLACK, lw=0.9, label=None if i else "a plan, from where it looked")
            ax.plot(plan["x_m"][0], plan["y_m"][0], "o", color=colour, mec=BLACK, mew=0.7, ms=5)
        ax.add_patch(Circle(drive["balloon_xy_m"], 0.16, color=RED))
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_ylabel("to the left (m)")
        ax.set_title(f"{drive['latency_ms']:g} ms, {label}: {drive['outcome']}", fontsize=11)
    axes[-1, 0].set_xlabel("ahead of the start (m)")
    _legend(axes[0, 0], loc="best")
    return fig
