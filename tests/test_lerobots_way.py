"""LeRobot's own way, end to end and without a network: recordings, a dataset, lerobot-train, an artifact."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import load_policy
from rover_lib.workshop.run.pipeline import make_artifact
from rover_lib.workshop.run.session import load
from tests.helpers.command import rover
from tests.helpers.recorded import record_drives

TINY = ("--policy.chunk_size=32", "--policy.n_action_steps=32", "--policy.dim_model=64", "--policy.n_heads=4",
        "--policy.dim_feedforward=64", "--policy.n_encoder_layers=1", "--policy.n_vae_encoder_layers=1")  # fmt: skip


@pytest.mark.slow
def test_from_recordings_to_an_artifact(tmp_path, monkeypatch):
    dataset = tmp_path / "dataset"
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    done = rover("export-dataset", record_drives(tmp_path / "mine", drives=3, frames=40), dataset, "--size", "64x36")
    assert done.exit_code == 0, done.output
    subprocess.run([Path(sys.executable).with_name("rover"), "inspect", dataset], check=True)  # torch is loaded late
    words = ["--policy.type=act", "--policy.pretrained_backbone_weights=null", *TINY, "--policy.device=cpu"]
    words += ["--policy.push_to_hub=false", "--wandb.enable=false", "--num_workers=0", "--dataset.repo_id=local/mine"]
    words += [f"--dataset.root={dataset}", "--dataset.video_backend=pyav", f"--output_dir={tmp_path / 'train'}"]
    words += ["--steps=2", "--save_freq=2", "--batch_size=2"]
    train = [Path(sys.executable).with_name("lerobot-train"), *words]
    done = subprocess.run(train, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr[-2000:]
    words = json.loads(rover("inspect", tmp_path / "train", "--json").output)["checkpoint"]
    assert words["format"] == "lerobot" and words["normalisation"]["action"].startswith("output * (")
    artifact = tmp_path / "policy_static.pt"
    few = params() | {"calibration": {"samples": 6, "seed": 0}}
    make_artifact(load(tmp_path / "train/checkpoints/last", dataset), artifact, few)
    manifest = load_policy(artifact).manifest
    assert (manifest["mode"], manifest["rate_hz"], manifest["chunk"]) == ("static", 30, 32)
    assert manifest["cameras"] == [{"name": "cam_front", "height": 36, "width": 64}]
