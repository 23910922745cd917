"""What single operations of the policy cost in the ways that were tried, kept or not (emulated/tries.py has them).

count_tries("runs/full")      # writes runs/full/tries.json
"""

import runpy
import tempfile
from pathlib import Path
from typing import Any

from rover_lib.onboard.stage import sha256_of, write_stage
from rover_lib.workshop import arm

SCRIPT = arm.REPOSITORY / "emulated" / "tries.py"


def count_tries(run_dir: Path | str, progress: arm.Progress = None) -> dict[str, Any]:
    """Count each try on the emulated Cortex-A76 (about a minute), write tries.json and return what is in it.

    The operations have the full policy's sizes whatever the run's policy is. metrics.tries: rows of what, how, kept,
    instructions_m, simd_m and sdot_m (10**6). Raises ArmError if the emulated machine cannot be set up or fails.
    """
    tries = runpy.run_path(str(SCRIPT))["TRIES"]
    machine = arm.prepare(progress)
    bar = iter(progress(tries, desc="tries", total=len(tries)) if progress else tries)
    with tempfile.TemporaryDirectory(prefix="rover-arm-") as scratch:
        folder = Path(scratch)
        done = arm.emulate_script(machine, SCRIPT, [folder], folder, on_line=lambda _: next(bar, None))
    next(bar, None)
    rows = [
        {
            "what": what,
            "how": how,
            "kept": kept,
            "instructions_m": done.total(i) / 1e6,
            "simd_m": done.total(i, "simd") / 1e6,
            "sdot_m": done.total(i, "sdot") / 1e6,
        }
        for i, (what, how, kept, _) in enumerate(tries)
    ]
    metrics, inputs = {"label": arm.LABEL, "tries": rows}, {SCRIPT.name: sha256_of(SCRIPT)}
    return write_stage(Path(run_dir) / "tries.json", "tries", params={}, metrics=metrics, inputs=inputs)


def table(content: dict[str, Any]) -> str:
    """tries.json for people."""
    lines = [f"{arm.LABEL}, M instructions; * is what the policy does"]
    before = None
    for row in content["metrics"]["tries"]:
        if row["what"] != before:
            lines.append(row["what"])
            before = row["what"]
        lines.append(
            f"  {'*' if row['kept'] else ' '} {row['how']:44} {row['instructions_m']:8.2f}, SIMD {row['simd_m']:7.2f}"
        )
    return "\n".join(lines)
