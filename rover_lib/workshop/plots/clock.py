"""Notebooks 05 and 06: times on a Raspberry Pi 5 that are computed from counts, against published and measured ones."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rover_lib.workshop.plots.style import BLACK, BLUE, MIST, RED, SLATE, claim, legend, new_figure

RUNTIMES = {"ncnn": SLATE, "executorch": BLUE}
SHOWN = ("teacher", "fast", "faster")  # of our policies


def draw_clock(clock: Mapping[str, Any], measured: Sequence[Mapping[str, Any]] = ()) -> Figure:
    """Draw published against computed times, a dot a network, and beside them our policies by threads.

    clock: metrics of clock.json. measured: rovers' own times, see `hosts.Benchmarks.beside_clock`.
    """
    fig, axes = new_figure(1, 2, height_in=4.4, width_ratios=(1.3, 1))
    _published(axes[0, 0], clock["networks"], measured)
    _ours(axes[0, 1], clock["policies"], measured)
    held = clock["judged"]
    shares = " and ".join(f"{held[n]['held_pct']:.0f} % on {n}" for n in held)
    claim(fig, f"Of times unknown to the fit, the interval holds {shares} threads.")
    return fig


def _published(ax: Axes, networks: Sequence[Mapping[str, Any]], measured: Sequence[Mapping[str, Any]]) -> None:
    for runtime, colour in RUNTIMES.items():
        for threads, face in ((1, "white"), (4, colour)):
            rows = [r for r in networks if (r["runtime"], r["threads"]) == (runtime, threads)]
            if not rows:
                continue
            x, y = [r["published_ms"] for r in rows], [r["predicted_ms"] for r in rows]
            far = [[r["predicted_ms"] - r["predicted_low_ms"] for r in rows],
                   [r["predicted_high_ms"] - r["predicted_ms"] for r in rows]]  # fmt: skip
            label = f"{runtime}, {threads} thread{'s' * (threads > 1)}"
            ax.errorbar(x, y, yerr=far, fmt="o", ms=4, color=colour, mfc=face, elinewidth=0.6, label=label)
    for row in networks:
        if row["odd"]:
            ax.annotate(row["name"], (row["published_ms"], row["predicted_ms"]), (4, -9), textcoords="offset points",
                        fontsize=8)  # fmt: skip
    if measured:
        x, y = [r["measured_ms"] for r in measured], [r["predicted_ms"] for r in measured]
        ax.plot(x, y, "*", ms=12, color=RED, label="rovers of ours, measured")
    ends = [min(r["published_ms"] for r in networks), max(r["published_ms"] for r in networks)]
    ax.plot(ends, ends, color=BLACK, lw=0.8)
    ax.set(xscale="log", yscale="log", xlabel="published for a Raspberry Pi 5 (ms)", ylabel="computed without it (ms)")
    legend(ax, loc="upper left")


def _ours(ax: Axes, policies: Sequence[Mapping[str, Any]], measured: Sequence[Mapping[str, Any]]) -> None:
    rows = [r for r in policies if r["name"] in SHOWN]
    for y, row in enumerate(rows):
        low, ms, high = (row[f"predicted{end}_ms"] for end in ("_low", "", "_high"))
        ax.plot([low, high], [y, y], color=MIST, lw=7, solid_capstyle="butt")
        ax.plot(ms, y, "|", color=BLACK, ms=9, mew=2)
        ax.annotate(f"{_two(low)} to {_two(high)}", (high, y), (4, -3), textcoords="offset points", fontsize=8)
        for own in measured:
            if (own["name"], own["threads"]) == (row["name"], row["threads"]):
                ax.plot(own["measured_ms"], y, "*", ms=12, color=RED)
    ax.set_yticks(range(len(rows)), [f"{r['name']}, {r['threads']}" for r in rows])
    ax.invert_yaxis()
    left, right = min(r["predicted_low_ms"] for r in rows), max(r["predicted_high_ms"] for r in rows)
    ax.set(xscale="log", xlabel="a plan of ours, computed (ms)", xlim=(left / 1.2, right * 3))
    ax.set_title("policy, threads", fontsize=10, loc="left")


def _two(ms: float) -> str:
    """Return a time with two digits."""
    return f"{float(f'{ms:.2g}'):g}"
