"""Worlds that a policy is shown as they are, and a policy that foresees them."""

import copy
import math

import numpy as np
import pytest

from balloon_world.world import World, expert


class Seen(World):
    """A policy is shown the world itself, not a picture of it: nothing is drawn, and the expert can plan."""

    def render(self):
        return copy.copy(self)


class Foresees:
    """Plans what the expert will do, and knows what it will see then. fails_at: the plan that is not finite."""

    rate_hz, chunk = 30.0, 32

    def __init__(self, fails_at=0):
        self.planned, self.fails_at = 0, fails_at

    def predict_unclipped(self, world, state):
        # the state is what was commanded before the frame
        assert state.tolist() == pytest.approx([world.state.steering_command, world.state.throttle_command], abs=1e-6)
        self.planned += 1
        world.trajectory, world.outcome = [], None
        plan = []
        for _ in range(self.chunk):
            plan.append(expert(world))
            if not world.done:
                world.step(*plan[-1])
        return np.array(plan, np.float32) * (math.nan if self.planned == self.fails_at else 1)
