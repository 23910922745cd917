"""The car's loop in virtual time: against the expert, the arithmetic of plans' ages, and itself."""

from dataclasses import replace

import numpy as np
import pytest

from balloon_world import drives
from balloon_world.drives import NoLog, TimedCar, drive_in, drive_missing, run_trials, wilson_interval
from balloon_world.world import World, expert
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.errors import PolicyError, TrainingError
from rover_lib.onboard.params import params
from tests.helpers.worlds import Foresees, Seen

SETTINGS = Settings.of(params()["drive"])
CURVE = 10_003  # the balloon is 23 degrees aside


class Strange(Foresees):
    """Finds all pictures from its third on strange."""

    strange = property(lambda self: 1.1 if self.planned > 2 else 0.5)


def late(seconds, pushes=0, policy=None, **settings):
    """A drive with plans that are late, and the places, (n, 2), where the car was."""
    world = Seen(CURVE, pushes)
    drive = drive_in(policy or Foresees(), world, seconds, replace(SETTINGS, **settings))
    return drive, np.array([(s.x_m, s.y_m) for s in world.trajectory])


def beside(path, other):
    """How far a path is from another one's places at most."""
    return np.linalg.norm(path[:, None] - other, axis=2).min(1).max()


def ages_in_ticks(drive):
    return [round(30 * o.age_s, 6) for o in drive.orders]


def test_without_latency_the_loop_does_what_the_expert_does():
    world = World(CURVE)
    while not world.done:
        world.step(*expert(world))
    drive, path = late(0.0)
    assert drive.outcome == world.outcome == "hit"
    assert np.allclose(path, [(s.x_m, s.y_m) for s in world.trajectory], atol=1e-5)
    assert beside(path, late(0.0, compensate=False)[1]) == 0  # nothing to compensate
    assert beside(late(0.0, pushes=3)[1], path) > 0.01


@pytest.mark.parametrize("seconds", [0.075, 0.3])
def test_compensation_keeps_the_car_nearer_to_the_path_without_latency(seconds):
    _, path = late(0.0)
    assert abs(path[-1, 1]) > 0.5  # a curve indeed
    assert beside(late(seconds)[1], path) < 0.7 * beside(late(seconds, compensate=False)[1], path)


@pytest.mark.parametrize(
    ("seconds", "first", "ages"),
    [
        (0.0, 0, {0}),
        (0.030, 1, {1}),
        # ready 2.25 ticks after a look at frame 0, which is driven from tick 3 on; the next look is at frame 2, at once
        (0.075, 3, {3, 4, 5}),
        (0.3, 9, set(range(9, 18))),
    ],
)
def test_ages_of_plans_are_those_of_the_planner(seconds, first, ages):
    found = ages_in_ticks(late(seconds)[0])
    assert found[0] == first and set(found) == ages


def test_a_plan_that_grows_too_old_stops_the_car(monkeypatch):
    drive, _ = late(0.6)
    assert (drive.outcome, ages_in_ticks(drive)) == ("stopped", list(range(18, 30)))  # the limit of 1 s is 30 ticks
    never, path = late(5.0)
    assert (never.outcome, never.orders, len(path)) == ("stopped", [], 1)
    monkeypatch.setattr(Foresees, "chunk", 12)
    assert ages_in_ticks(late(0.3)[0]) == [9, 10, 11]  # a chunk that ends sooner than the limit stops the car there


def test_a_place_that_is_unfamiliar_stops_the_car_but_for_who_judges_how_it_drives():
    assert TimedCar(Seen(CURVE), Strange(), 0.1).drive(SETTINGS, NoLog()).outcome == "stopped"
    assert late(0.1, policy=Strange())[0].outcome == "hit"


def test_a_policy_that_fails_is_not_a_car_that_was_stopped():
    with pytest.raises(PolicyError, match="plan 4"):
        late(0.15, policy=Foresees(fails_at=4))
    with pytest.raises(TrainingError, match="latency"):
        late(-0.1)


def test_a_kill_costs_the_drives_that_had_not_ended(tmp_path, monkeypatch):
    """Drives run on a thread for each policy, and their results do not depend on how many there are."""
    monkeypatch.setattr(drives, "load_policy", lambda artifact, threads: "a policy")
    asked, driven, path = [(how, seed) for how in ("alone", "pushed") for seed in range(4)], [], tmp_path / "d.jsonl"

    def one(policy, each):
        driven.append(each)
        return {"outcome": f"{each[0]} {each[1]}"}

    def dies(items, desc, total):
        for i, item in enumerate(items):
            if i == 3:
                raise KeyboardInterrupt
            yield item

    with pytest.raises(KeyboardInterrupt):
        drive_missing(None, asked, one, path, dies)
    with path.open("a") as file:
        file.write('\n{"how": "alone", "se')  # and tears a line
    driven.clear()
    found = drive_missing(None, asked, one, path)
    assert len(driven) == 8 - 3 and list(found) == asked
    assert all(row["outcome"] == f"{how} {seed}" for (how, seed), row in found.items())
    driven.clear()
    assert drive_missing(None, asked, one, path) == found and not driven


AHEAD = 21783  # in this world and the next two the balloon is straight ahead


class Constant:
    """Plans one action for ever."""

    chunk = 32

    def __init__(self, steering, throttle):
        self.action = np.array([steering, throttle], np.float32)
        self.states = []

    def predict_chunk(self, frame_bgr, state):
        assert frame_bgr.shape == (360, 640, 3)
        self.states.append(np.array(state))
        return np.tile(self.action, (self.chunk, 1))


# Newcombe 1998, Statistics in Medicine 17, table I, method 3 (Wilson's score); 40 of 40 and 0 of 40 by its formula.
@pytest.mark.parametrize(
    ("hits", "trials", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662), (0, 20, 0.0000, 0.1611), (1, 29, 0.0061, 0.1718), (40, 40, 0.9124, 1.0000),
    ],
)  # fmt: skip
def test_wilson_interval_equals_published_values(hits, trials, low, high):
    assert wilson_interval(hits, trials) == pytest.approx((low, high), abs=6e-5)


def test_hits_are_counted():
    report = run_trials(Constant(0.0, 0.05), worlds=4, seed=AHEAD - 1)
    assert (report.hits, report.trials) == (3, 4)


def test_the_state_is_the_action_before_and_neutral_at_the_start():
    policy = Constant(0.25, 0.03)
    run_trials(policy, worlds=1, replan_every=4)
    assert policy.states[0].tolist() == [0.0, 0.0]
    assert policy.states[0].dtype == np.float32
    assert all(s == pytest.approx([0.25, 0.03]) for s in policy.states[1:])


@pytest.mark.parametrize("wrong", [{"replan_every": 33}, {"worlds": 0}, {"steering": np.nan}])
def test_what_is_not_a_trial_is_refused(wrong):
    policy = Constant(wrong.pop("steering", 0.0), 0.0)
    with pytest.raises(TrainingError):
        run_trials(policy, **{"worlds": 1, **wrong})
