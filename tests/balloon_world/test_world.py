import numpy as np
import pytest

from balloon_world.level import EASY, HARD, level_named
from balloon_world.world import CAR_HALF_M, DECOY_ASIDE_RAD, FRAME_WIDTH, World, expert
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


@pytest.mark.parametrize(("level", "shoves", "least"), [(EASY, 0, 57), (EASY, 2, 57), (HARD, 0, 58)])
@pytest.mark.slow
def test_the_expert_hits_almost_always(level, shoves, least):
    worlds = [World(50_000 + seed, shoves, level=level) for seed in range(60)]
    for world in worlds:
        drive(world)
    assert sum(w.hit for w in worlds) >= least
    assert all(1 < w.state.time_s <= level.timeout_s for w in worlds)


def test_hard_hides_balloons_at_the_edge_and_pushes_a_slow_car_that_slips():
    """What hard has, some of its worlds have; what easy lacks, no world of it has."""
    hard = [World(seed, level=HARD) for seed in range(40)]
    easy = [World(seed) for seed in range(40)]
    for worlds, some in ((hard, True), (easy, False)):
        assert any(abs(w.balloon_seen()[1]) > EASY.bearing_rad for w in worlds) is some
        assert any(_is_partly_hidden(w) for w in worlds) is some
        assert any(w._glare is not None for w in worlds) is some
        assert any(w._slip_s > 0 and w._speed < 1 and w._steering != 1 for w in worlds) is some
        assert any(w._shoves for w in worlds) is some
        assert any(_is_red(t.colour) for w in worlds for t in w.distractors) is some
        assert any(w.solid for w in worlds) is some
    for w in hard:
        assert (w._wall[:, :FRAME_WIDTH] == w._wall[:, -FRAME_WIDTH:]).all()  # no spot appears as the car turns


def _is_partly_hidden(world):
    away, at = world.balloon_seen()
    for thing in world.distractors:
        near, aside = world.seen(thing)
        if near < away - 0.4 and abs(aside - at) < thing.radius_m / near + 0.5 * world.balloon.radius_m / away:
            return True
    return False


def _is_red(colour):
    blue, green, red = colour
    return red > 150 and blue < 60 and green < 50


def test_a_car_that_touches_what_is_solid_has_bumped():
    world = next(w for w in (World(seed, level=HARD) for seed in range(99)) if _is_partly_hidden(w))
    thing = min(world.solid, key=lambda t: world.seen(t)[0])
    while not world.done:
        world.step(world.left * float(np.clip(2 * world.seen(thing)[1], -1, 1)), 0.09)
    assert world.outcome == "bumped" and world.seen(thing)[0] < thing.radius_m + CAR_HALF_M


def test_another_level_is_refused():
    assert level_named("hard") is HARD
    with pytest.raises(TrainingError, match="easy, hard"):
        level_named("medium")


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
