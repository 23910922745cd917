"""What is familiar to a policy: the threshold, and the artifacts that carry it, in each engine."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard.artifact import manifest as artifact
from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.drive.inference import UNTOLD, PolicyProcess
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.policy.familiar import Familiar
from rover_lib.onboard.policy.load import load_policy
from rover_lib.workshop.act import ACT, inputs_of
from rover_lib.workshop.int8.export import Exporter, TorchScript
from rover_lib.workshop.int8.familiar import MARGIN, Drives, fit
from rover_lib.workshop.int8.quantize import quantize, with_embedding
from rover_lib.workshop.int8.scheme import Scheme
from tests.helpers.policies import MemorySample, memory_samples

NOISE = np.random.default_rng(5).integers(0, 256, (72, 128, 3), np.uint8)
MADE = ("policy_fp32.pt", "policy_static.pt", "policy_fp32.onnx.zip", "policy_static.onnx.zip")


@dataclass(frozen=True, eq=False)
class Timed(MemorySample):
    time_s: float = 0.0
    frame_name: str = "picture.jpg"
    decoded: list[int] = field(default_factory=list)

    def frame_bgr(self):
        self.decoded.append(1)
        return super().frame_bgr()


def drives_of(samples, each=2):
    """As a split: 12 of the samples calibrate, the others are held-out drives of `each` pictures, 0.1 s apart."""
    timed = [Timed(s.state, s.picture, i % each, str(i // each), time_s=i % each / 10) for i, s in enumerate(samples)]
    calibration = [replace(s, episode="calibration") for s in timed[:12]]
    return Drives.of(SimpleNamespace(calibration=calibration, choosing=(), held_out=timed[12:]))


@pytest.fixture(scope="module")
def made(thin, tmp_path_factory):
    """The thin policy in both modes for both engines, with what is familiar to it, and FP32 without."""
    (policy, calibration), folder = thin, tmp_path_factory.mktemp("familiar")
    exporter, drives = Exporter(policy, memory_samples(4, seed=1)), drives_of(memory_samples(12 + 2 * 19))
    for name in MADE:
        static = "static" in name
        module = quantize(policy, Scheme(), calibration) if static else ACT(policy.config, policy.weights)
        exporter.export(module, folder / name, calibration if static else None, drives)
    exporter.export(ACT(policy.config, policy.weights), folder / "without.pt")
    assert all(len(sample.decoded) == 1 for sample in drives.samples)  # not once more for each mode
    return folder


def test_of_new_drives_one_in_their_number_and_one_is_beyond_the_threshold():
    rng, beyond, fits = np.random.default_rng(0), 0, 400
    for _ in range(fits):
        seen = iter(rng.normal(size=(12 + 2 * 19, 6)).astype(np.float32))
        familiar, found = fit(drives_of(memory_samples(1) * (12 + 2 * 19)), lambda sample, seen=seen: next(seen))
        first, both = (familiar.strange(rng.normal(size=(n, 6)).astype(np.float32)) for n in (1, 1))
        beyond += max(first[0], (first[0] + both[0]) / 2) >= 1 / MARGIN
        assert found["drives"] == 19 and max(found["largest"].values()) == pytest.approx(1 / MARGIN)
    assert 0.025 < beyond / fits < 0.08  # 5 %
    ends_pct = found["stopped_low_pct"], found["stopped_high_pct"]
    assert np.allclose(ends_pct, (0.133, 17.647), atol=1e-3)  # scipy.stats.beta(1, 19).ppf


def test_too_few_drives_and_parts_of_a_drive_set_no_threshold(thin, tmp_path):
    policy, _ = thin
    few = drives_of(memory_samples(12 + 2 * 18))
    assert "18 drives" in few.warnings[0] and not drives_of(memory_samples(12 + 2 * 19)).warnings
    one = [Timed(s.state, s.picture, i, "one", time_s=i / 30) for i, s in enumerate(memory_samples(60))]
    assert not Drives.of(SimpleNamespace(calibration=one[:20], choosing=one[20:40], held_out=one[40:])).unseen
    module, exporter = ACT(policy.config, policy.weights), Exporter(policy, memory_samples(2))
    plain = exporter.export(module, tmp_path / "plain.pt")
    assert exporter.export(module, tmp_path / "few.pt", drives=few) == plain


def test_embeddings_are_those_that_the_artifact_gives(thin):
    """A float policy's come in batches, INT8's from a graph without a decoder."""
    (policy, calibration), samples = thin, memory_samples(11)
    for module in (ACT(policy.config, policy.weights), quantize(policy, Scheme(), calibration).module):
        found = Exporter(policy, samples)._embeddings(module, TorchScript, samples)
        whole = TorchScript(with_embedding(module), policy.config)
        for sample in samples:
            wanted = whole.run(inputs_of(sample, policy.config))[1][0].numpy()
            assert found[sample] == pytest.approx(wanted, abs=1e-5)


@pytest.mark.slow
def test_plans_stay_and_each_engine_and_mode_tells_the_same(made):
    state, (sample,) = np.zeros(2, np.float32), memory_samples(1)
    policies = {name: load_policy(made / name) for name in (*MADE, "without.pt")}
    plans = {name: policy.predict_unclipped(sample.picture, state) for name, policy in policies.items()}
    assert np.array_equal(plans["policy_fp32.pt"], plans["without.pt"])
    known = {name: policy.strange for name, policy in policies.items()}
    assert known.pop("without.pt") is None and max(known.values()) < 1
    assert known["policy_static.onnx.zip"] == pytest.approx(known["policy_static.pt"], abs=0.02)
    assert known["policy_fp32.onnx.zip"] == pytest.approx(known["policy_fp32.pt"], abs=1e-4)
    for name in MADE:
        policies[name].predict_unclipped(NOISE, state)
        assert policies[name].strange > 1.5
    with PolicyProcess(made / "policy_static.pt", threads=1) as process:
        assert process.predict(NOISE, state).shape == (process.chunk, 2)
        assert process.strange == pytest.approx(policies["policy_static.pt"].strange)
        whole = process._answer
        process._answer = lambda timeout_s: whole(timeout_s)[:-4] + np.float32(np.nan).tobytes()
        process.predict(NOISE, state)
        assert process.strange == UNTOLD  # stops, and JSON takes it


WIDE = {"wide": [1e30, 1e30], "one": [1.0, 1e30], "negative": [-1.0, -1.0], "zero": [0.0, 1.0]}
SO_WIDE = 6  # times as wide as they were made


@pytest.mark.parametrize(
    "change", ["embedding", "mean", "limits", "shape", "sizes", "unclaimed", "spread", "wider", *WIDE]
)
def test_a_false_claim_of_what_is_familiar_is_refused(made, tmp_path, monkeypatch, change):
    with Artifact(made / "policy_fp32.onnx.zip") as whole:
        manifest, vectors, model = dict(whole.manifest), dict(whole.parity), whole.record(artifact.ONNX)
    changed = {
        "embedding": {"embedding": vectors["embedding"] + 0.1},
        "mean": {"familiar_mean": np.full_like(vectors["familiar_mean"], np.nan)},
        "limits": {"familiar_limits": np.ones(3, np.float32)},
        "shape": {"familiar_directions": vectors["familiar_directions"].T},
        "spread": {"familiar_spread": -vectors["familiar_spread"]},
        "wider": {"familiar_limits": SO_WIDE * vectors["familiar_limits"]},
        **{name: {"familiar_limits": np.array(limits, np.float32)} for name, limits in WIDE.items()},
    }
    if change == "sizes":
        monkeypatch.setattr(artifact, "check_manifest", lambda *args: None)
        manifest["familiar"] = manifest["familiar"] | {"size": -1}
    if change == "unclaimed":
        del manifest["familiar"]
        vectors = {name: vectors[name] for name in vectors if name != "embedding" and "familiar" not in name}
    artifact.save_onnx(tmp_path / "p.zip", model, manifest, vectors | changed.get(change, {}))
    monkeypatch.undo()
    with pytest.raises(ArtifactError, match=r"unfamiliar|parity vector|sizes|another embedding|above 0"):
        load_policy(tmp_path / "p.zip")


def test_scores_by_hand():
    """Limits and scores are written and read by the same code; a slip in it would make the stop blind everywhere."""
    mean, directions = np.float32([1, 1, 0]), np.float32([[1, 0, 0], [0, 1, 0]])
    familiar = Familiar(mean, directions, np.float32([0.5, 2]), np.float32([4, 10]))
    embedding = np.float32([[4, 9, 12]])  # from the mean 3, 8 and 12: 6 and 4 standard deviations, and 12 left over
    assert familiar.scores(embedding) == pytest.approx(np.array([[np.sqrt((36 + 16) / 2), 12.0]]))
    assert familiar.strange(embedding) == pytest.approx([np.sqrt(26) / 4])  # 1.27 of the first limit, 1.2 of the other
    familiar.check_limits(embedding, "")
    for limits in ([4, 81], [35, 10]):  # of which they reach 12 / 81 and 5.1 / 35, less than 0.15
        familiar.limits = np.float32(limits)
        with pytest.raises(ArtifactError, match=r"0\.15 of a limit"):
            familiar.check_limits(embedding, "")


def test_a_fit_by_hand():
    """Two known pictures 3 apart, and held-out drives of one picture each that lie ever farther away."""
    drives = drives_of(memory_samples(1) * 31, each=1)
    embeddings = [3.0 * (i % 2) for i in range(12)] + [1.5 + 0.3 * k for k in range(1, 20)]
    at = dict(zip(drives.samples, embeddings, strict=True))
    familiar, found = fit(drives, lambda sample: np.float32([at[sample], 0]))
    assert familiar.mean == pytest.approx([1.5, 0]) and np.abs(familiar.directions) == pytest.approx(np.eye(1, 2))
    assert familiar.spread == pytest.approx([1.5])  # standard deviation of 0 and 3
    # The farthest drive, 19, is 5.7 from the mean, 3.8 standard deviations; a tenth more is the limit.
    assert familiar.limits[0] == pytest.approx(1.1 * 3.8)
    assert found["largest"]["21"] == pytest.approx(2.0 / 4.18) and found["drives"] == 19
