"""Judge and show what was counted: gates, and a table."""

import re
from collections.abc import Mapping
from typing import Any

from lab.a76.pi5 import DRIVING
from rover_lib.onboard.columns import align, number
from rover_lib.workshop.judge.compare import gate
from rover_lib.workshop.judge.recorded_range import worst

LABEL = "counted on an emulated Cortex-A76"
STATIC, STATIC_ONNX = "policy_static", "policy_static.onnx"

# The gates of instructions are for one policy: one whose multiply-accumulates differ by less than this share.
SAME_POLICY = 0.01
# Kernels that divide their work over the threads, by name or library. One thread executes the rest.
DIVIDED = re.compile(r"xnn|pthreadpool|sgemm|[Ss]leef|flash_attention|qmaxpool|onnxruntime|Mlas")

COLUMNS = {  # the table's, each with the key of arm.json and how it is written
    "steady": ("instructions_g", ".4g"),
    "SIMD": ("simd_g", ".4g"),
    "x floor": ("x_floor", ".2f"),
    "first": ("first_g", ".4g"),
    "tenth": ("tenth_g", ".4g"),
    "load": ("load_instructions_g", ".4g"),
    "MB": ("peak_memory_mb", ".0f"),
    "loading": ("peak_memory_loading_mb", ".0f"),
}


def alone_of(instructions_by_kernel: Mapping[str, float]) -> float:
    """Return the share of the instructions, 0 to 1, that are in no kernel that divides its work over the threads."""
    divided = sum(count for kernel, count in instructions_by_kernel.items() if DIVIDED.search(kernel))
    return 1 - divided / sum(instructions_by_kernel.values())


def gates(metrics: dict[str, Any], limits: dict[str, Any]) -> list[dict[str, Any]]:
    """Hold static artifacts to their gates; return `compare.gate` rows. limits: arm.gates of lab/params.yml.

    Errors are divided by this machine's, ONNX Runtime's by torch's too; the worst action counts.
    """
    rows = []
    for stem, artifact in metrics["artifacts"].items():
        own = dict(limits["policies"].get(stem, {}))
        if own and abs(artifact["gmac"] / own.pop("gmac") - 1) >= SAME_POLICY:
            own = {}
        rows += [gate(f"{stem} {key}", artifact[key], "<=", limit) for key, limit in own.items()]
        if stem not in (STATIC, STATIC_ONNX):
            continue
        here = {k.removeprefix("workstation_"): v for k, v in artifact.items() if k.startswith("workstation_")}
        off_pct = 100 * abs(artifact["tenth_g"] / artifact["instructions_g"] - 1)
        checks = [
            ("error on the emulated core, times the workstation's", _times(artifact, here), "x_workstation_error"),
            ("cost of the tenth plan against the third, %", off_pct, "tenth_pct"),
        ]
        checks += [(key, artifact[key], key) for key in ("peak_memory_mb", "peak_memory_loading_mb") if key not in own]
        if stem == STATIC_ONNX and (torchs := metrics["artifacts"].get(STATIC)):
            there = {key: torchs[key] for key in here}
            checks.append(("error on the emulated core, times torch's there", _times(artifact, there), "x_torch_error"))
        rows += [gate(f"{stem} {name}", value, "<=", limits[limit]) for name, value, limit in checks]
        frames = artifact["frames_on_the_core"]
        rows.append(gate(f"{stem} frames judged on the emulated core", frames, ">=", limits["frames"]))
    return rows


def _times(artifact: dict[str, Any], errors: dict[str, float | None]) -> float | None:
    """Return the largest ratio of the artifact's errors to these; None if no action is judged."""
    pairs = [(artifact[key], error) for key, error in errors.items() if error is not None]
    return worst(mine / error if error else float("inf") for mine, error in pairs)


def rows_of(metrics: Mapping[str, Any]) -> list[list[str]]:
    """Return a row for each count, a header first, and the fewest instructions after it. metrics: of arm.json."""
    rows = [["", *COLUMNS, "worst error, %", "frames", f"computed ms, {DRIVING} threads"]]
    for name, counts in sorted(metrics["artifacts"].items(), key=lambda item: item[1]["instructions_g"]):
        cells = [number(counts[key], form) for key, form in COLUMNS.values()]
        errors = [value for key, value in counts.items() if key.endswith("_mae_pct") and not key.startswith("work")]
        span = "{low:.3g} to {high:.3g}".format_map(counts["computed_pi5_ms"])
        rows.append([name, *cells, number(worst(errors), ".3f"), str(counts["frames_on_the_core"]), span])
    return rows


def table(content: dict[str, Any]) -> str:
    """Show arm.json as text: the counts with the computed times, then the gates."""
    rows = align(rows_of(content["metrics"]))
    lines = [f"{LABEL}, 10^9 instructions of an inference; times are computed from them (docs/clock.md)", *rows]
    for row in content["metrics"]["gates"]:
        verdict = {True: "pass", False: "FAIL", None: "not measured"}[row["passed"]]
        lines.append(f"{verdict}: {row['gate']}, {number(row['found'], '.4g')} {row['relation']} {row['limit']:g}")
    return "\n".join(lines)
