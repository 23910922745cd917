"""Look at frames one after the other in JupyterLab: the picture, what the driver did, and what policies plan there.

    explore(samples, {"fp32": fp32, "static": static}, ranges)

Needs ipywidgets. Where no JupyterLab runs the cell, one frame is drawn as a figure instead.
"""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.plots import style
from rover_lib.workshop.progress import in_jupyterlab

PLAY_MS = 200  # between two frames; a plan of the full policy takes no longer here


class FrameView:
    """One figure for all frames; each frame only changes what it shows, as drawing it anew takes three times as long.

    samples: with frame_bgr(), state, chunk (C, A) and is_pad (C,). policies: by mode, none for the driver alone.
    ranges: name -> (least, most) of each action.
    """

    def __init__(
        self,
        samples: Sequence[Any],
        policies: Mapping[str, Any],
        ranges: Mapping[str, tuple[float, float]],
        rate_hz: float = 30.0,
    ):
        self.samples = samples
        self.policies = policies
        self.actions = list(ranges)[: style.MOST_ACTIONS]
        self.figure, axes = style.new_figure(1, 1 + len(self.actions), height_in=2.7)
        self._picture, *self._fields = axes[0]
        times_s = np.arange(len(samples[0].chunk)) / rate_hz
        self._lines: list[dict[str, Any]] = []
        for ax, action in zip(self._fields, self.actions, strict=True):
            lines = {"driver": ax.plot(times_s, times_s, color=style.GREY, lw=4, label="driver")[0]}
            for mode in policies:
                dashes = "-" if mode == "fp32" else "--"
                lines[mode] = ax.plot(times_s, times_s, ls=dashes, **style.line_of(mode))[0]
            low, high = ranges[action]
            margin = 0.05 * (high - low + 1e-6)
            ax.set(ylim=(low - margin, high + margin), xlabel="s ahead", title=action)
            self._lines.append(lines)
        style.legend_below(self.figure, self._fields[0], 1 + len(policies))
        self.show(0)
        self.figure.draw_without_rendering()
        self.figure.set_layout_engine("none")  # else each frame would lay everything out again, a little elsewhere

    def show(self, index: int) -> Figure:
        """Let the figure show this frame, and return it. Raises EpisodeError if the picture is gone."""
        sample = self.samples[index]
        planned = {"driver": np.where(sample.is_pad[:, None], np.nan, sample.chunk)}
        scores = []
        for mode, policy in self.policies.items():
            planned[mode] = policy.predict_chunk(sample.frame_bgr(), sample.state)
            if policy.strange is not None:
                scores.append(f"{mode} {policy.strange:.2f}")
        for i, lines in enumerate(self._lines):
            for who, line in lines.items():
                line.set_ydata(planned[who][:, i])
        self._picture.clear()
        title = f"{sample.episode}, {sample.time_s:.1f} s"
        if scores:
            title += f"\nunfamiliar (1: stop): {', '.join(scores)}"
        style.show_picture(self._picture, sample, title)
        return self.figure

    def png(self, index: int) -> bytes:
        """A frame's figure as a PNG of 900 pixels' width."""
        buffer = io.BytesIO()
        self.show(index).savefig(buffer, format="png", dpi=style.DPI)
        return buffer.getvalue()


def explore(
    samples: Sequence[Any],
    policies: Mapping[str, Any],
    ranges: Mapping[str, tuple[float, float]],
    rate_hz: float = 30.0,
) -> Any:
    """Return a slider over frames with a button that plays them; outside JupyterLab the figure of a frame.

    The arrow keys move the slider once it was clicked. Arguments: as of FrameView.
    """
    view = FrameView(samples, policies, ranges, rate_hz)
    if not in_jupyterlab():
        return view.show(len(samples) // 2)
    from ipywidgets import HBox, Image, IntSlider, Layout, Play, VBox, jslink

    last = len(samples) - 1
    play = Play(max=last, interval=PLAY_MS)
    slider = IntSlider(max=last, description="frame", layout=Layout(width="700px"))
    image = Image(value=view.png(0), format="png", width=900)
    jslink((play, "value"), (slider, "value"))

    def turn(change: Mapping[str, Any]) -> None:
        image.value = view.png(change["new"])

    slider.observe(turn, names="value")
    return VBox([HBox([play, slider]), image])
