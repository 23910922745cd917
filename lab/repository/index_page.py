"""README.md as a package index shows it, where a relative link leads nowhere. The build calls this."""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

PICTURE = re.compile(r"\[?!\[([^\]]*)\]\((?!https?:)([^)]*)\)(?:\]\([^)]*\))?\n*")
LINK = re.compile(r"\[([^\]]*)\]\((?!https?:)([^)]*)\)")


def index_page(text: str, source: str = "") -> str:
    """README.md's text with absolute links. source: the repository's address; without one, no pictures and no links."""
    if not source:
        return LINK.sub(r"\1", PICTURE.sub("", text))
    text = PICTURE.sub(rf"![\1]({source}/raw/HEAD/\2)\n\n", text)
    return LINK.sub(rf"[\1]({source}/blob/HEAD/\2)", text)


class IndexPage(MetadataHookInterface):
    """Sets the project's readme."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Add it to the build's metadata."""
        text = Path(self.root, "README.md").read_text()
        source = metadata.get("urls", {}).get("Source", "").rstrip("/")
        metadata["readme"] = {"content-type": "text/markdown", "text": index_page(text, source)}
