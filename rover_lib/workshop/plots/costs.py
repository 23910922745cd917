"""The figures of what a plan costs: time (notebook 05), instructions (06), and error against it (08)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.plots import style

LONGEST = 44  # characters of a kernel's name


def latencies(
    benchmarks: Mapping[str, Mapping[str, Any]], deadline_ms: float, computed_ms: Mapping[str, tuple[float, float]]
) -> Figure:
    """Draw how each artifact's latencies are distributed on each host, beside the deadline of a plan.

    benchmarks: contents of benchmark-<host>.json by host. computed_ms: low and high for a Pi 5, by what it is of.
    """
    rows: dict[str, Any] = {}
    for host, content in benchmarks.items():
        rows |= {f"{name}, {host}": timed for name, timed in content["metrics"]["artifacts"].items()}
    fig, axes = style.new_figure(1, height_in=1.5 + 0.32 * (len(rows) + len(computed_ms)))
    ax = axes[0, 0]
    labels = []
    for row, (label, timed) in enumerate(rows.items()):
        least, p50, p95, p99, most = (timed[f"latency_{p}_ms"] for p in ("min", "p50", "p95", "p99", "max"))
        colour = style.COLOURS.get(label.split(",")[0], style.SLATE)
        ax.plot([least, most], [row, row], color=colour, lw=1)
        ax.plot([least, p95], [row, row], color=colour, lw=8, alpha=0.35, solid_capstyle="butt")
        ax.plot([p99], [row], "|", color=colour, ms=11)
        ax.plot([p50], [row], "o", color=colour, ms=6)
        labels.append(label)
    for row, (label, (low, high)) in enumerate(computed_ms.items(), len(rows)):
        ax.barh(row, high - low, 0.5, left=low, color="none", edgecolor=style.BLACK, hatch="////", lw=0.8)
        labels.append(f"{label}, Pi 5, computed")
    ax.axvline(deadline_ms, color=style.RED, lw=1.4)
    ax.text(deadline_ms, -0.9, f"a plan's deadline, {deadline_ms:.0f} ms ", color=style.RED, fontsize=9, ha="right")
    ax.set_yticks(range(len(labels)), labels)
    ax.set(xscale="log", xlabel="time of one plan (ms)", ylim=(len(labels) - 0.4, -1.4))
    ax.xaxis.set_major_formatter("{x:g}")
    return fig


def kernels(counted: Mapping[str, Any]) -> Figure | style.Note:
    """Draw the instructions of one plan by kernel, of FP32 and of static INT8. counted: arm.json's metrics."""
    names = [name for name in ("policy_fp32", "policy_static") if name in counted.get("artifacts", ())]
    if not names:
        return style.Note("nothing was counted yet")
    fig, axes = style.new_figure(len(names), height_in=0.8 + 1.8 * len(names), sharex=True)
    for ax, name in zip(axes[:, 0], names, strict=True):
        counts = counted["artifacts"][name]
        largest = list(counts["instructions_by_kernel"].items())[:6]
        rest_g = counts["instructions_g"] - sum(g for _, g in largest)
        bars = {_short(kernel): g for kernel, g in largest} | {"all others": rest_g}
        colour = style.COLOURS.get(name.removeprefix("policy_"), style.OTHERS[1])
        ax.barh(list(bars), list(bars.values()), color=[*[colour] * len(largest), style.GREY])
        ax.axvline(counts["floor_g"], color=style.RED, lw=1.2)
        ax.invert_yaxis()
        ax.set_title(f"{name}: {counts['instructions_g']:.2f}, floor {counts['floor_g']:.2f} (red)", fontsize=10)
    axes[-1, 0].set_xlabel("instructions of one plan (10^9)")
    return fig


def _short(kernel: str) -> str:
    """A kernel's own name, without its namespaces and its template's arguments."""
    name = kernel.replace("(anonymous namespace)::", "")
    if "VectorizedLoop2d<" in name:  # of torch: what is looped over tells more
        name = name.partition("VectorizedLoop2d<")[2]
    name = name.split("<")[0].split("(")[0].split("::")[-1]
    return name if len(name) <= LONGEST else f"{name[: LONGEST - 3]}..."


def students(judged: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw each policy's error to the teacher against what a plan of it costs. judged: students of students.json."""
    by_count = all(s.get("instructions_g") for s in judged)
    cost, unit = ("instructions_g", "instructions of one plan (10^9)") if by_count else ("gmac", "GMAC of one plan")
    keys = [key for key in judged[0] if key.startswith("teacher_") and key.endswith("_pct")]
    fig, axes = style.new_figure(1, 2, height_in=3.6)
    left, right = axes[0]
    for i, key in enumerate(keys):
        action = key.removeprefix("teacher_").removesuffix("_pct")
        errors = [s[key] for s in judged]
        left.plot([s[cost] for s in judged], errors, "o", color=style.action_colour(action, i), label=action)
    for s in judged:
        highest = max(s[key] for key in keys)
        left.annotate(s["name"], (s[cost], highest), (0, 6), textcoords="offset points", ha="center", fontsize=9)
    left.set(xscale="log", xlabel=unit, ylabel="mean difference from the teacher\n(% of the recorded range)")
    left.margins(0.2, 0.2)
    left.set_ylim(0, None)
    left.xaxis.set_major_formatter("{x:g}")
    left.xaxis.set_minor_formatter("{x:g}")
    left.tick_params(axis="x", which="minor", labelsize=8)
    left.legend()
    driven = [s for s in judged if s.get("pushed_trials")]
    for row, s in enumerate(driven):
        for aside, key, colour in ((-0.12, "", style.SLATE), (0.12, "pushed_", style.OTHERS[1])):
            share = s[f"{key}hits"] / s[f"{key}trials"]
            ends = 100 * np.clip([[share - s[f"{key}hits_wilson_low"]], [s[f"{key}hits_wilson_high"] - share]], 0, None)
            label = "pushed" if key else "left alone"
            marks = {"fmt": "o", "color": colour, "capsize": 3, "label": label if row == 0 else None}
            right.errorbar(100 * share, row + aside, xerr=ends, **marks)
    right.set_yticks(range(len(driven)), [s["name"] for s in driven])
    right.set(xlabel="balloons hit (%), 95 % intervals", ylim=(len(driven) - 0.4, -0.6))
    style.legend_below(fig, right, 2)
    return fig
