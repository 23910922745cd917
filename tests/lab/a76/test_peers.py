"""Other engines: what needs none of them is tested always, the engines themselves with ROVER_PEERS=1."""

import os
from types import SimpleNamespace

import needs
import numpy as np
import pytest
from policies import memory_samples

from lab.a76 import peers
from lab.a76.core import prepare
from lab.a76.count import Counted, count_artifact
from lab.a76.count_run import errors_pct
from lab.a76.peers import ENGINES
from lab.a76.report import LABEL, artifact_metrics
from rover_lib.onboard.artifact.manifest import read_manifest
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import sha256_of, write_stage
from rover_lib.workshop.act import ACT
from rover_lib.workshop.int8 import quantize as q
from rover_lib.workshop.int8.export import export
from rover_lib.workshop.int8.observe import calibrate

pytestmark = pytest.mark.emulated
RANGES = {"steering": (-0.5, 0.5), "throttle": (0.0, 0.1)}
FP32, STATIC = "policy_fp32.pt", "policy_static.pt"
needs_engines = pytest.mark.skipif(
    os.environ.get("ROVER_PEERS") != "1" or bool(needs.QEMU_MISSING),
    reason=f"fetches 2 GB of other engines: ROVER_PEERS=1, and Debian packages: {needs.QEMU_MISSING or 'none missing'}",
)


@pytest.fixture(scope="module")
def tiny_run(tiny, tmp_path_factory) -> SimpleNamespace:
    """A run's folder with FP32 and static artifacts, and what session.open_run would give of it."""
    folder, calibrating = tmp_path_factory.mktemp("run"), tuple(memory_samples(16))
    calibration = calibrate(tiny, calibrating)
    write_stage(folder / "calibrate.json", "calibrate", params={"samples": 16, "seed": 0, "smooth": 0.5}, metrics={})
    export(ACT(tiny.config, tiny.weights), tiny, folder / FP32, samples=calibrating[:3])
    static = q.quantize(tiny, q.Scheme("static"), calibration)
    export(static, tiny, folder / STATIC, samples=calibrating[:3], calibration=calibration)
    parts = SimpleNamespace(calibration=calibrating, held_out=memory_samples(12, seed=1))
    recordings = SimpleNamespace(action_range=lambda: dict(RANGES))
    opened = SimpleNamespace(checkpoint=tiny, parts=parts, recordings=recordings)
    return SimpleNamespace(folder=folder, opened=opened)


def counted(chunks: np.ndarray) -> Counted:
    steady = 3_000_000
    work = {"simd": 2_000_000, "cycles": 2e6, "near_lines": 500, "far_lines": 200}
    given = (9, (5, 4, steady), 1_000_000, work, {"k": (steady, 1)}, 70.0, 80.0)
    return Counted(*given, chunks, {"threads": 1})


def write_arm(folder, **rows) -> None:
    metrics = {"label": LABEL, "artifacts": rows, "gates": [1]}
    inputs = {FP32: sha256_of(folder / FP32)}
    write_stage(folder / "arm.json", "arm", params={"frames": 6}, metrics=metrics, inputs=inputs)


def test_a_peer_is_judged_by_its_distance_from_fp32(tiny_run):
    manifest = read_manifest(tiny_run.folder / FP32)
    reference = np.random.default_rng(0).uniform(0.01, 0.09, (6, 32, 2)).astype(np.float32)
    off = reference + np.float32([0.02, -0.001])
    metrics = peers.peer_metrics(counted(off), manifest, reference, RANGES)
    assert metrics["steering_mae_pct"] == pytest.approx(2, rel=1e-4)  # of a range of 1
    assert metrics["throttle_mae_pct"] == pytest.approx(1, rel=1e-4)  # of a range of 0.1
    assert metrics["x_floor"] == pytest.approx(0.003 / (manifest["gmac"] / 16))
    for wrong in (off[:, :16], np.where(off > 0.08, np.nan, off)):
        with pytest.raises(RoverError, match="a peer gave"):
            peers.peer_metrics(counted(wrong), manifest, reference, RANGES)


def test_counts_of_another_policy_are_refused(tmp_path):
    with pytest.raises(RoverError, match=r"arm\.json: not found"):
        peers.count_peers(tmp_path)
    (tmp_path / FP32).write_bytes(b"one")
    write_arm(tmp_path)
    (tmp_path / FP32).write_bytes(b"another")
    with pytest.raises(RoverError, match=r"counted from another policy_fp32\.pt"):
        peers.count_peers(tmp_path)


@needs_engines
def test_the_engines_run_the_policy_in_int8(users_cache, tiny, tiny_run, monkeypatch):
    monkeypatch.setattr(peers, "open_run", lambda run_dir: tiny_run.opened)
    machine, samples = prepare(), tiny_run.opened.parts.held_out[:6]
    ours, fp32 = (count_artifact(machine, tiny_run.folder / name, samples, counted=3) for name in (STATIC, FP32))
    manifest = read_manifest(tiny_run.folder / FP32)
    write_arm(tiny_run.folder, policy_fp32=artifact_metrics(fp32, manifest))
    rows = peers.count_peers(tiny_run.folder, frames=6)["metrics"]["peers"]
    our_error = errors_pct(fp32.chunks, ours.chunks, manifest["action_names"], RANGES)  # throttle: all clipped to 0
    for engine in ENGINES:
        row = rows[engine.name]
        assert 0 < row["sdot_g"] < row["simd_g"] < row["instructions_g"] < fp32.steady / 1e9, engine.name
        assert row["sdot_g"] == pytest.approx(ours.sdot / 1e9, rel=0.1), "the same layers are INT8"
        assert any("loops with SDOT" in kernel for kernel in row["instructions_by_kernel"])
        assert 0 < row["steering_mae_pct"] < 5 * our_error["steering_mae_pct"], engine.name
        assert row["versions"][engine.name] in engine.packages[0]
