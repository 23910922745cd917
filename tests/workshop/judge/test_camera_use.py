"""Whether a policy looks or copies, by policies of which it is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from policies import memory_samples

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import PolicyError
from rover_lib.workshop.judge.camera_use import FRAMES, look
from rover_lib.workshop.judge.compare import LerobotEager, fidelity

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


def samples(count):
    """The k-th shows k and was at k / 100."""
    return [
        SimpleNamespace(frame_bgr=lambda k=k: np.full((4, 6, 3), k, np.uint8), state=np.full(2, k / 100, np.float32))
        for k in range(count)
    ]


def looked(policy, count=10, action_range=RANGE, **options):
    report = fidelity(policy, {}, samples(count), action_range)
    policy.asked = 0
    return look(policy, report, **options)


def test_how_far_a_plan_moves():
    """Of ten frames each is swapped with the one five away."""
    found = looked(Known(looks=0.4, copies=0.6))
    assert found.by_picture == pytest.approx([0.02] * 2) and found.by_state == pytest.approx([0.03] * 2)
    assert found.apart == pytest.approx([0.05] * 2)
    expected = {"steering_by_picture_pct": 2, "throttle_by_state_pct": 15, "frames": 10}
    expected["steering_apart_us"] = 0.05 * found.report.us("steering")
    summary = found.summary()
    assert {key: summary[key] for key in expected} == pytest.approx(expected)
    assert found.warnings() == [] and "15.00 %" in str(found.table())
    policy = Known(1, 1)
    assert looked(policy, 200).frames == FRAMES and policy.asked == 2 * FRAMES  # it is cheap


@pytest.mark.parametrize(
    ("policy", "says"),
    [
        (Known(looks=0.02, copies=1), "this policy ignores its camera"),
        (Known(looks=1, copies=0), None),  # of one that does not need its state nothing bad can be said
        (Known(looks=0, copies=0), "plans the same whatever it is shown"),
        (Known(looks=0.004, copies=0), "plans the same whatever it is shown"),  # it follows by 0.02 % of the range
        (Known(looks=np.array([1, 0]), copies=np.array([0.5, 1])), "throttle hardly follows the camera"),
        (Known(looks=0.1, copies=0.5), "steering by 0.50 %"),
    ],
)
def test_what_must_be_known_before_it_drives(policy, says):
    warnings = looked(policy).warnings()
    assert len(warnings) == (says is not None) and (says is None or says in warnings[0])


def test_an_action_that_never_changes_is_not_judged():
    found = looked(Known(looks=np.array([1, 0]), copies=1), action_range=RANGE | {"throttle": (0.1, 0.1)})
    assert found.warnings() == [] and found.summary()["throttle_by_picture_pct"] is None
    assert "not judged" in str(found.table())
    with pytest.raises(PolicyError):
        looked(Known(1, 1), 1)  # one frame cannot be swapped


def test_an_act_without_its_image_projection_ignores_its_camera(tiny):
    """LeRobot's own policy, as it is and with the weights between picture and transformer at zero."""
    name = "encoder_img_feat_input_proj.weight"
    shown = memory_samples(6)
    found = {}
    for blind in (False, True):
        weights = tiny.weights | ({name: torch.zeros_like(tiny.weights[name])} if blind else {})
        policy = LerobotEager(replace(tiny, weights=weights))
        found[blind] = look(policy, fidelity(policy, {}, shown, RANGE))
    assert found[True].by_picture.max() < 1e-6 < found[True].by_state.max()
    assert "this policy ignores its camera" in found[True].warnings()[0]
    assert found[False].by_picture[0] > 1e-3  # this one's throttle is clipped to 0 whatever it sees
