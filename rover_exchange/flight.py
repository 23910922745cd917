"""Draw a flight log: what was commanded, what the pins did, how old the plans were, how late the loop was."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.onboard.car.protocol import State
from rover_lib.onboard.car.pwm import Channel
from rover_lib.onboard.drive.flight_log import Flight
from rover_lib.workshop.plots.style import BLACK, COLOURS, GREY, MIST, RED, SLATE, new_figure

STATES = {
    State.MANUAL.value: ("human", GREY),
    State.AUTONOMOUS.value: ("host", SLATE),
    State.STOPPED.value: ("nobody, stopped", RED),
    "": ("not known", "#F2F2F2"),
}
HEIGHTS = {"driven by": 0.4, "steering": 1.6, "throttle": 1.6, "plan (ms)": 1.6, "late (ms)": 1.3}  # inches


def flight_figure(flight: Flight) -> Figure:
    """Draw one drive: panels over the same seconds, and a dotted line for each event."""
    ticks = flight.ticks
    t_s = flight.ticks["t_s"]
    height_in = sum(HEIGHTS.values()) + 3
    fig, axes = new_figure(len(HEIGHTS), height_in=height_in, height_ratios=[*HEIGHTS.values()], sharex=True)
    who, steering, throttle, plan, late = axes[:, 0]
    _draw_who(who, ticks)
    _draw_pulses(steering, flight.car.pwm.steering, ticks, COLOURS["steering"])
    _draw_pulses(throttle, flight.car.pwm.throttle, ticks, COLOURS["throttle"])
    if (ticks["fade"] < 1).any():
        # The area hangs from the top: its share of the height is the share of the throttle that is taken away.
        options = {"step": "post", "transform": throttle.get_xaxis_transform(), "color": RED, "alpha": 0.18, "lw": 0}
        options["label"] = "faded, for the plan's age or an unfamiliar place"
        throttle.fill_between(t_s, ticks["fade"], 1, **options)
    _draw_plan(plan, ticks, flight.header.get("drive", {}))
    late.plot(t_s, ticks["late_ms"], ".", color=SLATE, ms=2.5, label="lateness of a command")
    for ax, name in zip(axes[:, 0], HEIGHTS, strict=True):
        ax.set_ylabel(name, fontsize=10)
        for event in flight.events:
            ax.axvline(event.t_s, color=BLACK, lw=0.8, ls=":", zorder=0.5)
        if ax.get_legend_handles_labels()[0]:  # above the axes, where no line can run through it
            ax.legend(loc="lower left", bbox_to_anchor=(0, 0.97), ncols=4, frameon=False, fontsize=9)
    start_s = 0.0
    end_s = 1.0
    if len(t_s):
        start_s = float(t_s[0])
        end_s = max(t_s[-1], *(e.t_s for e in flight.events), 1.0)
    axes[-1, 0].set_xlim(max(0.0, start_s - 0.02 * (end_s - start_s)), end_s)  # without what was before the first tick
    axes[-1, 0].set_xlabel("time since the start (s)", fontsize=10)
    fig.align_ylabels(axes[:, 0])
    fig.suptitle(f"{flight.path.name}: {flight.header.get('start', 'start not known')}", fontsize=11)
    return fig


def _draw_who(ax: Axes, ticks: Mapping[str, np.ndarray]) -> None:
    """Draw who drove, as coloured bands."""
    for state, (label, colour) in STATES.items():
        if (active := ticks["state"] == state).any():
            until_next = active | np.append(False, active[:-1])
            ax.fill_between(ticks["t_s"], 0, 1, where=until_next, step="post", color=colour, lw=0, label=label)
    ax.set_yticks([])
    ax.set_ylim(0, 1)


def _draw_pulses(ax: Axes, channel: Channel, ticks: Mapping[str, np.ndarray], colour: str) -> None:
    """Draw one channel's pulses, commanded and on the pin. The axis on the right shows the same lines as actions."""
    t_s = ticks["t_s"]
    commanded = ticks[f"{channel.name}_us"]
    pins = ticks[f"pins_{channel.name}_us"]
    neutral_us = channel.pulse_us(0.0)
    ax.plot(t_s, commanded, color=colour, lw=2.2, alpha=0.7, label="commanded, us", drawstyle="steps-post")
    ax.plot(t_s, pins, color=BLACK, lw=0.9, label="the Arduino's pin", drawstyle="steps-post")
    ax.axhline(neutral_us, color=GREY, lw=0.8, ls="--", label=f"neutral, {neutral_us} us")
    pulses = np.concatenate([commanded, pins, [neutral_us]])
    low = np.nanmin(pulses)
    high = np.nanmax(pulses)
    room = max(0.08 * (high - low), 6)  # or the noise of a standing car would fill the panel
    ax.set_ylim(low - room, high + room)
    scale = (lambda us: (us - neutral_us) / channel.us_per_unit, lambda a: neutral_us + a * channel.us_per_unit)
    ax.secondary_yaxis("right", functions=scale).set_ylabel("action", fontsize=10)


def _draw_plan(ax: Axes, ticks: Mapping[str, np.ndarray], drive: Mapping[str, Any]) -> None:
    t_s = ticks["t_s"]
    plans = ticks["plan"]
    ax.plot(t_s, ticks["plan_age_ms"], color=SLATE, lw=1.1, label="age of the plan")
    _, first = np.unique(plans, return_index=True)
    first = first[plans[first] > 0]
    ax.plot(t_s[first], ticks["latency_ms"][first], ".", color=BLACK, ms=4, label="latency of each")
    for key, colour, label in (("fade_s", MIST, "fades from"), ("stop_s", RED, "stopped from")):
        value = drive.get(key)
        if isinstance(value, (int, float)):
            ax.axhline(1000 * value, color=colour, lw=1.2, ls="--", label=f"{label} {1000 * value:g} ms on")
    ax.set_ylim(0, None)
    if np.isfinite(ticks["strange"]).any():
        share = ax.twinx()
        share.plot(t_s, ticks["strange"], color=RED, lw=1.1)
        share.set(ylim=(0, max(1.2, np.nanmax(ticks["strange"]))))
        share.axhline(1, color=RED, lw=0.8, ls=":")
        share.set_ylabel("unfamiliar, of the limit", color=RED, fontsize=9)
