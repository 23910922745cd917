"""Artifacts whose records are changed after they were made. The checksums of the archive stay right."""

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

Edit = Callable[[bytes], bytes | None]


def rewritten(source: Path, target: Path, change: Mapping[str, Edit], add: Mapping[str, bytes] | None = None) -> Path:
    """Write a copy of an artifact to `target`, and return its path.

    change: the end of a record's name -> its edit, which returns the new content, or None to leave the record out.
    add: name -> content of further records.
    """
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
    """Return an edit that sets values in a manifest. The value `...` removes an entry."""
    return lambda raw: json.dumps({k: v for k, v in (json.loads(raw) | values).items() if v is not ...}).encode()


def vectors_with(change: Callable[[dict[str, np.ndarray]], object]) -> Edit:
    """Return an edit that lets `change` alter the parity vectors in place."""

    def edit(raw: bytes) -> bytes:
        vectors = dict(np.load(io.BytesIO(raw)))
        change(vectors)
        out = io.BytesIO()
        np.savez_compressed(out, **vectors)
        return out.getvalue()

    return edit
