"""What JupyterLab's server is told: a notebook that was only opened and saved stays as it is.

As soon as JupyterLab opens a notebook, it writes the kernel's own name and version, and widgets that there are none of,
into its metadata. So a stored one would count as changed, in git and for the next run, without a changed cell.
"""

import json
import warnings
from pathlib import Path
from typing import Any

OF_THE_KERNEL = ("kernelspec", "language_info")
WIDGETS = "application/vnd.jupyter.widget-state+json"


def keep_metadata(model: dict[str, Any], path: str, contents_manager: Any, **_: Any) -> None:
    """Give the notebook that is to be saved the kernel of the file at `path`, if it is there, and no empty widgets."""
    file = Path(contents_manager.root_dir, path)
    if model["type"] != "notebook" or not file.is_file():
        return
    metadata = model["content"]["metadata"]
    stored = json.loads(file.read_text(encoding="utf-8"))["metadata"]
    for key in OF_THE_KERNEL:
        if key in stored:
            metadata[key] = stored[key]
    if not metadata.get("widgets", {}).get(WIDGETS, {}).get("state"):
        metadata.pop("widgets", None)


# traitlets sets it twice, from the same file.
warnings.filterwarnings("ignore", "Overriding existing pre_save_hook")
c = get_config()  # type: ignore[name-defined]  # noqa: F821, traitlets puts it there
c.ContentsManager.pre_save_hook = keep_metadata
