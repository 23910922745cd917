"""Artifacts for ONNX Runtime: the same policies as torch's, loaded, proven and deployed like them, without torch."""

import os
import subprocess
import sys

import numpy as np
import pytest
from archives import manifest_with, rewritten, vectors_with
from policies import memory_samples

from rover_lib.onboard import load_policy
from rover_lib.onboard.artifact.manifest import read_manifest
from rover_lib.onboard.drive.inference import PolicyProcess
from rover_lib.onboard.errors import ArtifactError

FRAME, STATE = np.full((360, 640, 3), 99, np.uint8), np.array([0.1, 0.2], np.float32)
HERE = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}


def refused(path) -> str:
    with pytest.raises(ArtifactError) as e:
        load_policy(path)
    assert str(path) in str(e.value) and "\n" not in str(e.value)
    return str(e.value)


def test_engines_agree(artifacts, onnx_static):
    """Nearer to each other than twice what INT8 costs."""
    fp32, static, onnx = (load_policy(p) for p in (artifacts["fp32"], artifacts["static"], onnx_static))
    observations = [(s.frame_bgr(), s.state) for s in memory_samples(6, seed=5)]
    exact, torchs, other = (np.stack([p.predict_chunk(*o) for o in observations]) for p in (fp32, static, onnx))
    assert np.abs(torchs - other).max() <= 2 * np.abs(torchs - exact).max()
    assert np.abs(other - exact).max() <= 1.5 * np.abs(torchs - exact).max()
    known = {k: v for k, v in static.manifest.items() if k not in ("engine", "versions", "parity")}
    assert onnx.manifest | known == onnx.manifest and onnx.manifest["engine"] == "onnxruntime"


def test_threads_can_be_chosen_later(onnx_static):
    policy = load_policy(onnx_static, threads=1)
    before = policy.predict_chunk(FRAME, STATE)
    policy.set_threads(2)
    assert policy.threads == 2 and np.array_equal(policy.predict_chunk(FRAME, STATE), before)


@pytest.mark.slow
def test_needs_no_torch(onnx_static):
    """Nor the package onnx: what drives imports neither, and what stages and proves a release does not either."""
    program = f"""
import sys
sys.modules |= dict.fromkeys(["torch", "onnx", "lerobot"])
import numpy as np
import rover_lib.onboard.cli, rover_lib.onboard.drive.drive
import rover_lib.onboard.care.benchmark, rover_lib.onboard.care.doctor
from rover_lib.onboard import load_policy
chunk = load_policy({str(onnx_static)!r}, threads=1).predict_chunk(np.full((360, 640, 3), 99, np.uint8), np.zeros(2))
assert chunk.shape == (32, 2) and np.isfinite(chunk).all()
print("drove")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=HERE)
    assert done.returncode == 0 and done.stdout.strip() == "drove", done.stderr


@pytest.mark.slow
def test_runs_confined_in_a_process_of_its_own(onnx_static):
    with PolicyProcess(onnx_static, threads=2) as process:
        assert process.unconfined == ""
        chunk = process.predict(FRAME, STATE)
    assert np.array_equal(chunk, load_policy(onnx_static).predict_unclipped(FRAME, STATE))


def test_refuses_what_is_not_proven(onnx_static, tmp_path):
    other = vectors_with(lambda vectors: vectors.update(chunk=vectors["chunk"] + 0.5))
    assert "differs by" in refused(rewritten(onnx_static, tmp_path / "a.zip", {"parity.npz": other}))
    camera = read_manifest(onnx_static)["cameras"][0] | {"name": "other"}
    path = rewritten(onnx_static, tmp_path / "b.zip", {"manifest.json": manifest_with(cameras=[camera])})
    assert "its model takes" in refused(path)
    path = rewritten(onnx_static, tmp_path / "c.zip", {"manifest.json": manifest_with(engine="qnnpack")})
    assert "names another engine" in refused(path)


def test_says_what_to_install(onnx_static, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.delitem(sys.modules, "rover_lib.onboard.policy.onnx_engine", raising=False)
    assert "install onnxruntime" in refused(onnx_static)
