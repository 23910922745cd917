"""`python -m research.gpu` measures a training by phase; tried on the CPU, by a tiny recipe, through the same code."""

import json

import pytest
from click.testing import CliRunner

from research import gpu
from tests.helpers.recorded import record_drives

TINY = "train: {small: {backbone_steps: 2, backbone_rounds: 1, transformer_steps: 3, together_steps: 2, "
TINY += "together_rounds: 1, batch: 4, transformer_batch: 4, together_batch: 2, samples: 40, feature_samples: 12, "
TINY += "judged: 8}}"


@pytest.mark.research
def test_each_phase_says_what_it_takes_and_the_weights_repeat(tmp_path, set_params, monkeypatch):
    set_params(TINY)
    monkeypatch.setattr(gpu, "REPEATED_STEPS", 6)
    monkeypatch.setattr(gpu, "STOPPED_AFTER", 1)
    out, episodes = tmp_path / "gpu.json", record_drives(tmp_path / "episodes")
    result = CliRunner().invoke(gpu.main, [str(out), str(episodes), "--device", "cpu", "--size", "small"])
    made = json.loads(out.read_text())
    assert result.exit_code == (1 if made["wrong"] else 0), result.output
    weights, took = made["rows"]["weights"], made["rows"]["phases"]
    phases = took["phases"]
    assert weights["differ"] == 0 and {"backbone", "transformer"} <= set(weights["resumed_at"])
    assert [phases[name]["steps"] for name in ("backbone", "transformer", "all together")] == [2, 3, 2]
    assert all(0 <= row["data_s"] <= row["s"] <= took["all_s"] for row in phases.values())
    assert 0 < took["before_s"] < took["all_s"] and made["device"].startswith("cpu")
