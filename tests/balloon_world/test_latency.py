"""Notebook 07's study: its rows, and its gate, which is of compensated drives."""

import pytest

from balloon_world import drives, latency
from balloon_world.drives import SEED
from balloon_world.latency import gates, table
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.stage import read_stage, sha256_of
from tests.helpers.worlds import Foresees, Seen


@pytest.fixture
def run_dir(tmp_path, monkeypatch):
    (tmp_path / "policy_static.pt").write_text("a policy")
    monkeypatch.setattr(latency, "content_hash", sha256_of)
    monkeypatch.setattr(drives, "load_policy", lambda path, threads: Foresees())
    monkeypatch.setattr(latency, "World", Seen)
    return tmp_path


HOW = {"worlds": 2, "latencies_ms": [0, 150, 600], "pushes": 2, "pushed_latencies_ms": [150]}


@pytest.mark.slow
def test_a_run_is_driven_in_each_way(run_dir):
    first = latency.measure_latencies(run_dir, **HOW)
    assert read_stage(run_dir / "drive.json", "drive") == first
    rows = [(r["latency_ms"], r["compensate"], r["pushes"]) for r in first["metrics"]["rows"]]
    calm = [(0, True), (150, True), (150, False), (600, True), (600, False)]
    assert rows == [(*c, 0) for c in calm] + [(150, True, 2), (150, False, 2)]
    fresh, stopped = first["metrics"]["rows"][0], first["metrics"]["rows"][3]
    assert (fresh["hits"], fresh["trials"], fresh["stopped"], fresh["plan_age_max_ms"]) == (2, 2, 0, 0)
    assert (stopped["hits"], stopped["stopped"]) == (0, 2)
    assert [g["passed"] for g in first["metrics"]["gates"]] == [None]  # two worlds show nothing
    assert "left alone, not compensated" in str(table(first))


def test_what_cannot_be_measured_is_refused(run_dir):
    for folder, worlds in ((run_dir, 0), (run_dir / "nothing", 1)):
        with pytest.raises(TrainingError):
            latency.measure_latencies(folder, worlds=worlds, latencies_ms=[0])


def test_the_map_is_of_the_level_that_was_driven(run_dir, monkeypatch):
    monkeypatch.setattr(latency, "load_policy", lambda path: Foresees())
    levels = []

    def drive(policy, world, latency_s, settings):
        levels.append(world.level.name)
        return drives.WorldDrive("hit", [])

    monkeypatch.setattr(latency, "drive_in", drive)
    monkeypatch.setattr(latency, "path_of", lambda world: world.seed)
    maps = latency.pushed_on_map(run_dir, latencies_ms=[150], pushes=2, worlds=1, level="hard")
    assert list(maps) == ["150 ms late"] and levels == ["hard"]


@pytest.mark.parametrize(
    ("missed_at", "passed"),
    [({0: 0, 150: 0}, True), ({0: 3, 150: 3}, True), ({0: 0, 150: 4}, None), ({0: 0, 150: 6}, False), ({30: 0}, None)],
)
def test_the_gate_is_of_compensated_drives_that_nobody_pushes(missed_at, passed):
    """In the same 200 worlds, pair by pair."""
    rows = []
    for ms, count in missed_at.items():
        calm = {"latency_ms": ms, "pushes": 0, "compensate": True, "trials": 200}
        calm["missed"] = [*range(SEED, SEED + count)]
        all_missed = {"missed": [*range(SEED, SEED + 200)]}
        rows += [calm, calm | all_missed | {"compensate": False}, calm | all_missed | {"pushes": 4}]
    (row,) = gates(rows, 2)
    assert (row["passed"], row["limit"]) == (passed, 2)
