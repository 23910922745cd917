"""Where a plan leads, compared with the physics and camera of the balloon world, whose car is the default."""

from dataclasses import replace

import pytest

from balloon_world import world as w
from rover_lib.onboard.errors import ParamsError
from rover_lib.onboard.view.path_overlay import CarShape

SHAPE = CarShape.of()
STEP_S = 1 / w.RATE_HZ
ASPECT = w.FRAME_WIDTH / w.FRAME_HEIGHT


@pytest.mark.parametrize("steering", [-0.6, 0.0, 0.3, 1.0])
def test_the_track_is_the_worlds(steering):
    world = w.World(1)
    speed = 0.08 * w.SPEED_PER_THROTTLE_MPS
    world.state = replace(world.state, steering=steering, speed_mps=speed)  # it has driven like this for a while
    for _ in range(30):
        world.step(steering, 0.08)
    x, y, heading = SHAPE.track([(steering, 0.08)] * 30, STEP_S)[-1]
    state = world.state
    assert (x, y, heading) == pytest.approx((state.x_m, state.y_m, state.heading_rad), abs=1e-9)


def test_it_is_drawn_where_the_worlds_camera_sees_the_floor():
    ribbon = SHAPE.ribbon([(0.2, 0.09)] * 30, STEP_S, ASPECT)
    track = [p for p in SHAPE.track([(0.2, 0.09)] * 30, STEP_S) if p[0] > 0.2]
    assert len(ribbon) >= len(track) > 10
    for (x, y, _), (a, b, c, d) in zip(track[::-1], ribbon[::-1], strict=False):
        u, v = (a + c) / 2 * w.FRAME_WIDTH, (b + d) / 2 * w.FRAME_HEIGHT
        ahead = w.FOCAL_PX * w.CAMERA_HEIGHT_M / (v - w.HORIZON_ROW)
        left = (w.CENTRE_COLUMN - u) * w.CAMERA_HEIGHT_M / (v - w.HORIZON_ROW)
        assert (ahead, left) == pytest.approx((x, y), abs=0.02)
        assert a < c  # the left wheel's track is left of the right one's
    assert SHAPE.ribbon([(0.5, 0.0)] * 30, STEP_S, ASPECT) == []  # it stands


def test_a_car_needs_numbers_above_0():
    for horizon in ("high", float("nan"), 0):
        with pytest.raises(ParamsError):
            replace(SHAPE, horizon=horizon)
