"""What a Raspberry Pi 5 takes for counted work, by a fit to published times: computed, never measured.

    predict_ms(Work(cycles_g=0.69, near_lines_g=0.03, far_lines_g=0.005))

The fit has three terms: the cycles of the busiest thread, the lines of 64 bytes that it fetches into its first cache,
and the lines between all cores and the memory, which overlap with the others. The low and the high end are as far off
as nine in ten architectures were from a fit that did not know them. docs/clock.md shows those.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

FITTED = Path(__file__).with_name("pi5.json")  # its program: lab/a76/clock.py at commit 545214c
DRIVING = 3  # threads of a policy that drives: all cores but one, which is left for the loop, the camera and the view
# Measured peaks of a Raspberry Pi 5, four cores at 2.4 GHz (public cpufp results), in 10**9 multiply-accumulates
# per second: INT8 SDOT 614 GOPS, FP16 307 GFLOPS, FP32 153.5 GFLOPS, two operations to a multiply-accumulate.
PI5_GMAC_PER_S = {"int8": 307.0, "fp16": 153.5, "fp32": 76.75}


class Span(NamedTuple):
    """A computed time of one inference in ms: the expected one, between two ends."""

    low: float
    ms: float
    high: float


@dataclass(frozen=True)
class Work:
    """What one inference executes in one thread, in 10**9.

    cycles_g, near_lines_g, far_lines_g: cycles, and lines of 64 bytes, as `lab.a76.core.Emulation` counts them.
    alone: the share of the instructions, 0 to 1, that one thread executes while the others wait.
    """

    cycles_g: float
    near_lines_g: float
    far_lines_g: float
    alone: float = 0.0

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> "Work":
        """Return the work that a row of arm.json or clock.json tells of."""
        return cls(row["cycles_g"], row["near_lines_g"], row["far_lines_g"], row["alone"])


@cache
def fitted() -> dict[str, Any]:
    """Return the fit: `ns` of each term, `off` by threads (the largest natural logarithm of a ratio of two times), and
    `gmac_per_s` (see `estimate_ms`).
    """
    return json.loads(FITTED.read_text())


def predict_ms(work: Work) -> Span:
    """Return the computed time of one inference in DRIVING threads, by `fitted`."""
    ns, off = fitted()["ns"], fitted()["off"]["4"]
    part = work.alone + (1 - work.alone) / DRIVING  # of the work, what the busiest thread does
    busiest = work.cycles_g * part * ns[0] + work.near_lines_g * part * ns[1]
    ms = 1e3 * (busiest**2 + (work.far_lines_g * ns[2]) ** 2) ** 0.5
    return Span(ms * math.exp(-off), ms, ms * math.exp(off))


def estimate_ms(gmac: float) -> float:
    """Return the high end for INT8 that was not counted, by its 10**9 multiply-accumulates: a rough estimate."""
    return 1e3 * gmac / fitted()["gmac_per_s"]


def floor_ms(gmac: float | None, mode: str) -> float | None:
    """Return the least time that a Pi 5 needs for one inference, by arithmetic alone; None where `gmac` is not known.

    gmac: 10**9 multiply-accumulates of one inference. mode: an artifact's: `mixed` and `dynamic` count as INT8, a floor
    that they cannot reach.
    """
    return None if gmac is None else gmac / PI5_GMAC_PER_S["fp32" if mode == "fp32" else "int8"] * 1000
