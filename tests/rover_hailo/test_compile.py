"""compile.py of a kit, with a stand-in for Hailo's compiler: every call that it makes, and what it refuses."""

import importlib.metadata
import json
import shutil
import subprocess
import sys
import zipfile

import hailo_standin
import numpy as np
import pytest

from rover_hailo import compile as hailo_compile


@pytest.fixture
def kit(hailo_kit, tmp_path, monkeypatch):
    hailo_standin.install(monkeypatch)
    return shutil.copytree(hailo_kit, tmp_path / "kit")


@pytest.mark.parametrize("network", ["backbone", "whole"])
def test_compiles_checks_and_packs(kit, network, capsys):
    hef = hailo_compile.compile_network(kit, "hailo8", network)
    # the stand-in quantizes nothing: what it answers is FP32, from frames and states as they are calibrated with
    assert capsys.readouterr().out.count("differ from FP32 by 0.0%") == 1
    calibrated = hailo_standin.ClientRunner.calibrated
    frames = next(v for k, v in calibrated.items() if v.dtype == np.uint8)
    assert np.array_equal(frames, np.load(kit / "calibration_frame_cam_front.npy"))
    path = hailo_compile.pack(kit, "hailo8", network, hef)
    with zipfile.ZipFile(path) as z:
        assert z.read("archive/network.hef") == hef.read_bytes()
        assert ("archive/model.onnx" in z.namelist()) == (network == "backbone")
        manifest = json.loads(z.read("archive/extra/manifest.json"))
    assert manifest["hailo"]["chip"] == "hailo8"
    described = json.loads((kit / "kit.json").read_text())["networks"][network]
    assert manifest["parity"]["tolerance"] == described["tolerance"]


def test_a_layer_that_the_compiler_calls_otherwise_is_named(kit, monkeypatch):
    monkeypatch.setattr(hailo_standin.ClientRunner, "renamed", {"ew_add10": "ew_add21"})
    with pytest.raises(SystemExit, match=r"ew_add10 is to be 'add_9', which is whole/ew_add21 here"):
        hailo_compile.compile_network(kit, "hailo8", "whole")
    assert not (kit / "whole_hailo8.hef").exists()


def test_another_compiler_or_none_is_refused(kit, monkeypatch):
    with pytest.raises(SystemExit, match=r"wants the Dataflow Compiler 5.x, here is 3.33.0"):
        hailo_compile.compile_network(kit, "hailo10h", "backbone")

    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.version", missing)
    with pytest.raises(SystemExit, match="not installed in this Python"):
        hailo_compile.compile_network(kit, "hailo8", "backbone")


def test_an_emulator_far_from_fp32_is_said(kit, capsys):
    with np.load(kit / "expected_backbone.npz") as vectors:
        np.savez(kit / "expected_backbone.npz", **{k: v if v.dtype == np.uint8 else 2 * v for k, v in vectors.items()})
    hailo_compile.compile_network(kit, "hailo8", "backbone")
    assert "more than 3 times as far" in capsys.readouterr().out


def test_the_script_of_a_chip_runs_in_a_kit_alone(kit):
    """With nothing of the project to import: it ends where the compiler is missing."""
    shell = ["env", "-i", f"PATH={sys.exec_prefix}/bin:/usr/bin:/bin", "sh", "compile_hailo10h.sh", "whole"]
    done = subprocess.run(shell, cwd=kit, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "Dataflow Compiler is not installed" in done.stderr


def test_a_hef_that_is_not_there_costs_no_artifact(kit):
    (kit / "policy_whole_hailo8.hailo.zip").write_bytes(b"of yesterday")
    program = [sys.executable, "compile.py", "hailo8", "whole", "--hef", "nowhere.hef"]
    done = subprocess.run(program, cwd=kit, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (1, "nowhere.hef: no such file\n")
    assert (kit / "policy_whole_hailo8.hailo.zip").read_bytes() == b"of yesterday"
