"""Execute a notebook's cells in this process, and read the outputs of an executed one as text."""

from pathlib import Path

import nbformat

from rover_lib.workshop.run.run import NOTEBOOKS, parameters_of


def text_of(cell: nbformat.NotebookNode) -> str:
    """Return what a cell printed and showed. A table is included as text; a figure adds nothing."""
    texts = (o.get("text") or o.get("data", {}).get("text/plain", "") for o in cell.get("outputs", ()))
    return "\n".join(text.rstrip("\n") for text in texts)


def shown(path: Path) -> str:
    """Return `text_of` all cells."""
    return "\n".join(text_of(c) for c in nbformat.read(path, as_version=4).cells)


def run_cells(name, run_dir, **given):
    """A notebook's cells, one after the other, without a kernel, which imports torch once more."""
    path, variables = NOTEBOOKS / f"{name}.ipynb", {}
    known = parameters_of(path)
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            exec(cell.source, variables)
        if "parameters" in cell.metadata.get("tags", []):
            variables |= {k: v for k, v in {"run_dir": str(run_dir), **given}.items() if k in known}
