import numpy as np
import pytest

from balloon_world.world import DECOY_ASIDE_RAD, TIMEOUT_S, World, expert
from rover_lib.onboard.errors import TrainingError


def drive(world):
    """The expert drives to the end."""
    while not world.done:
        world.step(*expert(world))


def test_decoys_are_red_things_beside_the_way_and_change_nothing_else():
    for seed in range(5):
        plain, with_decoys = World(seed, 2), World(seed, 2, decoys=2)
        assert (plain.balloon, plain._shoves) == (with_decoys.balloon, with_decoys._shoves)
        *others, first, second = with_decoys.distractors
        assert tuple(others) == plain.distractors and first != second
        bearing = np.arctan2(plain.balloon.y_m, plain.balloon.x_m)
        for decoy in (first, second):
            assert decoy.kind in ("box", "cone") and decoy.colour[2] > 1.5 * max(decoy.colour[:2])
            assert abs(np.arctan2(decoy.y_m, decoy.x_m) - bearing) >= DECOY_ASIDE_RAD - 1e-9


def test_the_balloon_is_red_where_it_should_be():
    for seed in range(8):
        world = World(seed)
        distance, bearing = world.balloon_seen()
        column = int(320 - 400 * np.tan(bearing))
        row = int(125 - 400 * 0.04 / (distance * np.cos(bearing)))
        blue, green, red = world.render()[row, column].astype(int)
        assert red > 1.5 * max(blue, green), f"seed {seed}: {(blue, green, red)}"


@pytest.mark.parametrize("shoves", [0, 2])
@pytest.mark.slow
def test_the_expert_hits_almost_always(shoves):
    worlds = [World(50_000 + seed, shoves) for seed in range(60)]
    for world in worlds:
        drive(world)
    assert sum(w.hit for w in worlds) >= 57
    assert all(1.5 < w.state.time_s <= TIMEOUT_S for w in worlds)


def test_steering_lags_and_a_car_that_stands_hits_nothing():
    world = World(2)
    world.step(0.5, 0.0)
    assert 0 < world.state.steering < 0.2
    while not world.done:
        world.step(0.5, 0.0)
    assert world.state.steering == pytest.approx(0.5, abs=0.01)
    assert (world.state.x_m, world.state.y_m, world.outcome) == (0.0, 0.0, "timeout")


@pytest.mark.parametrize("action", [(np.nan, 0.0), (0.0, np.nan), (1.1, 0.0), (0.0, -0.1)])
def test_an_action_outside_its_range_and_what_has_ended_are_refused(action):
    world = World(1)
    with pytest.raises(TrainingError):
        world.step(*action)
    drive(world)
    with pytest.raises(TrainingError):
        world.step(0.0, 0.0)


@pytest.mark.parametrize(("left", "side"), [(None, -1), (1, 1), (-1, -1)])
def test_positive_steering_turns_to_the_cars_side(left, side):
    """The recorded car's is right; a policy of older recordings of this world drives a car that turns left."""
    world = World(3, left=left)
    for _ in range(30):
        world.step(0.5, 0.09)
    assert world.state.heading_rad * side > 0.1
    world = World(3, left=left)
    drive(world)
    assert world.hit
