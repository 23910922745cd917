"""Execute a notebook's cells in this process, and read the outputs of an executed one as text."""

from pathlib import Path

import nbformat

from rover_lib.workshop.run.run import NOTEBOOKS, parameters_of


def shown(path: Path) -> str:
    """Return what a notebook's cells printed and showed. A table is included as text; a figure adds nothing."""
    outputs = [o for cell in nbformat.read(path, as_version=4).cells for o in cell.get("outputs", ())]
    return "\n".join((o.get("text") or o.get("data", {}).get("text/plain", "")).rstrip("\n") for o in outputs)


def run_cells(name, run_dir, **given):
    """A notebook's cells, one after the other, without a kernel, which imports torch once more."""
    path, variables = NOTEBOOKS / f"{name}.ipynb", {}
    known = parameters_of(path)
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            exec(cell.source, variables)
        if "parameters" in cell.metadata.get("tags", []):
            variables |= {k: v for k, v in {"run_dir": str(run_dir), **given}.items() if k in known}
