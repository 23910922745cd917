"""The figure of benchmarks of minutes: what heat did to the clock of each host, and the clock to its plans."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rover_lib.onboard.car.host import throttled_means
from rover_lib.onboard.care.benchmark import clock_fall, describe_clock
from rover_lib.workshop.plots.style import RED, SLATE, Note, line_of, new_figure

NONE_YET = "nobody has timed for minutes: `rover benchmark --minutes 10`, or `rover playbook benchmark -e minutes=10`"


def minutes(by_host: Mapping[str, Mapping[str, Any]], modes: Mapping[str, str]) -> Figure | Note:
    """Draw p50 and p95, clock and temperature over time, a row for each host; red: since its clock fell, or throttled.

    by_host, modes: of `hosts.read_benchmarks`.
    """
    long = {host: b for host, b in by_host.items() if b["metrics"].get("over_time")}
    if not long:
        return Note(NONE_YET)
    fig, axes = new_figure(len(long), 3, height_in=0.4 + 2.6 * len(long), width_ratios=(2, 1, 1))
    for (host, b), row in zip(long.items(), axes, strict=True):
        over_time = b["metrics"]["over_time"]
        times_min = [span["from_s"] / 60 for span in over_time]
        for name in over_time[0]["artifacts"]:
            line = line_of(modes.get(b["inputs"].get(f"{name}.pt", ""), name))
            for key, style in (("p50_ms", "-"), ("p95_ms", ":")):
                values = [span["artifacts"][name][key] for span in over_time]
                row[0].plot(times_min, values, **line | {"ls": style, "label": f"{line['label']}, {key[:3]}"})
        row[0].legend(frameon=False, fontsize=8)
        row[0].set_title(f"{host}: {describe_clock(over_time)}", loc="left", fontsize=10)
        for ax, key in ((row[1], "clock_mhz"), (row[2], "temperature_c")):
            values = [span[key] for span in over_time]
            if all(value is None for value in values):
                ax.text(0.5, 0.5, "not reported", ha="center", va="center", transform=ax.transAxes, fontsize=9)
            ax.plot(times_min, np.array(values, float), color=SLATE, lw=1.5)  # None becomes NaN
        fall = clock_fall(over_time)
        for ax, label in zip(row, ("ms", "clock (MHz)", "temperature (C)"), strict=True):
            ax.set(xlabel="minutes", ylabel=label)
            if fall is not None:
                ax.axvline(fall["from_s"] / 60, color=RED, lw=1.2)
        for span in over_time:
            if throttled_means(span["throttled"], since_the_start=False):
                row[1].axvspan(span["from_s"] / 60, span["from_s"] / 60 + 1 / 6, color=RED, alpha=0.15, lw=0)
        row[0].set_ylim(bottom=0)
    return fig
