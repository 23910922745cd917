"""The artifact: one TorchScript file with its manifest and parity vectors inside. No pickled objects, no lerobot.

Inside the zip, beside TorchScript's own records: `extra/manifest.json` (what it is, see MANIFEST_KEYS) and
`extra/parity.npz` (inputs, and the chunks that they must give).
"""

import hashlib
import io
import json
import math
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.stage import atomic_path

if TYPE_CHECKING:  # reading what an artifact says of itself needs neither
    import numpy as np
    import torch

SCHEMA = 1
MANGLED = re.compile(rb"___torch_mangle_\d+")
MANIFEST_KEYS: dict[str, type | tuple[type, ...]] = {
    "schema": int,
    "mode": str,  # fp32, dynamic, static, mixed
    "scheme": str,  # float, symmetric, affine
    "engine": str,  # of torch.backends.quantized
    "cameras": list,  # [{name, height, width}], in the graph's order
    "state_names": list,
    "action_names": list,
    "chunk": int,  # actions per inference
    "rate_hz": (int, float),  # of those actions
    "normalisation": str,  # where it happens
    "checkpoint": dict,  # {sha256, format}
    "calibration": (dict, type(None)),  # {samples, observer, ...}
    "weights_mb": (int, float),
    "gmac": (int, float),  # multiply-accumulates of one inference, in 1e9
    "parity": dict,  # {tolerance: {action: largest difference}, reason}
    "versions": dict,  # {torch, rover_lib}
}


def save_artifact(
    path: Path | str, module: "torch.jit.ScriptModule", manifest: dict[str, Any], parity: "dict[str, np.ndarray]"
) -> str:
    """Write the artifact atomically; return its content hash.

    parity: `state` (n, S) float32, `frame_<camera>` (n, height, width, 3) uint8 RGB, `chunk` (n, C, A) float32.
    Raises ArtifactError if the manifest lacks something.
    """
    import numpy as np
    import torch

    check_manifest(manifest, str(path))
    vectors = io.BytesIO()
    np.savez_compressed(vectors, allow_pickle=False, **parity)
    extra = {
        "manifest.json": json.dumps(manifest, sort_keys=True, indent=1),
        "parity.npz": vectors.getvalue(),
    }
    # Through a buffer, because torch.jit.save names the zip's folder after the file: same inputs, same bytes.
    buffer = io.BytesIO()
    torch.jit.save(module, buffer, _extra_files=extra)
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())
    return content_hash(path)


def content_hash(path: Path | str) -> str:
    """Hex SHA-256 over everything in the artifact that acts: the same inputs give the same hash.

    The bytes of the file may differ: TorchScript writes debug tables (source positions), a serial number, and class
    names with a counter of all classes that the process ever made.
    """
    digest = hashlib.sha256()
    with _open(path) as z:
        for name in sorted(z.namelist()):
            if name.endswith((".debug_pkl", "/.data/serialization_id")):
                continue
            record = z.read(name)
            if not name.startswith("archive/constants/"):
                record = MANGLED.sub(b"", record)
            digest.update(MANGLED.sub(b"", name.encode()) + b"\0")
            digest.update(hashlib.sha256(record).digest())
    return digest.hexdigest()


def read_manifest(path: Path | str) -> dict[str, Any]:
    """The manifest of an artifact, without running or even loading the policy. Raises ArtifactError."""
    with _open(path) as z:
        return _manifest_in(z, path)


def read_parity(path: Path | str) -> "dict[str, np.ndarray]":
    """The parity vectors of an artifact. Raises ArtifactError."""
    import numpy as np

    with _open(path) as z:
        try:
            content = np.load(io.BytesIO(z.read(_record(z, "parity.npz", path))), allow_pickle=False)
            vectors = {k: content[k] for k in content.files}
        except (ValueError, OSError, zipfile.BadZipFile) as e:
            raise ArtifactError(f"{path}: its parity vectors are not readable ({e})", remedy="quantize again") from None
    if "state" not in vectors or "chunk" not in vectors or len(vectors["chunk"]) == 0:
        raise ArtifactError(f"{path}: it has no parity vectors", found=sorted(vectors), remedy="quantize again")
    return vectors


def check_integrity(path: Path | str) -> None:
    """Raise ArtifactError if any byte changed since the artifact was written (TorchScript itself does not look)."""
    with _open(path) as z:
        try:
            damaged = z.testzip()
        # RuntimeError, its subclasses too: a damaged header may ask for a password, or for an unknown compression
        except (zipfile.BadZipFile, OSError, RuntimeError) as e:
            raise ArtifactError(f"{path}: damaged ({e})", remedy="copy the file again") from None
    if damaged:
        raise ArtifactError(
            f"{path}: damaged, the checksum of '{damaged}' does not match", remedy="copy the file again"
        )


def check_manifest(manifest: Any, where: str) -> None:
    """Raise ArtifactError, naming the key, for a manifest of another schema or with a value that cannot be."""
    if not isinstance(manifest, dict):
        raise ArtifactError(
            f"{where}: its manifest is no JSON object", found=type(manifest).__name__, remedy="quantize again"
        )
    if manifest.get("schema") != SCHEMA:
        raise ArtifactError(
            f"{where}: manifest schema {manifest.get('schema')!r}, this rover_lib reads {SCHEMA}",
            remedy="use the rover_lib that wrote it, or quantize again",
        )
    for key, kind in MANIFEST_KEYS.items():
        if not isinstance(manifest.get(key), kind):
            value = repr(manifest[key])[:60] if key in manifest else "nothing"
            raise ArtifactError(
                f"{where}: manifest key '{key}' is {value}, not what it should be", remedy="quantize again"
            )
    if not manifest["cameras"]:
        raise ArtifactError(f"{where}: manifest has no cameras", remedy="quantize again")
    for camera in manifest["cameras"]:
        if not isinstance(camera, dict) or not {"name", "height", "width"} <= camera.keys():
            raise ArtifactError(
                f"{where}: manifest camera {camera!r} lacks name, height or width", remedy="quantize again"
            )
        if not isinstance(camera["name"], str) or not _is_count(camera["height"]) or not _is_count(camera["width"]):
            raise ArtifactError(
                f"{where}: manifest camera {camera!r} is not a name and a size", remedy="quantize again"
            )
    if not _is_count(manifest["chunk"]):
        raise ArtifactError(
            f"{where}: manifest chunk must be 1 or more", found=manifest["chunk"], remedy="quantize again"
        )
    if not 0 < manifest["rate_hz"] < math.inf:
        raise ArtifactError(
            f"{where}: manifest rate_hz must be above 0", found=manifest["rate_hz"], remedy="quantize again"
        )
    for key in ("state_names", "action_names"):
        if not manifest[key] or not all(isinstance(name, str) for name in manifest[key]):
            raise ArtifactError(
                f"{where}: manifest {key} must be names", found=repr(manifest[key]), remedy="quantize again"
            )
    tolerance = manifest["parity"].get("tolerance")
    if not isinstance(tolerance, dict) or set(tolerance) != set(manifest["action_names"]):
        raise ArtifactError(
            f"{where}: manifest parity tolerance {tolerance!r} does not cover its actions", remedy="quantize again"
        )


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and value >= 1


def distinct_names(paths: Sequence[Path], drop: str = "") -> dict[str, Path]:
    """Artifacts by the shortest name that tells them apart: the stem, with as many folders before it as that takes.

    drop: a beginning of stems that says nothing, such as "policy_". Raises ArtifactError for a file given twice.
    """
    longest = max((len(path.absolute().parts) for path in paths), default=0)
    names: dict[str, Path] = {}
    for path in paths:
        if any(path.resolve() == other.resolve() for other in names.values()):
            raise ArtifactError(f"{path}: given twice", remedy="name each file once")
        name = str(path)  # if two files of one folder differ only in what is not in the name
        for folders in range(longest):
            candidate = _name(path, folders, drop)
            if [_name(other, folders, drop) for other in paths].count(candidate) == 1:
                name = candidate
                break
        names[name] = path
    return names


def _name(path: Path, folders: int, drop: str) -> str:
    """The stem of a path after this number of its folders."""
    parents = path.absolute().parts[1:-1]
    return "/".join([*parents[max(0, len(parents) - folders) :], path.stem.removeprefix(drop)])


def _open(path: Path | str) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except FileNotFoundError:
        raise ArtifactError(f"{path}: not found", remedy="'rover run' writes artifacts to runs/<name>/") from None
    except (zipfile.BadZipFile, OSError) as e:
        raise ArtifactError(f"{path}: not an artifact, or cut short ({e})", remedy="copy the file again") from None


def _record(z: zipfile.ZipFile, name: str, path: Path | str) -> str:
    records = [n for n in z.namelist() if n.endswith(f"/extra/{name}")]
    if len(records) != 1:
        raise ArtifactError(
            f"{path}: no {name} in it", remedy="is it an artifact of this project? ('rover inspect' says what)"
        )
    return records[0]


def _manifest_in(z: zipfile.ZipFile, path: Path | str) -> dict[str, Any]:
    record = _record(z, "manifest.json", path)
    try:
        manifest = json.loads(z.read(record))
    except (ValueError, zipfile.BadZipFile) as e:
        raise ArtifactError(f"{path}: its manifest is not readable ({e})", remedy="copy the file again") from None
    check_manifest(manifest, str(path))
    return manifest
