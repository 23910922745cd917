"""What a Raspberry Pi 5 takes for counted work, by a fit to published times: computed, never measured.

The fit has three terms: the cycles of the busiest thread, the lines of 64 bytes that it fetches into its first cache,
and the lines between all cores and the memory, which overlap with the others. The low and the high end are as far off
as nine in ten architectures were from a fit that did not know them. docs/clock.md shows those.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path

# `ns` of each term, and `off`, the largest natural logarithm of a ratio of two times. Its program: lab/a76/clock.py at
# commit 545214c.
FITTED = json.loads(Path(__file__).with_suffix(".json").read_text())
DRIVING = 3  # threads of a policy that drives: all cores but one, which is left for the loop, the camera and the view


def predict_ms(work: Mapping[str, float]) -> dict[str, float]:
    """Return the computed time of one inference in DRIVING threads, ms, between its two ends: {low, ms, high}.

    work: in one thread, in 10**9: cycles_g, near_lines_g and far_lines_g, as `core.Emulation` counts them; and `alone`,
    the share of the instructions, 0 to 1, that one thread executes while the others wait.
    """
    ns, off = FITTED["ns"], FITTED["off"]["4"]
    part = work["alone"] + (1 - work["alone"]) / DRIVING  # of the work, what the busiest thread does
    busiest = work["cycles_g"] * part * ns[0] + work["near_lines_g"] * part * ns[1]
    ms = 1e3 * (busiest**2 + (work["far_lines_g"] * ns[2]) ** 2) ** 0.5
    return {"low": ms * math.exp(-off), "ms": ms, "high": ms * math.exp(off)}
