"""The page's lines for several machines, with two worker processes of Dask, as a user's script."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.recorded import record_drives

ROOT = Path(__file__).resolve().parents[3]
FEW = "samples=samples, iterations=2, choosing_frames=2, held_out_frames=4, modes=['static'], worlds=0"


@pytest.mark.release
def test_two_workers_make_a_run_each(tmp_path, tiny_file):
    pytest.importorskip("distributed")
    (script,) = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / "notebooks.md").read_text(), re.M | re.S)
    assert "samples=samples)" in script and "[50, 100, 200]" in script
    script = script.replace("samples=samples", FEW).replace("[50, 100, 200]", "[6, 8]")
    (tmp_path / "batch.py").write_text(script)
    (tmp_path / "best_model.pth").symlink_to(tiny_file)
    record_drives(tmp_path / "episodes", drives=4, frames=40)
    command = [sys.executable, "-W", "ignore", "batch.py"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "ROVER_AS_ROOT": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert sorted(done.stdout.split()) == [str(tmp_path / "runs" / name) for name in ("n6", "n8")], done.stderr
    for samples in (6, 8):
        calibrated = json.loads((tmp_path / "runs" / f"n{samples}" / "calibrate.json").read_text())
        assert calibrated["params"]["samples"] == samples
        assert list((tmp_path / "runs" / f"n{samples}").glob("benchmark-*.json"))
