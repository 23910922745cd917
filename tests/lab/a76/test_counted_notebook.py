"""Notebook 06: what was counted is drawn, and nothing counted is a sentence."""

import pytest
from executed import shown

from lab.a76 import report
from lab.params import lab_params
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop.run import run as runs

pytestmark = pytest.mark.slow  # each executes a notebook


def counted(fewer: float, **changed):
    """What arm.json says of an artifact, as far as the notebook reads it."""
    kernels = {"xnn_qs8_qc8w_gemm_minmax_fp32_ukernel_4x16c4__asm_aarch64_neondot_ld128": 1.2 * fewer, "other": 0.2}
    instructions_g = 1.2 * fewer + 0.2
    values = {"instructions_g": instructions_g, "simd_g": 1.0 * fewer, "floor_g": 0.94 * fewer, "gmac": 15.02 * fewer}
    values |= {"tenth_g": instructions_g, "peak_memory_mb": 300, "peak_memory_loading_mb": 300}
    values |= {"instructions_by_kernel": kernels, "sdot_by_kernel": {next(iter(kernels)): 0.9 * fewer}}
    values |= {"frames_on_the_core": 50, "reference": "policy_fp32"}
    errors = {f"{where}{action}_mae_pct": 0.1 for where in ("", "workstation_") for action in ("steering", "throttle")}
    return values | errors | changed


def test_counts_are_drawn(tmp_path):
    artifacts = {"policy_fp32": counted(4), "policy_static": counted(1)}
    peer = {key: value for key, value in counted(1.1).items() if key != "sdot_by_kernel"}
    metrics = {"label": report.LABEL, "artifacts": artifacts, "peers": {"another one": peer}}
    metrics["gates"] = report.gates(metrics, lab_params()["arm"]["gates"])
    write_stage(tmp_path / "arm.json", "arm", params={}, metrics=metrics)
    text = shown(runs.execute("06_arm", tmp_path))
    assert report.LABEL in text
    assert "teacher at 320x180" in text  # the computed times
    assert {p.stem for p in (tmp_path / "figures").glob("*.png")} == {"06_counted", "06_by_kernel"}


def test_nothing_counted_is_a_sentence(tmp_path):
    (tmp_path / "mine").mkdir()
    assert "make count NAME=mine counts" in shown(runs.execute("06_arm", tmp_path / "mine"))
    assert {p.name for p in (tmp_path / "mine").iterdir()} == {"06_arm.ipynb"}
    with pytest.raises(runs.RoverError, match="not found"):
        runs.execute("06_arm", tmp_path / "nothing")
