"""Notebook 03: instructions counted on an emulated Cortex-A76. lab.a76.plots draws those of notebook 06."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rover_lib.workshop.plots.style import NAMES, bars_figure, legend, name_rows, simd_bars

# Instructions of one inference of the full policy (15 GMAC, 360x640), in 1e9: label, all instructions, and the SIMD
# instructions among them. Notebook 03 shows them for a run that `make count` has not counted. Source: `make count
# NAME=full PEERS=1`, as in notebook 06.
COUNTED = (
    ("FP32, TorchScript", 6.08, 3.81),
    ("INT8 affine (quint8): QNNPACK's kernels", 5.03, 4.34),
    ("INT8 in ONNX Runtime 1.31.1", 1.66, 1.12),
    ("INT8 in ExecuTorch 1.5.1: XNNPACK", 1.49, 1.08),
    ("INT8 symmetric (qint8), ours: XNNPACK", 1.44, 1.08),
    ("dot-product instructions alone", 0.94, 0.94),
)


def whole_size(metrics: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return the artifacts at the image size of training, by mode, and other engines' peers, most instructions first.

    A peer that only counts one of the artifacts again is left out. metrics: those of arm.json.
    """
    ours = {stem.removeprefix("policy_"): m for stem, m in metrics["artifacts"].items()}
    ours = {mode: m for mode, m in ours.items() if not re.search(r"_\d+x\d+$", mode)}
    counted = ours | {name: m for name, m in metrics.get("peers", {}).items() if "artifact" not in m}
    return dict(sorted(counted.items(), key=lambda item: -item[1]["instructions_g"]))


def instruction_counts(metrics: Mapping[str, Any] | None = None) -> Figure:
    """Draw why the scheme is symmetric: the instructions of one inference, by engine and scheme.

    metrics: those of the run's arm.json; None draws the full policy's, as recorded in COUNTED.
    """
    rows, title = list(COUNTED), "full policy at 360x640, recorded, not of this run"
    if metrics is not None:
        counted = whole_size(metrics)
        rows = [(NAMES.get(n, n), m["instructions_g"], m["simd_g"]) for n, m in counted.items()]
        floor_g, gmac = (next(iter(counted.values()))[key] for key in ("floor_g", "gmac"))
        rows.append(("dot-product instructions alone", floor_g, floor_g))
        title = f"this run's artifacts, {gmac:.3g} GMAC"
    fig, ax = bars_figure(len(rows), 1.2)
    total, simd = (np.array([row[i] for row in rows]) for i in (1, 2))
    simd_bars(ax, np.arange(len(rows)), total, simd)
    name_rows(ax, [row[0] for row in rows])
    ax.set_xlabel("instructions of one inference (10^9)")
    ax.set_title(f"{title}; counted on an emulated Cortex-A76", fontsize=10, loc="right")
    legend(ax, loc="lower right")
    return fig
