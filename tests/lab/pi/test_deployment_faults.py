"""What the bench of broken deployments sees and judges, without a Pi: `make pi-fast` has those."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from lab.params import lab_params
from lab.pi import container_run
from lab.pi.deployment_bench import DeploymentBench, Line, line_of
from lab.pi.deployment_faults import FAULTS, wrong_rows
from lab.pi.emulation import EmulationError

GOOD = {"healthy": True, "status_true": True, "healed_by_rerun": True}


def test_every_fault_has_its_own_name_and_there_are_enough():
    names = [fault.name for fault in FAULTS]
    assert len(set(names)) == len(names) >= lab_params()["pi_fast"]["rows"]
    parts = "power cut", "disk", "flipped", "ssh lost", "wrong hash", "another torch", "parity", "lies", "at once"
    assert all(any(part in name for name in names) for part in parts)
    assert container_run.ONE_FAULT in names


STATUS = """
TASK [Show all rovers in one table] ****
ok: [rover1] => {
    "msg": [
        "rover        healthy  model         mode    since                 deg C throttled    free MB last drive",
        "rover1       yes      bae35bda44db  static  2026-11-21 20:43:22       ? ?            48391 never   inactive",
        "rover2       NO       none                  2026-11-21 20:43:22       ? ?            48391 never   inactive",
        "             no model: deploy one",
        "             release 0123: damaged",
        "nobody       does not answer"
    ]
}
"""


def test_a_rover_is_found_in_the_table():
    assert line_of(STATUS, "rover1") == Line(True, "bae35bda44db", "static", "")
    assert line_of(STATUS, "rover2") == Line(False, "none", "2026-11-21", "no model: deploy one; release 0123: damaged")
    with pytest.raises(EmulationError, match="no line of rover3"):
        line_of(STATUS, "rover3")


def test_what_is_not_well_is_said():
    rows = [{"fault": "a", **GOOD}, {"fault": "b", **GOOD, "healthy": False}, {"fault": "c", **GOOD, "error": "no Pi"}]
    assert wrong_rows(rows[:1], 1) == []
    assert wrong_rows(rows, 4) == [
        "c: no Pi",
        "b: the rover has no model that passes its parity vectors",
        "3 faults of a deployment were made, at least 4 are wanted",
    ]


def test_a_row_may_begin_with_no_release_but_the_one_in_use(tmp_path):
    bench = object.__new__(DeploymentBench)  # its making packs real artifacts
    bench.pi = SimpleNamespace(on=False, root=tmp_path)
    bench.artifacts = {"static": Path("a"), "mixed": Path("b")}
    bench.packed = {"static": {"name": "a" * 64}, "mixed": {"name": "b" * 64}}
    models = bench.state / "models"
    names = [letter * 64 for letter in "abc"]
    for name in names:
        (models / "releases" / name).mkdir(parents=True)
    (models / "current").symlink_to(f"releases/{names[0]}")
    bench.begin()
    assert sorted(p.name for p in (models / "releases").iterdir()) == names
    bench.begin(fresh=True)
    assert [p.name for p in (models / "releases").iterdir()] == names[:1]
    assert (bench.before, bench.target) == ("static", "mixed")
