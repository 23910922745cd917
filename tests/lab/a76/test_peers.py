"""Other engines: what needs none of them is tested always, the engines themselves with ROVER_PEERS=1."""

import os
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import cv2
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
needs_engines = pytest.mark.skipif(
    os.environ.get("ROVER_PEERS") != "1" or bool(needs.QEMU_MISSING),
    reason="fetches 2 GB of other engines and takes minutes: ROVER_PEERS=1"
    + (f", and the Debian packages {' '.join(needs.QEMU_MISSING)}" if needs.QEMU_MISSING else ""),
)


@dataclass(frozen=True, eq=False)
class FileSample:
    """A recorded sample: the picture is in a file."""

    state: np.ndarray
    frame_path: Path
    row: int = 0
    episode: str = "memory"

    def frame_bgr(self) -> np.ndarray:
        return cv2.imread(str(self.frame_path))


def file_samples(folder: Path, count: int, seed: int) -> tuple[FileSample, ...]:
    samples = []
    for i, sample in enumerate(memory_samples(count, seed=seed)):
        path = folder / f"{seed}_{i:03d}.png"
        cv2.imwrite(str(path), sample.frame_bgr())
        samples.append(FileSample(sample.state, path))
    return tuple(samples)


@pytest.fixture(scope="module")
def tiny_run(tiny, tmp_path_factory) -> SimpleNamespace:
    """A run's folder with FP32 and static artifacts, and what session.opened would give of it."""
    folder = tmp_path_factory.mktemp("run")
    pictures = tmp_path_factory.mktemp("pictures")
    calibrating, held_out = file_samples(pictures, 16, seed=0), file_samples(pictures, 12, seed=1)
    calibration = calibrate(tiny, calibrating)
    calibration.save(folder / "calibration.pt")
    write_stage(folder / "calibrate.json", "calibrate", params={"samples": 16, "seed": 0, "smooth": 0.5}, metrics={})
    export(ACT(tiny.config, tiny.weights), tiny, folder / "policy_fp32.pt", samples=calibrating[:3])
    static = q.quantize(tiny, q.Scheme("static"), calibration)
    export(static, tiny, folder / "policy_static.pt", samples=calibrating[:3], calibration=calibration)
    parts = SimpleNamespace(calibration=calibrating, choosing=calibrating[:4], held_out=held_out)
    opened = SimpleNamespace(
        checkpoint=tiny, parts=parts, recordings=SimpleNamespace(action_range=lambda: dict(RANGES))
    )
    return SimpleNamespace(folder=folder, opened=opened)


def counted(chunks: np.ndarray, steady: int = 3_000_000) -> Counted:
    versions = {"threads": 1}
    return Counted(
        9,
        (5, 4, steady),
        2_000_000,
        1_000_000,
        2e6,
        500,
        200,
        {"k": (steady, 2, 1)},
        70.0,
        80.0,
        60.0,
        chunks,
        versions,
    )


def arm_json(folder: Path, **artifacts: dict) -> dict:
    metrics = {"label": LABEL, "artifacts": {"policy_fp32": {"instructions_g": 0.2}, **artifacts}, "gates": [1]}
    inputs = {"policy_fp32.pt": sha256_of(folder / "policy_fp32.pt")}
    return write_stage(folder / "arm.json", "arm", params={"frames": 6}, metrics=metrics, inputs=inputs)


# --- what needs no engine ---------------------------------------------------------------------------------------------


def test_a_peer_is_judged_by_its_distance_from_fp32(tiny_run):
    manifest = read_manifest(tiny_run.folder / "policy_fp32.pt")
    reference = np.random.default_rng(0).uniform(0.01, 0.09, (6, 32, 2)).astype(np.float32)
    off = reference + np.float32([0.02, -0.001])
    metrics = peers.peer_metrics(counted(off), manifest, reference, RANGES)
    assert metrics["steering_mae_pct"] == pytest.approx(2, rel=1e-4)  # of a range of 1
    assert metrics["throttle_mae_pct"] == pytest.approx(1, rel=1e-4)  # of a range of 0.1
    assert metrics["instructions_g"] == 0.003
    assert metrics["x_floor"] == pytest.approx(0.003 / (manifest["gmac"] / 16))
    assert (metrics["first_g"], metrics["peak_memory_mb"], metrics["threads"]) == (5e-9, 70.0, 1)
    beyond = peers.peer_metrics(counted(np.full_like(off, [1.5, -0.2])), manifest, np.full_like(off, [1, 0]), RANGES)
    assert beyond["steering_mae_pct"] == beyond["throttle_mae_pct"] == 0, "no pulse can say more"
    for wrong in (off[:, :16], np.where(off > 0.08, np.nan, off)):
        with pytest.raises(RoverError, match="a peer gave"):
            peers.peer_metrics(counted(wrong), manifest, reference, RANGES)


def test_as_many_layers_are_int8_as_in_ours(tiny, tiny_run):
    ours = q.quantize(tiny, q.Scheme("static"), q.Calibration.load(tiny_run.folder / "calibration.pt"))
    expected = peers.int8_layers(tiny)
    assert expected == ours.report["int8_modules"] > 20
    peers.check_int8("engine", {"int8_layers": expected, "float_layers": ["head"]}, expected)
    with pytest.raises(RoverError, match=rf"engine: 3 .* became INT8, and {expected} in ours; float are \['a', 'b'\]"):
        peers.check_int8("engine", {"int8_layers": 3, "float_layers": ["a", "b"]}, expected)


def test_counts_of_another_policy_are_refused(tmp_path):
    with pytest.raises(RoverError, match=r"arm\.json: not found; count the run's own artifacts first"):
        peers.count_peers(tmp_path)
    (tmp_path / "policy_fp32.pt").write_bytes(b"one")
    arm_json(tmp_path)
    (tmp_path / "policy_fp32.pt").write_bytes(b"another")
    with pytest.raises(RoverError, match=r"counted from another policy_fp32\.pt; count the run's own artifacts"):
        peers.count_peers(tmp_path)


# --- the engines ------------------------------------------------------------------------------------------------------


@needs_engines
def test_the_engines_run_the_policy_in_int8(users_cache, tiny, tiny_run, monkeypatch):
    monkeypatch.setattr(peers, "open_run", lambda run_dir: tiny_run.opened)
    machine, samples = prepare(), tiny_run.opened.parts.held_out[:6]
    ours = count_artifact(machine, tiny_run.folder / "policy_static.pt", samples, counted=3)
    fp32 = count_artifact(machine, tiny_run.folder / "policy_fp32.pt", samples, counted=3)
    manifest = read_manifest(tiny_run.folder / "policy_fp32.pt")
    metrics = {"artifacts": {"policy_fp32": artifact_metrics(fp32, manifest)}}
    inputs = {"policy_fp32.pt": sha256_of(tiny_run.folder / "policy_fp32.pt")}
    write_stage(tiny_run.folder / "arm.json", "arm", params={"frames": 6}, metrics=metrics, inputs=inputs)
    rows = peers.count_peers(tiny_run.folder, frames=6)["metrics"]["peers"]
    our_error = errors_pct(fp32.chunks, ours.chunks, manifest["action_names"], RANGES)  # throttle: all clipped to 0
    for engine in ENGINES:
        row = rows[engine.name]
        assert 0 < row["sdot_g"] < row["simd_g"] < row["instructions_g"] < fp32.steady / 1e9, engine.name
        assert row["sdot_g"] == pytest.approx(ours.sdot / 1e9, rel=0.1), "the same layers are INT8"
        assert sum(row["instructions_by_kernel"].values()) == pytest.approx(row["instructions_g"])
        assert any("loops with SDOT" in kernel for kernel in row["instructions_by_kernel"])
        assert row["int8_layers"] == peers.int8_layers(tiny)
        assert row["threads"] == 1
        assert 0 < row["steering_mae_pct"] < 5 * our_error["steering_mae_pct"], engine.name
        assert row["versions"][engine.name] in engine.guest_packages[0]
    assert rows["torch_affine"]["sdot_g"] == 0 < rows["torch_affine"]["steering_mae_pct"]
    made = {p.name: p.stat().st_mtime_ns for e in ENGINES for p in (tiny_run.folder / "peers").glob(f"{e.name}.*")}
    again = peers.count_peers(tiny_run.folder, frames=6)["metrics"]["peers"]
    assert made == {name: (tiny_run.folder / "peers" / name).stat().st_mtime_ns for name in made}
    for name, row in rows.items():
        assert again[name]["instructions_g"] == pytest.approx(row["instructions_g"], rel=0.01), name
