"""The pipeline once: what the command line makes is what a run makes."""

import shutil
from types import SimpleNamespace

import pytest
from policies import memory_samples

from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.errors import ArtifactError, RoverError
from rover_lib.onboard.params import params
from rover_lib.workshop.int8.observe import calibrate
from rover_lib.workshop.int8.quantize import quantize
from rover_lib.workshop.run import pipeline
from rover_lib.workshop.run.pipeline import (
    Recipe,
    export_onnx,
    export_policies,
    make_artifact,
    requantize,
    write_quantize,
)
from rover_lib.workshop.run.session import Opened


@pytest.fixture
def loaded(tiny):
    parts = SimpleNamespace(calibration=tuple(memory_samples(4)), choosing=tuple(memory_samples(3, seed=1)))
    return Opened(tiny, None, parts)


def test_the_recipe_is_what_params_yml_says():
    p = params()
    recipe = Recipe.of(p)
    assert (recipe.samples, recipe.seed) == (p["calibration"]["samples"], p["calibration"]["seed"])
    assert (recipe.scheme.kind, recipe.scheme.smooth) == (p["quantization"]["scheme"], p["quantization"]["smooth"])
    assert (recipe.parity.tolerance, recipe.parity.vectors) == (p["parity"]["fp32"], p["parity"]["vectors"])
    assert Recipe.of(p, samples=7).samples == 7


@pytest.mark.slow
def test_one_artifact_is_the_one_of_a_run(loaded, tiny, tmp_path):
    recipe = Recipe.of(params())
    digest, warnings = make_artifact(loaded, tmp_path / "one.pt", recipe)
    assert warnings[0].startswith(f"asked for {recipe.samples} calibration samples")
    chosen, _ = recipe.choose(loaded.parts.calibration)
    calibration = calibrate(tiny, chosen, smooth=recipe.scheme.smooth)
    policies = {"static": quantize(tiny, recipe.scheme, calibration)}
    modes = export_policies(tmp_path, tiny, policies, calibration, loaded.parts.choosing, recipe.parity)
    assert modes["static"]["content_hash"] == digest == content_hash(tmp_path / "policy_static.pt")
    assert modes["static"]["scheme"]["mode"] == "static" and modes["static"]["int8_modules"] > 0


def test_a_run_whose_files_do_not_fit_each_other_gets_no_onnx_at_all(loaded, calibration, tmp_path, monkeypatch):
    """Not even the FP32 one, which would lie there beside a static policy that is another."""
    monkeypatch.setattr(pipeline, "open_run", lambda *_: loaded)
    calibration.save(tmp_path / "calibration.pt")
    (tmp_path / "policy_static.pt").write_bytes(b"of another run")
    write_quantize(tmp_path, loaded.checkpoint, {"modes": {"static": {"content_hash": "of this run"}}})
    before = sorted(tmp_path.iterdir())
    with pytest.raises(RoverError):
        export_onnx(tmp_path)
    assert sorted(tmp_path.iterdir()) == before


def test_another_calibration_is_not_taken_for_the_artifacts(tiny, artifacts, calibration, tmp_path):
    calibration.save(tmp_path / "calibration.pt")
    shutil.copy(artifacts["static"], tmp_path / "policy_static.pt")
    made = {"content_hash": content_hash(tmp_path / "policy_static.pt")}
    write_quantize(tmp_path, tiny, {"modes": {"static": made}})
    (tmp_path / "calibration.pt").write_bytes(b"another")
    with pytest.raises(ArtifactError, match="not those of quantize"):
        requantize(tmp_path, tiny)
