"""What an executed notebook showed."""

from pathlib import Path

import nbformat


def printed(path: Path) -> str:
    """All that its cells printed."""
    cells = nbformat.read(path, as_version=4).cells
    return "".join(o.text for c in cells if c.cell_type == "code" for o in c.outputs if o.output_type == "stream")
