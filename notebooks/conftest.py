"""For nbval, which runs the notebooks here under pytest.

`make demo` has just run the same cells on the whole demo; what is left to prove is that
the committed notebooks run in order and still print what they must. So they run in a
folder of their own, on a few frames and worlds.
"""

import os
from pathlib import Path
from typing import Any

# The notebooks' kernels inherit these, as in `rover run`.
from rover_lib.workshop.run.run import KERNEL_ENVIRONMENT, LINE

# By its whole path: beside a folder of its own, the default would count as forgotten.
DEMO = Path(__file__).resolve().parents[1] / "runs" / "demo"

FEW: dict[str, Any] = {
    "run_dir": "../runs/nbval",
    "checkpoint": str(DEMO / "best_model.pth"),
    "episodes": str(DEMO / "episodes"),
    "samples": 12,
    "choosing_frames": 4,
    "held_out_frames": 8,
    "worlds": 2,
    "iterations": 5,
    "latencies_ms": [0, 150],
    "pushed_latencies_ms": [150],
    "students": ["../runs/demo-small"],
}


def pytest_sessionstart():
    for name, value in KERNEL_ENVIRONMENT.items():
        os.environ.setdefault(name, value)


def pytest_collection_modifyitems(items):
    for item in items:
        if (cell := getattr(item, "cell", None)) is None:
            continue
        if "parameters" in cell.metadata.get("tags", []):
            cell.source = with_few(cell.source)
        # Count every cell as run: nbval trusts no output of a cell without a count, and
        # committed notebooks have none: they would change with each publication.
        if cell.get("execution_count") is None:
            cell.execution_count = 0


def with_few(parameters: str) -> str:
    """A parameters cell whose literals are those of FEW."""
    lines = []
    for name, literal, _ in LINE.findall(parameters):
        lines.append(
            f"{name} = {FEW[name]!r}" if name in FEW else f"{name} = {literal}"
        )
    return "\n".join(lines)
