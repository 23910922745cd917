"""Artifacts that were changed after they were made: by their records, with every checksum right."""

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

Edit = Callable[[bytes], bytes | None]


def rewritten(source: Path, target: Path, change: Mapping[str, Edit], add: Mapping[str, bytes] | None = None) -> Path:
    """A copy of an artifact with records replaced, by the end of their names, or left out, and with others added."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for item in old.infolist():
            content: bytes | None = old.read(item)
            for name, edit in change.items():
                if content is not None and item.filename.endswith(name):
                    content = edit(content)
            if content is not None:
                new.writestr(item, content)
        for name, content in (add or {}).items():
            new.writestr(name, content)
    return target


def manifest_with(**values: object) -> Edit:
    """Other values in a manifest; ... takes one out."""
    return lambda raw: json.dumps({k: v for k, v in (json.loads(raw) | values).items() if v is not ...}).encode()


def vectors_with(change: Callable[[dict[str, np.ndarray]], object]) -> Edit:
    """Other parity vectors."""

    def edit(raw: bytes) -> bytes:
        vectors = dict(np.load(io.BytesIO(raw)))
        change(vectors)
        out = io.BytesIO()
        np.savez_compressed(out, **vectors)
        return out.getvalue()

    return edit
