"""Artifacts for ONNX Runtime: the same policies as torch's, loaded, proven and deployed like them, without torch."""

import sys

import numpy as np
import pytest

from rover_lib.onboard import load_policy
from rover_lib.onboard.artifact.manifest import read_manifest
from rover_lib.onboard.errors import ArtifactError
from tests.helpers.archives import manifest_with, rewritten, vectors_with

FRAME, STATE = np.full((360, 640, 3), 99, np.uint8), np.array([0.1, 0.2], np.float32)


def test_refuses_what_is_not_proven(onnx_static, tmp_path):
    other = vectors_with(lambda vectors: vectors.update(chunk=vectors["chunk"] + 0.5))
    camera = read_manifest(onnx_static)["cameras"][0] | {"name": "other"}
    for change, message in (
        ({"parity.npz": other}, "differs by"),
        ({"manifest.json": manifest_with(cameras=[camera])}, "its model takes"),
        ({"manifest.json": manifest_with(engine="qnnpack")}, "names another engine"),
    ):
        with pytest.raises(ArtifactError, match=message):
            load_policy(rewritten(onnx_static, tmp_path / "a.zip", change))


def test_says_what_to_install(onnx_static, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.delitem(sys.modules, "rover_lib.onboard.policy.onnx_engine", raising=False)
    with pytest.raises(ArtifactError, match="install onnxruntime"):
        load_policy(onnx_static)
