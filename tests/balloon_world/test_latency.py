"""The car's loop in virtual time: against the expert, the arithmetic of plans' ages, and itself."""

import copy
import json
import math
import re
import zipfile
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from balloon_world import latency, side_by_side
from balloon_world.latency import Condition, beside_path, drive_late, from_above, gates, run_latencies, table
from balloon_world.world import World, expert
from rover_lib.cli import main
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.errors import PolicyError, WorldError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.run import run as runs

SETTINGS = Settings.of(params()["drive"])
CURVE = 10_003  # the balloon is 23 degrees aside


class Seen(World):
    """A policy is shown the world itself, not a picture of it: nothing is drawn, and the expert can plan."""

    def render(self):
        return copy.copy(self)


class Foresees:
    """Plans what the expert will do, and knows what it will see then."""

    rate_hz, chunk = 30.0, 32

    def __init__(self):
        self.shown = []  # (time of the frame, state, state of the car in it)

    def predict_unclipped(self, world, state):
        assert state.dtype == np.float32
        self.shown.append((world.state.time_s, state, world.state))
        world.trajectory, world.outcome = [], None
        plan = []
        for _ in range(self.chunk):
            plan.append(expert(world))
            if not world.done:
                world.step(*plan[-1])
        return np.array(plan, np.float32)


@pytest.fixture(autouse=True)
def seen(monkeypatch):
    monkeypatch.setattr(latency, "World", Seen)


def late(seconds, seed=CURVE, pushes=0, **settings):
    return drive_late(Foresees(), seed, Condition(seconds, replace(SETTINGS, **settings), pushes))


def ages_in_ticks(drive):
    return [round(30 * o.age_s, 6) for o in drive.orders]


def test_without_latency_the_loop_does_what_the_expert_does():
    world = World(CURVE)
    while not world.done:
        world.step(*expert(world))
    drive = late(0.0)
    assert drive.outcome == world.outcome == "hit"
    assert np.allclose(drive.trajectory.x_m, [s.x_m for s in world.trajectory], atol=1e-5)
    assert np.allclose(drive.trajectory.y_m, [s.y_m for s in world.trajectory], atol=1e-5)


@pytest.mark.parametrize("seconds", [0.075, 0.15, 0.3])
def test_compensation_keeps_the_car_nearer_to_the_path_without_latency(seconds):
    path = late(0.0)
    assert abs(path.trajectory.y_m[-1]) > 0.5  # a curve indeed
    assert beside_path(late(seconds), path) < 0.7 * beside_path(late(seconds, compensate=False), path)


def test_a_plan_that_takes_no_time_needs_no_compensation():
    assert beside_path(late(0.0), late(0.0, compensate=False)) == 0


@pytest.mark.parametrize(
    ("seconds", "first", "pattern"),
    [
        (0.0, 0, [0]),
        (0.030, 1, [1]),
        # ready 2.25 ticks after a look at frame 0, which is driven from tick 3 on; the next look is at frame 2, at once
        (0.075, 3, [3, 4, 3, 4, 3, 4, 3, 4, 5]),
        (0.3, 9, [9, 10, 11, 12, 13, 14, 15, 16, 17]),
    ],
)
def test_ages_of_plans_are_those_of_the_planner(seconds, first, pattern):
    ages = ages_in_ticks(late(seconds))
    assert ages[0] == first
    assert set(ages) == set(pattern)


def test_the_newest_frame_is_looked_at_as_soon_as_a_plan_is_ready():
    policy = Foresees()
    drive = drive_late(policy, CURVE, Condition(0.15, SETTINGS))
    looked_at = [round(30 * captured.captured_s) for captured, _ in drive.plans]
    assert looked_at[:7] == [0, 4, 9, 13, 18, 22, 27]  # every 4.5 ticks; every other time that frame is half a tick old
    latencies = [30 * plan.latency_s for plan, _ in drive.plans[:4]]
    assert latencies == pytest.approx([4.5, 5, 4.5, 5])


@pytest.mark.parametrize("seconds", [0.0, 0.075, 0.3])
def test_the_state_is_the_command_before_the_frame(seconds):
    policy = Foresees()
    drive_late(policy, CURVE, Condition(seconds, SETTINGS))
    assert len(policy.shown) > 5
    for _, state, car in policy.shown:
        assert state.tolist() == pytest.approx([car.steering_command, car.throttle_command], abs=1e-6)
    assert any(state.any() for _, state, _ in policy.shown)


def test_a_plan_that_grows_too_old_stops_the_car():
    drive = late(0.6)
    assert drive.outcome == "stopped"
    ages, throttles = ages_in_ticks(drive), [o.throttle for o in drive.orders]
    assert ages == list(range(18, 30))  # the limit of 1 s is 30 ticks
    assert throttles[-1] < 0.15 * max(throttles)  # it had faded before
    assert late(0.6, fade_s=0.8, stop_s=0.8).duration_s == pytest.approx(6 / 30)


def test_a_policy_that_never_answers_in_time_moves_nothing():
    drive = late(5.0)
    assert (drive.outcome, drive.orders, drive.duration_s) == ("stopped", [], 0.0)
    assert drive.trajectory.x_m.tolist() == [0.0]


def test_a_chunk_that_ends_sooner_than_the_limit_stops_the_car_there(monkeypatch):
    monkeypatch.setattr(Foresees, "chunk", 12)
    assert ages_in_ticks(late(0.3)) == [9, 10, 11]


class Fails(Foresees):
    def predict_unclipped(self, world, state):
        plan = super().predict_unclipped(world, state)
        return plan if len(self.shown) < 4 else plan * math.nan


def test_a_policy_that_fails_is_not_a_car_that_was_stopped():
    with pytest.raises(PolicyError, match="plan 4 is not finite"):
        drive_late(Fails(), CURVE, Condition(0.15, SETTINGS))
    with pytest.raises(PolicyError, match="plan 4 is not finite"):
        run_latencies([Fails()], [Condition(0.15, SETTINGS)], worlds=2)


def test_pushes_push():
    assert beside_path(late(0.0, pushes=3), late(0.0)) > 0.01


@pytest.mark.slow
def test_reports_are_of_the_seeds_and_do_not_depend_on_threads():
    conditions = [Condition(0.0, SETTINGS), Condition(0.15, SETTINGS, pushes=2), Condition(0.6, SETTINGS)]
    told = []

    def progress(items, desc, total):
        told.append((desc, total))
        return items

    one = run_latencies([Foresees()], conditions, worlds=4, seed=77, progress=progress)
    three = run_latencies([Foresees() for _ in range(3)], conditions, worlds=4, seed=77)
    assert told == [("driving", 12)]
    assert [r.condition for r in one] == conditions
    for a, b in zip(one, three, strict=True):
        assert [d.seed for d in a.per_world] == [77, 78, 79, 80]
        assert a.summary() == b.summary()
        for d, e in zip(a.per_world, b.per_world, strict=True):
            assert d.trajectory.x_m.tolist() == e.trajectory.x_m.tolist() and d.orders == e.orders
    calm, _, stopped = (r.summary() for r in one)
    assert (calm["hits"], calm["trials"], calm["stopped"], calm["plan_age_max_ms"]) == (4, 4, 0, 0)
    assert (stopped["hits"], stopped["stopped"], stopped["time_to_hit_p50_s"]) == (0, 4, None)
    assert stopped["hits_wilson_high"] == pytest.approx(0.4899, abs=1e-4)


def test_what_is_no_drive_is_refused():
    for seconds in (-0.1, math.nan, 6.0):
        with pytest.raises(WorldError, match="latency must be"):
            Condition(seconds, SETTINGS)
    for policies, worlds in (([], 1), ([Foresees()], 0)):
        with pytest.raises(WorldError, match="drives need"):
            run_latencies(policies, [Condition(0.0, SETTINGS)], worlds=worlds)


def test_plans_from_above_lead_where_the_car_went():
    condition = Condition(0.0, SETTINGS)
    drive = drive_late(Foresees(), CURVE, condition)
    shown = from_above(drive, condition)
    assert len(shown["plans"]) == len(drive.plans) > 50
    for plan in shown["plans"][::10]:
        apart = np.hypot(*(np.array(plan[k])[:, None] - np.array(shown[k]) for k in ("x_m", "y_m"))).min(1)
        assert len(plan["x_m"]) > 1 and apart.max() < 0.01  # 2 cm between the driven points
    assert json.loads(json.dumps(shown)) == shown and shown["outcome"] == "hit"


# --- a run's drive.json


def write_policy(folder, acts, serial="1"):
    with zipfile.ZipFile(folder / "policy_static.pt", "w") as z:
        z.writestr("archive/code/__torch__/policy.py", acts)
        z.writestr("archive/.data/serialization_id", serial)
        for name in ("version", "data.pkl", "constants.pkl", "extra/manifest.json", "extra/parity.npz"):
            z.writestr(f"archive/{name}", "not read here")


@pytest.fixture
def run_dir(tmp_path, monkeypatch):
    write_policy(tmp_path, "a policy")
    loaded = []
    monkeypatch.setattr(side_by_side, "load_policy", lambda path, threads: loaded.append(path) or Foresees())
    return SimpleNamespace(path=tmp_path, loaded=loaded)


HOW = {"worlds": 2, "latencies_ms": [0, 150, 600], "pushes": 2, "pushed_latencies_ms": [150], "shown_ms": 150}


@pytest.mark.slow
def test_a_run_is_measured_once_for_each_policy_and_question(run_dir):
    first = latency.measure_latencies(run_dir.path, **HOW)
    assert run_dir.loaded and read_stage(run_dir.path / "drive.json", "drive") == first
    rows = [(r["latency_ms"], r["compensate"], r["pushes"], r["ensemble"]) for r in first["metrics"]["rows"]]
    calm = [(0, True), (150, True), (150, False), (600, True), (600, False)]
    assert rows == [(*c, 0, None) for c in calm] + [(150, True, 2, None), (150, False, 2, None), (0, True, 0, 0.01)]
    assert [g["passed"] for g in first["metrics"]["gates"]] == [True]
    assert [d["compensate"] for d in first["metrics"]["from_above"]] == [True, False]
    run_dir.loaded.clear()
    assert latency.measure_latencies(run_dir.path, **HOW) == first and not run_dir.loaded
    latency.measure_latencies(run_dir.path, **HOW | {"worlds": 1})
    assert run_dir.loaded
    run_dir.loaded.clear()
    write_policy(run_dir.path, "a policy", serial="2")  # exported again: other bytes, the same policy
    latency.measure_latencies(run_dir.path, **HOW | {"worlds": 1})
    assert not run_dir.loaded
    write_policy(run_dir.path, "another policy")
    latency.measure_latencies(run_dir.path, **HOW | {"worlds": 1})
    assert run_dir.loaded


def test_what_cannot_be_measured_is_a_sentence(run_dir):
    with pytest.raises(WorldError, match="at least one"):
        latency.measure_latencies(run_dir.path, worlds=1, latencies_ms=[])
    with pytest.raises(WorldError, match=r"policy_static\.pt: not there"):
        latency.measure_latencies(run_dir.path / "nothing", worlds=1, latencies_ms=[0])


def rows(hits_at):
    return [
        {"latency_ms": ms, "pushes": 0, "ensemble": None, "compensate": compensate, "hits": hits, "trials": 40}
        for ms, hits in hits_at.items()
        for compensate, hits in ((False, 0), (True, hits))
    ] + [{"latency_ms": 150, "pushes": 4, "ensemble": None, "compensate": True, "hits": 0, "trials": 40}]


@pytest.mark.parametrize(
    ("hits_at", "lost", "passed"),
    [
        ({0: 40, 150: 38}, 2, True),
        ({0: 40, 150: 37}, 3, False),
        ({0: 36, 150: 40}, -4, True),
        ({0: 40, 30: 40}, None, None),
    ],
)
def test_the_gate_is_of_compensated_drives_that_nobody_pushes(hits_at, lost, passed):
    (row,) = gates(rows(hits_at), 2)
    assert (row["found"], row["passed"], row["limit"]) == (lost, passed, 2)


@pytest.mark.slow
def test_the_command_measures_again_and_prints_a_table(run_dir, monkeypatch):
    (run_dir.path / "drive.json").write_text("of another version")

    def execute(name, folder, worlds):
        assert name == "07_drive" and not (folder / "drive.json").exists()
        latency.measure_latencies(folder, **HOW | {"worlds": worlds})

    monkeypatch.setattr(runs, "execute", execute)
    result = CliRunner().invoke(main, ["world", "latency", str(run_dir.path), "--worlds", "1"])
    assert result.exit_code == 0, result.output
    assert re.search(r"^left alone, not compensated +600 ms +9\d\d ms +0 of 1 +1$", result.output, re.M)
    assert result.output.endswith("static hits lost at 150 ms: 0, at most 2: pass\n")
    assert result.output.rstrip("\n") == str(table(read_stage(run_dir.path / "drive.json", "drive")))
    result = CliRunner().invoke(main, ["world", "latency", str(run_dir.path), "--worlds", "1", "--json"])
    assert json.loads(result.output)["metrics"]["rows"][0]["trials"] == 1
