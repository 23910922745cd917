"""What is said about counts: gates, errors, shares of threads, notebook 06. Needs no emulator."""

import shutil

import numpy as np
import pytest

from lab import PARAMS
from lab.a76 import count as counting
from lab.a76 import report
from rover_lib.workshop.run import run as runs
from tests.helpers.executed import shown


def test_what_is_not_divided_over_the_threads_is_executed_by_one():
    assert report.alone_of({"xnn_qs8_igemm": 0.7, "sgemm_kernel_ARMV8": 0.1, "other": 0.2}) == pytest.approx(0.2)


def artifact(**changed):
    numbers = {
        "gmac": 15.02, "instructions_g": 1.4, "simd_g": 1.05, "tenth_g": 1.401, "peak_memory_mb": 450,
        "peak_memory_loading_mb": 550, "reference": "policy_fp32", "frames_on_the_core": 50, "steering_mae_pct": 0.1,
        "throttle_mae_pct": 0.2, "workstation_steering_mae_pct": 0.1, "workstation_throttle_mae_pct": 0.2,
    }  # fmt: skip
    return numbers | changed


def gates(**artifacts):
    rows = report.gates({"artifacts": artifacts}, PARAMS["arm"]["gates"])
    return {row["gate"]: row["passed"] for row in rows}


@pytest.mark.parametrize(
    ("changed", "failing"),
    [
        ({"instructions_g": 1.47, "tenth_g": 1.47}, "instructions_g"), ({"simd_g": 1.11}, "simd_g"),
        ({"workstation_steering_mae_pct": 0.0}, "error on the emulated core, times the workstation's"),
        ({"frames_on_the_core": 49}, "frames judged on the emulated core"),
        ({"tenth_g": 1.38}, "cost of the tenth plan against the third, %"),
        ({"peak_memory_mb": 501}, "peak_memory_mb"), ({"peak_memory_loading_mb": 601}, "peak_memory_loading_mb"),
    ],
)  # fmt: skip
def test_each_gate_can_fail(changed, failing):
    passed_by_gate = gates(policy_static=artifact(**changed), policy_fp32=artifact(), policy_dynamic=artifact())
    assert len(passed_by_gate) == 7
    assert [name for name, passed in passed_by_gate.items() if not passed] == [f"policy_static {failing}"]


def test_an_action_that_never_changes_is_not_judged():
    chunks = np.random.default_rng(0).uniform(0, 0.1, (2, 4, 5, 2)).astype(np.float32)
    ranges = {"steering": (-0.5, 0.5), "throttle": (0.0, 0.0)}
    errors = counting.errors_pct(*chunks, ("steering", "throttle"), ranges)
    assert errors["throttle_mae_pct"] is None
    assert errors["steering_mae_pct"] == pytest.approx(100 * np.abs(chunks[1] - chunks[0])[..., 0].mean(), rel=1e-4)
    still = artifact(throttle_mae_pct=None, workstation_throttle_mae_pct=None)
    assert gates(policy_static=still)["policy_static error on the emulated core, times the workstation's"] is True


# ---- notebook 06


@pytest.mark.slow
def test_counts_are_shown(tmp_path):
    shutil.copy(runs.NOTEBOOKS.parent / "results" / "full" / "arm.json", tmp_path)
    text = shown(runs.execute("06_arm", tmp_path))
    assert report.LABEL in text
    assert "teacher at 320x180" in text  # the computed times


@pytest.mark.slow
def test_nothing_counted_is_a_sentence(tmp_path):
    (tmp_path / "mine").mkdir()
    assert "make count NAME=mine counts" in shown(runs.execute("06_arm", tmp_path / "mine"))
    assert {p.name for p in (tmp_path / "mine").iterdir()} == {"06_arm.ipynb"}
    with pytest.raises(runs.RoverError, match="not found"):
        runs.execute("06_arm", tmp_path / "nothing")
