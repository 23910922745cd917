"""Artifacts that somebody made to do harm: the archive is checked before use, and its program only runs confined."""

import os
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rover_lib.onboard import load_policy
from rover_lib.onboard.artifact.archive import ONNX
from rover_lib.onboard.artifact.manifest import Artifact, content_hash
from rover_lib.onboard.care.benchmark import peak_memory_alone_mb
from rover_lib.onboard.drive.inference import PolicyProcess
from rover_lib.onboard.errors import ArtifactError
from tests.helpers.archives import manifest_with, rewritten, vectors_with

HARM = "harm"  # the file that a hostile program writes into the working folder


def refused(path: Path, message: str) -> None:
    with pytest.raises(ArtifactError, match=message) as error, Artifact(path) as artifact:
        artifact.prove()
        _ = artifact.manifest, artifact.parity
    assert "\n" not in str(error.value)


def hostile(artifacts, folder: Path, change=None, add=None) -> Path:
    return rewritten(artifacts["fp32"], folder / "hostile.pt", change or {}, add)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_no_other_record_is_accepted_and_none_twice(artifacts, tmp_path):
    for name in ("archive/../../harm", "/harm", "archive/code/__torch__/../x.py", "other/data.pkl"):
        refused(hostile(artifacts, tmp_path, add={name: b"harm"}), "unknown record")
    for name in ("data.pkl", "constants.pkl"):
        refused(hostile(artifacts, tmp_path, add={f"archive/{name}": b"harm"}), "twice")
    refused(hostile(artifacts, tmp_path, {"manifest.json": lambda raw: None}), "no manifest.json")
    refused(rewritten(artifacts["static"], tmp_path / "two.pt", {}, {ONNX: b"x"}), "two engines")


def test_two_readers_see_one_archive(artifacts, tmp_path):
    path = hostile(artifacts, tmp_path)
    raw = path.read_bytes()
    changed = {"end": raw + b"harm", "directory": raw[:4] + bytes(4096) + raw[4:], "begin": b"\0\0\0\0PTMF" + raw}
    for message, content in changed.items():
        path.write_bytes(content)
        refused(path, message)
    for content in (raw[: len(raw) // 2], b""):
        path.write_bytes(content)
        refused(path, "not an artifact, or cut short")
    path.unlink()
    os.mkfifo(path)
    refused(path, "not a")


@pytest.mark.parametrize("name", ["extra/manifest.json", ".py"])
def test_a_bomb_is_known_by_its_header(artifacts, tmp_path, name):
    size = 33_558_911  # in no other header
    path = hostile(artifacts, tmp_path, {name: lambda raw: None})
    with zipfile.ZipFile(artifacts["fp32"]) as z, zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as new:
        new.writestr(next(n for n in z.namelist() if n.endswith(name)), bytes(size))
    refused(path, f"unpacks to {size} bytes")
    path.write_bytes(path.read_bytes().replace(struct.pack("<I", size), struct.pack("<I", 9000)))  # a header that lies
    refused(path, "is compressed" if "manifest" in name else "damaged")


CAMERA = {"name": "cam_front", "height": 72, "width": 128}
MANIFESTS = [
    ({"schema": 2}, "schema"),
    ({"gmac": ...}, "gmac"),
    ({"rate_hz": True}, "rate_hz"),
    ({"cameras": [CAMERA | {"height": 72_000}]}, "cameras"),
    ({"cameras": [CAMERA] * 2}, "cameras"),
    ({"cameras": [CAMERA | {"width": 256}]}, "another shape"),
    ({"state_names": ["steering\x1b[2J", "throttle"]}, "unprintable"),
    ({"state_names": ["s" * 65, "throttle"]}, "names"),
    ({"parity": {"tolerance": {"steering": 1e9, "throttle": 0}}}, "tolerance of steering"),
    ({"parity": {"tolerance": {"steering": 0}}}, "cover"),
    ({"engine": "onnxruntime"}, "another engine"),
]


def test_no_impossible_manifest_is_believed(artifacts, tmp_path):
    for values, message in MANIFESTS:
        refused(hostile(artifacts, tmp_path, {"manifest.json": manifest_with(**values)}), message)
    with Artifact(hostile(artifacts, tmp_path, {"manifest.json": manifest_with(state_names=["s" * 64, "t"])})) as whole:
        assert whole.manifest["state_names"] == ["s" * 64, "t"]
    for raw in (b"[" * 50_000, b"[]", b"\xff"):
        refused(hostile(artifacts, tmp_path, {"manifest.json": lambda _, raw=raw: raw}), "manifest is not")


def test_no_other_parity_vectors_are_read(artifacts, tmp_path):
    for change, message in (
        (lambda v: v["chunk"].fill(np.nan), "not finite"),
        (lambda v: v["chunk"].put(5, np.nan), "not finite"),  # one alone
        (lambda v: v["state"].put(1, np.inf), "not finite"),
        (lambda v: v.update(frame_cam_front=v["frame_cam_front"][:, :9]), "another shape"),
        (lambda v: v.update(state=v["state"].astype(float)), "another shape"),
        (lambda v: v.pop("state"), "not readable"),
        (lambda v: v.update(state=np.array([object], object)), "not readable"),  # a pickle
        (lambda v: v.update(state=np.zeros((10**6, 2), np.float32)), "too large"),
    ):
        refused(hostile(artifacts, tmp_path, {"parity.npz": vectors_with(change)}), message)


def test_names_that_look_like_torchs_counter_are_kept_in_the_content_hash(artifacts, tmp_path):
    """They were dropped from it, so that two programs could have one hash."""
    hashes = {content_hash(artifacts["static"])}
    for name in (b"x___torch_mangle_1", b"x___torch_mangle_2", b"x"):
        change = {".py": lambda raw, name=name: raw.replace(b"input", name, 1)}
        hashes.add(content_hash(rewritten(artifacts["static"], tmp_path / "other.pt", change)))
    assert len(hashes) == 4


def test_a_content_hash_by_hand(tmp_path):
    """By sha256sum: each name and a zero, then its record's digest, without torch's debug table, serial and counter."""
    name, digest = "a___torch_mangle_7", "cc03aae46f5b5005576df9b369348e518410ff96e636daffe9f53ca4517d8fd2"
    records = {
        "archive/version": "3",
        "archive/data.pkl": f"__torch__.{name} and x___torch_mangle_7",
        f"archive/code/__torch__/{name}.py": f"return __torch__.{name}",
        f"archive/code/__torch__/{name}.py.debug_pkl": "lines",
        "archive/.data/serialization_id": "12",
        "archive/constants.pkl": "c",
        "archive/extra/manifest.json": "{}",
        "archive/extra/parity.npz": "p",
    }
    with zipfile.ZipFile(tmp_path / "a.pt", "w") as z:
        for record, content in records.items():
            z.writestr(record, content)
    assert content_hash(tmp_path / "a.pt") == digest


def line_before_end(line: str):
    """Return an edit that inserts a line before the end of a program, whose answer is y."""

    def edit(source: bytes) -> bytes:
        if not source:  # torch also writes empty programs
            return source
        head, end = source.decode().rstrip().rsplit("    return ", 1)
        return f"{head}    y = {end}\n    {line}\n    return y\n".encode()

    return edit


@pytest.mark.slow
def test_a_program_that_writes_a_file_cannot_do_so_confined(artifacts, tmp_path, monkeypatch):
    path = hostile(artifacts, tmp_path, {".py": line_before_end(f'torch.save(1, "{HARM}")')})
    monkeypatch.chdir(tmp_path)
    assert peak_memory_alone_mb(path, threads=1) > 0
    assert not Path(HARM).exists()
    load = "import sys; from rover_lib.onboard import load_policy; load_policy(sys.argv[1])"
    subprocess.run([sys.executable, "-c", load, path], check=True)
    assert Path(HARM).exists()  # so the confinement prevented it


def test_what_a_program_prints_reaches_no_terminal(artifacts, tmp_path, capfd):
    said = "\\033[2J stopped, the human has the car"
    path = hostile(artifacts, tmp_path, {".py": line_before_end(f'print("{said}")')})
    with PolicyProcess(path, threads=1) as process:
        cameras = process.manifest["cameras"]
        process.predict(np.zeros((cameras[0]["height"], cameras[0]["width"], 3), np.uint8), np.zeros(2))
    assert peak_memory_alone_mb(path, threads=1) > 0
    assert capfd.readouterr() == ("", "")
    load_policy(path)  # by whoever made it
    assert "the human has the car" in capfd.readouterr().out


def test_an_answer_is_what_the_manifest_says(artifacts, tmp_path):
    for line, message in (
        ("y = torch.cat([y, torch.slice(y, 2, 0, 1)], 2)", "shape|must give"),
        ("y = torch.to(y, 7)", "float64"),
        ("y = torch.as_strided(y, [1, 32, 2], [64, 200, 1])", "do not run"),  # beyond the end
        ("y = torch.mul(y, 2)", "computes something else"),
    ):
        with pytest.raises(ArtifactError, match=message):
            load_policy(hostile(artifacts, tmp_path, {".py": line_before_end(line)}))


def test_root_loads_nothing_unless_there_is_nobody_else(artifacts, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.delenv("ROVER_AS_ROOT")
    with pytest.raises(ArtifactError, match="root"):
        load_policy(artifacts["static"])
