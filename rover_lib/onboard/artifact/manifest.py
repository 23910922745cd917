"""The artifact: one zip with a policy for an engine (see engines.py), its manifest and its parity vectors.

Beside the records of the policy itself, TorchScript's, model.onnx or network.hef, it contains `extra/manifest.json`
(what the artifact is, see MANIFEST_KEYS) and `extra/parity.npz` (inputs, and the chunks that they must give). It
contains no pickled Python objects, and reading it needs no lerobot.
"""

import hashlib
import io
import json
import math
import re
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rover_lib.onboard.artifact.archive import MANIFEST, ONNX, PARITY, kind_of, open_archive, read_record, refused
from rover_lib.onboard.artifact.engines import HAILO, ONNXRUNTIME
from rover_lib.onboard.artifact.onnx_file import check_model
from rover_lib.onboard.artifact.torchscript import check_program
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.errors import ArtifactError, CarError
from rover_lib.onboard.stage import atomic_path

if TYPE_CHECKING:  # reading a manifest needs neither
    import numpy as np
    import torch

SCHEMA = 1
ONNX_SUFFIX = ".onnx.zip"  # of artifacts for ONNX Runtime, as .pt is of torch's; readers go by the content instead
MANGLED = re.compile(rb"___torch_mangle_\d+")
MANIFEST_KEYS: dict[str, type | tuple[type, ...]] = {
    "schema": int,
    "mode": str,  # one of MODES
    "scheme": str,  # one of SCHEMES
    "engine": str,  # see engines.py
    "cameras": list,  # [{name, height, width}], in the graph's order, and recorded, see seen_size
    "state_names": list,
    "action_names": list,
    "chunk": int,  # actions per inference
    "rate_hz": (int, float),  # actions per second
    "normalisation": str,  # where it happens
    "checkpoint": dict,  # {sha256, format}
    "calibration": (dict, type(None)),  # {samples, observer, ...}
    "weights_mb": (int, float),
    "gmac": (int, float),  # multiply-accumulates of one inference, in 1e9
    "parity": dict,  # {tolerance: {action: largest difference}, reason}
    "versions": dict,  # {torch, rover_lib}, and for ONNX Runtime also {onnx, onnxruntime}
}
MODES = ("fp32", "dynamic", "static", "mixed")
SCHEMES = ("float", "dynamic", "symmetric", "affine")
# What the reader accepts, whatever a manifest says; both ends included
SIDE_PX, CHUNK, RATE_HZ = (16, 8192), (1, 256), (5.0, 120.0)
WEIGHTS_MB, GMAC = (0.0, 1000.0), (0.0, 1000.0)
MOST_NAMES, NAME_LENGTH, MOST_DEPTH = 64, 64, 8
MOST_VECTORS = 16
# How far a car's actions may differ from the parity vectors. FP32 policies differ by the order of sums, INT8 ones by
# flipped roundings: by at most 0.13 with random weights and 0.03 with trained ones, as far as we have seen.
LARGEST_TOLERANCE = {"fp32": 1e-3, "int8": 0.3}
CAR_ACTIONS = ("steering", "throttle")


def save_artifact(
    path: Path | str, module: "torch.jit.ScriptModule", manifest: dict[str, Any], parity: "dict[str, np.ndarray]"
) -> str:
    """Write an artifact for torch atomically, and return its content hash.

    parity: `state` (n, S) float32, `frame_<camera>` (n, height, width, 3) uint8 RGB, `chunk` (n, C, A) float32.
    Raises ArtifactError like check_manifest().
    """
    import torch

    # Through a buffer, because torch.jit.save would name the zip's folder after the temporary file.
    buffer = io.BytesIO()
    torch.jit.save(module, buffer, _extra_files=_extra(path, manifest, parity))
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
    return content_hash(path)


def save_onnx(path: Path | str, model: bytes, manifest: dict[str, Any], parity: "dict[str, np.ndarray]") -> str:
    """Write an artifact for ONNX Runtime, as save_artifact() does for torch. model: the bytes of an ONNX model."""
    records = {f"archive/extra/{name}": content for name, content in _extra(path, manifest, parity).items()}
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as z:
        for name, content in {ONNX: model, **records}.items():
            z.writestr(zipfile.ZipInfo(name), content)  # dated 1980, so that the same inputs give the same bytes
    return content_hash(path)


def _extra(path: Path | str, manifest: dict[str, Any], parity: "dict[str, np.ndarray]") -> dict[str, str | bytes]:
    import numpy as np

    check_manifest(manifest, str(path))
    vectors = io.BytesIO()
    np.savez_compressed(vectors, allow_pickle=False, **parity)
    return {"manifest.json": json.dumps(manifest, sort_keys=True, indent=1), "parity.npz": vectors.getvalue()}


def car_of(manifest: dict[str, Any]) -> Car:
    """Return the car whose recordings an artifact was calibrated with, from its manifest; Car() if that names none.

    Raises ArtifactError if the manifest's description is not one of a car.
    """
    if "car" not in manifest:
        return Car()
    try:
        return Car.of(manifest["car"], "the artifact's car")
    except CarError as error:
        raise ArtifactError(str(error), remedy="export it again") from None


class Artifact:
    """An artifact that is opened once, and carries on what was read of it and checked.

        with Artifact("policy_static.pt") as artifact:
            artifact.prove()

    path: of the file. All its methods raise ArtifactError.
    """

    def __init__(self, path: Path | str):
        """Open the file and check its directory, as open_archive() does."""
        self.path = Path(path)
        self._z = open_archive(path)
        self._proven = False

    def __enter__(self) -> "Artifact":
        return self

    def __exit__(self, *exc: object) -> None:
        self._z.close()

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """What the artifact is, checked (see MANIFEST_KEYS). Nothing is run or even loaded for it."""
        return _manifest_in(self._z, self.path)

    @cached_property
    def content_hash(self) -> str:
        """The hex SHA-256 of everything in the artifact that has an effect: the same inputs give the same hash.

        The bytes of the file may differ, because TorchScript also writes debug tables (source positions), a serial
        number, and in the class's name a counter of all classes that the process ever made. Reading each record for it
        also checks the record's checksum.
        """
        digest = hashlib.sha256()
        code = (r for r in self._z.infolist() if r.filename.startswith("archive/code/") and r.filename.endswith(".py"))
        programs = [r.filename for r in code if r.file_size]
        module = programs[0][13:-3].replace("/", ".").encode() if len(programs) == 1 else b""
        for name in sorted(self.names):
            record = self.record(name)
            if name.endswith((".debug_pkl", "/.data/serialization_id")):
                continue
            if name in ("archive/data.pkl", *programs):  # each names the class once; all other names there are kept
                record = record.replace(module, MANGLED.sub(b"", module), 1)
            digest.update((MANGLED.sub(b"", name.encode()) if name in programs else name.encode()) + b"\0")
            digest.update(hashlib.sha256(record).digest())
        return digest.hexdigest()

    @cached_property
    def parity(self) -> "dict[str, np.ndarray]":
        """The parity vectors, as save_artifact() takes them, of the shapes that the manifest says."""
        return _parity_in(self._z, self.path, self.manifest)

    @property
    def names(self) -> list[str]:
        """The names of its records."""
        return self._z.namelist()

    @property
    def kind(self) -> str:
        """The engine that its policy is for, by the records: torch, onnxruntime or hailo."""
        return kind_of(self._z.infolist())

    def record(self, name: str) -> bytes:
        """Read one record, whose checksum must match."""
        try:
            return read_record(self._z, name)
        # RuntimeError, its subclasses too: a damaged header may ask for a password, or for an unknown compression
        except (zipfile.BadZipFile, OSError, RuntimeError, zlib.error) as e:
            what = f"the checksum of '{name}' does not match" if "Bad CRC-32" in str(e) else str(e)
            raise ArtifactError(f"{self.path}: damaged, {what}", remedy="copy the file again") from None

    def prove(self) -> None:
        """Prove that no byte changed since the artifact was written, and that it has nothing that no artifact has.

        TorchScript itself checks neither. Nothing in the artifact is run. A second call does nothing.
        """
        if self._proven:
            return
        _ = self.content_hash  # which reads every byte
        if self.kind == "onnxruntime":
            check_model(self._z, self.path)
        elif self.kind == "torch":  # only HailoRT and the chip can read a HEF
            check_program(self._z, self.path)
        self._proven = True


def content_hash(path: Path | str) -> str:
    """Return Artifact.content_hash of a file. Raises ArtifactError."""
    with Artifact(path) as artifact:
        return artifact.content_hash


def read_manifest(path: Path | str) -> dict[str, Any]:
    """Return Artifact.manifest of a file. Raises ArtifactError."""
    with Artifact(path) as artifact:
        return artifact.manifest


def check_manifest(manifest: Any, where: str) -> None:
    """Raise ArtifactError, naming the key, if the manifest has another schema or an impossible value."""

    def wrong(what: str, found: object = None, length: int = 60) -> ArtifactError:
        return refused(where, what, None if found is None else repr(found)[:length])

    if not isinstance(manifest, dict):
        raise wrong(f"its manifest is no JSON object but a {type(manifest).__name__}")
    _check_values(manifest, where, MOST_DEPTH)
    if manifest.get("schema") != SCHEMA:
        raise ArtifactError(
            f"{where}: manifest schema {manifest.get('schema')!r}, this rover_lib reads {SCHEMA}",
            remedy="use the rover_lib that wrote it, or quantize again",
        )
    for key, kind in MANIFEST_KEYS.items():
        if not isinstance(manifest.get(key), kind):
            value = repr(manifest[key])[:60] if key in manifest else "nothing"
            raise wrong(f"manifest key '{key}' is {value}, not what it should be")
    for key, known in (("mode", MODES), ("scheme", SCHEMES)):
        if manifest[key] not in known:
            raise wrong(f"manifest {key} must be one of {', '.join(known)}", manifest[key])
    car_of(manifest)
    if not manifest["cameras"]:
        raise wrong("manifest has no cameras")
    for camera in manifest["cameras"]:
        recorded = camera.get("recorded", [1, 1]) if isinstance(camera, dict) else None
        pair = isinstance(recorded, list) and len(recorded) == 2
        if not isinstance(camera, dict) or not pair or not {"name", "height", "width"} <= camera.keys():
            raise wrong(f"manifest camera {str(camera)[:80]!r} lacks name, height or width")
        sides = [camera["height"], camera["width"], *camera.get("recorded", ())]
        if not is_name(camera["name"]) or not all(is_whole(s, *SIDE_PX) for s in sides):
            raise wrong(f"manifest camera {str(camera)[:80]!r} is not a name and a size")
    numbers = {"chunk": CHUNK, "rate_hz": RATE_HZ, "weights_mb": WEIGHTS_MB, "gmac": GMAC}
    for key, limits in numbers.items():
        if not (is_whole if key == "chunk" else is_number)(manifest[key], *limits):
            raise wrong(f"manifest {key} must be from {limits[0]:g} to {limits[1]:g}", manifest[key])
    for key in ("state_names", "action_names", "cameras"):
        names = [c["name"] for c in manifest[key]] if key == "cameras" else manifest[key]
        if not 1 <= len(names) <= MOST_NAMES or not all(map(is_name, names)) or len(set(names)) != len(names):
            raise wrong(f"manifest {key} must be names, each once", names, 80)
    tolerance = manifest["parity"].get("tolerance")
    if not isinstance(tolerance, dict) or set(tolerance) != set(manifest["action_names"]):
        raise wrong(f"manifest parity tolerance {str(tolerance)[:80]!r} does not cover its actions")
    for name, value in tolerance.items():
        most = largest_tolerance(manifest["mode"], name)
        if not is_number(value, 0, most):
            raise wrong(f"manifest parity tolerance of {name} must be from 0 to {most:g}", value)


def seen_size(manifest: Mapping[str, Any]) -> tuple[int, int]:
    """Return (width, height) of the pictures that a policy's first camera gave.

    That is the policy's own size unless its recordings have another shape, which then is the camera's `recorded`:
    [height, width].
    """
    camera = manifest["cameras"][0]
    height, width = camera.get("recorded", (camera["height"], camera["width"]))
    return width, height


def largest_tolerance(mode: str, action: str) -> float:
    """Return the largest parity tolerance that a manifest may have for an action; infinity if it moves no servo."""
    return LARGEST_TOLERANCE["fp32" if mode == "fp32" else "int8"] if action in CAR_ACTIONS else math.inf


def _check_values(value: Any, where: str, depth: int) -> None:
    """Raise ArtifactError for values that are nested more than `depth` deep, and for text with unprintable characters.

    Such characters could control the terminal: a manifest's values appear in sentences, and some stay in a release.
    """
    if isinstance(value, str) and not value.isprintable():
        raise refused(where, "its manifest holds text that cannot be printed", ascii(value)[:60])
    inner = [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else []
    if inner and not depth:
        raise refused(where, f"its manifest is nested more than {MOST_DEPTH} deep")
    for each in inner:
        _check_values(each, where, depth - 1)


def is_name(value: Any) -> bool:
    """Whether a manifest may give this name to a camera, a state or an action."""
    return isinstance(value, str) and 0 < len(value) <= NAME_LENGTH and "/" not in value


def distinct_names(paths: Sequence[Path], drop: str = "") -> dict[str, Path]:
    """Give each artifact the shortest name that no other has: its stem, with as many of its folders as that needs.

    drop: a prefix of stems that says nothing, such as "policy_". Raises ArtifactError for a file given twice.
    """
    longest = max((len(path.absolute().parts) for path in paths), default=0)
    names: dict[str, Path] = {}
    for path in paths:
        if any(path.resolve() == other.resolve() for other in names.values()):
            raise ArtifactError(f"{path}: given twice", remedy="name each file once")
        name = str(path)  # if two files of one folder differ only in what a name leaves out
        for folders in range(longest):
            candidate = _name(path, folders, drop)
            if [_name(other, folders, drop) for other in paths].count(candidate) == 1:
                name = candidate
                break
        names[name] = path
    return names


def _name(path: Path, folders: int, drop: str) -> str:
    """Return the stem of a path, preceded by the last `folders` of its folders."""
    parents = path.absolute().parts[1:-1]
    return "/".join([*parents[max(0, len(parents) - folders) :], path.stem.removeprefix(drop)])


def _manifest_in(z: zipfile.ZipFile, path: Path | str) -> dict[str, Any]:
    try:
        manifest = json.loads(read_record(z, MANIFEST))
    except (ValueError, zipfile.BadZipFile, RecursionError) as e:
        raise ArtifactError(f"{path}: its manifest is not readable ({e})", remedy="copy the file again") from None
    check_manifest(manifest, str(path))
    kind = manifest["engine"] if manifest["engine"] in (ONNXRUNTIME, HAILO) else "torch"
    if kind != kind_of(z.infolist()):
        raise refused(path, "its manifest names another engine than its policy is for", manifest["engine"][:60])
    return manifest


def _parity_in(z: zipfile.ZipFile, path: Path, manifest: dict[str, Any]) -> "dict[str, np.ndarray]":
    import numpy as np

    wanted: dict[str, tuple[str, tuple[int, ...]]] = {
        "state": ("float32", (len(manifest["state_names"]),)),
        "chunk": ("float32", (manifest["chunk"], len(manifest["action_names"]))),
    } | {f"frame_{c['name']}": ("uint8", (c["height"], c["width"], 3)) for c in manifest["cameras"]}
    vectors = {}
    try:
        with zipfile.ZipFile(io.BytesIO(read_record(z, PARITY))) as packed:
            for name, (dtype, shape) in wanted.items():
                size = packed.getinfo(f"{name}.npy").file_size
                if size > MOST_VECTORS * math.prod(shape) * np.dtype(dtype).itemsize + 200:
                    raise refused(path, "its parity vectors are too large")
                raw = io.BytesIO(read_record(packed, f"{name}.npy"))
                if np.lib.format.read_magic(raw) != (1, 0):
                    raise ValueError("another version of numpy's format")
                found, _, kind = np.lib.format.read_array_header_1_0(raw)
                if found[1:] != shape or not 1 <= found[0] <= MOST_VECTORS or kind != dtype:
                    what = "its parity vectors have another shape than its manifest says"
                    raise refused(path, what, f"{name} of {kind} {found}")
                raw.seek(0)
                vectors[name] = np.load(raw, allow_pickle=False)
    except (KeyError, ValueError, OSError, zipfile.BadZipFile, zlib.error, RuntimeError) as e:
        raise refused(path, f"its parity vectors are not readable ({e})") from None
    if len({len(v) for v in vectors.values()}) != 1 or not all(np.isfinite(v).all() for v in vectors.values()):
        raise refused(path, "its parity vectors do not belong together")
    return vectors
