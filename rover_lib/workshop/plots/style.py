"""What all figures share: axes, legends, colours, names of artifacts.

A colour has the same meaning in every figure: a mode, an action, or an alarm. Everything else is
slate or grey, and differs by marker or line; categories that only one figure has take their colours from OTHERS. The
colours are Okabe and Ito's and Paul Tol's, which colour-blind people can tell apart.

Figures are drawn for a notebook's width at 100 dots per inch, and shown and saved with twice as many pixels each way.
rover.mplstyle has their sizes and lines.
"""

import io
from base64 import b64encode
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.recordings.samples import by_camera

WIDTH_IN, DPI, SHARPER = 9.0, 100, 2
STYLE = Path(__file__).with_name("rover.mplstyle")
BLACK = "#333333"
RED = "#D55E00"  # a limit, a floor, a fault, a stopped car; and the balloon
SLATE = "#4A5A6A"  # a figure that belongs to no mode, action or part
MIST = "#AAB7C4"  # what is compared with a slate figure: before, without, the rest
GREY = "#B0B0B0"
BALLOON = RED
OTHERS = (SLATE, "#8C6D31", "#AA4499", "#117733", "#6699CC", "#994455", "#997700")  # hosts, students, more actions
COLOURS = {
    "fp32": BLACK,
    "dynamic": "#E69F00",
    "static": "#0072B2",
    "mixed": "#009E73",
    "steering": "#332288",
    "throttle": "#CC79A7",
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
    plt.style.use(STYLE)
    size: dict[str, Any] = {"figsize": (WIDTH_IN, height_in), "dpi": DPI, "layout": "constrained", "FigureClass": Drawn}
    fig, axes = plt.subplots(rows, columns, squeeze=False, **size, **options)
    plt.close(fig)
    return fig, axes


def figure_of(count: int, columns: int, row_in: float) -> tuple[Figure, list[Any]]:
    """Make a figure with axes for each of `count` things, in rows of `columns`."""
    columns = min(columns, count)
    rows = -(-count // columns)
    fig, axes = new_figure(rows, columns, height_in=row_in * rows)
    for ax in axes.flat[count:]:
        ax.set_axis_off()
    return fig, list(axes.flat[:count])


def show_picture(ax: Axes, sample: Any, title: str = "") -> None:
    """Draw what a sample saw, the pictures of several cameras side by side, without axes."""
    frames = by_camera(sample.frame_bgr(), "").values()
    height = max(len(frame) for frame in frames)
    same = [cv2.resize(frame, (round(frame.shape[1] * height / len(frame)), height)) for frame in frames]
    ax.imshow(np.concatenate(same, axis=1)[..., ::-1])
    ax.set_title(title, fontsize=9)
    ax.axis("off")


def line_of(mode: str) -> dict[str, Any]:
    """Return the colour and the label of a mode's line."""
    return {"color": COLOURS.get(mode, GREY), "label": "FP32" if mode == "fp32" else mode, "lw": 1.8}


def legend_below(fig: Figure, ax: Axes, columns: int) -> None:
    """Put one legend, with what `ax` has, below all of a figure's axes."""
    handles, labels = ax.get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=columns)


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
