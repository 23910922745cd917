"""What all figures share: axes, legends, colours, names of artifacts.

A colour has the same meaning in every figure: a mode, an action, a part of the policy, or an alarm. Everything else is
slate or grey, and differs by marker or line; categories that only one figure has take their colours from OTHERS. The
colours are Okabe and Ito's and Paul Tol's, which colour-blind people can tell apart.

Figures are drawn for a notebook's width at 100 dots per inch, and shown and saved with twice as many pixels each way.
"""

import io
from base64 import b64encode
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.judge.recorded_range import worst

WIDTH_IN, DPI, SHARPER = 9.0, 100, 2
BLACK = "#333333"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
RED = "#D55E00"  # a limit, a floor, a fault, a stopped car; and the balloon
SLATE = "#4A5A6A"  # a figure that belongs to no mode, action or part
MIST = "#AAB7C4"  # what is compared with a slate figure: before, without, the rest
GREY = "#B0B0B0"
OTHERS = (SLATE, "#8C6D31", "#AA4499", "#117733", "#6699CC", "#994455", "#997700")  # hosts, students, more actions
COLOURS = {
    "fp32": BLACK,
    "dynamic": ORANGE,
    "static": BLUE,
    "mixed": GREEN,
    "static_affine": SKY,
    "lerobot": "#777777",
    "steering": "#332288",
    "throttle": "#CC79A7",
}
PARTS = {"backbone": "#999933", "encoder": "#DDCC77", "decoder": "#882255"}  # of the policy; all others are grey
NAMES = {
    "fp32": "FP32",
    "static_affine": "static, affine",
    "lerobot": "LeRobot, eager FP32",
    "torch_affine": "torch, affine",
    "onnxruntime": "ONNX Runtime INT8",
    "fp32.onnx": "FP32, for ONNX Runtime",
    "static.onnx": "static INT8, for ONNX Runtime",
    "executorch": "ExecuTorch INT8",
}
MOST_ACTIONS = 3  # a figure shows at most this many beside each other


class Drawn(Figure):
    """A figure that a notebook shows at its own size, but with four pixels in the place of one, so that it is sharp."""

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=SHARPER * DPI)
        width, height = (round(DPI * inches) for inches in self.get_size_inches())
        shown = {"image/png": {"width": width, "height": height}}
        return {"image/png": b64encode(buffer.getvalue()).decode()}, shown


@dataclass(frozen=True)
class Note:
    """A sentence in the place of a figure that would show nothing."""

    text: str

    def __repr__(self) -> str:
        return self.text


def new_figure(rows: int, columns: int = 1, height_in: float = 3.2, **options: Any) -> tuple[Figure, np.ndarray]:
    """Make a figure and its (rows, columns) axes. pyplot is told to forget it, so only the caller shows it."""
    size: dict[str, Any] = {"figsize": (WIDTH_IN, height_in), "dpi": DPI, "layout": "constrained", "FigureClass": Drawn}
    fig, axes = plt.subplots(rows, columns, squeeze=False, **size, **options)
    plt.close(fig)
    for ax in axes.flat:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=9)
        ax.title.set_fontsize(11)
    return fig, axes


def bars_figure(rows: int, height_in: float) -> tuple[Figure, Axes]:
    """Make a figure of one row of axes, with room for this number of horizontal bars. height_in: of the rest."""
    fig, axes = new_figure(1, height_in=height_in + 0.36 * rows)
    return fig, axes[0, 0]


def figure_of(count: int, columns: int, row_in: float) -> tuple[Figure, list[Any]]:
    """Make a figure with axes for each of `count` things, in rows of `columns`."""
    columns = min(columns, count)
    rows = -(-count // columns)
    fig, axes = new_figure(rows, columns, height_in=row_in * rows)
    for ax in axes.flat[count:]:
        ax.set_axis_off()
    return fig, list(axes.flat[:count])


def picture_of(sample: Any) -> np.ndarray:
    """Return what a sample saw, (h, w, 3) uint8 RGB, the pictures of several cameras side by side."""
    seen = sample.frame_bgr()
    frames = list(seen.values()) if isinstance(seen, Mapping) else [seen]
    height = max(len(frame) for frame in frames)
    same = [cv2.resize(f, (round(f.shape[1] * height / len(f)), height)) if len(f) != height else f for f in frames]
    return np.concatenate(same, axis=1)[..., ::-1]


def show_picture(ax: Axes, sample: Any, title: str = "") -> None:
    """Draw what a sample saw, without axes."""
    ax.imshow(picture_of(sample))
    ax.set_title(title, fontsize=9)
    ax.axis("off")


def line_of(mode: str) -> dict[str, Any]:
    """Return the colour and the label of a mode's line."""
    return {"color": COLOURS.get(mode, GREY), "label": NAMES.get(mode, mode), "lw": 1.8}


def name_rows(ax: Axes, names: Iterable[str]) -> None:
    """Name the rows of horizontal bars, the first one on top. Modes get their names of NAMES."""
    shown = [NAMES.get(name, name) for name in names]
    ax.set_yticks(range(len(shown)), shown)
    ax.invert_yaxis()


def legend(ax: Axes, **options: Any) -> None:
    ax.legend(frameon=False, fontsize=9, **options)


def legend_below(fig: Figure, ax: Axes, columns: int) -> None:
    """Put one legend, with what `ax` has, below all of a figure's axes."""
    handles, labels = ax.get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def bar_values(ax: Axes, y: Iterable[float], x: Iterable[Any], form: str) -> None:
    """Write the numbers at the ends of horizontal bars, with room for them."""
    for at, value in zip(y, x, strict=True):
        ax.annotate(form.format(value), (value, at), (4, 0), textcoords="offset points", va="center", fontsize=9)
    ax.margins(x=0.16)


def annotate_row(ax: Axes, y: float, text: str) -> None:
    """Write a text to the right of the axes, at the height of a row."""
    ax.annotate(text, (1.01, y), xycoords=("axes fraction", "data"), va="center", fontsize=9)


def note(ax: Axes, text: str) -> None:
    """Write a sentence into axes in which there is nothing to draw."""
    ax.text(0.5, 0.5, text, ha="center", va="center", transform=ax.transAxes, fontsize=11)
    ax.set_axis_off()


def judged_keys(ax: Axes, errors: Mapping[str, float | None]) -> list[str]:
    """Return the keys <action>_mae_pct of the judged actions. The others are named in the legend of `ax`."""
    keys = [k for k in errors if k.endswith("_mae_pct")]
    for key in keys:
        if errors[key] is None:
            ax.plot([], [], " ", label=f"{key.removesuffix('_mae_pct')}: not judged")
    return [k for k in keys if errors[k] is not None]


def few_actions(table: Mapping[str, Mapping[str, float | None]]) -> tuple[dict[str, dict[str, float | None]], str]:
    """Return a table of <action>_mae_pct, of many actions only the worst of each row, and what it has, in words."""
    keys = [k for k in next(iter(table.values())) if k.endswith("_mae_pct")]
    if len(keys) <= MOST_ACTIONS:
        return {name: {k: row[k] for k in keys} for name, row in table.items()}, "mean error"
    worst_of = {name: {"worst action_mae_pct": worst(row[k] for k in keys)} for name, row in table.items()}
    return worst_of, f"mean error of the worst of {len(keys)} actions"


def draw_errors(ax: Axes, table: Mapping[str, Mapping[str, Any]], keys: list[str], *, values: bool = False) -> None:
    """Draw a bar for each action of each row of a table. keys: of the actions. values: write the numbers too."""
    height = 0.8 / max(len(keys), 1)
    for i, key in enumerate(keys):
        y, x = np.arange(len(table)) + (i - (len(keys) - 1) / 2) * height, [row[key] for row in table.values()]
        ax.barh(y, x, height, color=action_colour(key, i), label=key.removesuffix("_mae_pct"))
        if values:
            bar_values(ax, y, x, "{:.2f}")
    name_rows(ax, table)


def save(shown: Figure | Note, run_dir: Path | str, name: str) -> Figure | Note:
    """Write run_dir/figures/<name>.png, or remove an earlier one if nothing is drawn. Returns what a cell shows."""
    path = Path(run_dir) / "figures" / f"{name}.png"
    if isinstance(shown, Note):
        path.unlink(missing_ok=True)
        return shown
    path.parent.mkdir(parents=True, exist_ok=True)
    shown.savefig(path, dpi=SHARPER * DPI)
    return shown


def action_colour(key: str, index: int) -> str:
    """Return the colour of an action, or of a key such as steering_mae_pct. index: chooses one for other actions."""
    return COLOURS.get(key.split("_")[0], OTHERS[index % len(OTHERS)])


def label_parts(ax: Axes, colours: Mapping[str, str]) -> None:
    """Give the legend of a bar chart an entry for each of these."""
    for name, colour in colours.items():
        ax.barh(0, 0, color=colour, label=name)


def part_colours(blocks: Iterable[str]) -> list[str]:
    """Return the colours of blocks such as "encoder.0.attention"."""
    return [PARTS.get(block.split(".")[0], GREY) for block in blocks]
