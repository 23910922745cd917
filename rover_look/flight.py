"""Draw a flight log: what was commanded, what the pins did, how old the plans were, how late the loop was.

flight_figure(read_log("flight.log")).savefig("flight.log.png")
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from rover_lib.onboard.car.host import THROTTLED_BITS
from rover_lib.onboard.car.pwm import Channel
from rover_lib.onboard.car.servo_link import State
from rover_lib.onboard.drive.flight_log import Event, Flight
from rover_lib.workshop.plots.style import BLACK, COLOURS, GREY, MIST, NOW_BITS, RED, SLATE, new_figure

STATES = {
    State.MANUAL.value: ("human", GREY),
    State.AUTONOMOUS.value: ("host", SLATE),
    State.STOPPED.value: ("nobody, stopped", RED),
    "": ("not known", "#F2F2F2"),
}
EVENTS_LISTED = 14
LABEL_SHARE = 0.05  # events that are closer than this share of the width have one label together
TEXT_LENGTH = 105
DIGIT_SPACE = "\u2007"  # as wide as a digit


def flight_figure(flight: Flight) -> Figure:
    """Draw one drive, with all panels over the same seconds."""
    ticks, summary = flight.ticks, flight.summary()
    listed = list(enumerate(flight.events, 1))[-EVENTS_LISTED:]  # the last ones say why it ended
    rows = ("who", "steering", "throttle", "plan", "late", "temperature")
    heights = [0.35, 1.6, 1.6, 1.6, 1.3, 0.9]
    fig, axes = new_figure(
        len(rows), height_in=sum(heights) + 3.4 + 0.19 * len(listed), height_ratios=heights, sharex=True
    )
    panel = dict(zip(rows, axes[:, 0], strict=True))
    t_s, calibration = ticks["t_s"], flight.car.pwm
    times_s = [t_s, flight.machine["t_s"], np.array([e.t_s for e in flight.events])]
    end_s = max((float(t.max()) for t in times_s if len(t)), default=1.0) or 1.0
    start_s = float(t_s[0]) if len(t_s) else 0.0  # events before the first tick are listed, not drawn
    start_s = max(0.0, start_s - 0.02 * (end_s - start_s))

    _who(panel["who"], ticks, (flight.period_ms or 0) / 1000)
    _pulses(panel["steering"], calibration.steering, ticks, COLOURS["steering"])
    _pulses(panel["throttle"], calibration.throttle, ticks, COLOURS["throttle"])
    if (ticks["fade"] < 1).any():
        ax = panel["throttle"]
        # The area hangs from the top: its share of the height is the share of the throttle that is taken away.
        options = {"step": "post", "transform": ax.get_xaxis_transform(), "color": RED, "alpha": 0.18, "lw": 0}
        ax.fill_between(t_s, ticks["fade"], 1, label="faded for the plan's age", **options)
    _plan(panel["plan"], ticks, flight.header.get("drive", {}))
    _late(panel["late"], ticks, summary)
    _temperature(panel["temperature"], flight.machine, summary)
    for ax in axes[:, 0]:
        for event in flight.events:
            ax.axvline(event.t_s, color=BLACK, lw=0.8, ls=":", zorder=0.5)
        if ax is not panel["who"]:
            ax.grid(axis="y", color="#EEEEEE", lw=0.8)
            ax.set_axisbelow(True)
            _legend_above(ax)
    _event_numbers(panel["who"], [(n, e) for n, e in listed if e.t_s >= start_s], end_s - start_s)
    axes[-1, 0].set_xlim(start_s, end_s)
    axes[-1, 0].set_xlabel("time since the start (s)", fontsize=10)
    fig.align_ylabels(axes[:, 0])
    fig.suptitle(_title(flight, summary), fontsize=11)
    if listed:
        fig.supxlabel(_event_list(listed), fontsize=9, x=0.01, ha="left", linespacing=1.4)
    return fig


def _title(flight: Flight, summary: Mapping[str, Any]) -> str:
    start = str(flight.header.get("start", "start not known")).partition(".")[0].replace("T", " ")
    which = f", drive {flight.drive} of {flight.drives}" if flight.drives > 1 else ""
    return f"{flight.path.name}{which}: {start}, {summary['seconds']:.1f} s, {summary['ticks']} ticks"


def _legend_above(ax: Axes) -> None:
    """Put the legend above the axes, where no line can run through it."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="lower left", bbox_to_anchor=(0, 0.98), ncols=4, frameon=False, fontsize=9, borderaxespad=0,
                  columnspacing=1.5, handlelength=1.6)  # fmt: skip


def _who(ax: Axes, ticks: Mapping[str, np.ndarray], period_s: float) -> None:
    """Draw who drove, as coloured bands."""
    state, t_s = ticks["state"], ticks["t_s"]
    starts = np.flatnonzero(np.r_[True, state[1:] != state[:-1]]) if len(state) else np.array([], int)
    for i, at in enumerate(starts):
        until_s = t_s[starts[i + 1]] if i + 1 < len(starts) else t_s[-1] + period_s
        ax.axvspan(t_s[at], until_s, color=STATES.get(str(state[at]), STATES[""])[1], lw=0)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_ylabel("driven by", fontsize=10, rotation=0, ha="right", va="center")
    seen = [Patch(color=colour, label=label) for s, (label, colour) in STATES.items() if (state == s).any()]
    ax.legend(handles=seen, loc="lower left", bbox_to_anchor=(0, 1.45), ncols=4, frameon=False, fontsize=9,
              borderaxespad=0)  # fmt: skip


def _pulses(ax: Axes, channel: Channel, ticks: Mapping[str, np.ndarray], colour: str) -> None:
    """Draw one channel's pulses, commanded and on the pin. The axis on the right shows the same lines as actions."""
    t_s, commanded, pins = ticks["t_s"], ticks[f"{channel.name}_us"], ticks[f"pins_{channel.name}_us"]
    ax.plot(t_s, commanded, color=colour, lw=2.2, alpha=0.7, label="commanded", drawstyle="steps-post")
    ax.plot(t_s, pins, color=BLACK, lw=0.9, label="the Arduino's pin", drawstyle="steps-post")
    neutral_us = channel.pulse_us(0.0)
    ax.axhline(neutral_us, color=GREY, lw=0.8, ls="--", label=f"neutral, {neutral_us} us")
    ax.set_ylabel(f"{channel.name}\npulse (us)", fontsize=10)
    known = np.concatenate([commanded, pins, [neutral_us]])
    low, high = np.nanmin(known), np.nanmax(known)
    room = max(0.08 * (high - low), 6)  # or the noise of a standing car would fill the panel
    ax.set_ylim(low - room, high + room)
    scale = (lambda us: (us - neutral_us) / channel.us_per_unit, lambda a: neutral_us + a * channel.us_per_unit)
    right = ax.secondary_yaxis("right", functions=scale)
    right.set_ylabel("action", fontsize=10)
    right.tick_params(labelsize=9)


def _plan(ax: Axes, ticks: Mapping[str, np.ndarray], drive: Mapping[str, Any]) -> None:
    t_s, plans = ticks["t_s"], ticks["plan"]
    ax.plot(t_s, ticks["plan_age_ms"], color=SLATE, lw=1.1, label="age of the plan")
    _, first = np.unique(plans, return_index=True)
    first = first[plans[first] > 0]
    ax.plot(t_s[first], ticks["latency_ms"][first], ".", color=BLACK, ms=4, label="latency of each")
    for key, colour, label in (("fade_s", MIST, "fades from"), ("stop_s", RED, "stopped from")):
        value = drive.get(key)
        if isinstance(value, (int, float)):
            ax.axhline(1000 * value, color=colour, lw=1.2, ls="--", label=f"{label} {1000 * value:g} ms on")
    ax.set_ylim(0, None)
    ax.set_ylabel("plan (ms)", fontsize=10)


def _late(ax: Axes, ticks: Mapping[str, np.ndarray], summary: Mapping[str, Any]) -> None:
    label = "lateness of a command"
    if summary["jitter_p50_ms"] is not None:
        p50, p99, most = (summary[f"jitter_{p}_ms"] for p in ("p50", "p99", "max"))
        label += f": p50 {p50:.2f}, p99 {p99:.2f}, max {most:.2f} ms"
    if summary["missed"] is not None:
        label += f"; {summary['missed']} ticks missed"
    ax.plot(ticks["t_s"], ticks["late_ms"], ".", color=SLATE, ms=2.5, label=label)
    ax.set_ylim(0, None)
    ax.set_ylabel("late (ms)", fontsize=10)


def _temperature(ax: Axes, machine: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
    t_s, celsius = machine["t_s"], machine["temperature_c"]
    if np.isfinite(celsius).any():
        label = f"processor, {summary['temperature_max_c']:.1f} °C at most"
        ax.plot(t_s, celsius, color=RED, lw=1.4, label=label)
        ax.set_ylim(np.nanmin(celsius) - 2, np.nanmax(celsius) + 2)
    else:
        ax.text(0.5, 0.5, "this machine has no temperature sensor", transform=ax.transAxes, ha="center", va="center",
                fontsize=9)  # fmt: skip
        ax.set_yticks([])
    bits = np.array([int(v or "0", 16) & NOW_BITS for v in machine["throttled"]], int)
    if bits.any():
        names = [name for bit, name in THROTTLED_BITS.items() if (bits >> bit & 1).any()]
        options: dict[str, Any] = {"step": "post", "transform": ax.get_xaxis_transform()}
        ax.fill_between(t_s, 0, bits > 0, label=", ".join(names), color=RED, alpha=0.4, lw=0, **options)
    ax.set_ylabel("processor\n(°C)", fontsize=10)


def _event_numbers(ax: Axes, events: Sequence[tuple[int, Event]], seconds: float) -> None:
    """Write the events' numbers above their lines. Events that are close together share one label."""
    groups: list[list[tuple[int, Event]]] = []
    for number, event in events:
        if groups and event.t_s - groups[-1][0][1].t_s < LABEL_SHARE * seconds:
            groups[-1].append((number, event))
        else:
            groups.append([(number, event)])
    for group in groups:
        (first, event), (last, _) = group[0], group[-1]
        text = f"{first}" if first == last else f"{first}-{last}"
        ax.annotate(text, (event.t_s, 1.0), (0, 2), xycoords=("data", "axes fraction"), textcoords="offset points",
                    ha="center", va="bottom", fontsize=9)  # fmt: skip


def _event_list(events: Sequence[tuple[int, Event]]) -> str:
    lines = []
    if (before := events[0][0] - 1) > 0:
        lines.append(f"{before} earlier events: rover log --json lists them")
    for number, event in events:
        at = f"{event.t_s:.2f}".rjust(7, DIGIT_SPACE)
        text = str(event)
        text = text if len(text) <= TEXT_LENGTH else f"{text[:TEXT_LENGTH]} ..."
        lines.append(f"{str(number).rjust(2, DIGIT_SPACE)}  {at} s   {text}".replace("$", r"\$"))  # no formula
    return "\n".join(lines)
