"""The zip file around an artifact: a limited number of records, each with a known name and a bounded size.

It holds a program for torch (TorchScript's own records), or for ONNX Runtime (an ordinary .onnx).
"""

import os
import re
import struct
import zipfile
from pathlib import Path
from typing import BinaryIO

from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.stage import open_plain

# Limits, each several times what a policy of full size needs, whose artifact in FP32 has 266 MB
ARCHIVE_BYTES, DIRECTORY_BYTES, RECORDS = 1_000_000_000, 1_000_000, 5000
CODE_BYTES, DEBUG_BYTES, PICKLE_BYTES = 250_000, 2_000_000, 1_000_000
MANIFEST_BYTES, PARITY_BYTES = 100_000, 50_000_000
ABOUT = frozenset({"extra/manifest.json", "extra/parity.npz"})
REQUIRED = {"torch": ABOUT | {"data.pkl", "constants.pkl", "version"}, "onnxruntime": ABOUT | {"model.onnx"}}
MANIFEST, PARITY, ONNX = "archive/extra/manifest.json", "archive/extra/parity.npz", "archive/model.onnx"
RECORD_BYTES = {  # largest size by name after "archive/"
    r"version|byteorder|\.data/serialization_id": 100,
    r"(data|constants)\.pkl": PICKLE_BYTES,
    r"extra/manifest\.json": MANIFEST_BYTES,
    r"extra/parity\.npz": PARITY_BYTES,
    r"code/__torch__/[\w/]+\.py": CODE_BYTES,
    r"code/__torch__/[\w/]+\.py\.debug_pkl": DEBUG_BYTES,
    r"constants/\d{1,6}|model\.onnx": ARCHIVE_BYTES,
}


def refused(path: Path | str, what: str, found: object = None) -> ArtifactError:
    """The error of a file that no exporter of ours wrote, for the caller to raise."""
    return ArtifactError(f"{path}: {what}", found=found, remedy="quantize again")


def open_archive(path: Path | str) -> zipfile.ZipFile:
    """Open an artifact, after checking number, names and sizes of its records in its headers. Raises ArtifactError."""
    try:
        with open_plain(path, ArtifactError(f"{path}: not a file", remedy="give a policy_*.pt")) as file:
            _check_directory(file, path)
        z = zipfile.ZipFile(path)
        try:
            _check_records(z.infolist(), path)
        except BaseException:
            z.close()
            raise
    except FileNotFoundError:
        raise ArtifactError(f"{path}: not found", remedy="'rover run' writes artifacts to runs/<name>/") from None
    # NotImplementedError: from zipfile, for an unknown version of the format
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as e:
        raise ArtifactError(f"{path}: not an artifact, or cut short ({e})", remedy="copy the file again") from None
    return z


def read_record(z: zipfile.ZipFile, name: str) -> bytes:
    """Return a record's bytes, and never unpack more than its header announces. Raises like zipfile."""
    with z.open(name) as record:
        return record.read(z.getinfo(name).file_size)


def kind_of(records: list[zipfile.ZipInfo]) -> str:
    """Return the engine that an archive's policy is for: torch or onnxruntime."""
    names = {record.filename for record in records}
    return "onnxruntime" if ONNX in names else "torch"


def _check_directory(file: BinaryIO, path: Path | str) -> None:
    """Raise an error unless the file is one zip archive from first byte to last, so that all readers see the same."""
    if file.read(4) != b"PK\3\4":
        raise zipfile.BadZipFile("it does not begin as an archive")
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - 98))
    tail = file.read()
    end = tail[-22:]
    locator = tail[-42:-22]
    end64 = tail[:-42]
    if end[:4] != b"PK\5\6" or end[20:] != b"\0\0":
        raise zipfile.BadZipFile("it does not end as an archive")
    records, length, start = struct.unpack("<10xHII2x", end)
    after = 22
    if locator[:4] == b"PK\6\7":  # torch also writes the larger form of this end, zip64
        if end64[:4] != b"PK\6\6" or struct.unpack("<4xIQI", locator)[1] != size - 98:
            raise zipfile.BadZipFile("its end is not where it says")
        records, length, start = struct.unpack("<32xQQQ", end64)
        after = 98
    if start + length + after != size:
        raise zipfile.BadZipFile("its directory is not where it says")
    if records > RECORDS or length > DIRECTORY_BYTES:
        raise refused(path, f"{records} records are more than an artifact has")
    file.seek(0)


def _check_records(records: list[zipfile.ZipInfo], path: Path | str) -> None:
    names = set()
    total = 0
    for record in records:
        name = record.filename.removeprefix("archive/")
        if name == ".data/version":  # torch moves it there if the program has an operator that changed, as gelu did
            name = "version"
        limits = [limit for pattern, limit in RECORD_BYTES.items() if re.fullmatch(pattern, name, re.ASCII)]
        if not limits or not record.filename.startswith("archive/"):
            raise refused(path, "unknown record", repr(record.filename)[:80])
        if name.lower() in names:  # torch ignores case in names
            raise refused(path, f"'{name}' is in it twice")
        if record.file_size > limits[0]:
            raise refused(path, f"'{name}' unpacks to {record.file_size} bytes, at most {limits[0]} are taken")
        packed = record.compress_type == zipfile.ZIP_DEFLATED and name.startswith("code/")
        if not packed and (record.compress_type != zipfile.ZIP_STORED or record.compress_size != record.file_size):
            raise refused(path, f"'{name}' is compressed, only code may be")
        names.add(name.lower())
        total += record.file_size
    if total > ARCHIVE_BYTES:
        raise refused(path, f"{total} bytes are more than an artifact has")
    kind = kind_of(records)
    if kind != "torch" and names - REQUIRED[kind]:
        raise refused(path, "it is a policy for two engines")
    for name in sorted(REQUIRED[kind] - names):
        raise ArtifactError(f"{path}: no {name.removeprefix('extra/')} in it", remedy="give a policy_*.pt of a run")
