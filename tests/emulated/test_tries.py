"""What was tried: each operation runs in the emulated Pi, and what was kept costs less than what it replaced."""

import needs
import pytest

from rover_lib.onboard.stage import read_stage
from rover_lib.workshop import tries

pytestmark = [pytest.mark.emulated, needs.qemu]


def test_what_was_kept_is_the_cheaper_way(tmp_path):
    content = tries.count_tries(tmp_path)
    assert read_stage(tmp_path / "tries.json", "tries") == content
    found = {(r["what"], r["how"]): r for r in content["metrics"]["tries"]}
    columns = found["first convolution", "7x1 over 24 channels"]
    plain = found["first convolution", "7x7 over 3 channels"]
    assert columns["kept"] and columns["instructions_m"] < 0.55 * plain["instructions_m"]
    # 64 channels of 57600 positions over 7 rows of 24: what the window and its idle pixel ask for, to the tile's edges
    assert columns["sdot_m"] == pytest.approx(64 * 57600 * 7 * 24 / 16 / 1e6, rel=0.001)
    for what in ("first convolution", "LayerNorm"):
        kept = next(r for (w, _), r in found.items() if w == what and r["kept"])
        whole = next((r for (w, h), r in found.items() if w == what and "whole windows" in h), None)
        extra = found["frame's windows", "7 rows of 8 pixels (for 1x1 over 168)"]["instructions_m"] if whole else 0
        others = [r["instructions_m"] + (extra if r is whole else 0) for (w, _), r in found.items() if w == what]
        assert kept["instructions_m"] <= 1.01 * min(others), what
    stars = [line for line in tries.table(content).splitlines() if line.startswith("  * ")]
    assert len(stars) == sum(r["kept"] for r in found.values())
