"""Whether a policy looks or copies, by policies of which it is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import PolicyError
from rover_lib.workshop.judge.camera_use import FRAMES, look
from rover_lib.workshop.judge.compare import fidelity
from rover_lib.workshop.judge.recorded_range import follows

RANGE = {"steering": (-0.5, 0.5), "throttle": (0.0, 0.2)}
CHUNK = 4


class Known:
    """Plans `looks` times what is in the picture and `copies` times the state, both actions the same way."""

    chunk, action_names, car = CHUNK, ("steering", "throttle"), Car()

    def __init__(self, looks, copies):
        self.looks, self.copies, self.asked = looks, copies, 0

    def predict_chunk(self, frame_bgr, state):
        self.asked += 1
        seen = self.looks * frame_bgr[0, 0, :2] / 100 + self.copies * state
        return np.tile(seen.astype(np.float32), (CHUNK, 1))


def seen(k, state):
    """The k-th frame of a drive, which shows k."""
    drove = {"chunk": np.zeros((CHUNK, 2)), "is_pad": np.zeros(CHUNK, bool), "episode": "a", "row": k, "time_s": k / 30}
    return SimpleNamespace(frame_bgr=lambda: np.full((4, 6, 3), k, np.uint8), state=state, **drove)


def looked(policy, count=10, action_range=RANGE):
    """On samples of which the k-th shows k and was at k / 100."""
    report = fidelity(policy, {}, [seen(k, np.full(2, k / 100, np.float32)) for k in range(count)], action_range)
    policy.asked = 0
    return look(policy, report)


def test_how_far_a_plan_moves():
    """Of ten frames each is swapped with the one five away."""
    found = looked(Known(looks=0.4, copies=0.6))
    assert found.moved_pct["steering"] == pytest.approx({"by_picture": 2, "apart": 5, "by_100_ms": 0})
    summary = found.summary()
    assert summary["frames"] == 10 and summary["throttle_by_picture_pct"] == pytest.approx(10)
    assert found.warnings() == [] and "10.00 %" in str(found.table())
    policy = Known(1, 1)
    assert looked(policy, 200).frames == FRAMES and policy.asked == FRAMES  # it is cheap
    with pytest.raises(PolicyError):
        looked(policy, 1)  # one frame cannot be swapped


@pytest.mark.parametrize(
    ("policy", "says"),
    [
        (Known(looks=0.02, copies=1), "this policy ignores its camera"),
        (Known(looks=1, copies=0), None),  # of one that does not need its state nothing bad can be said
        (Known(looks=0, copies=0), "plans the same whatever it is shown"),
        (Known(looks=0.004, copies=0), "plans the same whatever it is shown"),  # it follows by 0.02 % of the range
        (Known(looks=np.array([1, 0]), copies=np.array([0.5, 1])), "throttle hardly follows the camera"),
    ],
)
def test_what_must_be_known_before_it_drives(policy, says):
    warnings = looked(policy).warnings()
    assert len(warnings) == (says is not None) and (says is None or says in warnings[0])


def test_how_far_a_plan_moves_if_its_picture_is_older():
    """The k-th frame shows k: a picture that is 33 ms older moves steering by 0.004, which is 0.4 % of its range."""
    turns, samples = Known(looks=np.array([0.4, 0]), copies=0), [seen(k, np.zeros(2)) for k in range(60)]
    found = look(turns, fidelity(turns, {}, samples[1::2], RANGE), samples)
    assert found.summary()["steering_by_100_ms_pct"] == pytest.approx(3 * 0.4)
    assert found.summary()["throttle_by_100_ms_pct"] == 0
    assert looked(turns).moved_pct["steering"]["by_100_ms"] == 0  # no older picture is known


def test_an_action_that_never_changes_is_not_judged():
    found = looked(Known(looks=np.array([1, 0]), copies=1), action_range=RANGE | {"throttle": (0.1, 0.1)})
    assert found.warnings() == [] and found.summary()["throttle_by_picture_pct"] is None
    assert "not judged" in str(found.table())


def test_a_plan_follows_what_moves_it_by_a_tenth_and_by_1_percent():
    assert follows(1.1, 10.0) and not follows(1.0, 5.0) and not follows(2.0, 20.0) and follows(2.1, 20.0)
