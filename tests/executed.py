"""What an executed notebook showed."""

from pathlib import Path

import nbformat


def text_of(cell: nbformat.NotebookNode) -> str:
    """What one of its cells printed and showed, as text: a table too, and of a figure nothing."""
    texts = (o.get("text") or o.get("data", {}).get("text/plain", "") for o in cell.get("outputs", ()))
    return "\n".join(text.rstrip("\n") for text in texts)


def shown(path: Path) -> str:
    """`text_of` all of its cells."""
    return "\n".join(text_of(c) for c in nbformat.read(path, as_version=4).cells)


def printed(path: Path) -> str:
    """All that its cells printed."""
    cells = nbformat.read(path, as_version=4).cells
    return "".join(o.text for c in cells if c.cell_type == "code" for o in c.outputs if o.output_type == "stream")
