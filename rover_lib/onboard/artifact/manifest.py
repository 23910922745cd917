"""The artifact: one zip with a policy for an engine, its manifest and its parity vectors.

Beside the policy's own records it contains `extra/manifest.json` (see RULES) and `extra/parity.npz` (inputs, and the
chunks that they must give), and no pickled Python objects. A policy that tells how unfamiliar a picture is has
"familiar" in its manifest, an embedding beside each chunk, and the arrays of policy/familiar.py beside its vectors.
"""

import hashlib
import io
import json
import math
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rover_lib.onboard.artifact.archive import MANIFEST, ONNX, PARITY, kind_of, open_archive, read_record, refused
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.checked import Rule, broken_rule, is_number, is_whole, number, of_type, one_of, whole
from rover_lib.onboard.errors import ArtifactError, CarError
from rover_lib.onboard.stage import atomic_path

if TYPE_CHECKING:  # only who writes an artifact needs it
    import torch

Vectors = dict[str, np.ndarray]  # state, chunk, and frame_<camera>: see save_artifact
SCHEMA = 1
TORCH, ONNXRUNTIME = "qnnpack", "onnxruntime"  # the engines that run artifacts
PACKAGES = {TORCH: "torch", ONNXRUNTIME: "onnxruntime"}  # the package each engine needs
ONNX_SUFFIX = ".onnx.zip"  # of artifacts for ONNX Runtime, as .pt is of torch's; readers go by the content instead
MANGLED = re.compile(rb"___torch_mangle_\d+")
MODES = ("fp32", "dynamic", "static", "mixed")
SCHEMES = ("float", "dynamic", "symmetric", "affine")
# What the reader accepts, whatever a manifest says; both ends included
SIDE_PX, CHUNK, RATE_HZ = (16, 8192), (1, 256), (1.0, 120.0)
WEIGHTS_MB, GMAC = (0.0, 1000.0), (0.0, 1000.0)
MOST_NAMES, NAME_LENGTH = 64, 64
MOST_VECTORS = 16
# How far a car's actions may differ from the parity vectors: FP32 by the order of sums, INT8 by flipped roundings, so
# far by at most 0.13 with random weights and 0.03 with trained ones.
LARGEST_TOLERANCE = {"fp32": 1e-3, "int8": 0.3}
CAR_ACTIONS = ("steering", "throttle")
MOST_SIZE = 4096  # of an embedding
DIVISORS = ("familiar_spread", "familiar_limits")  # with a negative one nothing would be unfamiliar


def _are_names(values: Any) -> bool:
    """Whether a manifest may give these names to cameras, states or actions."""
    words = isinstance(values, list) and all(isinstance(value, str) and "/" not in value for value in values)
    short = words and all(0 < len(value) <= NAME_LENGTH for value in values)
    return short and 1 <= len(values) <= MOST_NAMES and len(set(values)) == len(values)


def _are_cameras(cameras: Any) -> bool:
    if not isinstance(cameras, list) or not all(isinstance(c, dict) for c in cameras):
        return False
    sizes = [size for c in cameras for size in ([c.get("height"), c.get("width")], c.get("recorded", [99, 99]))]
    are_sizes = all(isinstance(s, list) and len(s) == 2 and all(is_whole(n, *SIDE_PX) for n in s) for s in sizes)
    return are_sizes and _are_names([c.get("name") for c in cameras])


def _is_familiar(value: Any) -> bool:
    sizes = ("directions", "size", "drives")
    return isinstance(value, dict) and all(is_whole(value.get(name), 1, MOST_SIZE) for name in sizes)


_NAMES = Rule(_are_names, f"1 to {MOST_NAMES} different names")
RULES = {
    "schema": Rule(lambda value: value == SCHEMA, f"{SCHEMA} for this rover_lib"),
    "mode": one_of(MODES),
    "scheme": one_of(SCHEMES),
    "engine": of_type(str),  # of PACKAGES
    # [{name, height, width}], in the graph's order, and recorded, see seen_size
    "cameras": Rule(_are_cameras, f"a name, and a height and width in {SIDE_PX} pixels, of each camera"),
    "state_names": _NAMES,
    "action_names": _NAMES,
    "chunk": whole(*CHUNK),  # actions per inference
    "rate_hz": number(*RATE_HZ),  # actions per second
    "normalisation": of_type(str),  # where it happens
    "checkpoint": of_type(dict),  # {sha256, format}
    "calibration": of_type(dict, type(None)),  # {samples, observer, ...}
    "weights_mb": number(*WEIGHTS_MB),
    "gmac": number(*GMAC),  # multiply-accumulates of one inference, in 1e9
    "parity": of_type(dict),  # {tolerance: {action: largest difference}, reason}
    "versions": of_type(dict),  # {torch, rover_lib}, and for ONNX Runtime also {onnx, onnxruntime}
}
# "familiar", if it is there: {size, directions, drives}, see shapes_of_familiar and workshop/int8/familiar.py


def save_artifact(path: Path | str, module: "torch.jit.ScriptModule", manifest: dict[str, Any], parity: Vectors) -> str:
    """Write an artifact for torch atomically, and return its content hash. Raises ArtifactError like check_manifest().

    parity: `state` (n, S) float32, `frame_<camera>` (n, height, width, 3) uint8 RGB, `chunk` (n, C, A) float32.
    """
    import torch

    # Through a buffer, because torch.jit.save would name the zip's folder after the temporary file.
    buffer = io.BytesIO()
    torch.jit.save(module, buffer, _extra_files=_extra(path, manifest, parity))
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
    return content_hash(path)


def save_onnx(path: Path | str, model: bytes, manifest: dict[str, Any], parity: Vectors) -> str:
    """Write an artifact for ONNX Runtime, as save_artifact() does for torch. model: the bytes of an ONNX model."""
    records = {f"archive/extra/{name}": content for name, content in _extra(path, manifest, parity).items()}
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as z:
        for name, content in {ONNX: model, **records}.items():
            z.writestr(zipfile.ZipInfo(name), content)  # dated 1980, so that the same inputs give the same bytes
    return content_hash(path)


def _extra(path: Path | str, manifest: dict[str, Any], parity: Vectors) -> dict[str, str | bytes]:
    check_manifest(manifest, str(path))
    vectors = io.BytesIO()
    np.savez_compressed(vectors, allow_pickle=False, **parity)
    return {"manifest.json": json.dumps(manifest, sort_keys=True, indent=1), "parity.npz": vectors.getvalue()}


def car_of(manifest: dict[str, Any]) -> Car:
    """Return the manifest's car, Car() if it names none. Raises ArtifactError for a description that is none."""
    try:
        return Car.of(manifest["car"], "the artifact's car") if "car" in manifest else Car()
    except CarError as error:
        raise ArtifactError(str(error), remedy="export it again") from None


class Artifact(AbstractContextManager["Artifact"]):
    """An artifact that is opened once, and carries on what was read of it and checked. All raise ArtifactError.

    with Artifact("policy_static.pt") as artifact:
        artifact.prove()
    """

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self._z = open_archive(path)

    def __exit__(self, *exc: object) -> None:
        self._z.close()

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """What the artifact is, checked (see RULES). Nothing is run or even loaded for it."""
        try:
            manifest = json.loads(read_record(self._z, MANIFEST))
            check_manifest(manifest, str(self.path))
        except (ValueError, zipfile.BadZipFile, RecursionError) as e:
            raise refused(self.path, f"its manifest is not readable ({e})") from None
        kind = ONNXRUNTIME if manifest["engine"] == ONNXRUNTIME else "torch"
        if kind != self.kind:
            raise refused(self.path, "its manifest names another engine than its policy's", manifest["engine"][:60])
        return manifest

    @cached_property
    def content_hash(self) -> str:
        """The hex SHA-256 of everything that has an effect; reading each record also checks its checksum.

        Left out are TorchScript's debug tables, its serial number, and the counter in its class's name.
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
            encoded = name.encode()
            if name in programs:
                encoded = MANGLED.sub(b"", encoded)
            digest.update(encoded + b"\0")
            digest.update(hashlib.sha256(record).digest())
        return digest.hexdigest()

    @cached_property
    def parity(self) -> Vectors:
        """The parity vectors, as save_artifact() takes them, of the shapes that the manifest says."""
        expected: dict[str, tuple[str, tuple[int, ...]]] = {
            "state": ("float32", (len(self.manifest["state_names"]),)),
            "chunk": ("float32", (self.manifest["chunk"], len(self.manifest["action_names"]))),
        } | {f"frame_{c['name']}": ("uint8", (c["height"], c["width"], 3)) for c in self.manifest["cameras"]}
        fixed = shapes_of_familiar(self.manifest)
        if fixed:
            expected["embedding"] = ("float32", fixed["familiar_mean"])
        expected |= {name: ("float32", shape) for name, shape in fixed.items()}
        limit = MOST_VECTORS * sum(math.prod(shape) * np.dtype(dtype).itemsize for dtype, shape in expected.values())
        try:
            with np.lib.npyio.NpzFile(io.BytesIO(read_record(self._z, PARITY)), allow_pickle=False) as packed:
                if sum(record.file_size for record in packed.zip.infolist()) > limit + 1000 * len(expected):
                    raise refused(self.path, "its parity vectors are too large")
                vectors = {name: np.asarray(packed[name]) for name in expected}
        except (KeyError, ValueError, OSError, MemoryError, zipfile.BadZipFile, zlib.error, RuntimeError) as e:
            raise refused(self.path, f"its parity vectors are not readable ({e})") from None
        for name, (dtype, shape) in expected.items():
            vector = vectors[name]
            if name not in fixed:
                shape = (len(vectors["state"]), *shape)
            if vector.dtype != dtype or vector.shape != shape or not len(vector):
                raise refused(self.path, f"its parity vector {name} has another shape than its manifest says")
            if not np.isfinite(vector).all():
                raise refused(self.path, "its parity vectors are not finite", name)
            if name in DIVISORS and not (vector > 0).all():
                raise refused(self.path, f"its {name} must be above 0", f"{vector.min():g}")
        return vectors

    @property
    def names(self) -> list[str]:
        return self._z.namelist()

    @property
    def kind(self) -> str:
        """The engine that its policy is for, by the records: torch or onnxruntime."""
        return kind_of(self._z.infolist())

    def record(self, name: str) -> bytes:
        """Read one record, whose checksum must match."""
        try:
            return read_record(self._z, name)
        # RuntimeError, its subclasses too: a damaged header may ask for a password, or for an unknown compression
        except (zipfile.BadZipFile, OSError, RuntimeError, zlib.error) as e:
            problem = f"the checksum of '{name}' does not match" if "Bad CRC-32" in str(e) else str(e)
            raise ArtifactError(f"{self.path}: damaged, {problem}", remedy="copy the file again") from None

    def prove(self) -> None:
        """Prove that no byte changed since the artifact was written. Nothing in it is run."""
        _ = self.content_hash  # which reads every byte, once


def content_hash(path: Path | str) -> str:
    """Return Artifact.content_hash of a file."""
    with Artifact(path) as artifact:
        return artifact.content_hash


def read_manifest(path: Path | str) -> dict[str, Any]:
    """Return Artifact.manifest of a file. Raises ArtifactError."""
    with Artifact(path) as artifact:
        return artifact.manifest


def check_manifest(manifest: Any, where: str) -> None:
    """Raise ArtifactError, naming the key, if the manifest has another schema or an impossible value."""
    if not isinstance(manifest, dict):
        raise refused(where, "its manifest is not a JSON object", type(manifest).__name__)
    if text := next((text for text in _texts(manifest) if not text.isprintable()), None):  # it might reach a terminal
        raise refused(where, "its manifest contains unprintable text", ascii(text)[:60])
    if broken := broken_rule(manifest, RULES):
        raise refused(where, f"manifest {broken[0]} must be {broken[1]}", broken[2])
    if "familiar" in manifest and not _is_familiar(manifest["familiar"]):
        problem = f"manifest familiar must have its sizes, 1 to {MOST_SIZE}"
        raise refused(where, problem, repr(manifest["familiar"])[:80])
    car_of(manifest)
    tolerance = manifest["parity"].get("tolerance")
    if not isinstance(tolerance, dict) or set(tolerance) != set(manifest["action_names"]):
        raise refused(where, "manifest parity tolerance does not cover its actions", repr(tolerance)[:80])
    for name, value in tolerance.items():
        limit = largest_tolerance(manifest["mode"], name)
        if not is_number(value, 0, limit):
            raise refused(where, f"manifest parity tolerance of {name} must be from 0 to {limit:g}", repr(value)[:80])


def seen_size(manifest: Mapping[str, Any]) -> tuple[int, int]:
    """Return (width, height) of what a policy's first camera gave: the policy's own size, or the one `recorded`."""
    camera = manifest["cameras"][0]
    height, width = camera.get("recorded", (camera["height"], camera["width"]))
    return width, height


def shapes_of_familiar(manifest: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays that tell what is familiar, by their names in parity.npz; none without them."""
    if not (familiar := manifest.get("familiar")):
        return {}
    size = familiar["size"]
    directions = familiar["directions"]
    return {
        "familiar_mean": (size,),
        "familiar_directions": (directions, size),
        "familiar_spread": (directions,),
        "familiar_limits": (2,),
    }


def largest_tolerance(mode: str, action: str) -> float:
    """Return the largest parity tolerance that a manifest may have for an action; infinity if it moves no servo."""
    if action not in CAR_ACTIONS:
        return math.inf
    return LARGEST_TOLERANCE["fp32" if mode == "fp32" else "int8"]


def _texts(value: Any) -> Iterator[str]:
    """Yield every text in a value of JSON."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for entry in [*value, *value.values()] if isinstance(value, dict) else value:
            yield from _texts(entry)
